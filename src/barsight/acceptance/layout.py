"""Lay out a plan for a given yard: artefacts spread over free floor, with limits based on the pixel size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from barsight.artefacts.plan import (
    AcceptancePlan,
    DummyBundle,
    ErrorLimits,
    HeightStep,
    Plate,
    Sphere,
    SphereBar,
)
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.yard.types import YardMap

PLATES = (
    ("plate 1", 0.12, 0.16, 0.0), ("plate 2", 0.38, 0.82, 0.12), ("plate 3", 0.38, 0.46, 0.22),
    ("plate 4", 0.88, 0.55, 0.33), ("plate 5", 0.62, 0.12, 0.0), ("plate 6", 0.12, 0.5, 0.33),
)  # fmt: skip
SPHERES = (
    ("monument 1", 0.14, 0.92, 0.0), ("monument 2", 0.12, 0.75, 0.12), ("monument 3", 0.34, 0.14, 0.0),
    ("monument 4", 0.85, 0.86, 0.12), ("monument 5", 0.85, 0.14, 0.0),
)  # fmt: skip
"""PLATES and SPHERES: names, places as fractions of the area, and heights (tops of plates, undersides of
spheres) as fractions of the cameras' height.
"""
BARS = (("bar along", "monument 3", "monument 5"), ("bar across", "monument 4", "monument 5"),
        ("bar aslant", "monument 1", "monument 4"))  # fmt: skip
DUMMY = ("dummy bundle", 0.64, 0.5)
BAR_PX = 12.5
"""Width of a dummy bundle's bar on the floor, in pixels."""
FLOOR_M = 0.05
"""Maximum height (m) of a map cell that counts as floor, above or below zero."""


