"""Describe fitted outlines as bundles: ends, layers, which lies on which, and how certain all of it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.bundles.doubts import (
    count_bars,
    list_cover_doubts,
    list_doubts,
    list_wall_doubts,
    rate_confidence,
)
from barsight.yard.bundles.fitting.bars import fit_bars, visible_bars
from barsight.yard.bundles.fitting.ends import End, find_end, middle_and_length_sigma
from barsight.yard.bundles.fitting.outline import bundle_width, make_outline
from barsight.yard.bundles.fitting.outline_fit import (
    DIAMETER,
    ROLL,
    SLOPE_U,
    SLOPE_Z,
    Fit,
    FittedOutline,
    U,
    Z,
    compare_halves,
)
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.bundles.floor import is_sunken
from barsight.yard.bundles.irregular import widen_sigma, widen_unended, widen_unseen
from barsight.yard.bundles.layers import check_uncovered, find_layers, list_neighbours, list_overlaps
from barsight.yard.bundles.pack_edges import DOUBTFUL
from barsight.yard.bundles.reading import Reading
from barsight.yard.bundles.section.seen_section import estimate_section, seen_section
from barsight.yard.bundles.strapped_bundles import held_by_straps
from barsight.yard.sections import MapStretch, part_about
from barsight.yard.types import Bundle, BundleSigma, DoubtKind, FitSigma, HeightMap, YardMap

_SLOPE_RATIO = 0.6
"""Factor on the slope's sigma, which follows from errors correlated over `correlated_along_m`: errors that
are correlated over longer distances shift the bundle sideways and hardly turn it.
"""
_BOW_RATIO, _TURN_RATIO = 0.15, 0.5
"""Error of the fitted heading of bowed bars, as fractions: of the angle between the headings of the two
halves, and of the angle between the mean of both and the heading of the whole.
"""


def describe_bundles(
    bundles: list[Bundle], floor_m: float | None, parts: list[MapStretch]
) -> tuple[Bundle, ...]:
    """Number the bundles by rising x of their centres and relate each one to its neighbours.

    A bundle that may be a wall or two bundles end to end is doubtful, and so is one that reaches below the
    floor, since it can't be as high as it was measured.
    """
    ordered = sorted(bundles, key=lambda b: tuple(b.centre_m))
    ordered = [replace(bundle, id=k) for k, bundle in enumerate(ordered)]
    out = list(ordered)
    for part in parts:
        near = [bundle for bundle in ordered if part.reaches(bundle.centre_m, *bundle.ends_m)]
        for bundle, layer in zip(near, find_layers(near, floor_m), strict=True):
            if part.owns(bundle.centre_m):
                on_top, why = check_uncovered(bundle, near, layer)
                doubtful = is_sunken(floor_m, bundle.bottom_z_m, bundle.width_m) or any(
                    doubt.kind is DoubtKind.WALL or (doubt.kind is DoubtKind.GAP and doubt.end is None)
                    for doubt in bundle.reasons
                )
                out[bundle.id] = replace(
                    bundle, layer=layer, on_top=on_top, neighbours=list_neighbours(bundle, near),
                    reasons=bundle.reasons + why,
                    cover_doubts=bundle.cover_doubts + list_overlaps(bundle, near),
                    confidence=min(bundle.confidence, DOUBTFUL) if doubtful else bundle.confidence,
                )  # fmt: skip
    return tuple(out)


def make_bundle(
    reading: Reading, others: list[FittedOutline], settings: BundleSettings, floor_m: float | None,
    heights: HeightMap,
) -> Bundle:  # fmt: skip
    """Make a bundle of a chosen reading, without number, layer and what lies on it. others: all chosen."""
    grid, fit = reading.found.grid, reading.found.fit
    ends = [find_end(grid, fit, step, settings, heights) for step in (-1, 1)]
    outline = make_outline(fit.rings, float(fit.values[DIAMETER]), float(fit.values[ROLL]), 0.0)
    axis = np.array([_in_map(grid, fit, end.v_m) for end in ends])
    yaw = grid.heading_rad - np.arctan(fit.values[SLOPE_U])
    pitch = np.arctan(fit.values[SLOPE_Z] / np.hypot(1, fit.values[SLOPE_U]))
    if not -np.pi / 2 < yaw <= np.pi / 2:
        yaw, pitch = yaw - np.pi * np.sign(yaw), -pitch
        axis, ends = axis[::-1], ends[::-1]
    centre = axis.mean(axis=0)
    rows = fit.state[fit.first : fit.last + 1]
    seen = seen_section(reading.found, others, settings.smoothing_m)
    top = float(np.nanmax(outline.exact_m))
    top_z = float(centre[2]) + top
    bars, doubt = count_bars(reading, seen, top_z, floor_m)
    reasons = doubt + list_wall_doubts(reading, seen, top_z, floor_m)
    reasons += list_doubts(reading, rows, ends, settings)
    section, section_sigma = estimate_section(
        seen, fit, top_z, floor_m, is_along_baseline=reading.is_along_baseline,
        shows_bars=reading.found.shades is not None,
    )  # fmt: skip
    own = _sigma(reading.found, ends, top, settings)
    bundle = Bundle(
        id=0,
        centre_m=centre,
        yaw_rad=float(yaw),
        pitch_rad=float(pitch),
        length_m=float(np.linalg.norm(axis[1] - axis[0])),
        ends_m=axis,
        ends_open=(ends[0].is_open, ends[1].is_open),
        width_m=fit.width_m,
        top_z_m=top_z,
        bar_diameter_m=float(fit.values[DIAMETER]),
        visible_bars=len(visible_bars(fit)),
        bars=bars,
        layer=0,
        on_top=True,
        neighbours=(),
        sigma=replace(own, section_m2=section_sigma),
        known_share=float((rows != 0).mean()),
        confidence=rate_confidence(reading, rows),
        reasons=reasons,
        bar_axes=fit_bars(reading.found, settings),
        ends_sigma_m=(ends[0].sigma_m, ends[1].sigma_m),
        section_m2=section,
        cover_doubts=list_cover_doubts(reading, reasons),
        fit_sigma=_fit_sigma(own, ends),
    )
    doubtful = reading.other_packing is not None
    width_m = None if seen is None else seen.width_m
    if reading.pack is not None and reading.pack.is_bounded:
        width_m = reading.pack.width_m
    irregular = widen_sigma(bundle.sigma, reading.found, width_m, bundle.length_m, is_one_of_two=doubtful)
    held = held_by_straps(bundle, irregular, reading, seen, floor_m)
    return widen_unseen(widen_unended(held, reading.unended_sides), reading.flanks, settings.max_width_m)


def map_sigma(yard: YardMap, bundle: Bundle) -> float:
    """Return the median of the map's height sigma over a bundle; NaN where nothing was seen."""
    low = np.minimum(*bundle.ends_m[:, :2]) - bundle.width_m / 2
    high = np.maximum(*bundle.ends_m[:, :2]) + bundle.width_m / 2
    part = part_about(yard, np.array([low[0], high[0]]), np.array([low[1], high[1]]))
    y, x = np.meshgrid(
        part.y0_m + part.cell_m * np.arange(part.shape[0]),
        part.x0_m + part.cell_m * np.arange(part.shape[1]), indexing="ij",
    )  # fmt: skip
    way = bundle.direction[:2] / np.linalg.norm(bundle.direction[:2])
    aside = way[1] * (x - bundle.centre_m[0]) - way[0] * (y - bundle.centre_m[1])
    along = way[0] * (x - bundle.centre_m[0]) + way[1] * (y - bundle.centre_m[1])
    over = (np.abs(aside) <= bundle.width_m / 2) & (np.abs(along) <= bundle.length_m / 2)
    seen = part.sigma_m[over & np.isfinite(part.sigma_m)]
    return float(np.median(seen)) if seen.size else float("nan")


