"""Cut contours from the surface, along X at a given y."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import median_filter

from barsight.core.arrays import Float64, UInt8
from barsight.core.records.heights import Contour, HeightSource
from barsight.core.records.sensor_samples import LaserProfile
from barsight.mapping.agreement import JUMP_M
from barsight.mapping.surface.surface import Surface

SPACING_M = 0.01
"""Spacing (m) of a contour's samples along X."""
SAME_Y_M = 0.001
"""Maximum distance (m) along Y of a requested contour from a laser profile for them to be compared."""
_FILTER_SAMPLES = 5


def cut_contours(
    surface: Surface,
    laser: tuple[LaserProfile, ...],
    profile_y_m: tuple[float, ...],
    kind: Literal["fused", "paper"] = "fused",
) -> tuple[Contour, ...]:
    """Cut a contour at each y of profile_y_m; if it is empty, at each laser profile, or in the middle without
    a laser.

    At a laser profile, the samples lie on the laser's own x grid, extended over the whole surface, and the
    contour has the laser's number; the others are numbered after the laser's. kind: `fused` for `cut_contour`
    alone, `paper` to apply `smooth_contour` as well.
    """
    places = [(p.profile, float(np.median(p.y_m)), float(p.x_m[0])) for p in laser]
    if profile_y_m:
        unused = max((p.profile + 1 for p in laser), default=0)
        asked = (
            next((place for place in places if abs(place[1] - y) < SAME_Y_M), (unused + number, y, 0.0))
            for number, y in enumerate(dict.fromkeys(profile_y_m))
        )
        places = list(dict.fromkeys(asked))
    elif not laser:
        places = [(0, (surface.rows[0] + surface.rows[1] - 1) / 2 * surface.cell_m, 0.0)]
    contours = tuple(cut_contour(surface, number, y, phase) for number, y, phase in places)
    return contours if kind == "fused" else tuple(smooth_contour(contour) for contour in contours)


def cut_contour(surface: Surface, profile: int, y_m: float, phase_m: float = 0.0) -> Contour:
    """Sample a contour every 10 mm along the whole surface, on the grid through x = phase_m.

    Each sample is the bilinear mean of the four cells around it, without those more than 30 mm above or below
    the nearest one, so that an edge stays sharp. It is unknown where the nearest cell is unknown.
    """
    first, last = ((column * surface.cell_m - phase_m) / SPACING_M for column in surface.columns)
    x = phase_m + np.arange(np.ceil(first), np.floor(last) + 1) * SPACING_M
    column = np.floor(x / surface.cell_m + 1e-6).astype(np.int64)
    row = int(np.floor(y_m / surface.cell_m + 1e-6))
    if x.size == 0:
        return Contour(profile, x, x.copy(), x.copy(), x.copy(), np.empty(0, np.uint8))
    start = int(column[0])
    layers = surface.window(start, row, int(column[-1]) - start + 2, 2)
    share_x = np.clip(x / surface.cell_m - column, 0, 1)
    share_y = min(max(y_m / surface.cell_m - row, 0.0), 1.0)
    corners = [(j, column - start + i) for j in (0, 1) for i in (0, 1)]
    weights = np.stack(
        [(share_y if j else 1 - share_y) * (share_x if i else 1 - share_x) for j in (0, 1) for i in (0, 1)]
    )
    z = np.stack([layers.z_m[c] for c in corners]).astype(np.float64)
    sigma = np.stack([layers.sigma_m[c] for c in corners]).astype(np.float64)
    source = np.stack([layers.source[c] for c in corners])
    return Contour(profile, x, np.full(x.shape, y_m), *_blend(z, sigma, source, weights))


def smooth_contour(contour: Contour) -> Contour:
    """Apply the paper's post-processing [paper 4.4]: median, cubic interpolation of gaps, filter.

    The paper takes the median over the points that several frames have at one place; the map has already
    fused those, so it is taken over a sample and its neighbours. Interpolated samples are FILLED, and their
    sigma is at least half the step that they bridge; nothing is added beyond the ends. The filter is Savitzky
    and Golay's (5 samples, second order), since the paper doesn't name one.
    """
    # Imported only when needed: it takes most of a second.
    from scipy.signal import savgol_filter

    known = np.flatnonzero(np.isfinite(contour.z_m))
    if known.size < _FILTER_SAMPLES:
        return contour
    median = median_filter(contour.z_m[known], 3, mode="nearest")
    inner = np.arange(known[0], known[-1] + 1)
    z, sigma = np.full_like(contour.z_m, np.nan), contour.sigma_m.copy()
    z[inner] = savgol_filter(PchipInterpolator(known, median)(inner), _FILTER_SAMPLES, 2)
    source = contour.source.copy()
    filled = inner[~np.isfinite(contour.z_m[inner])]
    after = np.searchsorted(known, filled)
    step = np.abs(median[after] - median[after - 1])
    sigma[filled] = np.hypot(step / 2, np.maximum(sigma[known[after]], sigma[known[after - 1]]))
    source[filled] = HeightSource.FILLED
    return Contour(contour.profile, contour.x_m, contour.y_m, z, sigma, source)


def _blend(z: Float64, sigma: Float64, source: UInt8, weights: Float64) -> tuple[Float64, Float64, UInt8]:
    """Interpolate four corners (4, N) to height, sigma and source (N,)."""
    nearest = np.argmax(weights, axis=0)[None, :]
    z_nearest = np.take_along_axis(z, nearest, axis=0)
    source_nearest = np.take_along_axis(source, nearest, axis=0)
    joined = (source == source_nearest) & (np.abs(z - z_nearest) <= JUMP_M)
    w = np.where(joined, weights, 0.0)
    with np.errstate(invalid="ignore"):
        w /= w.sum(axis=0)
    known = source_nearest[0] != HeightSource.UNKNOWN
    height = np.where(known, np.where(joined, w * z, 0).sum(axis=0), np.nan)
    spread = np.where(known, np.where(joined, w * sigma, 0).sum(axis=0), np.nan)
    return height, spread, source_nearest[0]
