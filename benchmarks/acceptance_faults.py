"""Accept simulated rigs, nominal and with one fault each.

`python benchmarks/acceptance_faults.py 40:42 OUT.jsonl` writes a line of JSON for each rig. Small pictures
(640x512, 7.2 mm a pixel on the floor, 4.5 m over it) show a plan's artefacts. A nominal rig's calibration is
off by 0.002 degrees, 0.02 % of baseline and 0.02 % of focal length (1 sigma).
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from barsight.acceptance.acceptance import accept
from barsight.acceptance.layout import Area, lay_out
from barsight.artefacts.plan import AcceptancePlan
from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.geometry.rig import StereoRig
from barsight.measure_settings import MeasureSettings
from barsight.motion.rig_check.self_calibration import turn_right_camera
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from barsight.simulation.effects.settings import FaultSettings
from barsight.simulation.settings import CameraSettings, SimulationSettings
from barsight.simulation.simulate import simulate
from barsight.simulation.worlds.artefacts import lay_artefacts

CONDITIONS = ("nominal", "yaw", "baseline", "focal", "dirt")
CAMERA = CameraSettings(width_px=640, height_px=512, focal_px=625.0, above_floor_m=4.5, trolley_y_m=0.0)


def wrong_rig(rig: StereoRig, yaw_deg: float, baseline: float, focal: float) -> StereoRig:
    """Make the rig file's rig: turned, with another baseline and other focal lengths (as ratios)."""
    turned = turn_right_camera(rig, np.array([0.0, np.radians(yaw_deg), 0.0]))
    between = turned.cam0_from_cam1
    between = replace(between, translation=between.translation * (1 + baseline))
    cam0, cam1 = (
        replace(one, fx_px=float(one.fx_px * (1 + focal)), fy_px=float(one.fy_px * (1 + focal)))
        for one in (turned.cam0, turned.cam1)
    )
    body = turned.body_from_cam0
    return StereoRig(cam0, cam1, body, body @ between, turned.timeshift_cam_imu_ns)


def judge(seed: int, work: Path, out: Path) -> None:
    """Simulate one yard, clean and with dirty lenses, and accept it under each condition."""
    plan = lay_out(Area((0.2, 3.8), (-1.35, 1.35), 4.5, 625.0, 0.5), "simulated")
    assert isinstance(plan, AcceptancePlan)
    rng = np.random.default_rng((seed, 99))
    ordinary = [float(rng.normal(0, sigma)) for sigma in (0.002, 2e-4, 2e-4)]
    signs = rng.choice([-1, 1], 3)
    for condition in CONDITIONS:
        dirty = condition == "dirt"
        recording = work / ("dirty" if dirty else "clean")
        faults = FaultSettings(dirt_spots=12, dirt_px=14) if dirty else FaultSettings()
        if not recording.exists():
            settings = SimulationSettings(
                length_m=4.0, frames=10, seed=seed, camera=CAMERA, depth_views=0, faults=faults
            )
            simulate(recording, settings, laid=lay_artefacts(plan, settings))
        errors = list(ordinary)
        for k, (name, size) in enumerate((("yaw", 0.02), ("baseline", 0.003), ("focal", 0.002))):
            errors[k] += size * float(signs[k]) * (condition == name)
        rig = work / f"{condition}.yaml"
        write_rig_file(rig, wrong_rig(open_recording(recording).rig, *errors))
        measured = work / condition
        measured.mkdir()
        settings = MeasureSettings(recording=RecordingSettings(rig=rig))
        found = accept(plan, [recording], settings, measured, lambda *_: None)
        shutil.rmtree(measured)
        row = {
            "seed": seed, "condition": condition, "errors": errors, "passed": found.is_passed,
            "causes": [(one.name, one.value, one.sigma, one.unit) for one in found.causes],
            "not_passed": [
                (q.name, q.error, q.limit, str(q.decision))
                for q in found.quantities
                if q.decision != "passed"
            ],
        }  # fmt: skip
        with out.open("a") as file:
            file.write(json.dumps(row, default=float) + "\n")


if __name__ == "__main__":
    first, end = map(int, sys.argv[1].split(":"))
    for number in range(first, end):
        with tempfile.TemporaryDirectory() as folder:
            judge(number, Path(folder), Path(sys.argv[2]))
