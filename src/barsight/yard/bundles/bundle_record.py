"""Describe fitted outlines as bundles: ends, layers, what lies on what, how sure all of it is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Bool, Float64, UInt8
from barsight.yard.bundles.bar_pitch import DIAMETER_SIGMA_RATIO
from barsight.yard.bundles.crossing_bundles import rise_over
from barsight.yard.bundles.fitting.bars import fit_bars, visible_bars
from barsight.yard.bundles.fitting.ends import End, find_end
from barsight.yard.bundles.fitting.outline import BARS_OF_RINGS, LOOSENESS, make_outline
from barsight.yard.bundles.fitting.outline_fit import (
    ABOVE,
    AGREES,
    BELOW,
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
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.bundles.flanks import Flanks, seen_flanks
from barsight.yard.bundles.irregular import widen_sigma
from barsight.yard.bundles.layers import check_uncovered, find_layers, list_neighbours
from barsight.yard.bundles.pack_edges import DOUBTFUL, hold_off
from barsight.yard.bundles.seen_section import (
    SeenSection,
    estimate_section,
    is_no_hexagon,
    section_of_pack,
    seen_section,
)
from barsight.yard.bundles.straps import Pack, contradicts
from barsight.yard.sections import MapStretch
from barsight.yard.thin_lines import KNOWN_ACROSS
from barsight.yard.types import Bundle, BundleSigma

_NARROW_M = 0.3
_SAME_RATIO, _SAME_M = 0.12, 0.005
"""Of the width, and besides: how far an outline's edges lie off those of the pack that it describes."""
_PACK_MIDDLE_M, _PACK_WIDTH_M, _PACK_TOP_M, _PACK_WIDTH_SIGMAS = 0.009, 0.016, 0.006, 3.0
"""Standard deviations of a pack's middle, width and top, and its width's in those of a height."""
_CREST_M = 0.006
"""Crest height that a map's mean section cuts off."""
_STRAPPED = 0.95
"""Confidence in a bundle whose straps and flanks were seen."""
_PIECE_M, _PIECE_HIGHER_M, _PIECE_BEYOND_M, _PIECE_SKEW = 0.02, 0.012, 0.1, 0.05
"""Bounds of a piece: way of its axis within the flanks, most by which its top is higher and its ends lie
beyond the pack's, sine of its skew."""
_LIES_M, _ONE_PLACE_M = 0.02, 0.3
"""What lies across a bundle rises so far over it; runs of rows nearer to each other than the second are one
thing. Dunnage comes in twos and more."""
_ASIDE_M = 0.02
"""Straps whose middle lies so far beside an outline's make its place that unsure."""
_SURE_KNOWN = 0.7


@dataclass(frozen=True, eq=False)
class Reading:
    """A chosen outline with its weight (cells explained) and the strongest other reading of its place.

    other_packing: rings of another packing that explains the bundles of this kind as well, if any does. pack:
    the bars that straps hold together there, None where no straps are seen. flanks: of the pack where it is
    seen whole, else of the outline; None where too little of them is seen.
    """

    found: FittedOutline
    weight: float
    rival: FittedOutline | None
    rival_weight: float
    other_packing: int | None
    pack: Pack | None = None
    flanks: Flanks | None = None

    @property
    def outlines_pack(self) -> bool:
        """Check whether the fitted outline ends where the pack does, or no pack is seen whole."""
        pack, width = self.pack, self.found.fit.width_m
        if pack is None or not pack.sides_seen:
            return True
        off = max(abs(pack.low_m + width / 2), abs(pack.high_m - width / 2))
        return off < _SAME_RATIO * width + _SAME_M

    def with_flanks(self) -> Reading:
        """Return the same with its flanks."""
        half = self.found.fit.width_m / 2
        edges = -half, half
        if self.pack is not None and self.pack.sides_seen:
            edges = self.pack.low_m, self.pack.high_m
        return replace(self, flanks=seen_flanks(self.found, *edges))


