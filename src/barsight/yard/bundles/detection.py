"""Find bundles in the height map: propose candidates in cross-sections, grow them, keep the best set."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.parallel import ordered_map, prefetch
from barsight.core.records.heights import HeightSource
from barsight.yard.bundles.bundle_kinds import (
    common_diameter,
    other_packings,
    reinforce_kinds,
)
from barsight.yard.bundles.bundle_record import describe_bundles, make_bundle, map_sigma
from barsight.yard.bundles.collinear_pieces import join_pieces
from barsight.yard.bundles.crossing_bundles import OVER_M, crossing_pieces, is_beam, rise_over
from barsight.yard.bundles.fitting.growth import grow_outline
from barsight.yard.bundles.fitting.outline import bundle_width
from barsight.yard.bundles.fitting.outline_fit import (
    AGREES,
    Fit,
    FittedOutline,
    U,
    Z,
    refine_outline,
    widen_fit,
)
from barsight.yard.bundles.fitting.rotated_map import AlignedMap, align_map
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.bundles.fitting.template_matching import (
    BundleCandidate,
    Templates,
    make_templates,
    propose_candidates,
)
from barsight.yard.bundles.floor import find_floor, is_sunken
from barsight.yard.bundles.gully_shading import estimate_smoothing, refit_with_packing
from barsight.yard.bundles.headings import find_headings
from barsight.yard.bundles.layers import same_place
from barsight.yard.bundles.reading import Reading
from barsight.yard.bundles.section.packs import strapped_pack
from barsight.yard.bundles.set_packing import (
    NARROWER,
    best_intervals,
    choose_readings,
    holds_several,
    overlaps,
    strongest_rivals,
    without_slivers,
)
from barsight.yard.bundles.strapped_bundles import without_pieces
from barsight.yard.sections import split_map
from barsight.yard.thin_lines import with_thin_lines
from barsight.yard.types import Bundle, HeightMap, YardMap

_EDGE_CELLS = 3.0
"""Cost of a bundle in cells per row: the cells at its edges explain nothing."""
_CLAIM_M = 0.02
_RIVAL_RATIO = 0.8
_FLAT_RATIO, _FLAT_WEIGHT = 0.4, 0.5
"""Maximum depth below the floor, in widths, of a circle that is fitted to the flat top of an irregular pack;
factor on the weight of such an outline, which competes with those that stand on the floor.
"""
_LOWER_M = 0.005
"""Maximum distance (m) by which the top of a single bar is measured too low."""
_RESOLVED_CELLS = 4.0
_SLIVER_RATIO = 0.03
_CROSSING_STEP_M = 0.4
"""Spacing (m) of the cross-sections in which crossing bundles are sought: close enough to meet short ones."""
_ALONG_COS = 0.87
"""Cosine of the maximum angle, 30 degrees, of bars along the baseline: single ones aren't matched."""
_SEAM_M = 0.1
"""Maximum distance (m) between the middles that two stretches of a yard measure for one bundle."""


def find_bundles(
    yard: YardMap, settings: BundleSettings, baseline: Float64 | None = None
) -> tuple[Bundle, ...]:
    """Find all bundles in the map, in the map's frame, ordered by rising x; empty where there are none.

    baseline: (2,) horizontal unit vector from camera to camera, None where it isn't known.

    A bundle is an outline of round bars in hexagonal packing (or of one bar) that the measured heights
    follow. Outlines are proposed in cross-sections and grown along the bars by least squares. Among those
    that compete for a place, the set is kept that explains the most heights. A long yard is searched in
    stretches; where two stretches read a place differently, the first one takes precedence.
    """
    if yard.cell_m > settings.max_cell_m:
        return ()
    floor = find_floor(yard)
    templates = make_templates(settings, yard.cell_m)
    parts, found = split_map(yard), list[Bundle]()
    for part in parts:
        read = _search(yard.part(part.rows, part.columns), floor, templates, settings, baseline)
        own = [bundle for bundle in read if part.owns(bundle.centre_m, _SEAM_M)]
        before = [bundle for bundle in found if part.reaches(bundle.centre_m)]
        found += [bundle for bundle in own if not any(same_place(bundle, one) for one in before)]
    described = describe_bundles(found, floor, parts)
    return tuple(replace(one, map_sigma_z_m=map_sigma(yard, one)) for one in described)


