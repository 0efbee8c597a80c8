"""`barsight info` says what is in a recording."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console

from barsight.recording.info import describe_recording, stream_info
from barsight.recording.info_tables import print_info
from barsight.recording.open import open_recording
from recording_samples import START_NS, camera_yaml, mounts, real, stamps, write_euroc


def test_gaps_are_counted() -> None:
    steps = np.array([10, 10, 10, 16, 10, 40, 10, 15]) * 1_000_000
    info = stream_info("imu0", START_NS + np.concatenate([[0], np.cumsum(steps)]))
    assert (info.count, info.gaps) == (9, 2)
    assert info.longest_gap_s == 0.04
    assert info.rate_hz == 100
    assert info.duration_s == 0.121
    alone = stream_info("cam0", np.array([START_NS]))
    assert (alone.count, alone.gaps, alone.duration_s) == (1, 0, 0)
    assert np.isnan(alone.rate_hz)


def test_describe_and_print(tmp_path: Path) -> None:
    root = write_euroc(tmp_path / "a [b] c", 4)
    path = root / "mav0" / "cam1" / "data.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    (root / "mav0" / "cam0" / "data" / f"{stamps(4)[0]}.png").write_bytes(b"x")
    info = describe_recording(open_recording(root))
    assert info.pairs == 3
    assert [frame.stamp_ns for frame in info.dropped] == [stamps(4)[3]]
    assert info.first_refused == f"cam0/data/{stamps(4)[0]}.png is not a readable picture"
    assert [stream.name for stream in info.streams] == ["cam0", "cam1", "imu0", "crane0"]
    assert info.streams[2].rate_hz == 200
    assert info.calibration.timeshift_cam_imu_ms == -3.5
    assert abs(info.calibration.baseline_m - np.linalg.norm([0.12, 0.001, -0.002])) < 1e-9
    assert info.crane is not None
    assert info.crane.highest_m[0] == pytest.approx(0.3)
    assert [(p.profile, p.count) for p in info.laser] == [(0, 5), (3, 5)]
    console = Console(width=140, record=True, file=(tmp_path / "log").open("w"))
    print_info(info, console)
    text = console.export_text()
    console.file.close()
    for part in ("a [b] c", "cam1", "200.00", "cam0 only", "not a readable picture", "-3.500 ms"):
        assert part in text
    assert "120.02" in text


def test_odd_things_are_noted(tmp_path: Path) -> None:
    write_euroc(tmp_path, 8)
    for camera, matrix in enumerate(mounts()):
        text = yaml.safe_dump(camera_yaml(matrix, timeshift_cam_imu=-3.5))
        (tmp_path / "mav0" / f"cam{camera}" / "sensor.yaml").write_text(text)
    rows = [f"{k * 5_000_000},9,0,0,0,0,30" for k in range(10)]
    (tmp_path / "mav0" / "imu0" / "data.csv").write_text("\n".join(rows) + "\n")
    notes = " / ".join(describe_recording(open_recording(tmp_path)).notes)
    assert "30 m/s^2" in notes
    assert "not degrees/s" in notes
    assert "imu0 and cam0 have no time in common" in notes
    assert "timeshift_cam_imu is -3.5 s" in notes
    assert "not mm" not in notes
    assert "crane0 does not span the pictures: 0.00 s missing at the start, 0.20 s at the end" in notes


def test_pictures_that_are_not_there_are_noted(tmp_path: Path) -> None:
    write_euroc(tmp_path, 8)
    before = describe_recording(open_recording(tmp_path)).notes
    lost = sorted((tmp_path / "mav0" / "cam1" / "data").iterdir())[5]
    lost.unlink()
    note, *others = describe_recording(open_recording(tmp_path)).notes
    assert tuple(others) == before
    assert "refused: 1, first" in note and note.endswith(f"cam1/data/{lost.name}")


def test_a_crane_in_millimetres_is_noted(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    rows = [f"{stamp},35000.0,120.0,8500.0" for stamp in stamps(3)]
    (tmp_path / "mav0" / "crane0" / "data.csv").write_text("\n".join(rows) + "\n")
    notes = describe_recording(open_recording(tmp_path)).notes
    assert any("the crane is up to 35000 m away" in note for note in notes)


def test_no_picture_beyond_the_first_pair_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from barsight.recording import pairing

    calls = []
    decode = pairing.decode_gray
    monkeypatch.setattr(pairing, "decode_gray", lambda *given: calls.append(0) or decode(*given))
    describe_recording(open_recording(write_euroc(tmp_path, 6)))
    assert len(calls) == 2


def test_real_info() -> None:
    info = describe_recording(open_recording(real("yard_dev")))
    assert info.pairs == 19
    assert info.notes == ()
    assert info.first_refused is None
