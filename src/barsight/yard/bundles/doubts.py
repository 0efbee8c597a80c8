"""State the doubts about a bundle's reading, whether its bars can be counted, and how certain it is."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, UInt8
from barsight.yard.bundles.crossing_bundles import rise_over
from barsight.yard.bundles.fitting.ends import End, gap_rows, lost_rows
from barsight.yard.bundles.fitting.outline import BARS_OF_RINGS, bundle_width
from barsight.yard.bundles.fitting.outline_fit import ABOVE, AGREES, BELOW, DIAMETER, SLOPE_U, U, Z
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.bundles.pack_edges import DOUBTFUL
from barsight.yard.bundles.reading import Reading
from barsight.yard.bundles.section.laid_objects import (
    StraightSections,
    look_up,
    measure_along,
    measure_laid,
    straight_sections,
)
from barsight.yard.bundles.section.seen_section import (
    MAX_HEIGHT_RATIO,
    SeenSection,
    agreeing_rows,
    is_no_hexagon,
    sections,
)
from barsight.yard.types import ENDS, Doubt, DoubtKind

_NARROW_M = 0.3
"""Maximum length (m) along a bundle over which an object that lies across it counts as narrow."""
_LIES_M, _ONE_PLACE_M = 0.02, 0.3
"""Minimum rise over a bundle of an object that lies across it; maximum gap between runs of rows that belong
to one object. Dunnage comes in twos or more. Both in m.
"""
_ALONG_M, _BARE_M = 0.012, 0.004
"""Minimum rises (m) from which something lies along on a bundle: over the fitted outline's top or over other
parts of the bundle, by which no free bundle of measured yards rises by more than 10 mm; and of a crest that
no strap crosses.
"""
_UNSEEN_M, _CREST_RATIO = 0.1, 0.4
"""Minimum size (m) of an unseen place over a bundle that may hide what lies there; maximum distance of such
places from the middle, in widths: matching loses the steep flanks beyond.
"""
_MAX_DUNNAGE_M = 0.15
"""Maximum height (m) of the dunnage under a bundle."""
_CARRIER_M, _CARRIED_RATIO = 0.15, 0.03
"""Maximum distance (m) of a carrier from both flanks; minimum share of the length over which it shows."""
_BEFORE_END_M = 0.05
"""Margin (m) at each end within which rows aren't used: bars end unevenly."""
_STUB_M, _HIDES_M, _MIN_LOST_M = 0.3, 0.05, 0.015
"""Lengths (m) along a bundle: that of what is too short to be another one at its end; maximum distance from
what lies across it of the rows that this hides; minimum of a gap between two bundles.
"""
_MAX_CONFIDENCE = 0.95
"""Maximum confidence: the share of bundles told as free, with no doubt about that, that were free and lay as
told on measured yards, irregular and spilled ones among them.
"""
_SURE_KNOWN = 0.7
"""Minimum share of a bundle's length that must have been measured; below it, the bundle gets a doubt."""


def count_bars(
    reading: Reading, seen: SeenSection | None, top_m: float, floor_m: float | None
) -> tuple[int | None, tuple[Doubt, ...]]:
    """Count the bars by the outline. None and a doubt where it may not be a full hexagon, where another
    packing explains its kind as well, or where one bar may as well be many thin ones.
    """
    fit, other = reading.found.fit, reading.other_packing
    if other is None:
        why_not = is_no_hexagon(seen, fit, top_m, floor_m)
        if not why_not and fit.rings == 0 and reading.found.shades is None:
            why_not = "many thin bars may look like one"
        if not why_not:
            return fit.bars, ()
        return None, (Doubt(DoubtKind.OTHER, f"its bars can't be counted: {why_not}"),)
    diameter = fit.width_m / bundle_width(other, 1.0)
    both = (
        f"{fit.bars} bars of {1e3 * fit.values[DIAMETER]:.0f} mm or {BARS_OF_RINGS[other]} of "
        f"{1e3 * diameter:.0f} mm: the outline fits both"
    )
    return None, (Doubt(DoubtKind.OTHER, both),)


