"""Match cross-sections of the map to the outlines of all bundles that may be in the yard."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from barsight.core.arrays import Float32, Float64, Int64, kernel
from barsight.core.linalg.robust import nan_medians
from barsight.yard.bundles.fitting.outline import (
    BARS_OF_RINGS,
    STEP_M,
    bundle_width,
    make_outline,
    period_rad,
)
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.fitting.settings import BundleSettings

_RATIO = 1.06
_ROLLS = 10
_PHASES = 2
_SPREAD_M = 0.06
_KNOWN = 0.55
_RIM_M = 0.004
_BEYOND_M = 0.01
_BLOCK = 64
"""Number of columns that one thread compares with all outlines: they fit in its nearest cache."""


@dataclass(frozen=True)
class BundleCandidate:
    """A bundle that may cross the section at v_m: place, axis height, kind. gain: cells it explains."""

    v_m: float
    u_m: float
    z_m: float
    rings: int
    diameter_m: float
    roll_rad: float
    gain: float


@dataclass(frozen=True, eq=False)
class Templates:
    """Outlines sampled in cells. kinds: (T, 3) rings, diameter, roll. offsets: (T,) first cell from the
    middle.

    heights: (T, widest) float32 over the axis, NaN past the end. phase: (T,) shift of the axis in cells.
    """

    kinds: Float64
    phase: Float64
    offsets: Int64
    lengths: Int64
    heights: Float32


def cross_section(grid: AlignedMap, v_m: float, length_m: float) -> Float32:
    """Compute each column's median height (columns,) over `length_m` about v_m; NaN if unknown or floor."""
    first = round((v_m - length_m / 2 - grid.v0_m) / grid.cell_m)
    rows = max(round(length_m / grid.cell_m), 1)
    part = grid.z_m[max(first, 0) : first + rows]
    known = np.isfinite(part).sum(axis=0)
    out = np.full(part.shape[1], np.nan, np.float32)
    enough = known >= max(0.3 * rows, 1)
    if enough.any():
        out[enough] = nan_medians(part[:, enough])
    out[out <= grid.stock_over_m] = np.nan
    return out


def make_templates(settings: BundleSettings, cell_m: float) -> Templates:
    """Sample the outlines of all bundles that the settings allow: diameters 6 % apart, or the catalogue's."""
    kinds, phases, samples = [], [], []
    for rings in range(len(BARS_OF_RINGS)):
        rolls = period_rad(rings) * np.arange(_ROLLS) / _ROLLS if rings else np.zeros(1)
        for diameter in _diameters(rings, settings):
            for roll in rolls:
                outline = make_outline(rings, diameter, roll, settings.smoothing_m)
                for phase in range(_PHASES):
                    shift = phase / _PHASES
                    half = int((outline.reach_m - _RIM_M) / cell_m)
                    u = cell_m * (np.arange(-half, half + 2) - shift)
                    at = np.rint((u + outline.reach_m) / STEP_M).astype(int)
                    inside = (np.abs(u) < outline.reach_m - _RIM_M) & (at >= 0) & (at < outline.seen_m.size)
                    heights = np.where(inside, outline.seen_m[at.clip(0, outline.seen_m.size - 1)], np.nan)
                    there = np.flatnonzero(np.isfinite(heights))
                    kinds.append((rings, diameter, roll))
                    phases.append(shift)
                    samples.append((there[0] - half, heights[there[0] : there[-1] + 1]))
    widest = max(len(s[1]) for s in samples)
    heights = np.full((len(samples), widest), np.nan, np.float32)
    for k, (_, row) in enumerate(samples):
        heights[k, : len(row)] = row
    return Templates(
        np.array(kinds), np.array(phases), np.array([s[0] for s in samples], np.int64),
        np.array([len(s[1]) for s in samples], np.int64), heights,
    )  # fmt: skip


def _diameters(rings: int, settings: BundleSettings) -> list[float]:
    if settings.catalogue_mm:
        return [d / 1000 for d in settings.catalogue_mm if settings.allows(rings, d / 1000)]
    low, high = settings.diameters_m(rings)
    if low > high:
        return []
    return list(np.geomspace(low, high, int(np.log(high / low) / np.log(_RATIO)) + 2))


def propose_candidates(
    grid: AlignedMap, templates: Templates, v_m: float, settings: BundleSettings
) -> list[BundleCandidate]:
    """Propose bundles that may cross the section at v_m, best first: local maxima for each
    number of rings.
    """
    profile = cross_section(grid, v_m, settings.slice_m)
    if not np.isfinite(profile).any():
        return []
    classes = np.unique(templates.kinds[:, 0]).astype(np.int64)
    of_class = np.searchsorted(classes, templates.kinds[:, 0].astype(np.int64))
    gain, height, which = _match(
        profile, templates.heights, templates.offsets, templates.lengths, of_class, len(classes),
        settings.agreement_m,
    )  # fmt: skip
    guesses = []
    for k in range(len(classes)):
        for column in _peaks(gain[k]):
            t = int(which[k, column])
            rings, diameter, roll = templates.kinds[t]
            u = grid.u0_m + (column + templates.phase[t]) * grid.cell_m
            score = float(gain[k, column])
            if score < 0.4 * bundle_width(int(rings), diameter) / grid.cell_m:
                continue
            z = float(height[k, column])
            guesses.append(BundleCandidate(v_m, float(u), z, int(rings), float(diameter), float(roll), score))
    return sorted(guesses, key=lambda g: -g.gain)