def describe_bundles(
    bundles: list[Bundle], floor_m: float | None, parts: list[MapStretch]
) -> tuple[Bundle, ...]:
    """Number the bundles by rising x of their centres and relate each to its neighbours."""
    ordered = sorted(bundles, key=lambda b: tuple(b.centre_m))
    ordered = [replace(bundle, id=k) for k, bundle in enumerate(ordered)]
    out = list(ordered)
    for part in parts:
        near = [bundle for bundle in ordered if part.reaches(bundle.centre_m)]
        for bundle, layer in zip(near, find_layers(near, floor_m), strict=True):
            if part.owns(bundle.centre_m):
                on_top, why = check_uncovered(bundle, near)
                out[bundle.id] = replace(
                    bundle, layer=layer, on_top=on_top, neighbours=list_neighbours(bundle, near),
                    reasons=bundle.reasons + why,
                )  # fmt: skip
    return tuple(out)


def make_bundle(
    reading: Reading, others: list[FittedOutline], settings: BundleSettings, floor_m: float | None
) -> Bundle:
    """Make a bundle of the chosen reading, without its number, layer and what lies on it. others: all that
    were chosen.
    """
    sheet, fit = reading.found.sheet, reading.found.fit
    ends = [find_end(sheet, fit, step, settings) for step in (-1, 1)]
    outline = make_outline(fit.rings, float(fit.values[DIAMETER]), float(fit.values[ROLL]), 0.0)
    axis = np.array([_in_map(sheet, fit, end.v_m) for end in ends])
    yaw = sheet.heading_rad - np.arctan(fit.values[SLOPE_U])
    pitch = np.arctan(fit.values[SLOPE_Z] / np.hypot(1, fit.values[SLOPE_U]))
    if not -np.pi / 2 < yaw <= np.pi / 2:
        yaw, pitch = yaw - np.pi * np.sign(yaw), -pitch
        axis, ends = axis[::-1], ends[::-1]
    centre = axis.mean(axis=0)
    rows = fit.state[fit.first : fit.last + 1]
    seen = seen_section(reading.found, others, settings.smoothing_m)
    top = float(np.nanmax(outline.exact_m))
    top_z = float(centre[2]) + top
    bars, doubt = _count(reading, seen, top_z, floor_m)
    reasons = doubt + _doubts(reading, rows, ends, settings)
    section, section_sigma = estimate_section(seen, fit, top_z, floor_m)
    if reading.flanks is not None and reading.flanks.doubt:
        reasons += (reading.flanks.doubt,)
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
        sigma=replace(_sigma(fit, ends, top, settings), section_m2=section_sigma),
        known_share=float((rows != 0).mean()),
        confidence=_confidence(reading, rows),
        reasons=reasons,
        bar_axes=fit_bars(reading.found, settings),
        ends_sigma_m=(ends[0].sigma_m, ends[1].sigma_m),
        section_m2=section,
    )
    doubtful = reading.other_packing is not None
    irregular = widen_sigma(bundle.sigma, reading.found, seen, bundle.length_m, is_one_of_two=doubtful)
    if reading.pack is not None:
        return _held_by_straps(bundle, irregular, reading, reading.pack, floor_m)
    return bundle if bars is not None else replace(bundle, sigma=irregular)


def _partly_seen(bundle: Bundle, irregular: BundleSigma, pack: Pack) -> Bundle:
    """Doubt a bundle whose pack goes on beyond it or lies aside, and whose flanks are not both seen."""
    beyond_m, doubt = contradicts(pack, bundle.width_m)
    if doubt:
        sure = min(bundle.confidence, DOUBTFUL)
        bundle = replace(bundle, confidence=sure, reasons=(*bundle.reasons, doubt), bars=None)
        irregular = replace(
            irregular,
            width_m=float(np.hypot(irregular.width_m, beyond_m)),
            lateral_m=float(np.hypot(irregular.lateral_m, beyond_m / 2)),
        )
    if bundle.bars is None:
        bundle = replace(bundle, sigma=irregular)
    if abs(pack.middle_m) > _ASIDE_M:
        lateral = float(np.hypot(bundle.sigma.lateral_m, pack.middle_m))
        bundle = replace(bundle, sigma=replace(bundle.sigma, lateral_m=lateral))
    if bundle.bars is None and pack.diameter_m > 0:
        spread = DIAMETER_SIGMA_RATIO * pack.diameter_m
        sigma = replace(bundle.sigma, bar_diameter_m=spread)
        bundle = replace(bundle, bar_diameter_m=pack.diameter_m, sigma=sigma)
    return bundle


