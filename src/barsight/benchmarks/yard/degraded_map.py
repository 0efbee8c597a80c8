"""Generate a height map with the errors of a measured one from the exact surface: a minute for thirty yards.

The errors of a measured map are applied to the exact heights: the cameras' field of view, places that no pair
sees, edges that grow over what they hide, smoothing by the matching window, noise correlated along the bars,
a common offset, flying cells. benchmarks/results compares its errors with measured ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float64, kernel
from barsight.core.records.heights import HeightSource
from barsight.simulation.scene import Scene
from barsight.simulation.sensors import heights
from barsight.simulation.settings.rig import CameraSettings
from barsight.yard.types import HeightMap

CELL_M = 0.01
_HALF_WIDTH_M = 3.8
_MARGIN_M = 0.5


@dataclass(frozen=True)
class Defects:
    """Standard deviations and shares of the errors of a measured map."""

    white_m: float = 0.002
    short_m: float = 0.0025
    """Standard deviation of the height noise correlated over 10 mm across and 0.1 m along the bars, m."""
    long_m: float = 0.004
    """Standard deviation of the height noise correlated over 10 mm across and 1.5 m along the bars, m:
    gloss and shading of each bar.
    """
    shared_m: float = 0.001
    """Standard deviation of the height offset common to the whole map, m."""
    placed_m: float = 0.0014
    """Standard deviation of the whole map's displacement along X and along Y by the trajectory's error, m."""
    stated_m: float = 0.0045
    """Standard deviation that the map states for its heights, m."""
    window_m: tuple[float, float] = (0.005, 0.014)
    """Smallest and largest sigma of the smoothing across the bars, m; drawn for each yard."""
    window_along_m: float = 0.015
    growth_cells: float = 1.2
    """Mean number of cells by which an edge grows over what it hides."""
    frame_step_m: float = 0.4
    """Travel from frame to frame, m: a gully must be open to some pair along the travel."""
    flying_ratio: float = 0.008
    hole_ratio: float = 0.01


def degraded_map(
    scene: Scene, length_m: float, camera: CameraSettings, rng: np.random.Generator, defects: Defects
) -> HeightMap:
    """Generate the map of a yard `length_m` long in X, with 10 mm cells."""
    xs = CELL_M * np.arange(round(-_MARGIN_M / CELL_M), round((length_m + _MARGIN_M) / CELL_M) + 1)
    ys = CELL_M * np.arange(round(-_HALF_WIDTH_M / CELL_M), round(_HALF_WIDTH_M / CELL_M) + 1)
    x, y = np.meshgrid(xs, ys)
    exact = heights(scene, x.ravel(), y.ravel()).reshape(x.shape)
    seen = _seen(exact, y, camera, defects)
    z = _windowed(exact, seen, (rng.uniform(*defects.window_m), defects.window_along_m))
    z, seen = _grown(z, seen, rng, defects)
    z = z + _noise(z.shape, rng, defects)
    z, seen = _flying(z, seen, rng, defects)
    seen &= ~_patches(z.shape, rng, defects.hole_ratio)
    beside = rng.normal(0, defects.placed_m, 2)
    sigma = np.where(seen, defects.stated_m * rng.uniform(0.9, 1.2, z.shape), np.nan)
    return HeightMap(
        x0_m=float(xs[0] + beside[0]),
        y0_m=float(ys[0] + beside[1]),
        cell_m=CELL_M,
        z_m=np.where(seen, z, np.nan).astype(np.float32),
        sigma_m=sigma.astype(np.float32),
        views=np.where(seen, 6, 0).astype(np.float32),
        source=np.where(seen, HeightSource.VISION, HeightSource.UNKNOWN).astype(np.uint8),
    )


def _seen(exact: Float64, y: Float64, camera: CameraSettings, defects: Defects) -> Bool:
    """Mark visible cells: in the field of view, and not occluded across or along the travel.

    Along X they must be visible from two positions, across it from the trolley's line.
    """
    depth = camera.above_floor_m - exact
    side = (y - camera.trolley_y_m) / depth
    field = np.abs(side) < 0.5 * camera.height_px / camera.focal_px
    middle = int(np.argmin(np.abs(y[:, 0] - camera.trolley_y_m)))
    outward = np.maximum.accumulate(side[middle:], axis=0) <= side[middle:] + 1e-9
    inward = np.minimum.accumulate(side[: middle + 1][::-1], axis=0) >= side[: middle + 1][::-1] - 1e-9
    open_y = np.vstack([inward[::-1][:-1], outward])
    opening = _opening(exact, CELL_M)
    return field & open_y & (opening > (camera.baseline_m + defects.frame_step_m) / depth)


@kernel()
def _opening(exact: Float64, cell: float) -> Float64:
    """Compute the opening of each cell to the sky along X: the sum of the tangents to either side, at most 4.

    exact: (rows, columns) heights, m; cell: m. Returns (rows, columns).
    """
    rows, columns = exact.shape
    opening = np.empty((rows, columns))
    for j in range(rows):
        for i in range(columns):
            total = 0.0
            for step in (-1, 1):
                least = 2.0
                for k in range(1, 41):
                    n = i + step * k
                    if n < 0 or n >= columns:
                        break
                    rise = exact[j, n] - exact[j, i]
                    if rise > 0:
                        least = min(least, (k - 0.5) * cell / rise)
                total += least
            opening[j, i] = total
    return opening


def _windowed(exact: Float64, seen: Bool, window_m: tuple[float, float]) -> Float64:
    """Average visible heights under the matching window, on the same surface (within 80 mm) only."""
    z = np.where(seen, exact, np.nan)
    total, weight = np.zeros_like(z), np.zeros_like(z)
    across, along = (int(2 * s / CELL_M + 0.5) for s in window_m)
    for j in range(-along, along + 1):
        for i in range(-across, across + 1):
            w = np.exp(-0.5 * CELL_M**2 * ((i / window_m[0]) ** 2 + (j / window_m[1]) ** 2))
            other = np.roll(z, (j, i), axis=(0, 1))
            near = np.abs(other - z) < 0.08
            total += np.where(near, w * other, 0.0)
            weight += np.where(near, w, 0.0)
    return np.where(weight > 0, total / np.maximum(weight, 1e-12), z)


def _grown(z: Float64, seen: Bool, rng: np.random.Generator, defects: Defects) -> tuple[Float64, Bool]:
    """Grow edges over hidden cells and over lower ones beside them; the ends of bars grow half as far."""
    steps = rng.poisson(defects.growth_cells, (z.shape[0] // 8 + 1, z.shape[1])).repeat(8, axis=0)[
        : z.shape[0]
    ]
    out, known = z.copy(), seen.copy()
    for k in (1, 2, 3):
        for axis, step in ((1, k), (1, -k), (0, k), (0, -k)):
            source = np.roll(np.where(seen, z, -np.inf), step, axis=axis)
            level = source > np.where(known, out, -np.inf) + 0.05
            take = level & (steps >= (k if axis == 1 else 2 * k))
            out[take] = source[take] - 0.004 * k
            known |= take
    return out, known


def _noise(shape: tuple[int, ...], rng: np.random.Generator, defects: Defects) -> Float64:
    noise = rng.normal(0, defects.white_m, shape) + rng.normal(0, defects.shared_m)
    for size, along_m in ((defects.short_m, 0.1), (defects.long_m, 1.5)):
        field = ndimage.gaussian_filter(rng.normal(0, 1, shape), (along_m / CELL_M / 2, 0.7))
        noise += size * field / field.std()
    return noise


def _flying(z: Float64, seen: Bool, rng: np.random.Generator, defects: Defects) -> tuple[Float64, Bool]:
    wrong = _patches(z.shape, rng, defects.flying_ratio) & seen
    rise = ndimage.gaussian_filter(rng.normal(0, 1, z.shape), 2.0)
    return np.where(wrong, z + 0.3 * rise / rise.std(), z), seen


def _patches(shape: tuple[int, ...], rng: np.random.Generator, share: float) -> Bool:
    """Draw blobs of about 3 x 3 cells that cover a given share of the map."""
    field = ndimage.gaussian_filter(rng.normal(0, 1, shape), 1.5)
    blobs: Bool = field > np.quantile(field[::3, ::3], 1 - share)
    return blobs