def list_doubts(
    reading: Reading, rows: UInt8, ends: list[End], settings: BundleSettings
) -> tuple[Doubt, ...]:
    """List the doubts about the bundle as described."""
    out = []
    known = (rows != 0).mean()
    if known < _SURE_KNOWN:
        out.append(Doubt(DoubtKind.OTHER, f"only {100 * known:.0f} % of its length was measured"))
    crossed = _runs(rows == ABOVE)
    cell = reading.found.grid.cell_m
    slim = [run for run in crossed if cell < (run[1] - run[0]) * cell <= _NARROW_M]
    narrow = _places(slim, reading, settings)
    long = [run for run in crossed if (run[1] - run[0]) * cell > _NARROW_M]
    if narrow == 1:
        out.append(Doubt(DoubtKind.LIES_ACROSS, "something narrow lies across it at one place"))
    elif narrow:
        said = f"something narrow crosses over it at {narrow} places, such as dunnage"
        out.append(Doubt(DoubtKind.CROSSED, said))
    out += [
        Doubt(DoubtKind.COVERS_PART, f"something {(b - a) * cell:.2f} m long covers a part of it")
        for a, b in long
    ]
    sunken = (rows == BELOW).sum() * cell
    if sunken > 0.1:
        out.append(Doubt(DoubtKind.OTHER, f"over {sunken:.2f} m the surface lies lower than the outline"))
    for number, (name, end) in enumerate(zip(ENDS, ends, strict=True)):
        if end.is_open:
            kind = DoubtKind.COVERED_END if end.is_covered else DoubtKind.OTHER
            out.append(Doubt(kind, f"the {name} end is open: {end.why}", number))
        if end.shows_gap:
            said = f"the {name} end is open: behind it shows {DoubtKind.GAP.value}"
            out.append(Doubt(DoubtKind.GAP, said, number))
    out += _list_gaps(reading, long + (slim if narrow else []), settings)
    if reading.rival is not None and reading.rival_weight > 0.9 * reading.weight:
        gap = abs(reading.rival.fit.width_m - reading.found.fit.width_m)
        if gap > 0.15 * reading.found.fit.width_m:
            width_mm = 1e3 * reading.rival.fit.width_m
            said = f"a bundle {width_mm:.0f} mm wide explains the surface nearly as well"
            out.append(Doubt(DoubtKind.RIVAL, said))
    if reading.flanks is not None and reading.flanks.doubt:
        out.append(reading.flanks.doubt)
    return tuple(out)


def _list_gaps(reading: Reading, across: list[tuple[int, int]], settings: BundleSettings) -> list[Doubt]:
    """List the doubts that two bundles may lie end to end: a gap that is seen, or rows in which the surface
    isn't seen to go on. across: rows of what lies across the bundle, which hides the rows beside it.
    """
    grid, fit = reading.found.grid, reading.found.fit
    if deep := gap_rows(grid, fit, settings):
        length_m = deep * grid.cell_m
        said = f"{DoubtKind.GAP.value}, {length_m:.2f} m long, parts it: two bundles may lie end to end"
        return [Doubt(DoubtKind.GAP, said)]
    lost = lost_rows(grid, fit, settings)
    stub, beside = (round(reach / grid.cell_m) for reach in (_STUB_M, _HIDES_M))
    lost[:stub] = lost[max(len(lost) - stub, 0) :] = False
    longest = grid.cell_m * max(
        (
            end - first
            for first, end in _runs(lost)
            if not any(first <= b + beside and end >= a - beside for a, b in across)
        ),
        default=0,
    )
    return list_hidden_gaps(longest)


def list_hidden_gaps(lost_m: float) -> list[Doubt]:
    """List the doubt that a gap may hide in a length along a bundle that the map doesn't show."""
    if lost_m < _MIN_LOST_M:
        return []
    said = f"may hide in {lost_m:.2f} m that the map doesn't show: two bundles may lie end to end"
    return [Doubt(DoubtKind.GAP, f"{DoubtKind.GAP.value} {said}")]


def _places(runs: list[tuple[int, int]], reading: Reading, settings: BundleSettings) -> int:
    """Count the places at which runs of rows lie over an outline; 0 where all are as low as noise."""
    grid, fit = reading.found.grid, reading.found.fit
    across = np.linspace(-0.35, 0.35, 15) * fit.width_m
    places, highest, last = 0, 0.0, -np.inf
    for first, end in runs:
        rows = np.arange(first, end) + fit.first
        along = grid.v0_m + grid.cell_m * rows - fit.v_m
        u = fit.values[U] + fit.values[SLOPE_U] * along[:, None] + across
        highest = max(highest, float(np.nanmedian(rise_over(grid, fit, rows, u, settings))))
        places += (first - last) * grid.cell_m > _ONE_PLACE_M
        last = end
    return places if highest > _LIES_M else 0


def list_wall_doubts(
    reading: Reading, seen: SeenSection | None, top_m: float, floor_m: float | None
) -> tuple[Doubt, ...]:
    """List the doubt that the bundle may be a wall: no flank falls off, or nothing carries it so high."""
    if reading.is_flat or (reading.flanks is not None and reading.flanks.are_steps):
        return (Doubt(DoubtKind.WALL, "neither flank falls off: it may be a wall"),)
    if seen is None or floor_m is None:
        return ()
    if top_m - floor_m <= MAX_HEIGHT_RATIO * reading.found.fit.width_m + _MAX_DUNNAGE_M:
        return ()
    if _shows_carrier(reading, seen.width_m):
        return ()
    said = f"nothing carries it {1e3 * (top_m - floor_m):.0f} mm over the floor: it may be a wall"
    return (Doubt(DoubtKind.WALL, said),)


