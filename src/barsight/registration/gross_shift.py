"""Search the gross shift of one height map with its picture against another, as of encoders that lost their
reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from barsight.core.arrays import Bool, Float64
from barsight.registration.block_shifts import GATE_M, MatchedMap, smooth_known

COARSE_M = 0.04
"""Size of the cells that are compared."""
REACH_M = 2.0
"""Largest shift searched for, along x and y."""
NEAR_M = 0.04
"""Largest shift that `block_shifts` finds by itself; its steps of a bar's pitch look alike."""
SLOW_M = (1.0, 0.4)
"""Size of the structures that count, of heights and of pictures; slower changes are removed."""
MIN_ALIKE, MIN_MORE = 0.5, 0.15
"""Minimum correlation at a gross shift, and minimum excess over that without one."""
MIN_OVERLAP_RATIO = 0.3
"""Minimum share of the common cells that a shift leaves."""
VOTER_M, MIN_VOTES, MIN_VOTERS_RATIO = 0.64, 0.7, 0.3
"""Size of the parts that vote between the shift and none; minimum share of votes for it, and minimum share of
the parts that vote: fewer may show a bundle that was moved.
"""
MIN_LEVEL_RATIO, MAX_STILL_RATIO = 0.7, 0.05
"""Minimum share of the common cells within GATE_M of a common difference in height; maximum share of those
that kept their height: floor beside a layer that was laid since does.
"""


@dataclass(frozen=True, eq=False)
class CoarsePair:
    """Two maps on one coarse grid (H, W): heights and pictures, NaN where unknown."""

    heights: tuple[Float64, Float64]
    pictures: tuple[Float64, Float64]

    @classmethod
    def of(cls, first: MatchedMap, second: MatchedMap, cell_m: float) -> CoarsePair:
        """Average the maps to coarse cells."""
        step = max(1, round(COARSE_M / cell_m))
        return cls(
            (_reduced(first.z_m, step), _reduced(second.z_m, step)),
            (_reduced(first.gray, step), _reduced(second.gray, step)),
        )


def find_gross_shift(pairs: Sequence[CoarsePair], cell_m: float) -> Float64:
    """Find the shift (3,) m that moves the second maps onto the first, 0 where none explains them far better.

    pairs: parts of the same two maps. cell_m: of the maps before they were averaged. Heights and pictures are
    correlated over their known cells; most parts that tell must prefer the shift.
    """
    coarse_m = cell_m * max(1, round(COARSE_M / cell_m))
    alike = _correlated(pairs, coarse_m)
    reach = alike.shape[0] // 2
    near = round(NEAR_M / coarse_m)
    if np.isnan(alike).all():
        return np.zeros(3)
    middle = alike[reach - near : reach + near + 1, reach - near : reach + near + 1]
    row, column = np.unravel_index(int(np.nanargmax(alike)), alike.shape)
    best = float(alike[row, column])
    rows, columns = int(row) - reach, int(column) - reach
    if not (
        best >= MIN_ALIKE
        and best - np.nanmax(middle) >= MIN_MORE
        and _is_voted(pairs, rows, columns, coarse_m)
    ):
        rows = columns = 0
    shift = np.array([columns * coarse_m, rows * coarse_m, 0.0])
    if best >= MIN_ALIKE:
        off = np.concatenate([
            (one.heights[0] - _shifted(one.heights[1], rows, columns)).ravel() for one in pairs
        ])  # fmt: skip
        off = off[np.isfinite(off)]
        level = float(np.median(off)) if off.size else 0.0
        still = np.mean(np.abs(off) < min(GATE_M, abs(level) / 2)) > MAX_STILL_RATIO
        if abs(level) > GATE_M and np.mean(np.abs(off - level) < GATE_M) >= MIN_LEVEL_RATIO and not still:
            shift[2] = level
    return shift


