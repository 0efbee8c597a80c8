"""Measure the section of a bundle that is seen from above: its width, its top, and its possible depth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.linalg.robust import nan_medians
from barsight.yard.bundles.fitting.outline import STEP_M, make_outline, turned_packing
from barsight.yard.bundles.fitting.outline_fit import (
    AGREES,
    DIAMETER,
    ROLL,
    SLOPE_U,
    SLOPE_Z,
    Fit,
    FittedOutline,
    U,
    Z,
)
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.lift_settings import UPPER

_UNIT = NormalDist()
_ROWS_ENOUGH = 120
_GULLY_RATIO = 0.95
"""Minimum depth, in bar diameters, of a dip between two crests that separates two bundles."""
_REACH_RATIO = 1.5
"""Maximum distance from the axis, in widths of the outline, at which parts of a bundle are searched for."""
_GULLIES_APART = 0.8
"""Share of the places, with the smallest misfits, that are judged: maps smooth gullies differently."""
_MISFIT_RATIO, _HEIGHT_RATIO, _WIDTH_RATIO = 0.05, 0.1, 0.2
"""Tolerances, in bar diameters, for bars to be counted: RMS misfit of the surface, height, width."""
_HIDDEN_M = 0.12
"""Distance (m) behind a hidden side within which the surface is searched."""
_RIM, _HIGHER_M = 4, 0.03
"""Number of places compared on either side of a flank, and the rise (m) of a neighbour that is higher."""
_WIDER_M = 0.045
_MIN_PIECE_RATIO, _MAX_PIECE_RATIO = 0.7, 1.5
"""Bounds of a section's width, in widths of the outline (the upper one widened by _WIDER_M): what is narrower
or wider isn't the outline's section.
"""
_ALIKE_LOG = 0.35
"""Maximum log ratio of two neighbours' widths: beyond it they may be pieces of one irregular pack."""
_PARTED_RATIO, _PARTED_BARS, _PARTED_DIAMETER_M = 0.3, 1.5, 0.04
"""Minimum depth to which the surface sinks between two separate bundles, in outline widths and in bars, and
minimum diameter (m) of their bars. Below these, they may be pieces of one pack: a bar one layer below the
highest shows a gully 0.87 + 0.5 bars under its top, and a diameter's sigma is 6 %.
"""
MAX_HEIGHT_RATIO, _MAX_FILL_RATIO = 1.25, 0.79
"""Maximum height of a bundle in widths, and maximum share of steel in its bounding box."""
_HEIGHT_RATIO_PRIOR = NormalDist(0.92, 0.14)
"""Prior of a bundle's height in widths. Its mean and deviation, and those of the fill ratio, come from 1500
settled packs simulated with seeds 0 to 1499; full hexagons at any roll lie within two deviations of both.
"""
_FILL_RATIO, _BAR_FILL_RATIO = (0.65, 0.045), (0.70, 0.055)
"""Mean and deviation of the share of steel in a bundle's bounding box, and in that of what looks like one
bar: it is one, or a round pack of thin ones.
"""
_MAX_DEVIATIONS = 4.0
"""Maximum deviations from the prior's mean: a floor further above cuts off nothing, further below no more."""
_BULGE_RATIO = 0.4
"""Standard deviation of the bulge of bars behind a flank, as a fraction of the unseen length there."""
_GROWTH_M = 0.01
"""Width (m) that the map adds to a bundle: the matching window, not the size of the cells, determines it."""
_SEEN_WIDTH_SIGMA_M, _SEEN_WIDTH_CELLS, _OUTLINE_RATIO = 0.0113, 6**-0.5, 0.5
"""Errors of the seen width: a constant standard deviation (m), the rounding of both sides to whole cells, and
a fraction of its difference from the outline's width.
"""
_FINE_SIGMA_M = 0.012
"""Standard deviation (m) of the seen width with cells of 10 mm, which a map's growth outweighs."""


@dataclass(frozen=True, eq=False)
class SeenSection:
    """The section of a bundle that is seen.

    width_m: from side to side, with its sigma. misfit_m: RMS of the mean section over the outline of a full
    hexagon. sides_seen: both sides fall to the floor, or sink deep before a bundle of about its width begins.
    sides_free: both fall to the floor. hidden_m: length out of sight behind the low and the high side.
    middle_m: place midway between the sides, beside the outline's axis.
    """

    width_m: float
    misfit_m: float
    sides_seen: bool
    sides_free: bool
    hidden_m: tuple[float, float] = (0.0, 0.0)
    width_sigma_m: float = 0.012
    middle_m: float = 0.0


