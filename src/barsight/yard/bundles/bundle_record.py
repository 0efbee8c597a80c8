"""Describe fitted outlines as bundles: ends, layers, what lies on what, how sure all of it is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Bool, Float64, UInt8
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
from barsight.yard.bundles.layers import check_uncovered, find_layers, list_neighbours
from barsight.yard.bundles.seen_section import SeenSection, estimate_section, is_no_hexagon, seen_section
from barsight.yard.sections import MapStretch
from barsight.yard.types import Bundle, BundleSigma

_NARROW_M = 0.3
_SURE_KNOWN = 0.7


@dataclass(frozen=True, eq=False)
class Reading:
    """A chosen outline with its weight (cells explained) and the strongest other reading of its place.

    other_packing: rings of another packing that explains the bundles of this kind as well, if any does.
    """

    found: FittedOutline
    weight: float
    rival: FittedOutline | None
    rival_weight: float
    other_packing: int | None


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
    reasons = doubt + _doubts(reading, rows, ends, sheet)
    section, section_sigma = estimate_section(seen, fit, top_z, floor_m)
    return Bundle(
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


def _doubts(reading: Reading, rows: UInt8, ends: list[End], sheet: AlignedMap) -> tuple[str, ...]:
    """List what speaks against the bundle as described."""
    out = []
    known = (rows != 0).mean()
    if known < _SURE_KNOWN:
        out.append(f"only {100 * known:.0f} % of its length was measured")
    crossed = _runs(rows == ABOVE)
    cell = sheet.cell_m
    narrow = [b - a for a, b in crossed if 2 * cell < (b - a) * cell <= _NARROW_M]
    wide = [b - a for a, b in crossed if (b - a) * cell > _NARROW_M]
    if narrow:
        out.append(f"something narrow crosses over it at {len(narrow)} place(s), such as dunnage")
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


def _confidence(reading: Reading, rows: UInt8) -> float:
    """Estimate the probability from how much of the length agrees and how far the next other reading is
    behind.
    """
    agrees = float((rows == AGREES).sum() / max((rows != 0).sum(), 1))
    fit, rival = reading.found.fit, reading.rival
    lead = 1.0
    if rival is not None and abs(rival.fit.width_m - fit.width_m) > 0.15 * fit.width_m:
        lead = 1 - reading.rival_weight / max(reading.weight, 1e-9)
    sure = 1 - 0.5 * np.exp(-max(lead, 0.0) / 0.05)
    return float(np.clip(sure * min(1.0, agrees / 0.8), 0.01, 0.99))


def _runs(flags: Bool) -> list[tuple[int, int]]:
    """Find first and one-past-last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
