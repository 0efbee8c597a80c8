"""Correct fitted outlines by what the straps show."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from barsight.yard.bundles.doubts import rate_agreement
from barsight.yard.bundles.fitting.outline_fit import SLOPE_U
from barsight.yard.bundles.pack_edges import DOUBTFUL, hold_off
from barsight.yard.bundles.reading import Reading
from barsight.yard.bundles.section.dark_lines import SAME_DIAMETER_RATIO
from barsight.yard.bundles.section.pack_sides import PackSide
from barsight.yard.bundles.section.packs import Pack, contradicts
from barsight.yard.bundles.section.seen_section import SeenSection, bulge_sigma, over_floor, section_of_pack
from barsight.yard.types import Bundle, BundleSigma, Doubt, DoubtKind

_LINES_SIGMA_RATIO = 0.6
"""Standard deviation of a diameter measured by dark lines, as a fraction of it. Where not all lines between
thin bars show, the measured one is that of two bars, of three or of more.
"""
_PACK_MIDDLE_M, _PACK_WIDTH_M, _PACK_TOP_M, _PACK_WIDTH_SIGMAS = 0.012, 0.016, 0.006, 3.0
"""Standard deviations (m) of a pack's middle, width and top, and that of its width in sigmas of a height."""
_CREST_RATIO, _SMEARED_M = 0.6, 0.03
"""Minimum share of a pack's width over which straps must show to bound it: heaps of three rows extend beyond
straps that only show on the top bar. Maximum width (m) that the map adds by smearing two flanks.
"""
_BOTH_MIDDLE_M, _BOTH_WIDTH_RATIO = 0.004, 0.25
"""Sigma of the middle of a pack and an outline that agree: absolute (m), and as a fraction of that of their
width. Both flanks were found twice, so that hardly one of them alone is off.
"""
_SAME_MIDDLE_M = 0.009
"""Maximum distance (m) between the middles of a pack and of the outline that is fitted to it."""
_CREST_M = 0.006
"""Height (m) by which a map's mean section underestimates the crest."""
_HIDDEN_RATIO = 0.5
"""Standard deviation of the part of a pack that a neighbour hides, as a fraction of the width in sight. In
the pile that was examined, at most as much was hidden as was in sight.
"""
_STRAPPED = 0.95
"""Confidence in a bundle whose straps and flanks were seen."""
_PIECE_M, _PIECE_HIGHER_M, _PIECE_BEYOND_M, _PIECE_SKEW = 0.02, 0.012, 0.1, 0.05
"""Limits for a piece of a pack: minimum distance of its axis from the flanks, maximum by which its top is
higher, maximum by which its ends extend beyond the pack's (all m), maximum sine of its skew.
"""
_ONE_BAR, _TWO_BARS = 1.05, 1.75
"""Limits of the width in bar diameters: an outline up to the first is one bar's. One between the two isn't a
whole bundle's, which has at least two bars side by side.
"""
_ASIDE_M = 0.02
"""Distance (m) between the middles of straps and outline from which it counts as uncertainty of the place."""


def held_by_straps(
    bundle: Bundle, irregular: BundleSigma, reading: Reading, seen: SeenSection | None, floor_m: float | None
) -> Bundle:
    """Correct a bundle by its straps.

    Place, width and section are replaced where the fitted outline misses the pack, only the section where
    both agree. Doubts are added where a neighbour may lie over the pack, where the pack continues out of
    sight, and where no straps show. irregular: the bundle's sigma where it may not be the hexagon that was
    fitted. seen: its section as the surface shows it.
    """
    pack = reading.pack
    if pack is None:
        return _without_straps(bundle, irregular, reading)
    held = _held(bundle, irregular, reading, seen, floor_m)
    if held.bars is None and _is_top_bar(reading):
        said = "straps cross what looks like one bar: it may be the top one of several"
        held = replace(held, reasons=(*held.reasons, Doubt(DoubtKind.STRAPPED_BAR, said)))
    if held.bars is not None or not _may_go_on(pack, seen):
        return held
    said = "its straps show on its crest alone, and its surface doesn't end there: it may be wider"
    return replace(
        held, section_m2=np.nan, sigma=replace(held.sigma, section_m2=np.nan),
        reasons=(*held.reasons, Doubt(DoubtKind.MAY_GO_ON, said)),
    )  # fmt: skip