def _held_by_straps(
    bundle: Bundle, irregular: BundleSigma, reading: Reading, pack: Pack, floor_m: float | None
) -> Bundle:
    """Hold a bundle to what straps show: place, width and section where the fitted outline misses the pack,
    the section alone where both agree, a doubt where the pack is not seen whole and goes on beyond it.

    irregular: its sigma where it is not surely the hexagon that was fitted.
    """
    if not pack.sides_seen:
        return _partly_seen(bundle, irregular, pack)
    if reading.outlines_pack:
        if bundle.bars is not None:
            return bundle
        if abs(pack.middle_m) < _PACK_MIDDLE_M:
            return _confirmed(replace(bundle, sigma=irregular), pack, floor_m)
    fit = reading.found.fit
    top_z = float(bundle.centre_m[2]) + pack.top_m + _CREST_M
    section, section_sigma = section_of_pack(pack.width_m, _over(top_z, floor_m))
    aside = pack.middle_m * np.array([np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad), 0.0])
    if abs(bundle.yaw_rad - reading.found.sheet.heading_rad + np.arctan(fit.values[SLOPE_U])) > 1.0:
        aside = -aside
    down = np.array([0.0, 0.0, pack.top_m - pack.width_m / 2])
    diameter = pack.diameter_m if pack.diameter_m > 0 else bundle.bar_diameter_m
    packing = f"straps at {len(pack.span.rows_m)} places hold it together, not the packing that was fitted"
    return replace(
        bundle,
        centre_m=bundle.centre_m + aside + down,
        ends_m=bundle.ends_m + aside + down,
        width_m=pack.width_m,
        top_z_m=top_z,
        bars=None,
        bar_diameter_m=diameter,
        bar_axes=(),
        section_m2=section,
        confidence=_STRAPPED * _agreement(fit.state[fit.first : fit.last + 1]),
        reasons=(*(reason for reason in bundle.reasons if "explains the surface" not in reason), packing),
        sigma=replace(
            bundle.sigma,
            lateral_m=float(np.hypot(bundle.sigma.lateral_m, _PACK_MIDDLE_M)),
            yaw_rad=irregular.yaw_rad,
            width_m=float(np.hypot(_PACK_WIDTH_M, _PACK_WIDTH_SIGMAS * fit.sigma_m)),
            top_z_m=float(np.hypot(bundle.sigma.top_z_m, _PACK_TOP_M)),
            bar_diameter_m=DIAMETER_SIGMA_RATIO * pack.diameter_m,
            section_m2=section_sigma,
        ),
    )


def _confirmed(bundle: Bundle, pack: Pack, floor_m: float | None) -> Bundle:
    """Keep a fitted outline that ends where the pack does; they are as sure as they agree."""
    section, section_sigma = section_of_pack(pack.width_m, _over(bundle.top_z_m, floor_m))
    diameter, spread = bundle.bar_diameter_m, bundle.sigma.bar_diameter_m
    if abs(pack.diameter_m - diameter) > DIAMETER_SIGMA_RATIO * diameter:
        diameter, spread = pack.diameter_m, DIAMETER_SIGMA_RATIO * pack.diameter_m
    sigma = replace(
        bundle.sigma,
        bar_diameter_m=spread,
        lateral_m=float(np.hypot(bundle.sigma.lateral_m, pack.middle_m)),
        width_m=float(np.hypot(bundle.sigma.width_m, bundle.width_m - pack.width_m)),
        section_m2=section_sigma,
    )
    return replace(bundle, section_m2=section, bar_diameter_m=diameter, sigma=sigma)


def _over(top_z_m: float, floor_m: float | None) -> float:
    return np.inf if floor_m is None else max(top_z_m - floor_m, 0.0)


