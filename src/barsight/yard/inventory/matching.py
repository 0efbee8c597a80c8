"""Match the bundles of two surveys or lists, each at most once, and decide which of them have moved."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.spatial import KDTree

from barsight.core.arrays import Bool, Float64, Int64
from barsight.yard.types import UNKNOWN_SIGMA_M, UNKNOWN_SIGMA_RAD, Bundle

SIGNIFICANCE = 0.001
"""Probability by which chance alone lets a bundle that lies still count as moved."""
MOVE_SIGMAS = NormalDist().inv_cdf(1 - SIGNIFICANCE / 8)
"""The same as a bound on each of four two-sided figures (Bonferroni)."""
MOVED_M, MOVED_RAD = 0.05, math.radians(1.0)
"""Minimum move that isn't the settling of a pile or a rough list."""
SAME_PLACE_SIGMAS, SAME_SIZE_RATIO = 4.0, 0.15
"""Tolerance for two measured values to agree, in combined sigmas; of sizes also as a share."""
FRAME_SIGMA_M, FRAME_SIGMA_RAD = 0.02, math.radians(0.3)
"""Standard deviations of errors common to a whole survey, its place in the yard, beside the stated sigmas."""
_MIN_LENGTH_TOLERANCE_M = 0.1
_MAX_TURN_RAD = math.radians(6.0)
MIN_GAIN = 1e-3
"""Gain of a pair that is as unlikely as a possible one can be."""
_ROWS = 256
"""Number of bundles whose neighbours are looked up at a time."""


@dataclass(frozen=True, eq=False)
class Places:
    """Places and sizes of N bundles; NaN where one isn't known.

    top_m: (N, 3) x and y of the axis's middle, height of the top. yaw_rad: (N,). sizes: (N, 4) length, width,
    bar diameter (m) and section (m2). sigmas: (N, 4) of the place across, along and up (m) and of yaw.
    size_sigmas: (N, 4). ends_open: (N, 2). ends_sigma_m: (N, 2).
    """

    top_m: Float64
    yaw_rad: Float64
    sizes: Float64
    sigmas: Float64
    size_sigmas: Float64
    ends_open: Bool
    ends_sigma_m: Float64

    @classmethod
    def of(cls, bundles: Sequence[Bundle]) -> Places:
        """Collect the places of bundles."""

        def table(rows: list[Any], columns: int) -> Float64:
            return np.array(rows, np.float64).reshape(-1, columns)

        sigma = [one.sigma for one in bundles]
        return cls(
            table([(*one.centre_m[:2], one.top_z_m) for one in bundles], 3),
            np.array([one.yaw_rad for one in bundles], np.float64),
            table([(b.length_m, b.width_m, b.bar_diameter_m, b.section_m2) for b in bundles], 4),
            table([(s.lateral_m, s.along_m, s.top_z_m, s.yaw_rad) for s in sigma], 4),
            table([(s.length_m, s.width_m, s.bar_diameter_m, s.section_m2) for s in sigma], 4),
            table([one.ends_open for one in bundles], 2).astype(np.bool_),
            table([one.ends_sigma_m for one in bundles], 2),
        )

    def take(self, rows: Int64 | Sequence[int]) -> Places:
        """Select bundles."""
        chosen = np.asarray(rows, np.int64)
        return Places(*(one[chosen] for one in vars(self).values()))

    def across_along(self, way_m: Float64) -> tuple[Float64, Float64]:
        """Split ways (N, 2) into their parts (N,) across the axes and along them."""
        across, along = self.axes
        return (way_m * across).sum(axis=1), (way_m * along).sum(axis=1)

    @property
    def axes(self) -> tuple[Float64, Float64]:
        """Return unit vectors (N, 2) in plan view: across the axes and along them."""
        cos, sin = np.cos(np.nan_to_num(self.yaw_rad)), np.sin(np.nan_to_num(self.yaw_rad))
        return np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)

    def __len__(self) -> int:
        return len(self.yaw_rad)


@dataclass(frozen=True, eq=False)
class Displacements:
    """Displacements of N bundles. values, sigmas: (N, 4) across, along and up (m) and yaw (rad), in the
    axes before, the sigmas from both measurements. along: of the middle if all ends were seen, otherwise of
    an end that was seen both times; value and sigma are 0 if there is none.
    """

    values: Float64
    sigmas: Float64

    @property
    def ratios(self) -> Float64:
        """Return the ratios (N, 4) of the displacements to their sigmas; 0 where nothing is known."""
        is_known = self.sigmas > 0
        return np.where(is_known, np.abs(self.values) / np.where(is_known, self.sigmas, 1), 0)

    def moved(self, min_m: float = 0.0, min_rad: float = 0.0) -> Bool:
        """Decide which have moved (N,): by more than these, and than by chance at SIGNIFICANCE."""
        floor = np.array([min_m, min_m, min_m, min_rad])
        return np.asarray(((np.abs(self.values) > floor) & (self.ratios > MOVE_SIGMAS)).any(axis=1))