def _peaks(gain: Float32) -> list[int]:
    """Find the columns whose gain is no smaller than any within three cells."""
    reach = 3
    padded = np.pad(gain, reach, constant_values=-np.inf)
    best = np.max([padded[k : k + gain.size] for k in range(2 * reach + 1)], axis=0)
    return np.flatnonzero((gain > 0) & (gain >= best)).tolist()


def _match(
    profile: Float32, heights: Float32, offsets: Int64, lengths: Int64, of_class: Int64, classes: int,
    agreement: float,
) -> tuple[Float32, Float32, Int64]:  # fmt: skip
    """Match templates to a profile. Return three arrays (classes, columns), about each column: gain of the
    best template in cells, height of its axis, its number.

    Each known cell gains 1 - (misfit / agreement)^2, but at least -1.
    """
    shape = classes, profile.size
    best = (
        np.full(shape, -np.inf, np.float32), np.full(shape, np.nan, np.float32), np.full(shape, -1, np.int64),
    )  # fmt: skip
    known = ~np.isnan(profile)
    surface = np.where(known, profile, np.float32(0.0))
    known_before = np.concatenate([[0], np.cumsum(known)])
    _match_blocks(
        profile, surface, known.astype(np.float32), known_before, heights, offsets, lengths, of_class,
        agreement, best,
    )  # fmt: skip
    return best


@kernel(parallel=True)
def _match_blocks(
    profile: Float32, surface: Float32, seen: Float32, known_before: Int64, heights: Float32, offsets: Int64,
    lengths: Int64, of_class: Int64, agreement: float, best: tuple[Float32, Float32, Int64],
) -> None:  # fmt: skip
    """Match into `best` as `_match` does. surface: the profile, 0 where unknown; seen: 1 where known, else 0;
    known_before: cumulative sums of seen, starting with 0.

    profile, surface (m), seen: (columns,); known_before: (columns + 1,). heights: (T, widest) m; offsets,
    lengths, of_class: (T,). best: gain, height (m) and template's number, (classes, columns).
    """
    gain, height, which = best
    columns = profile.size
    for block in numba.prange((columns + _BLOCK - 1) // _BLOCK):
        for t in range(offsets.size - 1, -1, -1):
            k, n, template = of_class[t], lengths[t], heights[t]
            start = max(block * _BLOCK, -offsets[t])
            for column in range(start, min((block + 1) * _BLOCK, columns - n - offsets[t] + 1)):
                first = column + offsets[t]
                known = known_before[first + n] - known_before[first]
                if known < _KNOWN * n or known <= gain[k, column]:
                    continue
                low, high = _bounds(profile[first : first + n], template)
                if high - low > _SPREAD_M or high < low:
                    continue
                z, score = _compare(
                    surface[first : first + n], seen[first : first + n], template, known,
                    low - _BEYOND_M, high + _BEYOND_M, agreement,
                )  # fmt: skip
                if score > gain[k, column]:
                    gain[k, column] = score
                    height[k, column] = z
                    which[k, column] = t


@kernel()
def _bounds(profile: Float32, template: Float32) -> tuple[float, float]:
    """Bound the height of the profile over the template by five samples; inf, -inf where all are unknown.

    profile: (N,) m. template: (N,) m over the axis, or longer.
    """
    low, high = np.inf, -np.inf
    for q in range(5):
        i = q * (profile.size - 1) // 4
        r = profile[i] - template[i]
        if r == r:
            low, high = min(low, r), max(high, r)
    return low, high


@kernel()
def _compare(
    surface: Float32, seen: Float32, template: Float32, known: int, low: float, high: float, agreement: float
) -> tuple[float, float]:
    """Compute the height of the axis and the gain of a template placed on a piece of the profile.

    surface: 0 where unknown; seen: 1 where known, else 0. All values are finite, so sums may run in any
    order. surface, seen: (N,); template: (N,) m over the axis, or longer. known: sum of seen. low, high:
    bounds of the height, m.
    """
    one, nothing = np.float32(1.0), np.float32(0.0)
    least, most, gate = np.float32(low), np.float32(high), np.float32(1.5 * agreement)
    total = nothing
    for i in range(surface.size):
        total += seen[i] * min(max(surface[i] - template[i], least), most)
    z = np.float32(total / known)
    for _ in range(2):
        total, near = nothing, nothing
        for i in range(surface.size):
            r = surface[i] - template[i] - z
            counts = seen[i] if abs(r) < gate else nothing
            total += counts * r
            near += counts
        if near > 0:
            z += total / near
    score, scale = nothing, np.float32(1.0 / agreement)
    for i in range(surface.size):
        r = (surface[i] - template[i] - z) * scale
        score += seen[i] * max(one - r * r, -one)
    return float(z), float(score)