def seen_section(one: FittedOutline, others: list[FittedOutline], smoothing_m: float) -> SeenSection | None:
    """Measure the mean section over the rows that agree; None where there are too few."""
    grid, fit = one.grid, one.fit
    rows = agreeing_rows(fit)
    if rows.size < 3:
        return None
    half = round(_REACH_RATIO * fit.width_m / grid.cell_m)
    beside, level = mean_section(grid, fit, rows, half)
    crest = half + round(0.3 * fit.width_m / grid.cell_m) * np.array([-1, 1])
    middle = int(crest[0] + np.argmax(np.nan_to_num(level[crest[0] : crest[1] + 1], nan=-np.inf)))
    deep_m = _GULLY_RATIO * float(fit.values[DIAMETER])
    others_begin = _is_neighbour(one, beside, others)
    parted_m = np.inf
    if is_resolved(fit):
        parted_m = max(_PARTED_RATIO * fit.width_m, _PARTED_BARS * float(fit.values[DIAMETER]))
    lowest_m = float(level[middle]) - MAX_HEIGHT_RATIO * (_MAX_PIECE_RATIO * fit.width_m + _WIDER_M)
    limits = deep_m, parted_m, lowest_m, round(_HIDDEN_M / grid.cell_m)
    ends = [_edge(level, others_begin, middle, step, *limits) for step in (-1, 1)]
    own = level[ends[0][0] : ends[1][0] + 1]
    if not np.isfinite(own).any():
        return None
    outline = make_outline(fit.rings, float(fit.values[DIAMETER]), float(fit.values[ROLL]), smoothing_m)
    at = (np.arange(outline.seen_m.size) - outline.seen_m.size // 2) * STEP_M
    expected = np.interp(beside, at, outline.seen_m, left=np.nan, right=np.nan)
    within = np.abs(beside) < 0.42 * fit.width_m
    misfit = (level - expected)[within]
    misfit = np.sort(np.abs(misfit[np.isfinite(misfit)]))
    misfit = misfit[: round(_GULLIES_APART * misfit.size)]
    return SeenSection(
        width_m=grid.cell_m * len(own) - _GROWTH_M,
        width_sigma_m=math.hypot(_SEEN_WIDTH_SIGMA_M, _SEEN_WIDTH_CELLS * grid.cell_m),
        misfit_m=float(np.sqrt(np.mean(misfit**2))) if misfit.size else np.inf,
        sides_seen=all(seen for _, seen, _ in ends),
        sides_free=all(free for _, _, free in ends),
        hidden_m=(
            grid.cell_m * unseen_places(level[: ends[0][0]][::-1]),
            grid.cell_m * unseen_places(level[ends[1][0] + 1 :]),
        ),
        middle_m=float(beside[ends[0][0]] + beside[ends[1][0]]) / 2,
    )


def is_no_hexagon(seen: SeenSection | None, fit: Fit, top_m: float, floor_m: float | None) -> str:
    """State why a section may not be that of the full hexagon that was fitted; empty where it certainly is.

    From above, its lower half isn't seen; only the height over the floor on which it stands reveals what is
    there.
    """
    if seen is None or not seen.sides_free:
        return "its sides were not seen down to the floor"
    if floor_m is None:
        return "no floor was seen to measure its height from"
    diameter = float(fit.values[DIAMETER])
    axes = turned_packing(fit.rings, diameter, float(fit.values[ROLL]))
    width, height = (float(size) + diameter for size in np.ptp(axes, axis=0))
    higher = top_m - floor_m - height
    if abs(higher) > _HEIGHT_RATIO * diameter:
        more = "higher" if higher > 0 else "lower"
        return f"it stands {1e3 * abs(higher):.0f} mm {more} over the floor than a full bundle of {fit.bars}"
    wider = seen.width_m - width
    if abs(wider) > _WIDTH_RATIO * diameter:
        more = "wider" if wider > 0 else "narrower"
        return f"it is {1e3 * abs(wider):.0f} mm {more} than a full bundle of {fit.bars}"
    if seen.misfit_m > _MISFIT_RATIO * diameter:
        return f"its surface lies {1e3 * seen.misfit_m:.0f} mm off that of a full bundle of {fit.bars}"
    return ""


def bulge_sigma(hidden_m: tuple[float, float], width_m: float, *, is_along_baseline: bool) -> float:
    """Estimate the standard deviation (m) of how much wider a bundle is where nothing was seen behind its
    flanks.

    Single bars along the cameras' baseline aren't matched at all. All of the length h that wasn't seen may
    then be bars, and the section's bound, which 2 h / w raises, holds with (1 + h / w)^2 = 1 + 2 h' / w.
    """
    if not is_along_baseline:
        return _BULGE_RATIO * math.hypot(*hidden_m)
    h = sum(hidden_m)
    return h * (1 + h / (2 * width_m)) / UPPER


def estimate_section(
    seen: SeenSection | None,
    fit: Fit,
    top_m: float,
    floor_m: float | None,
    *,
    is_along_baseline: bool = False,
    shows_bars: bool = False,
) -> tuple[float, float]:
    """Estimate the steel section of a bundle whose bars can't be counted, and its sigma (m2); NaN where its
    sides weren't seen, or where the visible part isn't the outline's section.

    What looks like one bar, or like bars too thin to show, may be one bar: the section's upper bound is then
    no less than that of a solid bar as wide as the map may show it, unless the photo shows the bars.
    """
    if seen is None or not seen.sides_seen:
        return np.nan, np.nan
    if not _MIN_PIECE_RATIO * fit.width_m < seen.width_m < _MAX_PIECE_RATIO * fit.width_m + _WIDER_M:
        return np.nan, np.nan
    fill = _FILL_RATIO if fit.rings else _BAR_FILL_RATIO
    off_m = _OUTLINE_RATIO * (seen.width_m - fit.width_m)
    bulge_m = bulge_sigma(seen.hidden_m, seen.width_m, is_along_baseline=is_along_baseline)
    sigma_m = math.hypot(seen.width_sigma_m, off_m, bulge_m)
    section, sigma = section_of_pack(seen.width_m, sigma_m, over_floor(top_m, floor_m), fill)
    if shows_bars or is_resolved(fit):
        return section, sigma
    rounded_m = UPPER * (seen.width_sigma_m - _FINE_SIGMA_M)
    solid = math.pi / 4 * (max(fit.width_m, seen.width_m + _GROWTH_M) + rounded_m) ** 2
    return section, max(sigma, (solid - section) / UPPER)


def is_resolved(fit: Fit) -> bool:
    """Check whether an outline has several bars, thick enough for the map to show their shape."""
    return fit.rings > 0 and bool(fit.values[DIAMETER] > _PARTED_DIAMETER_M)


def section_of_pack(
    width_m: float, width_sigma_m: float, over_floor_m: float, fill: tuple[float, float] = _FILL_RATIO
) -> tuple[float, float]:
    """Estimate the steel section of bars and its sigma (m2) from the width between the flanks.

    section = fill x height x width. Nothing below the widest place is seen, so the height is the prior's,
    truncated at the floor [Johnson 1994, truncated normal]. over_floor_m: height of the top over the floor,
    inf where no floor was seen. fill: share of steel in the bars' bounding box, and its deviation.
    """
    if not width_m > 0 or not over_floor_m > 0:
        return np.nan, np.nan
    prior, cut = _HEIGHT_RATIO_PRIOR, over_floor_m / width_m
    height, height_sigma = prior.mean, prior.stdev
    at = max(prior.zscore(cut), -_MAX_DEVIATIONS)
    if at < _MAX_DEVIATIONS:
        slope = _UNIT.pdf(at) / _UNIT.cdf(at)
        height = cut - min(prior.stdev * (slope + at), cut / 2)
        height_sigma = prior.stdev * math.sqrt(1 - at * slope - slope**2)
    section = fill[0] * height * width_m**2
    share = np.linalg.norm([fill[1] / fill[0], height_sigma / height, 2 * width_sigma_m / width_m])
    widest = width_m + UPPER * width_sigma_m
    most = _MAX_FILL_RATIO * min(over_floor_m, MAX_HEIGHT_RATIO * widest) * widest
    return section, min(section * float(share), (most - section) / UPPER)


def over_floor(top_m: float, floor_m: float | None) -> float:
    """Compute the height of a top over the floor; infinite where no floor was seen."""
    return np.inf if floor_m is None else max(top_m - floor_m, 0.0)


def agreeing_rows(fit: Fit) -> Int64:
    """Select rows of the map that agree with a fit, no more than its mean section needs."""
    rows = np.flatnonzero(fit.state[fit.first : fit.last + 1] == AGREES) + fit.first
    return rows[:: max(len(rows) // _ROWS_ENOUGH, 1)]


def sections(grid: AlignedMap, fit: Fit, rows: Int64, half: int) -> tuple[Float64, Float64]:
    """Sample the heights over the axis (rows, N) at lateral places (N,); NaN unknown, -inf floor."""
    v = grid.v0_m + grid.cell_m * rows - fit.v_m
    axis = fit.values[U] + fit.values[SLOPE_U] * v
    up = fit.values[Z] + fit.values[SLOPE_Z] * v
    beside = grid.cell_m * np.arange(-half, half + 1)
    column = np.rint((axis[:, None] + beside - grid.u0_m) / grid.cell_m).astype(np.int64)
    inside = (column >= 0) & (column < grid.z_m.shape[1])
    z = np.where(inside, grid.z_m[rows[:, None], np.clip(column, 0, grid.z_m.shape[1] - 1)], np.nan)
    z = np.where(z <= grid.stock_over_m, -np.inf, z)
    return np.asarray(beside, np.float64), np.asarray(z - up[:, None], np.float64)


def mean_section(grid: AlignedMap, fit: Fit, rows: Int64, half: int) -> tuple[Float64, Float64]:
    """Compute the median heights over the axis at places (N,); NaN where over half are unknown."""
    beside, heights = sections(grid, fit, rows, half)
    enough = 2 * (~np.isnan(heights)).sum(axis=0) >= len(rows)
    level = np.full(len(beside), np.nan)
    with np.errstate(invalid="ignore"):
        level[enough] = nan_medians(heights[:, enough])
    return beside, level


def unseen_places(level: Float64) -> int:
    """Count the places before the first one that was seen."""
    return int(np.argmin(np.append(np.isnan(level), False)))


def _is_neighbour(one: FittedOutline, beside_m: Float64, others: list[FittedOutline]) -> Bool:
    """Check which places (N,) beside a bundle's axis, at mid-length, lie in another of similar width that
    lies beside some of its length.
    """
    u = one.fit.values[U] + beside_m
    places = one.grid.to_map(np.column_stack([u, np.full(len(u), one.fit.v_m)]))
    ends = one.grid.to_map(_axis_ends(one))
    taken = np.zeros(len(u), bool)
    for other in others:
        fit = other.fit
        if other is one or abs(np.log(fit.width_m / one.fit.width_m)) > _ALIKE_LOG:
            continue
        along, own_along = other.grid.from_map(ends)[:, 1], _axis_ends(other)[:, 1]
        if along.max() < own_along[0] or along.min() > own_along[1]:
            continue
        away = other.grid.from_map(places) - [fit.values[U], fit.v_m]
        taken |= np.abs(away[:, 0] - fit.values[SLOPE_U] * away[:, 1]) < fit.width_m / 2
    return taken


def _axis_ends(one: FittedOutline) -> Float64:
    """Return the ends (2, 2) of a bundle's axis, u and v of its grid."""
    v = one.grid.v0_m + one.grid.cell_m * np.array([one.fit.first, one.fit.last])
    return np.column_stack([one.fit.values[U] + one.fit.values[SLOPE_U] * (v - one.fit.v_m), v])


def is_overhung(inwards: Float64, outwards: Float64) -> bool:
    """Check whether a neighbour stands higher at a flank and so may lie over it. Heights begin
    at the flank.
    """
    own, theirs = (part[np.isfinite(part)][:_RIM] for part in (inwards, outwards))
    return bool(theirs.size and own.size and theirs.max() > own.max() + _HIGHER_M)


def _edge(
    level: Float64, others_begin: Bool, middle: int, step: int, deep_m: float, parted_m: float,
    lowest_m: float, hidden: int,
) -> tuple[int, bool, bool]:  # fmt: skip
    """Walk from the middle to the last place that belongs to the bundle. Return that place; whether the
    surface falls to the floor there, or sinks by parted_m before another bundle begins; whether it falls to
    the floor.

    A surface that shows behind places out of sight may be the bundle's own lower bars, down to lowest_m,
    unless another bundle begins there.
    """
    last, lowest, lowest_at = middle, level[middle], middle
    for k in range(middle, len(level) if step > 0 else -1, step):
        if np.isnan(level[k]):
            behind = (level[k + 1 :] if step > 0 else level[:k][::-1])[:hidden]
            taken = (others_begin[k + 1 :] if step > 0 else others_begin[:k][::-1])[:hidden]
            taken, behind = taken[~np.isnan(behind)], behind[~np.isnan(behind)]
            if not behind.size:
                return last, False, False
            inwards = level[last::-1] if step > 0 else level[last:]
            ends = bool(behind[0] <= lowest_m or taken[0])
            return last, ends and not is_overhung(inwards, behind), bool(behind[0] == -np.inf)
        if not level[k] > -np.inf:
            return last, True, True
        if others_begin[k]:
            return last, bool(level[middle] - min(lowest, level[k]) >= parted_m), False
        if level[k] < lowest:
            lowest, lowest_at = level[k], k
        if level[k] - lowest > deep_m:
            own = max(lowest_at - step, middle) if step > 0 else min(lowest_at - step, middle)
            return own, False, False
        last = k
    return last, False, False
