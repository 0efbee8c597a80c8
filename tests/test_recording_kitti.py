"""KITTI's odometry layout, and the variant with bare lines and no times."""

from pathlib import Path

import numpy as np
import pytest

from barsight.core.errors import CalibrationError, InputError
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.recording.open import open_recording
from recording_samples import HEIGHT, WIDTH, picture, png, real

LEFT = "60 0 31 0 0 60 23 0 0 0 1 0"
RIGHT = "60 0 31 -30 0 60 23 0 0 0 1 0"
TIMES = "0.000000e+00\n1.036224e-01\n2.072434e-01\n"


def write_kitti(root: Path, *, standard: bool = True, colour: bool = False) -> Path:
    names = ("image_2", "image_3") if colour else ("image_0", "image_1")
    names = names if standard else ("image_l", "image_r")
    for side, name in enumerate(names):
        (root / name).mkdir()
        for k in range(3):
            (root / name / f"{k:06d}.png").write_bytes(png(picture(10 * k + side)))
    if standard:
        lines = [f"P0: {LEFT}", f"P1: {RIGHT}", f"P2: {LEFT}", f"P3: {RIGHT}", "Tr: 1 0 0"]
        (root / "times.txt").write_text(TIMES)
    else:
        lines = [LEFT, RIGHT]
    (root / "calib.txt").write_text("\n".join(lines) + "\n")
    return root


@pytest.mark.parametrize("colour", [False, True])
def test_standard_layout(tmp_path: Path, colour: bool) -> None:
    recording = open_recording(write_kitti(tmp_path, colour=colour))
    assert recording.format == "kitti"
    assert recording.index.stamps_ns == (0, 103_622_400, 207_243_400)
    assert recording.notes == ()
    rig = recording.rig
    assert rig.baseline_m == 0.5
    assert (rig.cam0.width, rig.cam0.height, rig.cam0.fx_px, rig.cam0.cx_px) == (WIDTH, HEIGHT, 60, 31)
    np.testing.assert_array_equal(rig.body_from_cam0.matrix, np.eye(4))
    frames = list(recording.frames())
    assert isinstance(frames[1], StereoFrame)
    np.testing.assert_array_equal(frames[1].right, picture(11))
    assert (recording.imu(), recording.crane(), recording.laser()) == (None, None, ())
    assert set(recording.digests()) == {"calib.txt", "times.txt"}


def test_bare_layout_assumes_ten_pictures_per_second_and_says_so(tmp_path: Path) -> None:
    recording = open_recording(write_kitti(tmp_path, standard=False))
    assert recording.index.stamps_ns == (0, 100_000_000, 200_000_000)
    assert "10 pictures per second are assumed" in recording.notes[0]
    assert recording.rig.baseline_m == 0.5


def test_a_reference_camera_elsewhere(tmp_path: Path) -> None:
    """P = K [I | t] of both cameras against a third one, as KITTI's colour cameras have."""
    write_kitti(tmp_path, colour=True)
    left, right = "60 0 31 12 0 60 23 -1 0 0 1 0.02", "60 0 31 -30 0 60 23 2 0 0 1 0.02"
    (tmp_path / "calib.txt").write_text(f"P2: {left}\nP3: {right}\n")
    place = open_recording(tmp_path).rig.cam0_from_cam1
    np.testing.assert_allclose(place.translation, [0.7, -0.05, 0.0], atol=1e-12)


def test_a_missing_and_a_torn_picture(tmp_path: Path) -> None:
    write_kitti(tmp_path)
    (tmp_path / "image_0" / "000000.png").write_bytes(b"")
    (tmp_path / "image_1" / "000001.png").unlink()
    recording = open_recording(tmp_path)
    assert len(recording.index.stamps_ns) == 2
    assert recording.index.unpaired[0].stamp_ns == 103_622_400
    first, second = recording.frames()
    assert isinstance(first, RefusedFrame)
    assert first.reason == "image_0/000000.png is empty"
    assert isinstance(second, StereoFrame)


@pytest.mark.parametrize(
    ("name", "text", "kind", "message"),
    [
        ("calib.txt", "P0: 1 2 3\n", CalibrationError, "line 1: expected 12 numbers in range"),
        ("calib.txt", f"P0: {LEFT}\n\nP1: {RIGHT} x\n", CalibrationError, "line 3: holds something"),
        ("calib.txt", f"P0: {LEFT}\n", CalibrationError, "has no lines `P0:` and `P1:`"),
        ("calib.txt", f"P0: {LEFT}\nP1: {LEFT}\n", CalibrationError, "the baseline is zero"),
        ("calib.txt", f"P0: {RIGHT}\nP1: {LEFT}\n", CalibrationError, "left and right are swapped"),
        ("calib.txt", f"P0: -{LEFT}\nP1: {RIGHT}\n", CalibrationError, "must be positive"),
        ("times.txt", "0\n", InputError, "has 1 lines, but there is a picture 000002.png"),
        ("times.txt", "0\nsoon\n2\n", InputError, "line 2: 'soon' is not a time"),
        ("times.txt", "0\n0.2\n0.1\n", InputError, "line 3: .*goes back in time"),
        ("times.txt", "0\ninf\n2\n", InputError, "line 2"),
        ("times.txt", "\n", InputError, "has no rows"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    tmp_path: Path, name: str, text: str, kind: type[InputError], message: str
) -> None:
    write_kitti(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(kind, match=message) as caught:
        open_recording(tmp_path)
    assert name in str(caught.value)
    assert caught.value.remedy


def test_folders_that_are_not_there(tmp_path: Path) -> None:
    write_kitti(tmp_path)
    (tmp_path / "calib.txt").unlink()
    with pytest.raises(CalibrationError, match=r"calib\.txt: no such file"):
        open_recording(tmp_path)
    (tmp_path / "image_1").rename(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="has image_0 but no image_1"):
        open_recording(tmp_path)
    (tmp_path / "calib.txt").write_text("")
    (tmp_path / "image_0").rename(tmp_path / "images")
    with pytest.raises(InputError, match="no folder image_0"):
        open_recording(tmp_path)


def test_real_kitti() -> None:
    recording = open_recording(real("kitti_odometry_a"))
    assert len(recording.index.stamps_ns) == 41
    assert abs(recording.rig.baseline_m - 379.8145 / 707.0912) < 1e-12
    assert all(isinstance(frame, StereoFrame) for frame in recording.frames())