def displace(before: Places, after: Places, shift_m: Float64 | None = None) -> Displacements:
    """Compute the displacements of N bundles, beyond a shift (3,) of the whole yard."""
    turned = np.nan_to_num((after.yaw_rad - before.yaw_rad + math.pi / 2) % math.pi - math.pi / 2)
    way = np.nan_to_num(after.top_m - before.top_m - (0 if shift_m is None else shift_m))
    across, along = before.across_along(way[:, :2])
    across += along * np.tan(turned) / 2
    unknown = np.array([*(UNKNOWN_SIGMA_M,) * 3, UNKNOWN_SIGMA_RAD])
    sigmas = np.hypot(*(np.where(np.isnan(one.sigmas), unknown, one.sigmas) for one in (before, after)))
    along, sigmas[:, 1] = _along_seen(before, after, along, sigmas[:, 1])
    return Displacements(np.stack([across, along, way[:, 2], turned], axis=1), sigmas)


def _along_seen(
    before: Places, after: Places, middle: Float64, middle_sigma: Float64
) -> tuple[Float64, Float64]:
    """Compute the displacements (N,) along the axes and their sigmas from those of the middles, or from an
    end that was seen both times.
    """
    # Along X, a small turn swaps which end is the low one.
    swapped = (np.cos(after.yaw_rad - before.yaw_rad) < 0)[:, None]
    is_open = before.ends_open | np.where(swapped, after.ends_open[:, ::-1], after.ends_open)
    end_sigma = np.hypot(
        _ends_sigma(before),
        np.where(swapped, _ends_sigma(after)[:, ::-1], _ends_sigma(after)),
    )
    grown = (after.sizes[:, 0] - before.sizes[:, 0]) / 2
    seen = ~is_open & np.isfinite(grown)[:, None]
    cases = [~is_open.any(axis=1), seen[:, 0], seen[:, 1]]
    along = np.select(cases, [middle, middle - grown, middle + grown], 0.0)
    return along, np.select(cases, [middle_sigma, end_sigma[:, 0], end_sigma[:, 1]], 0.0)


def _ends_sigma(places: Places) -> Float64:
    """Return the sigmas (N, 2) of the ends along the axis, from those of middle and length where unknown."""
    own = places.ends_sigma_m
    parts = np.hypot(np.nan_to_num(places.sigmas[:, 1]), np.nan_to_num(places.size_sigmas[:, 0]) / 2)
    return np.where(np.isfinite(own), own, parts[:, None])


def common_shift(before: Places, after: Places) -> Float64:
    """Estimate the shift (3,) of the whole yard, as by an error of its frame, from N matched bundles.

    Bundles that moved hardly count (Cauchy weights), and a shift is unlikely beyond FRAME_SIGMA_M.
    """
    moves = displace(before, after)
    rows = np.zeros((len(before), 3, 3))
    rows[:, 0, :2], rows[:, 1, :2] = before.axes
    rows[:, 2, 2] = 1
    values, sigmas = moves.values[:, :3], moves.sigmas[:, :3]
    weights = np.divide(1, sigmas**2, out=np.zeros_like(sigmas), where=sigmas > 0)
    shift = np.zeros(3)
    for _ in range(30):
        each = weights / (1 + weights * (values - rows @ shift) ** 2)
        normal = np.einsum("nij,ni,nik->jk", rows, each, rows) + np.eye(3) / FRAME_SIGMA_M**2
        shift = np.linalg.solve(normal, np.einsum("nij,ni,ni->j", rows, each, values))
    return np.asarray(shift, np.float64)


def moved_bundles(before: Sequence[Bundle], after: Sequence[Bundle]) -> list[bool]:
    """Decide which of N matched bundles have moved, neither by noise, nor as a pile settles, nor with the
    whole yard.
    """
    old, new = Places.of(before), Places.of(after)
    moved: list[bool] = displace(old, new, common_shift(old, new)).moved(MOVED_M, MOVED_RAD).tolist()
    return moved


@dataclass(frozen=True, eq=False)
class Candidates:
    """Pairs of bundles that may be one, as far as their places tell. before, after: (P,) indices. in_place:
    whether both lie in one place. agree: whether their sizes do. gain: how much better the pair is than none,
    above 0, by the displacement and the difference of sizes in sigmas.
    """

    before: Int64
    after: Int64
    in_place: Bool
    agree: Bool
    gain: Float64


def match_bundles(
    before: Places, after: Places, reach_m: float = 0.0, *, sizes_agree: bool = True
) -> dict[int, int]:
    """Match bundles: index in `after` by index in `before`. See `find_candidates`, `match_candidates`."""
    return match_candidates(find_candidates(before, after, reach_m), sizes_agree=sizes_agree)


