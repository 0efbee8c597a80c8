"""Find spheres and plates in a height map near their planned places, and fit them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from barsight.artefacts.plan import Plate, Sphere
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.core.records.heights import HeightSource
from barsight.yard.types import YardMap

CAP_RATIO = 0.7
"""Fraction of the radius up to which a sphere's cap is used; the surface slopes by 44 degrees there."""
EDGE_M = 0.08
"""Width (m) of a plate's margin that is not used, because matching blurs its edge."""
STEP_M = 0.02
"""Step (m) of the search grid for a place; the fit refines the best one."""
NEAR_M = 0.02
"""Maximum distance (m) of a height from the artefact's surface for it to count."""
LEVEL_RATIO, LEVEL_M = 5.0, 0.001
"""Maximum deviation of a height that is level with a plate, as a multiple of the median deviation on the
plate, and its lower bound (m). It separates a low plate from the floor around it.
"""
TIGHT_RATIO = 0.07
"""Maximum deviation of a sphere's heights in the last fit, as a fraction of the radius."""
ROUND_RATIO = 0.75
"""Maximum misfit of a sphere relative to that of a plane."""
STARTS = 6
THINNED = 5
"""Thinning factor of the heights in the search for a plate."""
CORRELATED_M = 0.03
"""Correlation length (m): closer cells see the same pixels, so their errors aren't independent."""
MIN_SHARE, MIN_CAP_SHARE = 0.5, 0.35
"""Minimum fraction of the cells of a plate, and of a sphere's cap, that must be present and fit; matching
leaves out more of a cap.
"""


@dataclass(frozen=True, eq=False)
class FittedSphere:
    """A fitted sphere.

    centre_m: (3,) fitted with the calibrated diameter. sigma_m: noise of one coordinate, from the residuals.
    diameter_m: from a fit with free radius. form_m: 95 % span of the radii. cells: number used.
    """

    centre_m: Float64
    sigma_m: float
    diameter_m: float
    form_m: float
    cells: int


@dataclass(frozen=True, eq=False)
class FittedPlate:
    """A fitted plate.

    z_m: height at its centre. sigma_m: noise of z_m, from the residuals. shift_m: (2,) from the planned
    place, to the resolution of the search. tilt_deg: of its plane. flatness_m: 95 % span about the plane.
    cells: number used.
    """

    z_m: float
    sigma_m: float
    shift_m: Float64
    tilt_deg: float
    flatness_m: float
    cells: int


def fit_sphere(yard: YardMap, sphere: Sphere, search_m: float) -> FittedSphere | Failed:
    """Fit a sphere's cap. Failed `not-found` where too few heights near its place fit a sphere."""
    radius = sphere.diameter_m / 2
    points = _known(yard, sphere.x_m, sphere.y_m, search_m + radius)
    expected = np.pi * (CAP_RATIO * radius / yard.cell_m) ** 2
    best: tuple[Float64, Float64] | None = None
    for start in _starts(points, sphere, search_m, expected):
        centre, cap = start, points
        for near in (NEAR_M, NEAR_M, TIGHT_RATIO * radius):
            away = np.hypot(points[:, 0] - centre[0], points[:, 1] - centre[1]) < CAP_RATIO * radius
            off = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
            cap = points[away & (off < near)]
            if len(cap) < MIN_CAP_SHARE * expected:
                break
            centre = _solve(cap, centre, radius)
        if len(cap) >= MIN_CAP_SHARE * expected and (best is None or len(cap) > len(best[1])):
            best = centre, cap
    if best is None or not _is_round(best[1], best[0], radius):
        return Failed("not-found", f"{sphere.name}: no sphere within {search_m:g} m of its place")
    centre, cap = best
    free = _solve(cap, np.append(centre, radius), None)
    residual = np.linalg.norm(cap - centre, axis=1) - radius
    low, high = np.percentile(np.linalg.norm(cap - free[:3], axis=1), (2.5, 97.5))
    alone = max(len(cap) * (yard.cell_m / CORRELATED_M) ** 2, 1.0)
    sigma = float(residual.std()) * np.sqrt(1 + 1 / CAP_RATIO**2) / np.sqrt(alone)
    return FittedSphere(centre, float(sigma), 2 * float(free[3]), float(high - low), len(cap))


def _is_round(cap: Float64, centre: Float64, radius: float) -> bool:
    """Check that a sphere fits the heights (N, 3) far better than a plane does."""
    flat = np.column_stack([cap[:, :2], np.ones(len(cap))])
    off_plane = cap[:, 2] - flat @ np.linalg.lstsq(flat, cap[:, 2], rcond=None)[0]
    off_sphere = np.linalg.norm(cap - centre, axis=1) - radius
    return bool(off_sphere.std() < ROUND_RATIO * off_plane.std())


def _starts(points: Float64, sphere: Sphere, search_m: float, expected: float) -> list[Float64]:
    """List the centres (3,) around which the heights look most like the sphere."""
    radius, scored = sphere.diameter_m / 2, list[tuple[float, Float64]]()
    for dx in _steps(search_m):
        for dy in _steps(search_m):
            x, y = sphere.x_m + dx, sphere.y_m + dy
            square = (points[:, 0] - x) ** 2 + (points[:, 1] - y) ** 2
            near = square < (CAP_RATIO * radius) ** 2
            if near.sum() < MIN_CAP_SHARE * expected:
                continue
            z = points[near, 2] - np.sqrt(radius**2 - square[near])
            middle = float(np.median(z))
            if abs(middle - sphere.z_m) < search_m:
                fits = np.maximum(1 - ((z - middle) / NEAR_M) ** 2, 0).sum()
                scored.append((float(fits), np.array([x, y, middle])))
    scored.sort(key=lambda one: -one[0])
    return [centre for _, centre in scored[:STARTS]]