def _reduced(values: np.ndarray, step: int) -> Float64:
    """Average blocks of step x step known cells; NaN where none is."""
    rows, columns = (size // step for size in values.shape)
    parts = values[: rows * step, : columns * step].astype(np.float64).reshape(rows, step, columns, step)
    known = np.isfinite(parts)
    count = known.sum(axis=(1, 3))
    total = np.where(known, parts, 0.0).sum(axis=(1, 3))
    mean: Float64 = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean


def _contrast(values: Float64, sigma_cells: float) -> tuple[Float64, Bool]:
    """Subtract the slow part of the known cells; returns 0 elsewhere, and which are known."""
    known = np.isfinite(values)
    return np.where(known, values - smooth_known(values, known, sigma_cells), 0.0), known


def _features(one: CoarsePair, coarse_m: float) -> list[tuple[tuple[Float64, Bool], tuple[Float64, Bool]]]:
    """Return the contrasts of both maps, of heights and of pictures."""
    both = zip((one.heights, one.pictures), SLOW_M, strict=True)
    return [
        (_contrast(first, slow_m / coarse_m), _contrast(second, slow_m / coarse_m))
        for (first, second), slow_m in both
    ]


def _correlated(pairs: Sequence[CoarsePair], coarse_m: float) -> Float64:
    """Compute the mean correlation of heights and pictures for all shifts within REACH_M, (2 R + 1, 2 R + 1);
    NaN where too little would be in common.
    """
    reach = round(REACH_M / coarse_m)
    lags = np.arange(-reach, reach + 1)
    sums = np.zeros((2, 4, lags.size, lags.size))
    for one in pairs:
        shape = [fft.next_fast_len(size + reach) for size in one.heights[0].shape]
        for k, ((a, known_a), (b, known_b)) in enumerate(_features(one, coarse_m)):
            own, squares, ones = (fft.rfft2(part.astype(np.float64), shape) for part in (a, a * a, known_a))
            others = [np.conj(fft.rfft2(part.astype(np.float64), shape)) for part in (b, b * b, known_b)]
            products = own * others[0], squares * others[2], ones * others[1], ones * others[2]
            for n, product in enumerate(products):
                sums[k, n] += fft.irfft2(product, shape)[np.ix_(lags % shape[0], lags % shape[1])]
    power = np.sqrt(np.maximum(sums[:, 1] * sums[:, 2], 0))
    enough = sums[:, 3] >= max(MIN_OVERLAP_RATIO * float(sums[0, 3, reach, reach]), 1.0)
    whole = np.where(enough & (power > 0), sums[:, 0] / np.where(power > 0, power, 1.0), np.nan)
    mean: Float64 = whole.mean(axis=0)
    return mean


def _shifted(values: Float64, rows: int, columns: int) -> Float64:
    """Move a map by whole cells; NaN where nothing comes from."""
    moved = np.full_like(values, np.nan)
    height, width = values.shape
    moved[max(rows, 0) : height + min(rows, 0), max(columns, 0) : width + min(columns, 0)] = values[
        max(-rows, 0) : height + min(-rows, 0), max(-columns, 0) : width + min(-columns, 0)
    ]
    return moved


def _is_voted(pairs: Sequence[CoarsePair], rows: int, columns: int, coarse_m: float) -> bool:
    """Check whether most parts of the overlap that tell are more alike with the shift than without."""
    side = max(2, round(VOTER_M / coarse_m))
    votes, tell, known = 0, 0, 0
    for one in pairs:
        moved = CoarsePair(
            (one.heights[0], _shifted(one.heights[1], rows, columns)),
            (one.pictures[0], _shifted(one.pictures[1], rows, columns)),
        )
        (before, common), (after, _) = _local(one, side, coarse_m), _local(moved, side, coarse_m)
        more = np.where(common, after - before, 0.0)
        votes += int((more > MIN_MORE).sum())
        tell += int((np.abs(more) > MIN_MORE).sum())
        known += int(common.sum())
    return votes >= MIN_VOTES * tell and tell >= MIN_VOTERS_RATIO * max(known, 1)


def _local(one: CoarsePair, side: int, coarse_m: float) -> tuple[Float64, Bool]:
    """Correlate heights and pictures in each part of side x side cells; also return which have enough."""
    rows, columns = (size // side for size in one.heights[0].shape)

    def sums(values: Float64) -> Float64:
        parts = values[: rows * side, : columns * side].reshape(rows, side, columns, side)
        total: Float64 = parts.sum(axis=(1, 3))
        return total

    alike, common = np.zeros((rows, columns)), np.ones((rows, columns), np.bool_)
    for (a, known_a), (b, known_b) in _features(one, coarse_m):
        both = known_a & known_b
        a, b = a * both, b * both
        alike += sums(a * b) / np.sqrt(sums(a * a) * sums(b * b) + 1e-9) / 2
        common &= sums(both.astype(np.float64)) >= MIN_OVERLAP_RATIO * side**2
    return alike, common