def _in_map(grid: AlignedMap, fit: Fit, v_m: float) -> Float64:
    u, z = fit.at(v_m)
    return np.append(grid.to_map(np.array([[u, v_m]]))[0], z)


def _sigma(one: FittedOutline, ends: list[End], top: float, settings: BundleSettings) -> BundleSigma:
    """Propagate the fit's covariance to each quantity, and add the errors that the whole map shares."""
    fit = one.fit
    along = (ends[0].v_m + ends[1].v_m) / 2 - fit.v_m
    covariance = fit.covariance
    at_middle = np.zeros((2, 6))
    at_middle[0, [U, SLOPE_U]] = 1, along
    at_middle[1, [Z, SLOPE_Z]] = 1, along
    at_middle[1, ROLL], at_middle[1, DIAMETER] = _top_changes(fit, top)
    lateral, height = np.sqrt(np.maximum(np.diag(at_middle @ covariance @ at_middle.T), 0))
    diameter = float(np.sqrt(covariance[DIAMETER, DIAMETER]))
    middle, length = middle_and_length_sigma((ends[0].sigma_m, ends[1].sigma_m))
    slope = _SLOPE_RATIO * np.sqrt(covariance[SLOPE_U, SLOPE_U])
    bow, turn = compare_halves(one, settings)
    turned = slope, _BOW_RATIO * bow, _TURN_RATIO * turn, np.radians(settings.shared_yaw_deg)
    return BundleSigma(
        lateral_m=float(np.hypot(lateral, settings.shared_lateral_m)),
        along_m=middle,
        yaw_rad=float(np.linalg.norm(turned)),
        length_m=length,
        width_m=bundle_width(fit.rings, diameter),
        top_z_m=float(np.hypot(height, settings.shared_height_m)),
        bar_diameter_m=diameter,
    )


def _fit_sigma(own: BundleSigma, ends: list[End]) -> FitSigma:
    """Return the fit's own sigmas, the one along the axis being that of bars with flush ends."""
    along, _ = middle_and_length_sigma((ends[0].flush_sigma_m, ends[1].flush_sigma_m))
    return FitSigma(own.lateral_m, along, own.yaw_rad, own.width_m, own.top_z_m)


def _top_changes(fit: Fit, top: float) -> tuple[float, float]:
    """Differentiate the height of the outline's top over the axis by roll and by diameter."""
    step = 0.01
    diameter, roll = float(fit.values[DIAMETER]), float(fit.values[ROLL])
    if fit.rings == 0:
        return 0.0, 0.5
    rolled = float(np.nanmax(make_outline(fit.rings, diameter, roll + step, 0.0).exact_m))
    return (rolled - top) / step, top / diameter