def _search(
    height_map: HeightMap, floor: float | None, templates: Templates, settings: BundleSettings,
    baseline: Float64 | None,
) -> list[Bundle]:  # fmt: skip
    """Find the bundles of a map that is short enough to be kept in memory."""
    if not HeightSource.measured(height_map.source).any():
        return []
    found: list[FittedOutline] = []
    stock_over_m = -np.inf if floor is None else floor + settings.min_rise_m
    headings = find_headings(height_map, settings.max_skew_deg, stock_over_m)
    for heading in headings:
        found += _found(height_map, heading, floor, templates, settings)
    places = [_claims(one, settings) for one in found]
    chosen = choose_readings(_weights(found, floor), without_slivers(places, _SLIVER_RATIO))
    kept = [(found[k].grid, found[k].fit) for k in chosen]
    close = replace(settings, slice_step_m=_CROSSING_STEP_M)
    for heading, part in crossing_pieces(height_map, kept, headings, settings):
        across = _found(part, heading, floor, templates, close)
        found += [one for one in across if not is_beam(one.grid, one.fit, settings)]
    places += [_claims(one, settings) for one in found[len(places) :]]
    claims = without_slivers(places, _SLIVER_RATIO)
    readings = [
        replace(one, is_along_baseline=_runs_along(one.found.grid, baseline))
        for one in _settled(found, _weights(found, floor), claims, height_map, settings)
    ]
    chosen_ones = [reading.found for reading in readings]
    bundles = [make_bundle(reading, chosen_ones, settings, floor, height_map) for reading in readings]
    joined = join_pieces(without_pieces(bundles, readings))
    return list(ordered_map(lambda bundle: with_thin_lines(bundle, height_map), joined))


def _runs_along(grid: AlignedMap, baseline: Float64 | None) -> bool:
    """Check whether bars of a grid's heading run roughly along the baseline."""
    if baseline is None:
        return False
    axis = np.array([-np.sin(grid.heading_rad), np.cos(grid.heading_rad)])
    return bool(abs(axis @ baseline) > _ALONG_COS)


def _found(
    height_map: HeightMap, heading: float, floor: float | None, templates: Templates, settings: BundleSettings
) -> list[FittedOutline]:
    """Find all outlines that run roughly along `heading`."""
    grid = align_map(height_map, heading, -np.inf if floor is None else floor + settings.min_rise_m)
    return [
        FittedOutline(grid, fit) for fit in _readings(grid, templates, settings) if _on(floor, fit, settings)
    ]


def _weights(found: list[FittedOutline], floor_m: float | None) -> Float64:
    """Compute the number of cells that each outline explains, halved for those that reach below the floor."""
    return np.array([
        _weight(fit) * (_FLAT_WEIGHT if is_sunken(floor_m, _bottom_m(fit), fit.width_m) else 1.0)
        for fit in (one.fit for one in found)
    ])  # fmt: skip


def _settled(
    found: list[FittedOutline], weights: Float64, claims: list[Int64], height_map: HeightMap,
    settings: BundleSettings,
) -> list[Reading]:  # fmt: skip
    """Select the best set of readings. Those that straps show to be several bundles, which narrower readings
    explain nearly as well, are left out, and the others are selected anew.
    """
    widths, weights = np.array([one.fit.width_m for one in found]), weights.copy()
    while True:
        chosen, readings = _selected(found, weights, claims, height_map, settings)
        split = [
            k
            for k, reading in zip(chosen.tolist(), readings, strict=True)
            if reading.ends_inside and holds_several(k, widths, weights, claims)
        ]
        if not split:
            return [one for one in readings if one.pack is not None or not one.is_flat]
        weights[split] = 0.0


