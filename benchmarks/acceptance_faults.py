"""Accept simulated rigs, nominal and with one fault each.

`python benchmarks/acceptance_faults.py 40:42 OUT.jsonl [nominal,focal]` writes a line of JSON for each rig;
of a nominal one also how far off the dummy bundle's lift is, with the sigma that it is budgeted with. Small
pictures (640x512, 7.2 mm a pixel on the floor, 4.5 m over it) show a plan's artefacts. A nominal rig's
calibration is off by 0.002 degrees, 0.02 % of baseline and 0.02 % of focal length (1 sigma).
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from barsight.acceptance.acceptance import Acceptance, accept
from barsight.acceptance.budgets.budget import BudgetedLoad, ErrorSource, budget
from barsight.acceptance.budgets.error_sources import SHAPE, fit_sources
from barsight.acceptance.causes import name_causes
from barsight.acceptance.layout import Area, lay_out
from barsight.acceptance.pictures import check_pictures
from barsight.artefacts.plan import AcceptancePlan
from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.errors import Failed
from barsight.core.records.pairs import StereoFrame
from barsight.measure_settings import MeasureSettings
from barsight.motion.rig_check.self_calibration import turn_right_camera
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from barsight.result_folder import read_heights
from barsight.simulation.effects.settings import FaultSettings
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.simulate import simulate
from barsight.simulation.worlds.artefacts import lay_artefacts
from barsight.yard.weight import bundle_mass

CONDITIONS = ("nominal", "yaw", "baseline", "focal", "dirt")
LENSES_ALONE = "lenses"
"""Dirty lenses, looked at as `accept` does without measuring: it refuses by their name all the same."""
ORDINARY = (0.002, 2e-4, 2e-4)
"""One sigma of a nominal rig: yaw (deg), baseline and focal length (as ratios)."""
DIRTY = FaultSettings(dirt_spots=12, dirt_px=14)
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


def lift_errors(found: Acceptance, folder: Path) -> dict[str, tuple[float, float]] | None:
    """Compute errors and budgeted sigma of the dummy bundle's lift, mm and degrees, its shape being known;
    None where it wasn't found.
    """
    (dummy,), view = found.plan.dummy_bundle, found.observations[0]
    bundle = view.bundles[dummy.name]
    if isinstance(bundle, Failed):
        return None
    top = np.array([*bundle.centre_m[:2], bundle.top_z_m])
    load = BudgetedLoad(top, bundle.yaw_rad, bundle.length_m, bundle.width_m, bundle_mass(bundle).kg)
    drawn = np.diag(np.square([np.radians(ORDINARY[0]), *ORDINARY[1:]]))
    rig = ErrorSource("rig", ("yaw", "baseline", "focal"), drawn, "as drawn here")
    fit = (one for one in fit_sources(bundle, read_heights(folder)) if one.name != SHAPE)
    sources = (rig, *fit)
    figures = budget(load, view.view, np.zeros(3), sources, samples=100)
    off = [*(1e3 * (top - (dummy.x_m, dummy.y_m, dummy.top_z_m))), np.degrees(bundle.yaw_rad) - dummy.yaw_deg]
    return {one.name: (float(error), one.combined.sigma) for one, error in zip(figures[:4], off, strict=True)}


def judge_lenses(seed: int, work: Path, out: Path) -> None:
    """Simulate one yard with dirty lenses and say what the pictures' check makes of them."""
    plan = lay_out(Area((0.2, 3.8), (-1.35, 1.35), 4.5, 625.0, 0.5), "simulated")
    assert isinstance(plan, AcceptancePlan)
    settings = SimulationSettings(
        length_m=4.0, frames=10, seed=seed, camera=CAMERA, depth_views=0, faults=DIRTY
    )
    simulate(work / "dirty", settings, laid=lay_artefacts(plan, settings))
    frames = open_recording(work / "dirty").frames()
    health = check_pictures(one for one in frames if isinstance(one, StereoFrame))
    causes = name_causes(plan, (), (), (health,))
    row = {"seed": seed, "condition": LENSES_ALONE, "passed": not causes, "causes": [
        (one.words, one.value) for one in causes
    ]}  # fmt: skip
    with out.open("a") as file:
        file.write(json.dumps(row, default=float) + "\n")


def judge(seed: int, work: Path, out: Path, conditions: tuple[str, ...] = CONDITIONS) -> None:
    """Simulate one yard, clean and with dirty lenses, and accept it under each condition."""
    plan = lay_out(Area((0.2, 3.8), (-1.35, 1.35), 4.5, 625.0, 0.5), "simulated")
    assert isinstance(plan, AcceptancePlan)
    rng = np.random.default_rng((seed, 99))
    ordinary = [float(rng.normal(0, sigma)) for sigma in ORDINARY]
    signs = rng.choice([-1, 1], 3)
    for condition in conditions:
        dirty = condition == "dirt"
        recording = work / ("dirty" if dirty else "clean")
        faults = DIRTY if dirty else FaultSettings()
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
        lift = lift_errors(found, measured / "measured_1") if condition == "nominal" else None
        shutil.rmtree(measured)
        row = {
            "seed": seed, "condition": condition, "errors": errors, "passed": found.is_passed,
            "lift": lift,
            "causes": [(one.words, one.value, one.sigma, one.unit, one.chi2) for one in found.causes],
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
    chosen = tuple(sys.argv[3].split(",")) if len(sys.argv) > 3 else CONDITIONS
    for number in range(first, end):
        with tempfile.TemporaryDirectory() as folder:
            if LENSES_ALONE in chosen:
                judge_lenses(number, Path(folder), Path(sys.argv[2]))
            else:
                judge(number, Path(folder), Path(sys.argv[2]), chosen)