def without_pieces(bundles: list[Bundle], readings: list[Reading]) -> list[Bundle]:
    """Remove bundles that are pieces of one that straps hold: their axes run within its flanks. What else
    reaches into one is cut.
    """
    whole = [k for k, one in enumerate(readings) if not one.outlines_pack]
    whole.sort(key=lambda k: -readings[k].weight)
    gone: set[int] = set()
    for k in whole:
        if k not in gone:
            gone |= {n for n, other in enumerate(bundles) if n != k and _is_piece(other, bundles[k])}
    left = [k for k in range(len(bundles)) if k not in gone]
    packs = [pack is not None and pack.sides_seen for pack in (readings[k].pack for k in left)]
    return hold_off([bundles[k] for k in left], packs)


def _is_piece(piece: Bundle, whole: Bundle) -> bool:
    """Check that a bundle's middle lies within another's flanks, at about its height, and along it."""
    away = piece.centre_m[:2] - whole.centre_m[:2]
    along = np.array([-np.sin(whole.yaw_rad), np.cos(whole.yaw_rad)])
    beside = abs(float(away[0] * along[1] - away[1] * along[0]))
    lower = whole.top_z_m - piece.top_z_m
    return bool(
        beside < whole.width_m / 2 - _PIECE_M
        and abs(float(away @ along)) + piece.length_m / 2 < whole.length_m / 2 + _PIECE_BEYOND_M
        and abs(np.sin(piece.yaw_rad - whole.yaw_rad)) < _PIECE_SKEW
        and -_PIECE_HIGHER_M < lower < whole.width_m
    )


def _in_map(sheet: AlignedMap, fit: Fit, v_m: float) -> Float64:
    u, z = fit.at(v_m)
    return np.append(sheet.to_map(np.array([[u, v_m]]))[0], z)


def _sigma(fit: Fit, ends: list[End], top: float, settings: BundleSettings) -> BundleSigma:
    """Propagate the fit's covariance to each figure, with the parts that the whole map shares."""
    along = (ends[0].v_m + ends[1].v_m) / 2 - fit.v_m
    covariance = fit.covariance
    at_middle = np.zeros((2, 6))
    at_middle[0, [U, SLOPE_U]] = 1, along
    at_middle[1, [Z, SLOPE_Z]] = 1, along
    at_middle[1, ROLL], at_middle[1, DIAMETER] = _top_changes(fit, top)
    lateral, height = np.sqrt(np.maximum(np.diag(at_middle @ covariance @ at_middle.T), 0))
    diameter = float(np.sqrt(covariance[DIAMETER, DIAMETER]))
    sigmas = np.array([end.sigma_m for end in ends])
    return BundleSigma(
        lateral_m=float(np.hypot(lateral, settings.shared_lateral_m)),
        along_m=float(np.linalg.norm(sigmas) / 2),
        yaw_rad=float(np.hypot(np.sqrt(covariance[SLOPE_U, SLOPE_U]), np.radians(settings.shared_yaw_deg))),
        length_m=float(np.linalg.norm(sigmas)),
        width_m=(2 * LOOSENESS * fit.rings + 1) * diameter,
        top_z_m=float(np.hypot(height, settings.shared_height_m)),
        bar_diameter_m=diameter,
    )


def _top_changes(fit: Fit, top: float) -> tuple[float, float]:
    """Differentiate the highest line over the axis by roll and by diameter."""
    step = 0.01
    diameter, roll = float(fit.values[DIAMETER]), float(fit.values[ROLL])
    if fit.rings == 0:
        return 0.0, 0.5
    rolled = float(np.nanmax(make_outline(fit.rings, diameter, roll + step, 0.0).exact_m))
    return (rolled - top) / step, top / diameter


