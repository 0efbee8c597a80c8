"""Draw a map's errors onto exact heights: noise that neighbours share, slow errors, unknown cells."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Float32, Float64
from barsight.core.records.heights import HeightSource
from barsight.yard.types import BundleSigma, HeightMap

CELL_SIGMA_M, CORRELATION_CELLS = 0.005, 2.0
SHARED_SIGMA_M, SHARED_CELLS = 0.004, 100.0
STEEP_M, STEEP_UNKNOWN = 0.08, 0.3
"""Where neighbouring cells differ by more than this, so large a share of them is unknown."""
SIGMA = BundleSigma(
    lateral_m=0.004, along_m=0.02, yaw_rad=0.0008, length_m=0.03, width_m=0.01, top_z_m=0.004,
    bar_diameter_m=0.001,
)  # fmt: skip


def seen_heights(exact: HeightMap, rng: np.random.Generator) -> HeightMap:
    """Add noise that neighbours share, an error that changes slowly along the map, and unknown cells."""
    z, shape = exact.z_m, exact.z_m.shape
    noise = _smooth(rng, shape, CORRELATION_CELLS) * CELL_SIGMA_M
    noise += _smooth(rng, shape, SHARED_CELLS) * SHARED_SIGMA_M
    kernel = np.ones((3, 3), np.uint8)
    steep = cv2.dilate(z, kernel) - cv2.erode(z, kernel) > STEEP_M
    lost = steep & (rng.random(shape) < STEEP_UNKNOWN)
    seen = np.where(lost, np.nan, z + noise).astype(np.float32)
    sigma = np.where(lost, np.nan, np.hypot(CELL_SIGMA_M, SHARED_SIGMA_M)).astype(np.float32)
    source = np.where(lost, HeightSource.UNKNOWN, HeightSource.VISION).astype(np.uint8)
    views = np.where(lost, 0, exact.views).astype(np.float32)
    return HeightMap(exact.x0_m, exact.y0_m, exact.cell_m, seen, sigma, views, source)


def _smooth(rng: np.random.Generator, shape: tuple[int, int], cells: float) -> Float32:
    """Smooth white noise over `cells`, of variance 1."""
    shrink = max(1, int(cells / 4))
    rows, columns = -(-shape[0] // shrink) + 8, -(-shape[1] // shrink) + 8
    smooth: Float64 = cv2.GaussianBlur(rng.normal(0, 1, (rows, columns)), (0, 0), cells / shrink)
    smooth /= smooth.std()
    whole = cv2.resize(smooth, (columns * shrink, rows * shrink), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole[: shape[0], : shape[1]], dtype=np.float32)