def match_candidates(found: Candidates, *, sizes_agree: bool = True) -> dict[int, int]:
    """Choose pairs so that each bundle has at most one partner and the total gain is largest: `after` by
    `before`. sizes_agree: whether only bundles of equal sizes match.
    """
    chosen = found.agree | (not sizes_agree)
    before, after, gain = found.before[chosen], found.after[chosen], found.gain[chosen]
    if not len(gain):
        return {}
    count, columns = int(before.max()) + 1, int(after.max()) + 1
    alone, worst = np.arange(count), float(gain.max()) + 1
    costs = np.concatenate([worst - gain, np.full(count, worst)])
    places = np.concatenate([before, alone]), np.concatenate([after, columns + alone])
    graph = csr_array((costs, places), shape=(count, columns + count))
    pairs = zip(*min_weight_full_bipartite_matching(graph), strict=True)
    return {int(i): int(j) for i, j in pairs if j < columns}


def find_candidates(before: Places, after: Places, reach_m: float = 0.0) -> Candidates:
    """Find the pairs that lie in one place, where two can't be side by side, or within reach.

    reach_m: distance, m, by which a bundle may have moved across or along.
    """
    none = np.zeros(0, np.int64)
    parts = [_candidates(before, after, none, none, reach_m)]
    if len(before) and len(after):
        tree, longest = KDTree(after.top_m[:, :2]), float(np.nan_to_num(after.sizes[:, 0]).max())
        length, width = np.nan_to_num(before.sizes[:, :2]).T
        radius = np.hypot(
            np.maximum(width / 2, reach_m), np.maximum(np.maximum(length, longest) / 2, reach_m)
        )
        for start in range(0, len(before), _ROWS):
            rows = np.arange(start, min(start + _ROWS, len(before)))
            near = tree.query_ball_point(before.top_m[rows, :2], radius[rows], return_sorted=True)
            i = np.repeat(rows, [len(each) for each in near])
            parts.append(_candidates(before, after, i, np.concatenate(near).astype(np.int64), reach_m))
    return Candidates(*(np.concatenate([getattr(one, name) for one in parts]) for name in vars(parts[0])))


def _candidates(before: Places, after: Places, i: Int64, j: Int64, reach_m: float) -> Candidates:
    one, other = before.take(i), after.take(j)
    moves = displace(one, other)
    across, along, up, turn = np.abs(moves.values).T
    along = np.abs(one.across_along((other.top_m - one.top_m)[:, :2])[1])
    half = np.fmin(one.sizes[:, 1], other.sizes[:, 1]) / 2
    is_open = (one.ends_open | other.ends_open).any(axis=1)
    long = np.where(is_open, 0.5, 0.25) * np.fmax(one.sizes[:, 0], other.sizes[:, 0])
    is_level = up < np.maximum(half, SAME_PLACE_SIGMAS * moves.sigmas[:, 2])
    in_place = is_level & (across < half) & (along < long) & (turn < _MAX_TURN_RAD)
    near = in_place | (is_level & (across < reach_m) & (along < np.maximum(long, reach_m)))
    spread = np.hypot(moves.sigmas, [*(FRAME_SIGMA_M,) * 3, FRAME_SIGMA_RAD])
    away = np.where(moves.sigmas > 0, moves.values / spread, 0)
    agree, differ = _compare_sizes(one, other)
    # Heavy tails (Cauchy): bundles that moved are far off by their sigmas, and two moved far are less likely
    # than one that lies and one that is gone.
    bound = np.log1p((np.maximum(half, reach_m) / spread[:, 0]) ** 2) + np.log1p(SAME_PLACE_SIGMAS**2)
    gain = bound - np.log1p((away**2).sum(axis=1)) - np.log1p(differ)
    gain = np.maximum(gain, MIN_GAIN)
    return Candidates(i[near], j[near], in_place[near], agree[near], gain[near])


def agree_in_size(before: Places, after: Places) -> Bool:
    """Compare length, width, bar diameter and section of N bundles each, where both are known."""
    return _compare_sizes(before, after)[0]


def _compare_sizes(before: Places, after: Places) -> tuple[Bool, Float64]:
    """Return whether the sizes agree (N,), and the sum of their squared differences in sigmas (N,).

    A bundle with an open end may be longer than seen.
    """
    differ = after.sizes - before.sizes
    sigmas = np.hypot(np.nan_to_num(before.size_sigmas), np.nan_to_num(after.size_sigmas))
    tolerance = np.maximum(SAME_SIZE_RATIO * before.sizes, SAME_PLACE_SIGMAS * sigmas)
    tolerance[:, 0] = np.maximum(_MIN_LENGTH_TOLERANCE_M, SAME_PLACE_SIGMAS * sigmas[:, 0])
    for one, sign in ((before, 1), (after, -1)):
        is_open = one.ends_open.any(axis=1)
        differ[:, 0] = np.where(is_open & (sign * differ[:, 0] > 0), 0, differ[:, 0])
    differ = np.nan_to_num(differ)
    spread = np.hypot(sigmas, np.nan_to_num(SAME_SIZE_RATIO / SAME_PLACE_SIGMAS * before.sizes))
    ratios = np.divide(differ, spread, out=np.zeros_like(differ), where=spread > 0)
    return np.asarray(~(np.abs(differ) > tolerance).any(axis=1)), (ratios**2).sum(axis=1)