@dataclass(frozen=True)
class Area:
    """Floor area (m) for the artefacts, and the view of it: height of the cameras above it (m), focal length
    (px) and baseline (m).
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    above_floor_m: float
    focal_px: float
    baseline_m: float

    @property
    def ground_px_m(self) -> float:
        """Return the size of a pixel on the floor."""
        return self.above_floor_m / self.focal_px

    @property
    def height_px_m(self) -> float:
        """Return the height difference that corresponds to one pixel of disparity on the floor."""
        return self.above_floor_m**2 / (self.focal_px * self.baseline_m)

    def at(self, along: float, across: float) -> Float64:
        """Convert fractions of the area to a place (2,) m in the yard."""
        return np.array([
            self.x_m[0] + along * (self.x_m[1] - self.x_m[0]),
            self.y_m[0] + across * (self.y_m[1] - self.y_m[0]),
        ])  # fmt: skip


def lay_out(area: Area, yard: str, floor: YardMap | None = None) -> AcceptancePlan | Failed:
    """Lay out a plan. floor: a map of the yard as it is; artefacts are then placed on its free floor.

    Calibrated values are nominal: whoever builds the artefacts enters the measured ones. Failed `no-floor`
    where there isn't enough free floor.
    """
    side = float(np.clip(70 * area.ground_px_m, 0.4, 1.2))
    wide = float(np.clip(40 * area.ground_px_m, 0.15, 0.6))
    free = None if floor is None else _free_floor(floor)
    places: dict[str, Float64] = {}
    for name, along, across, *_ in (*PLATES, *SPHERES, DUMMY):
        wanted, reach = area.at(along, across), {"p": 0.7 * side, "m": 0.7 * wide, "d": 0.4}[name[0]]
        taken = list(places.values())
        spot = wanted if free is None or floor is None else _nearest_free(floor, free, wanted, reach, taken)
        if spot is None:
            return Failed("no-floor", f"no free floor for {name}: {2 * reach:.1f} m across are wanted")
        places[name] = np.round(spot, 2)
    limits = _limits(area)
    lowest = max(2e-3 * limits.height_mm, 0.02)  # bare floor at a plate's place must not pass for it
    tops = {name: round(max(up * area.above_floor_m, lowest), 2) for name, _, _, up in PLATES}
    plates = tuple(_plate(name, places[name], tops[name], side) for name, *_ in PLATES)
    spheres = tuple(
        _monument(name, places[name], up * area.above_floor_m + wide / 2, wide) for name, _, _, up in SPHERES
    )
    return AcceptancePlan(
        yard, plates, spheres, _bars(spheres),
        tuple(
            HeightStep(f"step {k}", "plate 1", name, round(tops[name] - tops["plate 1"], 3))
            for k, name in enumerate((n for n in tops if tops[n] > tops["plate 1"]), 1)
        ),
        (_dummy(places[DUMMY[0]], area.ground_px_m),), (), limits,
    )  # fmt: skip


def _plate(name: str, place: Float64, top_m: float, side_m: float) -> Plate:
    side = round(side_m, 2)
    return Plate(name, float(place[0]), float(place[1]), top_m, (side, side))


def _monument(name: str, place: Float64, centre_m: float, wide_m: float) -> Sphere:
    x, y = float(place[0]), float(place[1])
    return Sphere(name, x, y, round(centre_m, 3), round(wide_m, 3), place_sigma_m=0.0005)


def _bars(spheres: tuple[Sphere, ...]) -> tuple[SphereBar, ...]:
    centre = {one.name: np.array([one.x_m, one.y_m, one.z_m]) for one in spheres}
    return tuple(
        SphereBar(name, (first, second), round(float(np.linalg.norm(centre[first] - centre[second])), 5))
        for name, first, second in BARS
    )


def _dummy(place: Float64, ground_px_m: float) -> DummyBundle:
    """Make a dummy bundle of seven bars, hexagonally packed, 1.4 m long, each wide enough to be resolved."""
    diameter = round(float(np.clip(BAR_PX * ground_px_m, 0.06, 0.15)), 2)
    pitch = 1.003 * diameter
    return DummyBundle(
        DUMMY[0], float(place[0]), float(place[1]), 3.0, 1.4, round(2 * pitch + diameter, 4),
        round(pitch * 3**0.5 + diameter, 4), 7, diameter,
    )  # fmt: skip


def _limits(area: Area) -> ErrorLimits:
    """Set the limits as multiples of the pixel size that a good calibration can keep. Sizes are in m,
    limits in mm.
    """
    up, across = 1e3 * area.height_px_m, 1e3 * area.ground_px_m
    return ErrorLimits(
        height_mm=round(0.14 * up, 1), position_mm=round(1.3 * across, 1), length_mm=round(1.3 * across, 1),
        step_mm=round(0.14 * up, 1), flatness_mm=round(0.35 * up, 1), lift_mm=round(2.0 * across, 1),
        lift_along_mm=round(10.0 * across, 1),
        yaw_deg=0.5, width_mm=round(4.5 * across, 1), bundle_length_mm=round(15.0 * across, 1),
        touch_mm=round(2.0 * across, 1), repeat_mm=round(0.6 * across, 1), laser_mm=round(0.1 * up, 1),
    )  # fmt: skip


def _free_floor(floor: YardMap) -> Float64:
    """Compute the distance (m) of each cell of free floor from the nearest cell that isn't."""
    part = floor.part(slice(0, floor.shape[0]), slice(0, floor.shape[1]))
    level: Bool = np.isfinite(part.z_m) & (np.abs(part.z_m) < FLOOR_M)
    away: Float64 = distance_transform_edt(np.pad(level, 1))[1:-1, 1:-1] * floor.cell_m
    return away


def _nearest_free(
    floor: YardMap, free: Float64, wanted: Float64, reach_m: float, taken: list[Float64]
) -> Float64 | None:
    rows, columns = np.nonzero(free > reach_m)
    spots = np.column_stack([floor.x0_m + columns * floor.cell_m, floor.y0_m + rows * floor.cell_m])
    for other in taken:
        spots = spots[np.linalg.norm(spots - other, axis=1) > 2 * reach_m]
    if not len(spots):
        return None
    nearest: Float64 = spots[int(np.argmin(((spots - wanted) ** 2).sum(axis=1)))]
    return nearest
