"""Observe a plan's artefacts in a measured folder: spheres, plates, bundles, laser and viewing geometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.acceptance.fitting import FittedPlate, FittedSphere, fit_plate, fit_sphere
from barsight.artefacts.plan import AcceptancePlan, DummyBundle
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64
from barsight.core.errors import Failed, InputError
from barsight.result_folder import open_folder, read_heights, read_path
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.types import Bundle

MIN_BAR_PX = 10.0
"""Minimum width (px) on the floor of a dummy bundle's bars; the sides of bars of 8 px were assigned to
another row in two of five yards.
"""


@dataclass(frozen=True)
class LaserAgreement:
    """Bias of vision minus laser on smooth places, mm, and the margin within which the two are equivalent."""

    profile: int
    bias_mm: float
    equivalence_mm: float


@dataclass(frozen=True, eq=False)
class ViewGeometry:
    """Geometry of the view. camera_m: (3,) mean position of cam0 in the yard. focal_px, baseline_m: of the
    rectified pair.
    """

    camera_m: Float64
    focal_px: float
    baseline_m: float

    def px_m(self, z_m: float) -> float:
        """Compute the metres of height per pixel of disparity at a height in the yard."""
        return float((self.camera_m[2] - z_m) ** 2 / (self.focal_px * self.baseline_m))


@dataclass(frozen=True, eq=False)
class Observation:
    """The artefacts as one recording shows them.

    map_id, calibration_id, yard_frame_id: of the measured folder; warnings: its warning codes.
    """

    recording: str
    map_id: str
    calibration_id: str
    yard_frame_id: str | None
    is_simulated: bool
    spheres: Mapping[str, FittedSphere | Failed]
    plates: Mapping[str, FittedPlate | Failed]
    bundles: Mapping[str, Bundle | Failed]
    laser: tuple[LaserAgreement, ...]
    view: ViewGeometry
    warnings: tuple[str, ...]


def observe(folder: Path, plan: AcceptancePlan, rig: StereoRig, recording: str) -> Observation:
    """Find and fit all artefacts. Raises InputError for a folder that isn't in the yard's frame."""
    summary, identity = open_folder(folder, lifts=False)
    if summary["reference"] != "yard" or identity is None:
        remedy = "give a recording with encoders, or a yard file (--yard)"
        raise InputError(recording, "was not measured in the yard's frame", remedy)
    heights, search = read_heights(folder), plan.conditions.search_m
    bundles, view = read_bundles(folder / "bundles.json"), view_geometry(folder, rig)
    ground_px_m = float(view.camera_m[2]) / view.focal_px
    return Observation(
        recording, identity.map_id, identity.calibration_id, identity.yard_frame_id, identity.is_simulated,
        {one.name: fit_sphere(heights, one, search) for one in plan.sphere},
        {one.name: fit_plate(heights, one, search) for one in plan.plate},
        {one.name: nearest_bundle(bundles, one, search, ground_px_m) for one in plan.dummy_bundle},
        tuple(
            LaserAgreement(row["profile"], row["smooth_bias_mm"], row["equivalence_mm"])
            for row in summary["agreement"] or []
            if row.get("equivalence_mm") is not None
        ),
        view,
        tuple(str(one["code"]) for one in summary["warnings"] or []),
    )  # fmt: skip


def nearest_bundle(
    bundles: tuple[Bundle, ...], dummy: DummyBundle, search_m: float, ground_px_m: float
) -> Bundle | Failed:
    """Find the bundle nearest to a dummy's place. Failed `not-found`, or `thin-bars` where its bars are too
    thin to find its sides at this pixel size on the floor.
    """
    wide_px = dummy.bar_diameter_m / ground_px_m
    if wide_px < MIN_BAR_PX:
        seen = f"its bars are {wide_px:.1f} pixels wide, {MIN_BAR_PX:g} are the least"
        return Failed(
            "thin-bars", f"{dummy.name}: {seen}: take thicker bars ({MIN_BAR_PX * ground_px_m:.3f} m)"
        )
    place = np.array([dummy.x_m, dummy.y_m])
    near = [b for b in bundles if np.linalg.norm(b.centre_m[:2] - place) < search_m]
    if not near:
        return Failed("not-found", f"{dummy.name}: no bundle within {search_m:g} m of its place")
    return min(near, key=lambda b: float(np.linalg.norm(b.centre_m[:2] - place)))


def view_geometry(folder: Path, rig: StereoRig) -> ViewGeometry:
    """Compute the viewing geometry of a measured folder. Raises InputError where it has no trajectory."""
    path = read_path(folder)
    if path is None:
        raise InputError(folder, "has no trajectory.tum", "measure the recording again")
    lever = rig.body_from_cam0.translation.copy()
    levers_m = Rotation.from_quat(path.quaternion_xyzw).apply(lever)
    camera = Rectifier(rig).camera
    return ViewGeometry((path.position_m + levers_m).mean(axis=0), camera.focal_px, camera.baseline_m)