def _selected(
    found: list[FittedOutline], weights: Float64, claims: list[Int64], height_map: HeightMap,
    settings: BundleSettings,
) -> tuple[Int64, list[Reading]]:  # fmt: skip
    """Select readings twice: first by themselves, then with regard to the kinds of bundles in the first set.
    Also return their indices.

    The packing of each outline is settled by the photo where that shows the bars, otherwise by its
    neighbours.
    """
    fits = [one.fit for one in found]
    first = choose_readings(weights, claims)
    raised = reinforce_kinds(fits, weights, first, overlaps(first, claims))
    chosen = choose_readings(raised, claims)
    wanted = overlaps(chosen, claims)
    best = (found[k] for k in chosen)
    kept = list(ordered_map(lambda one: refit_with_packing(one, height_map, settings), best))
    smoothed = replace(settings, smoothing_m=estimate_smoothing(kept, settings))
    again = ordered_map(lambda one: refine_outline(one.grid, one.fit, smoothed) or one.fit, kept)
    kept = [replace(one, fit=fit) for one, fit in zip(kept, again, strict=True)]
    resolved = 0.0 if settings.catalogue_mm else _RESOLVED_CELLS * height_map.cell_m
    readings = []
    for k, one, rival, other in zip(
        chosen.tolist(),
        kept,
        strongest_rivals(chosen, raised, wanted),
        other_packings(fits, weights, chosen, wanted, resolved),
        strict=True,
    ):
        final = _finished(one, [each.fit for each in kept], smoothed)
        weight = 0.0 if rival is None else float(raised[rival])
        against = None if rival is None else found[rival]
        packing = None if one.shades is not None else one.doubt if other is None else other
        readings.append(Reading(final, float(raised[k]), against, weight, packing))
    packs = ordered_map(
        lambda reading: strapped_pack(height_map, reading.found.grid, reading.found.fit), readings
    )
    return chosen, [replace(one, pack=pack).with_flanks() for one, pack in zip(readings, packs, strict=True)]


def _finished(one: FittedOutline, kept: list[Fit], settings: BundleSettings) -> FittedOutline:
    """Refit an outline with the diameter that the bundles of its kind have in common."""
    fit = one.fit
    common = common_diameter(fit, kept)
    if common is not None and not settings.catalogue_mm:
        fit = refine_outline(one.grid, fit, settings, common=common) or fit
    return replace(one, fit=widen_fit(fit, settings))


def _on(floor_m: float | None, fit: Fit, settings: BundleSettings) -> bool:
    """Check that an outline lies over the floor.

    A packing may reach below it by as much as its circle is higher than a flat pack. A single bar must rise
    from it by the minimum diameter of one, however wide it looks in the map.
    """
    if floor_m is None:
        return True
    top = float(fit.values[Z]) + fit.width_m / 2
    if fit.rings == 0 and top - floor_m < settings.min_single_diameter_m - _LOWER_M:
        return False
    return floor_m - _bottom_m(fit) < _FLAT_RATIO * fit.width_m


def _bottom_m(fit: Fit) -> float:
    """Return the height of an outline's lowest point."""
    return float(fit.values[Z]) - fit.width_m / 2