def _is_top_bar(reading: Reading) -> bool:
    """Check whether straps, which hold several bars, cross an outline of one bar without showing others."""
    pack = reading.pack
    one_bar = reading.found.fit.rings == 0 and pack is not None and math.isnan(pack.diameter_m)
    return bool(one_bar and pack is not None and not pack.is_bounded)


def _without_straps(bundle: Bundle, irregular: BundleSigma, reading: Reading) -> Bundle:
    """Add the doubt to several bars that can't be counted that no straps were seen, whether or not a photo
    would show them.
    """
    if bundle.bars is not None:
        return bundle
    bundle = replace(bundle, sigma=irregular)
    if reading.found.fit.rings == 0:
        return bundle
    said = "no straps that hold it were seen: its bars may lie loose, or be some of a wider bundle's"
    return replace(bundle, reasons=(*bundle.reasons, Doubt(DoubtKind.NO_STRAPS, said)))


def doubted_without_straps(bundle: Bundle) -> Bundle:
    """Lower the confidence in several bars that can't be counted and on which neither the photo nor the
    pictures show straps: they may lie loose, and the outline may be that of some bars of a pack.
    """
    if not any(doubt.kind is DoubtKind.NO_STRAPS for doubt in bundle.reasons):
        return bundle
    return replace(bundle, confidence=min(bundle.confidence, DOUBTFUL))


def doubted_if_narrow(bundle: Bundle) -> Bundle:
    """Mark as doubtful a bundle narrower than two of its bars, unless it may be one bar: it is a part of a
    wider bundle, or one bar whose diameter is wrong. Straps hold no single bar. Its section isn't known.
    """
    strapped = [doubt for doubt in bundle.reasons if doubt.kind is DoubtKind.STRAPPED_BAR]
    ratio = bundle.width_m / bundle.bar_diameter_m
    if bundle.bars is not None or (ratio <= _ONE_BAR and not strapped):
        return bundle
    reasons = tuple(doubt for doubt in bundle.reasons if doubt not in strapped)
    if ratio >= _TWO_BARS:
        return replace(bundle, reasons=reasons) if strapped else bundle
    narrow = (
        f"it is {1e3 * bundle.width_m:.0f} mm wide, less than two of its bars of "
        f"{1e3 * bundle.bar_diameter_m:.0f} mm: it may be wider, or one bar"
    )
    doubts = strapped if ratio <= _ONE_BAR else [Doubt(DoubtKind.MAY_GO_ON, narrow)]
    return replace(
        bundle, section_m2=np.nan, confidence=min(bundle.confidence, DOUBTFUL), reasons=(*reasons, *doubts),
        sigma=replace(bundle.sigma, section_m2=np.nan),
    )  # fmt: skip


def _may_go_on(pack: Pack, seen: SeenSection | None) -> bool:
    """Check whether straps only show on a pack's crest while its surface doesn't end with its flanks."""
    if pack.span.width_m >= _CREST_RATIO * pack.width_m:
        return False
    return seen is None or not seen.sides_seen or seen.width_m >= pack.width_m + _SMEARED_M


def _held(
    bundle: Bundle, irregular: BundleSigma, reading: Reading, seen: SeenSection | None, floor_m: float | None
) -> Bundle:
    """Correct a bundle by its straps as if they showed all across it; see `held_by_straps`."""
    pack = reading.pack
    assert pack is not None
    if not pack.is_bounded:
        return _partly_seen(bundle, irregular, pack, reading.straps_aside_m(seen))
    if reading.outlines_pack:
        if bundle.bars is not None and pack.sides_seen:
            return bundle
        shown = reading.found.shades is not None
        if shown or abs(pack.middle_m) < _SAME_MIDDLE_M:
            own = replace(bundle, sigma=irregular)
            sigmas_m = bundle.sigma.lateral_m, _pack_sigma(reading, pack)
            return _covered(_confirmed(own, pack, floor_m, sigmas_m), pack)
    return _covered(_as_pack(bundle, irregular, reading, pack, floor_m), pack)


