"""The paper: nothing of it is left out, its code exists, its method runs on stereo and IMU alone."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.cli.main import run
from barsight.core.pose import Pose
from barsight.core.records.pairs import StereoFrame
from barsight.core.records.sensor_samples import ImuSamples
from barsight.features.matching import hamming_distances
from barsight.motion.frame_to_frame.motion_trend import MotionTrend
from barsight.motion.settings import MotionSettings, make_estimator
from barsight.paper.checks import rotation_errors_deg
from barsight.paper.published import RELATIVE_TO_M, TARGET_SIZE, recomputed
from barsight.paper.registry import ENTRIES, FURTHER, PaperEntry, find_code
from barsight.paper.runs import FULL, QUICK
from motion_recordings import MemoryRecording, ideal_rig

WHOLE = {"equation": 20, "figure": 12, "table": 4, "conclusion": 5}
"""What the paper has."""


@pytest.mark.parametrize("kind", WHOLE)
def test_nothing_is_left_out(kind: str) -> None:
    assert [e.number for e in ENTRIES if e.kind == kind] == list(range(1, WHOLE[kind] + 1))


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: e.place)
def test_an_entry_names_code_that_exists(entry: PaperEntry) -> None:
    assert entry.code
    for name in entry.code:
        assert callable(find_code(name))
    assert entry.paper and entry.ours
    assert entry.command.startswith("barsight ")


@pytest.mark.parametrize(
    "command", sorted({entry.command for entry in ENTRIES} | {row[1] for row in FURTHER})
)
def test_a_command_and_its_options_exist(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Names of the command up to its first argument, and each option in its help."""
    words = command.split()[1:]
    named = [word for word in words if word.islower() and not word.startswith("-")][:2]
    name = named if named[0] in ("bench", "calibrate") else named[:1]
    with pytest.raises(SystemExit) as ended:
        run([*name, "--help"])
    assert ended.value.code == 0
    told = capsys.readouterr().out
    for word in words:
        assert not word.startswith("-") or word in told, word


def test_a_name_without_code_is_found() -> None:
    with pytest.raises(AttributeError):
        find_code("paper.checks:no_such_thing")


def test_the_misprints_of_table_1() -> None:
    """The errata's row, 3000 mm: the only one whose printed errors are wrong."""
    wrong = {row[0] for row in TARGET_SIZE for k in (1, 3, 5) if abs(recomputed(row[k]) - row[k + 1]) > 0.02}
    assert wrong == {3000}
    assert round(recomputed(89.978), 2) == 0.02
    assert round(recomputed(93.608), 2) == 4.01
    assert abs(9.82 / 2.6 - RELATIVE_TO_M) < 0.01
    assert abs(17.73 / 4.7 - RELATIVE_TO_M) < 0.01


def test_the_printed_rotation_is_the_transpose() -> None:
    printed, corrected = rotation_errors_deg(10.0)
    assert abs(printed - 20) < 1e-6
    assert corrected < 1e-6


def test_hamming_distances_count_bits() -> None:
    first, second = np.random.default_rng(6).integers(0, 256, (2, 30, 32), dtype=np.uint8)
    slow = [bin(int.from_bytes(a.tobytes()) ^ int.from_bytes(b.tobytes())).count("1")
            for a, b in zip(first, second, strict=True)]  # fmt: skip
    assert hamming_distances(first, second).tolist() == slow


def test_the_trend_follows_a_known_motion() -> None:
    """A body at rest for 2 s, then accelerating and turning: the way of each step to 2 mm, the turn to
    0.01 degrees.
    """
    t = np.arange(0, 6, 0.005)
    going = np.maximum(t - 2, 0)
    rate, push = np.where(t > 2, 0.02, 0.0), np.where(t > 2, 0.3, 0.0)
    angle = 0.02 * going
    gyro = np.column_stack([0 * t, 0 * t, rate]) + np.array([0.004, -0.002, 0.003])
    force = np.column_stack([push * np.cos(angle), -push * np.sin(angle), np.full_like(t, 9.80665)])
    rng = np.random.default_rng(1)
    imu = ImuSamples(np.round(t * 1e9).astype(np.int64), gyro, force + rng.normal(0, 1e-3, force.shape))
    stamps = tuple(int(s * 1e9) for s in (1.8, 2.6, 3.4, 4.2, 5.0))
    trend = MotionTrend(imu, MemoryRecording(ideal_rig(), stamps_ns=stamps, imu_samples=imu))
    last: Pose | None = None
    for stamp in stamps:
        past = max(stamp / 1e9 - 2, 0)
        turn = Rotation.from_euler("z", 0.02 * past)
        pose = Pose("world", "body", turn.as_matrix(), np.array([0.15 * past**2, 0, 0]))
        found = trend.predict(stamp)
        trend.correct(stamp, pose)
        if last is not None:
            true = last.inverse() @ pose
            assert found is not None
            assert np.abs(found.translation - true.translation).max() < 0.002
            off = Rotation.from_matrix(found.rotation.T @ true.rotation).magnitude()
            assert np.degrees(off) < 0.01
        last = pose


def test_the_paper_needs_no_encoders() -> None:
    """Without IMU and encoders nothing is predicted; the estimator still begins."""
    foreign = StereoFrame(1, *np.random.default_rng(0).integers(0, 256, (2, 240, 320), dtype=np.uint8))
    source = MemoryRecording(ideal_rig(), (foreign,))
    estimator = make_estimator(MotionSettings(estimator="paper"))
    poses = estimator.begin(source, Rectifier(source.rig))
    assert poses.finish().sensors == ("stereo",)


def test_the_scales_say_what_they_draw() -> None:
    assert FULL.recording().length_m == 35
    assert FULL.recording().frames == 100
    assert QUICK.recording().length_m == 10


def test_a_missing_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert run(["paper", "-o", str(out), "--recording", str(tmp_path / "none")]) == 3
    assert "no such recording" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_the_quick_page(tmp_path: Path) -> None:
    """Every entry has its place on the page, which loads nothing from elsewhere."""
    assert run(["paper", "--quick", "-o", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "paper.html").read_text(encoding="utf-8")
    for entry in ENTRIES:
        part = page.split(f'<article id="{entry.place}">')[1].split("</article>")[0]
        assert entry.kind != "figure" or "<img" in part or "<table" in part
        assert entry.kind != "table" or "<table" in part
        assert entry.kind != "conclusion" or "<strong>Measured:</strong>" in part
    assert 'src="http' not in page