def fit_plate(yard: YardMap, plate: Plate, search_m: float) -> FittedPlate | Failed:
    """Fit a plate's plane. Failed `not-found` where too few heights near its place are level."""
    points = _known(yard, plate.x_m, plate.y_m, search_m + max(plate.size_m))
    points = points[np.abs(points[:, 2] - plate.z_m) < search_m]
    turn = np.radians(plate.yaw_deg)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    half = np.array(plate.size_m) / 2
    expected = float(np.prod(2 * (half - EDGE_M))) / yard.cell_m**2
    shift = _plate_shift(points[::THINNED], plate, search_m, axes, expected / THINNED)
    if shift is None:
        return Failed("not-found", f"{plate.name}: no level plate within {search_m:g} m of its place")
    at = (points[:, :2] - (plate.x_m, plate.y_m) - shift) @ axes.T
    used = points[_inside(at, half - EDGE_M)]
    used = used[np.abs(used[:, 2] - np.median(used[:, 2])) < NEAR_M]
    flat = np.column_stack([used[:, :2] - (plate.x_m, plate.y_m) - shift, np.ones(len(used))])

    def off_plane(plane: Float64) -> Float64:
        off: Float64 = flat @ plane - used[:, 2]
        return off

    start = [0.0, 0.0, np.median(used[:, 2])]
    plane = least_squares(off_plane, start, loss="soft_l1", f_scale=2e-3).x
    residual = used[:, 2] - flat @ plane
    low, high = np.percentile(residual, (2.5, 97.5))
    alone = max(len(used) * (yard.cell_m / CORRELATED_M) ** 2, 1.0)
    return FittedPlate(
        float(plane[2]), float(residual.std() / np.sqrt(alone)), shift,
        float(np.degrees(np.arctan(np.hypot(*plane[:2])))), float(high - low), len(used),
    )  # fmt: skip


def _plate_shift(
    points: Float64, plate: Plate, search_m: float, axes: Float64, expected: float
) -> Float64 | None:
    """Find the shift (2,) with the most heights level on the plate and the fewest around it; None where the
    plate has too few heights everywhere.
    """
    half, shift, best = np.array(plate.size_m) / 2, None, -np.inf
    for dx in _steps(search_m):
        for dy in _steps(search_m):
            at = (points[:, :2] - (plate.x_m + dx, plate.y_m + dy)) @ axes.T
            inner = _inside(at, half - EDGE_M)
            if inner.sum() < MIN_SHARE * expected:
                continue
            off = np.abs(points[:, 2] - np.median(points[inner, 2]))
            level = off < np.clip(LEVEL_RATIO * np.median(off[inner]), LEVEL_M, NEAR_M)
            beside = _inside(at, half + EDGE_M) & ~_inside(at, half)
            score = (
                (inner & level).sum() - (beside & level).sum() - 0.01 * expected * np.hypot(dx, dy) / search_m
            )
            if score > best:
                best, shift = float(score), np.array([dx, dy])
    return shift


def _known(yard: YardMap, x_m: float, y_m: float, reach_m: float) -> Float64:
    """Read the heights (N, 3) measured by vision in a square of half side `reach_m`."""
    spans = [
        slice(
            min(max(int((at - reach_m - low) / yard.cell_m), 0), size),
            min(max(int((at + reach_m - low) / yard.cell_m) + 2, 0), size),
        )
        for at, low, size in ((y_m, yard.y0_m, yard.shape[0]), (x_m, yard.x0_m, yard.shape[1]))
    ]
    if any(span.start >= span.stop for span in spans):
        return np.empty((0, 3))
    part = yard.part(*spans)
    known = (part.source == HeightSource.VISION) & np.isfinite(part.z_m)
    rows, columns = np.nonzero(known)
    return np.column_stack([part.x_m[columns], part.y_m[rows], part.z_m[known].astype(np.float64)])


def _steps(search_m: float) -> Float64:
    """List the offsets to try in ascending size, so that the nearest one wins a tie."""
    count = round(search_m / STEP_M)
    steps = STEP_M * np.arange(-count, count + 1, dtype=np.float64)
    return steps[np.argsort(np.abs(steps), kind="stable")]


def _inside(at: Float64, half: Float64) -> Bool:
    inside: Bool = np.all(np.abs(at) < half, axis=1)
    return inside


def _solve(cap: Float64, start: Float64, radius: float | None) -> Float64:
    """Solve for the centre (3,), or for centre and radius (4,) where radius is None, from the cap's points
    (N, 3).
    """

    def off(unknown: Float64) -> Float64:
        wanted = unknown[3] if radius is None else radius
        distance: Float64 = np.linalg.norm(cap - unknown[:3], axis=1) - wanted
        return distance

    found: Float64 = least_squares(off, start, loss="soft_l1", f_scale=2e-3).x
    return found