def _readings(grid: AlignedMap, templates: Templates, settings: BundleSettings) -> list[Fit]:
    """Grow every proposed outline and keep those of at least the minimum length."""
    fits: list[Fit] = []
    rows = grid.z_m.shape[0]
    step = max(round(settings.slice_step_m / grid.cell_m), 1)
    known = np.flatnonzero(np.isfinite(grid.z_m).any(axis=1))
    if known.size == 0:
        return []
    sections = range(int(known[0]) + min(step, known.size) // 2, int(known[-1]) + 1, step)
    proposed = (
        _worth_growing(propose_candidates(grid, templates, grid.v0_m + row * grid.cell_m, settings))
        for row in sections
    )
    # The next sections are matched while the outlines of this one grow.
    for row, candidates in zip(sections, prefetch(proposed, 2), strict=True):
        v = grid.v0_m + row * grid.cell_m
        taken = _taken(fits, row, v)
        fresh = [one for one in candidates if not _is_taken(one, taken)]
        seeds = (_seed(one, row, rows, grid, settings) for one in fresh)
        grown = ordered_map(lambda seed: grow_outline(grid, seed, settings), seeds)
        for one, fit in zip(fresh, grown, strict=True):
            if fit is None or _is_taken(one, taken):
                continue
            if (fit.last - fit.first + 1) * grid.cell_m >= settings.min_length_m:
                fits.append(fit)
                for rings, places in _taken([fit], row, v).items():
                    taken.setdefault(rings, []).extend(places)
    return fits


def _seed(candidate: BundleCandidate, row: int, rows: int, grid: AlignedMap, settings: BundleSettings) -> Fit:
    half = max(round(settings.slice_m / grid.cell_m / 2), 1)
    first, last = max(row - half, 0), min(row + half, rows - 1)
    values = np.array([candidate.u_m, 0.0, candidate.z_m, 0.0, candidate.roll_rad, candidate.diameter_m])
    state, gain = np.zeros(rows, np.uint8), np.zeros(rows, np.float32)
    return Fit(
        candidate.rings, candidate.v_m, values, np.zeros((6, 6)), first, last, state, gain, np.nan, np.nan
    )


def _worth_growing(guesses: list[BundleCandidate]) -> list[BundleCandidate]:
    """Select the best set of candidates that don't overlap, other packings that explain the same places
    nearly as well, and narrower candidates side by side that do so in the place of a wide one.
    """
    if not guesses:
        return []
    u, gain, width = np.array([(g.u_m, g.gain, bundle_width(g.rings, g.diameter_m)) for g in guesses]).T
    reach = 0.45 * width
    best = best_intervals(u - reach, u + reach, gain - _EDGE_CELLS)
    kept = list(best)
    for k in best:
        inner = np.flatnonzero((width < NARROWER * width[k]) & (np.abs(u - u[k]) < width[k] / 2))
        beside = best_intervals(u[inner] - reach[inner], u[inner] + reach[inner], gain[inner] - _EDGE_CELLS)
        if len(beside) > 1 and gain[inner][beside].sum() > _RIVAL_RATIO * gain[k]:
            kept += inner[beside].tolist()
        seen = {guesses[k].rings}
        for n in np.flatnonzero((np.abs(u - u[k]) < reach[k]) & (gain > _RIVAL_RATIO * gain[k])):
            if guesses[n].rings not in seen:
                kept.append(int(n))
                seen.add(guesses[n].rings)
    return [guesses[k] for k in dict.fromkeys(kept)]


def _taken(fits: list[Fit], row: int, v_m: float) -> dict[int, list[tuple[float, float, float]]]:
    """Group by rings the outlines that cross a row: their axes there (u, z), and the distance within which a
    candidate is the same, all in m.
    """
    taken: dict[int, list[tuple[float, float, float]]] = {}
    for fit in fits:
        if fit.first <= row <= fit.last:
            taken.setdefault(fit.rings, []).append((*fit.at(v_m), 0.3 * fit.width_m))
    return taken


def _is_taken(candidate: BundleCandidate, taken: dict[int, list[tuple[float, float, float]]]) -> bool:
    places = taken.get(candidate.rings, ())
    return any(abs(candidate.u_m - u) < near and abs(candidate.z_m - z) < near for u, z, near in places)


def _weight(fit: Fit) -> float:
    """Count the cells that an outline explains, less the cost of its edges."""
    agreeing = fit.state[fit.first : fit.last + 1] == AGREES
    return float((fit.gain[fit.first : fit.last + 1] - _EDGE_CELLS)[agreeing].sum())


def _claims(reading: FittedOutline, settings: BundleSettings) -> Int64:
    """Number the map's patches of 20 mm that lie well inside the outline and close to it in height."""
    grid, fit = reading.grid, reading.fit
    rows = np.arange(fit.first, fit.last + 1)
    rows = rows[fit.state[rows] == AGREES]
    v = grid.v0_m + grid.cell_m * rows
    middle = fit.values[U] + fit.values[1] * (v - fit.v_m)
    across = np.linspace(-0.35, 0.35, max(int(fit.width_m / 0.02), 3)) * fit.width_m
    u = middle[:, None] + across
    own = np.abs(rise_over(grid, fit, rows, u, settings)) < OVER_M
    xy = grid.to_map(np.stack([u[own], np.broadcast_to(v[:, None], u.shape)[own]], axis=1))
    patch = np.floor(xy / _CLAIM_M).astype(np.int64) + (1 << 20)
    return np.unique(patch[:, 0] << 32 | patch[:, 1])