def _count(
    reading: Reading, seen: SeenSection | None, top_m: float, floor_m: float | None
) -> tuple[int | None, tuple[str, ...]]:
    """Count bars by the outline; None and a sentence where it is not surely a full hexagon, where another
    packing explains its kind as well, or where one bar may as well be many thin ones.
    """
    fit, other = reading.found.fit, reading.other_packing
    if other is None:
        why_not = is_no_hexagon(seen, fit, top_m, floor_m)
        if not why_not and fit.rings == 0 and reading.found.shades is None:
            why_not = "many thin bars may look like one"
        return (None, (f"its bars can't be counted: {why_not}",)) if why_not else (fit.bars, ())
    diameter = fit.width_m / (2 * LOOSENESS * other + 1)
    return None, (
        f"{fit.bars} bars of {1e3 * fit.values[DIAMETER]:.0f} mm or {BARS_OF_RINGS[other]} of "
        f"{1e3 * diameter:.0f} mm: the outline fits both",
    )


def _doubts(reading: Reading, rows: UInt8, ends: list[End], settings: BundleSettings) -> tuple[str, ...]:
    """List what speaks against the bundle as described."""
    out = []
    known = (rows != 0).mean()
    if known < _SURE_KNOWN:
        out.append(f"only {100 * known:.0f} % of its length was measured")
    crossed = _runs(rows == ABOVE)
    cell = reading.found.sheet.cell_m
    narrow = _places(
        [run for run in crossed if cell < (run[1] - run[0]) * cell <= _NARROW_M], reading, settings
    )
    wide = [b - a for a, b in crossed if (b - a) * cell > _NARROW_M]
    if narrow == 1:
        out.append("something narrow lies across it at one place")
    elif narrow:
        out.append(f"something narrow {KNOWN_ACROSS} at {narrow} places, such as dunnage")
    out += [f"something {n * cell:.2f} m long covers a part of it" for n in wide]
    sunken = (rows == BELOW).sum() * cell
    if sunken > 0.1:
        out.append(f"over {sunken:.2f} m the surface lies lower than the outline")
    out += [f"the {name} end is open: {end.why}" for name, end in zip(("low-y", "high-y"), ends, strict=True)
            if end.is_open]  # fmt: skip
    if reading.rival is not None and reading.rival_weight > 0.9 * reading.weight:
        gap = abs(reading.rival.fit.width_m - reading.found.fit.width_m)
        if gap > 0.15 * reading.found.fit.width_m:
            out.append(
                f"a bundle {1e3 * reading.rival.fit.width_m:.0f} mm wide explains the surface nearly as well"
            )
    return tuple(out)


def _places(runs: list[tuple[int, int]], reading: Reading, settings: BundleSettings) -> int:
    """Count the places at which runs of rows lie over an outline; none where all are so low that noise is."""
    sheet, fit = reading.found.sheet, reading.found.fit
    across = np.linspace(-0.35, 0.35, 15) * fit.width_m
    places, highest, last = 0, 0.0, -np.inf
    for first, end in runs:
        rows = np.arange(first, end) + fit.first
        along = sheet.v0_m + sheet.cell_m * rows - fit.v_m
        u = fit.values[U] + fit.values[SLOPE_U] * along[:, None] + across
        highest = max(highest, float(np.nanmedian(rise_over(sheet, fit, rows, u, settings))))
        places += (first - last) * sheet.cell_m > _ONE_PLACE_M
        last = end
    return places if highest > _LIES_M else 0


def _confidence(reading: Reading, rows: UInt8) -> float:
    """Estimate the probability from how much of the length agrees and how far the next other reading is
    behind.
    """
    fit, rival = reading.found.fit, reading.rival
    lead = 1.0
    if rival is not None and abs(rival.fit.width_m - fit.width_m) > 0.15 * fit.width_m:
        lead = 1 - reading.rival_weight / max(reading.weight, 1e-9)
    sure = 1 - 0.5 * np.exp(-max(lead, 0.0) / 0.05)
    return float(np.clip(sure * _agreement(rows), 0.01, 0.99))


def _agreement(rows: UInt8) -> float:
    """Rate by how much of what was seen of its length agrees with an outline: 1 from four fifths on."""
    return min(1.0, float((rows == AGREES).sum() / max((rows != 0).sum(), 1)) / 0.8)


def _runs(flags: Bool) -> list[tuple[int, int]]:
    """Find first and one-past-last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