def _as_pack(
    bundle: Bundle, irregular: BundleSigma, reading: Reading, pack: Pack, floor_m: float | None
) -> Bundle:
    """Replace place, width, top and section of a fitted outline by those of the pack that straps hold."""
    fit = reading.found.fit
    top_z = float(bundle.centre_m[2]) + pack.top_m + _CREST_M
    width_sigma = _pack_sigma(reading, pack)
    section, section_sigma = section_of_pack(pack.width_m, width_sigma, over_floor(top_z, floor_m))
    aside = pack.middle_m * np.array([np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad), 0.0])
    if abs(bundle.yaw_rad - reading.found.grid.heading_rad + np.arctan(fit.values[SLOPE_U])) > 1.0:
        aside = -aside
    down = np.array([0.0, 0.0, pack.top_m - pack.width_m / 2])
    diameter = pack.diameter_m if pack.diameter_m > 0 else bundle.bar_diameter_m
    said = f"straps at {len(pack.span.rows_m)} places hold it together, not the packing that was fitted"
    kept = (doubt for doubt in bundle.reasons if doubt.kind is not DoubtKind.RIVAL)
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
        confidence=_STRAPPED * rate_agreement(fit.state[fit.first : fit.last + 1]),
        reasons=(*kept, Doubt(DoubtKind.OTHER, said)),
        sigma=replace(
            bundle.sigma,
            lateral_m=math.hypot(bundle.sigma.lateral_m, _PACK_MIDDLE_M, _bulge(reading, pack) / 2),
            yaw_rad=irregular.yaw_rad,
            width_m=width_sigma,
            top_z_m=float(np.hypot(bundle.sigma.top_z_m, _PACK_TOP_M)),
            bar_diameter_m=_LINES_SIGMA_RATIO * diameter,
            section_m2=section_sigma,
        ),
        fit_sigma=None,
    )


def _covered(bundle: Bundle, pack: Pack) -> Bundle:
    """Mark as doubtful a bundle over whose flanks neighbours may lie: only its visible width is known."""
    sides = [name for name, side in zip(("low", "high"), pack.sides, strict=True) if side == PackSide.COVERED]
    if not sides:
        return bundle
    hidden_m = _HIDDEN_RATIO * bundle.width_m
    doubts = tuple(
        Doubt(DoubtKind.HIDDEN_FLANK, f"what stands beside it may lie over its {name} flank")
        for name in sides
    )
    return replace(
        bundle,
        bars=None,
        section_m2=np.nan,
        confidence=min(bundle.confidence, DOUBTFUL),
        reasons=bundle.reasons + doubts,
        cover_doubts=bundle.cover_doubts + doubts,
        sigma=replace(
            bundle.sigma,
            lateral_m=float(np.hypot(bundle.sigma.lateral_m, hidden_m / 2)),
            width_m=float(np.hypot(bundle.sigma.width_m, hidden_m)),
            section_m2=np.nan,
        ),
    )