def _shows_carrier(reading: Reading, width_m: float) -> bool:
    """Check whether something stands over the floor on both sides, as a cross-beam underneath does."""
    grid, fit = reading.found.grid, reading.found.fit
    edge = max(fit.width_m, width_m) / 2 + grid.cell_m
    half = round((edge + _CARRIER_M) / grid.cell_m)
    beside, heights = sections(grid, fit, agreeing_rows(fit), half)
    stands = np.isfinite(heights)
    low, high = (stands[:, side * beside > edge].any(axis=1) for side in (-1, 1))
    return bool((low & high).mean() > _CARRIED_RATIO)


def list_cover_doubts(reading: Reading, reasons: tuple[Doubt, ...]) -> tuple[Doubt, ...]:
    """List the objects that may hold the bundle down although no other bundle is known to lie on it."""
    out = [doubt for doubt in reasons if doubt.kind is DoubtKind.CROSSED]
    sections = straighten(reading)
    laid, is_clear = measure_laid(sections)
    if is_clear:
        said = f"something {1e3 * laid:.0f} mm high lies over a part of its width"
        out.append(Doubt(DoubtKind.OTHER, said))
    elif laid > 0:
        said = f"something {1e3 * laid:.0f} mm high beside it may lie over its flank"
        out.append(Doubt(DoubtKind.HIDDEN_FLANK, said))
    along, sure = measure_along(sections)
    if sure > _ALONG_M:
        said = f"something {1e3 * along:.0f} mm over its outline, or over its other parts, lies along on it"
        out.append(Doubt(DoubtKind.OTHER, said))
    elif along > _ALONG_M:
        said = (
            f"along it the map rises by {1e3 * along:.0f} mm where it is unsure: a thin bar may lie over it"
        )
        out.append(Doubt(DoubtKind.FAINT_LINE, said))
    if reading.pack is not None and reading.pack.bare_m > _BARE_M:
        out.append(Doubt(DoubtKind.OTHER, "no strap crosses its crest: something lies along on its straps"))
    if reading.flanks is not None and reading.flanks.cover_doubt:
        out.append(reading.flanks.cover_doubt)
    if unseen := _unseen_length(reading):
        said = f"over {unseen:.2f} m a part of its width was not seen: something may lie there"
        out.append(Doubt(DoubtKind.OTHER, said))
    return tuple(out)


def _unseen_length(reading: Reading) -> float:
    """Measure the length (m) of a bundle over which unseen places can hide something that lies there."""
    grid, fit, (low, high) = reading.found.grid, reading.found.fit, _bounds(reading)
    rim, inset = round(_BEFORE_END_M / grid.cell_m), (0.5 - _CREST_RATIO) * (high - low)
    rows = np.arange(fit.first + rim, fit.last + 1 - rim)
    unseen = np.isnan(look_up(grid, fit, rows, np.arange(low + inset, high - inset, grid.cell_m)))
    side = round(_UNSEEN_M / grid.cell_m)
    wide = ndimage.binary_opening(unseen, np.ones((side, min(side, unseen.shape[1])), bool))
    return float(grid.cell_m * wide.any(axis=1).sum())


def straighten(reading: Reading) -> StraightSections | None:
    """Straighten the sections of a bundle between its flanks; None where it is too short."""
    grid, fit, pack = reading.found.grid, reading.found.fit, reading.pack
    axis_z_m = float(fit.values[Z])
    if pack is not None and pack.is_bounded:
        axis_z_m += pack.top_m - pack.width_m / 2
    rim = round(_BEFORE_END_M / grid.cell_m)
    rows = np.arange(fit.first + rim, fit.last + 1 - rim)
    return straight_sections(grid, fit, rows, _bounds(reading), axis_z_m) if rows.size > 1 else None


def _bounds(reading: Reading) -> tuple[float, float]:
    """Return the flanks (m) beside the axis: those of the pack where its bounds are known."""
    half, pack = reading.found.fit.width_m / 2, reading.pack
    return (-half, half) if pack is None or not pack.is_bounded else (pack.low_m, pack.high_m)


def rate_confidence(reading: Reading, rows: UInt8) -> float:
    """Estimate the probability of a reading by the share of its length that agrees and by its lead over the
    next different one. One bar fits any crest: where a wider outline explains more, it is a part of that.
    """
    fit, rival = reading.found.fit, reading.rival
    lead = 1.0
    if rival is not None and abs(rival.fit.width_m - fit.width_m) > 0.15 * fit.width_m:
        lead = 1 - reading.rival_weight / max(reading.weight, 1e-9)
        if fit.rings == 0 and lead < 0 and rival.fit.width_m > fit.width_m:
            return DOUBTFUL * rate_agreement(rows)
    sure = 1 - 0.5 * np.exp(-max(lead, 0.0) / 0.05)
    return float(np.clip(sure * rate_agreement(rows), 0.01, _MAX_CONFIDENCE))


def rate_agreement(rows: UInt8) -> float:
    """Rate the share of the measured length that agrees with an outline: 1 from four fifths on."""
    return min(1.0, float((rows == AGREES).sum() / max((rows != 0).sum(), 1)) / 0.8)


def _runs(flags: Bool) -> list[tuple[int, int]]:
    """Find the first and one-past-last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
