"""`barsight calibrate check`: a yaw put between the cameras is found, and what can't be checked is said."""

import json
from pathlib import Path

import numpy as np
import pytest

from barsight.calibration.files.rig_file import write_rig_file
from barsight.cli.main import run
from barsight.motion.rig_check.self_calibration import turn_right_camera
from barsight.recording.open import open_recording


def test_a_turned_camera_is_found(data: Path, tmp_path: Path) -> None:
    rig = open_recording(data / "yard_dev").rig
    turn = np.deg2rad([0.05, 0.01, -0.03])
    write_rig_file(tmp_path / "old.yaml", turn_right_camera(rig, -turn))
    arguments = ["calibrate", "check", str(data / "yard_dev"), "-o", str(tmp_path / "check.json")]
    assert run([*arguments, "--recording.rig", str(tmp_path / "old.yaml")]) == 5
    check = json.loads((tmp_path / "check.json").read_text())
    lines = {line["name"]: line for line in check["lines"]}
    assert abs(lines["yaw"]["value"] - 0.01) < 0.003
    assert abs(lines["pitch"]["value"] - 0.05) < 0.003
    assert abs(lines["roll"]["value"] + 0.03) < 0.003
    assert lines["yaw"]["state"] == lines["pitch"]["state"] == check["state"] == "recalibrate"
    assert lines["yaw, rows minus travel"]["state"] == "good"
    page = (tmp_path / "check.html").read_text()
    assert '"rows-seen"' in page
    assert '"depth"' in page
    assert abs(lines["yaw"]["cost_mm"] + 1e3 * np.deg2rad(0.01) * check["range_m"] ** 2 / 0.5) < 6


def test_without_encoders_the_rows_are_checked(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["calibrate", "check", str(data / "kitti_odometry_a"), "--frames", "5"]
    assert run(words) == 5
    assert (
        "roll: rows are off by up to 0.18 px (0.3 are fine), depth by 9.5 mm at 8.1 m, which is assumed"
        in (capsys.readouterr().err)
    )
    assert run([*words, "--max-depth-error-mm", "40"]) == 0
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "no travel is known" in shown
    assert "not seen" in shown


@pytest.mark.parametrize(
    ("arguments", "code", "reason"),
    [
        (["nowhere"], 3, "no such file"),
        (["nowhere", "-o", "check.txt"], 4, "end its name in .json"),
        (["nowhere", "--range-m", "0"], 2, "must lie in 0.1...1000"),
        (["nowhere", "--frames", "0"], 2, "must be positive"),
        (["nowhere", "--max-depth-error-mm", "-1"], 2, "must be positive"),
    ],
)
def test_bad_input(arguments: list[str], code: int, reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        assert run(["calibrate", "check", *arguments]) == code
    except SystemExit as error:
        assert error.code == code
    assert reason in " ".join(capsys.readouterr().err.replace("│", " ").split())