def _partly_seen(bundle: Bundle, irregular: BundleSigma, pack: Pack, aside_m: float) -> Bundle:
    """Mark as doubtful a bundle whose pack extends beyond it or lies aside, by aside_m, with a flank that
    isn't seen.
    """
    beyond_m, said = contradicts(pack, bundle.width_m)
    if said:
        sure, reasons = min(bundle.confidence, DOUBTFUL), (*bundle.reasons, Doubt(DoubtKind.OTHER, said))
        bundle = replace(bundle, confidence=sure, reasons=reasons, bars=None)
        irregular = replace(
            irregular,
            width_m=float(np.hypot(irregular.width_m, beyond_m)),
            lateral_m=float(np.hypot(irregular.lateral_m, beyond_m / 2)),
        )
    if bundle.bars is None:
        bundle = replace(bundle, sigma=irregular)
    if aside_m > _ASIDE_M:
        lateral = float(np.hypot(bundle.sigma.lateral_m, aside_m))
        bundle = replace(bundle, sigma=replace(bundle.sigma, lateral_m=lateral))
    if bundle.bars is None and pack.diameter_m > 0:
        spread = _LINES_SIGMA_RATIO * pack.diameter_m
        sigma = replace(bundle.sigma, bar_diameter_m=spread)
        bundle = replace(bundle, bar_diameter_m=pack.diameter_m, sigma=sigma)
    return bundle


def _confirmed(
    bundle: Bundle, pack: Pack, floor_m: float | None, sigmas_m: tuple[float, float]
) -> Bundle:  # fmt: skip
    """Keep a fitted outline that ends where the pack does. Its width is the mean of both, weighted by their
    sigmas, and its sigma reflects how well they agree, as that of its middle does. The outline counts more
    where the pack's flanks are out of sight.

    sigmas_m: of the fit's place, and of the pack's width.
    """
    fitted_m, pack_sigma_m = sigmas_m
    diameter, spread = bundle.bar_diameter_m, bundle.sigma.bar_diameter_m
    if abs(pack.diameter_m - diameter) > SAME_DIAMETER_RATIO * diameter:
        diameter, spread = pack.diameter_m, _LINES_SIGMA_RATIO * pack.diameter_m
    own, packs = bundle.sigma.width_m**-2, pack_sigma_m**-2
    width = (own * bundle.width_m + packs * pack.width_m) / (own + packs)
    width_sigma = math.hypot((own + packs) ** -0.5, (bundle.width_m - pack.width_m) / 2)
    section, section_sigma = section_of_pack(width, width_sigma, over_floor(bundle.top_z_m, floor_m))
    sigma = replace(
        bundle.sigma,
        bar_diameter_m=spread,
        lateral_m=math.hypot(fitted_m, pack.middle_m, _BOTH_MIDDLE_M, _BOTH_WIDTH_RATIO * width_sigma),
        width_m=width_sigma,
        section_m2=section_sigma,
    )
    return replace(bundle, width_m=width, section_m2=section, bar_diameter_m=diameter, sigma=sigma)


def _pack_sigma(reading: Reading, pack: Pack) -> float:
    """Compute the standard deviation (m) of a pack's width."""
    return math.hypot(_PACK_WIDTH_M, _PACK_WIDTH_SIGMAS * reading.found.fit.sigma_m, _bulge(reading, pack))


def _bulge(reading: Reading, pack: Pack) -> float:
    """Compute the standard deviation (m) of the extra width where nothing was seen behind the flanks."""
    return bulge_sigma(pack.hidden_m, pack.width_m, is_along_baseline=reading.is_along_baseline)


def without_pieces(bundles: list[Bundle], readings: list[Reading]) -> list[Bundle]:
    """Remove bundles that are pieces of a strapped one, as their axes run within its flanks, and cut those
    that otherwise reach into one.
    """
    whole = [k for k, one in enumerate(readings) if one.pack is not None and one.pack.is_bounded]
    whole.sort(key=lambda k: -readings[k].weight)
    gone: set[int] = set()
    for k in whole:
        if k not in gone:
            gone |= {n for n, other in enumerate(bundles) if n != k and _is_piece(other, bundles[k])}
    left = [k for k in range(len(bundles)) if k not in gone]
    packs = [pack is not None and pack.is_bounded for pack in (readings[k].pack for k in left)]
    return hold_off([bundles[k] for k in left], packs)


def _is_piece(piece: Bundle, whole: Bundle) -> bool:
    """Check whether a bundle's middle lies within another's flanks, at about its height, and along it."""
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
