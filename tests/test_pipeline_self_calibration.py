"""A yaw put between the cameras of simulated travel: warned of, and taken off by --self-calibrate yaw."""

import json
from pathlib import Path

import numpy as np
import pytest

from barsight.calibration.files.rig_file import write_rig_file
from barsight.cli.main import run
from barsight.evaluation.score import score_folder
from barsight.motion.rig_check.self_calibration import turn_right_camera
from barsight.recording.open import open_recording

YARD = (
    "--length", "3", "--frames", "10", "--seed", "2", "--yard.max-layers", "3",
    "--camera.width-px", "640", "--camera.height-px", "512", "--camera.focal-px", "625",
)  # fmt: skip


@pytest.mark.slow
def test_the_height_bias_of_a_yaw_falls_to_a_fifth(tmp_path: Path) -> None:
    recording = tmp_path / "yard"
    assert run(["simulate", str(recording), *YARD]) == 0
    turn = np.array([0.0, np.deg2rad(0.01), 0.0])
    write_rig_file(tmp_path / "old.yaml", turn_right_camera(open_recording(recording).rig, -turn))
    turned = ["--recording.rig", str(tmp_path / "old.yaml")]
    bias, warnings = {}, {}
    for name, more in (("true", []), ("old", turned), ("mended", [*turned, "--self-calibrate", "yaw"])):
        out = tmp_path / name
        assert run(["measure", str(recording), "-o", str(out), "--stereo.method", "sgbm", *more]) == 0
        bias[name] = score_folder(recording, out)["height, smooth stack"]["bias_mm"]
        warnings[name] = {w["code"] for w in json.loads((out / "result.json").read_text())["warnings"]}
    assert bias["old"] - bias["true"] > 10
    assert abs(bias["mended"] - bias["true"]) < (bias["old"] - bias["true"]) / 5
    assert "calibration-drift" in warnings["old"] & warnings["mended"]
    assert "calibration-drift" not in warnings["true"]
