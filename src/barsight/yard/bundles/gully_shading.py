"""Find a bundle's packing in the orthophoto, which is dark along the lines where bars meet.

The shading across a bundle reveals its packing, which a smoothed surface often can't. Once the packing is
known, the surface shows how much it is smoothed, and so how thick the bars are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64, kernel
from barsight.yard.bundles.fitting.outline import (
    BARS_OF_RINGS,
    STEP_M,
    TRIANGLE,
    TRIANGLE_BARS_M,
    add_weighted,
    bundle_width,
    highest_bars,
    packing_axes,
    turned_packing,
)
from barsight.yard.bundles.fitting.outline_fit import (
    DIAMETER,
    ROLL,
    Fit,
    FittedOutline,
    ShadeProfile,
    refine_outline,
)
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.bundles.section.shades import shade_profile
from barsight.yard.types import HeightMap

_PIXEL_M = 0.003
"""Standard deviation (m, on the surface) of the blur by lens and pixel."""
_WIDER = np.arange(-0.04, 0.041, 0.02)
_SHIFTS_M = np.arange(-0.004, 0.0041, 0.002)
_ROLLS_RAD = np.radians(np.arange(-6.0, 6.1, 3.0))
_MAX_REST = 0.4
"""Maximum share of the gray levels' variance that the best packing may leave unexplained."""
_MAX_DOUBTING = 0.5
"""The same for a packing that isn't certain, but counts as evidence against the packing of the surface."""
_SURE = 4.5
"""Minimum log-likelihood ratio between the best packing and the next for the best one to be certain."""
_SMOOTHINGS_M = np.array([0.004, 0.007, 0.010, 0.013, 0.016])
_MAX_SMOOTHED = 8


@dataclass(frozen=True)
class Packing:
    """The packing that explains the gray levels best. rest: share of their variance that it leaves
    unexplained; lead: log-likelihood ratio over the next best.
    """

    rings: int
    diameter_m: float
    roll_rad: float
    rest: float
    lead: float


def packing_by_shades(shades: ShadeProfile, fit: Fit, cell_m: float, settings: BundleSettings) -> Packing:
    """Fit the packing whose shading explains most of the gray levels, near the fit's width, place and roll.

    Each visible bar counts as two independent samples: its sides.
    """
    tried: list[tuple[float, int, float, float]] = []
    for rings in range(len(BARS_OF_RINGS)):
        diameter = fit.width_m / bundle_width(rings, 1.0)
        if rings == TRIANGLE and not TRIANGLE_BARS_M[0] <= diameter <= TRIANGLE_BARS_M[1]:
            continue
        if settings.catalogue_mm:
            known = 1e-3 * np.array(settings.catalogue_mm)
            diameters = known[np.abs(known / diameter - 1) < -2 * _WIDER[0]]
        else:
            diameters = diameter * (1 + _WIDER)
        rolls = fit.values[ROLL] + (_ROLLS_RAD if rings else np.zeros(1))
        blur = float(np.hypot(cell_m / np.sqrt(12), _PIXEL_M))
        if diameters.size:
            rests = _rests(
                shades.places_m, shades.levels, packing_axes(rings), diameters, rolls, _SHIFTS_M, blur
            )
            k = np.unravel_index(int(rests.argmin()), rests.shape)
            tried.append((float(rests.min()), rings, float(diameters[k[0]]), float(rolls[k[1]])))
    tried.sort()
    rest, rings, diameter, roll = tried[0]
    others = tried[1][0] if len(tried) > 1 else 1.0
    lead = _visible(rings, diameter, roll) * np.log(others / max(rest, 1e-9))
    return Packing(rings, diameter, roll, rest, float(lead))


@kernel()
def _rests(
    places: Float64, levels: Float64, packing: Float64, diameters: Float64, rolls: Float64, shifts: Float64,
    blur: float,
) -> Float64:  # fmt: skip
    """Compute the fraction (diameters, rolls) of the gray levels' variance that the best shift leaves
    unexplained.

    The model is round bars lit from above and from the side, where both lights vary smoothly across the
    bundle. places: (N,) m beside the axis; levels: (N,) log gray levels. packing: (bars, 2), in diameters.
    diameters: m; rolls: rad; shifts: (S,) m. blur: m.
    """
    out = np.ones((diameters.size, rolls.size))
    spread = levels - levels.mean()
    total = max((spread * spread).sum(), 1e-12)
    widest = np.abs(places).max()
    table, row = np.empty((7, 8)), np.empty(8)
    for a in range(diameters.size):
        for b in range(rolls.size):
            above, aside = _shading(packing, diameters[a], rolls[b], blur)
            middle = above.size // 2
            for shift in shifts:
                table[:] = 0.0
                for n in range(places.size):
                    x = (places[n] - shift) / STEP_M + middle
                    k = min(max(int(x), 0), above.size - 2)
                    t = min(max(x - k, 0.0), 1.0)
                    q = places[n] / widest
                    light = above[k] * (1 - t) + above[k + 1] * t
                    row[0], row[1], row[2] = 1.0, q, q * q
                    row[3], row[4], row[5] = light, light * q, light * q * q
                    row[6] = aside[k] * (1 - t) + aside[k + 1] * t
                    row[7] = spread[n]
                    for i in range(7):
                        for j in range(8):
                            table[i, j] += row[i] * row[j]
                for i in range(7):
                    table[i, i] += 1e-6 * places.size
                found = np.linalg.solve(table[:, :7].copy(), table[:, 7].copy())
                rest = total - (found * table[:, 7]).sum()
                out[a, b] = min(out[a, b], rest / total)
    return out


@kernel()
def _shading(packing: Float64, diameter: float, roll: float, blur: float) -> tuple[Float64, Float64]:
    """Render how far each place faces up, and how far sideways, blurred; 0 beside the bars.

    packing: (bars, 2), in diameters. diameter, blur: m. Returns two arrays (N,), STEP_M apart, with the axis
    in the middle.
    """
    c, s = np.cos(roll), np.sin(roll)
    radius = diameter / 2
    half = int((np.abs(packing).max() * diameter + radius) / STEP_M) + 20
    size = 2 * half + 1
    top, up, side = np.full(size, -np.inf), np.zeros(size), np.zeros(size)
    for bar in range(packing.shape[0]):
        u = diameter * (packing[bar, 0] * c - packing[bar, 1] * s)
        z = diameter * (packing[bar, 0] * s + packing[bar, 1] * c)
        for i in range(
            max(int(np.ceil((u - radius) / STEP_M)) + half, 0),
            min(int((u + radius) / STEP_M + half), size - 1) + 1,
        ):
            turned = (STEP_M * (i - half) - u) / radius
            rise = np.sqrt(max(1 - turned * turned, 0.0))
            if z + radius * rise > top[i]:
                top[i], up[i], side[i] = z + radius * rise, rise, turned
    reach = int(3 * blur / STEP_M)
    above, aside = np.zeros(size), np.zeros(size)
    total = 0.0
    for k in range(-reach, reach + 1):
        weight = np.exp(-0.5 * (STEP_M * k / blur) ** 2)
        total += weight
        first, end = max(-k, 0), min(size - k, size)
        add_weighted(above[first:end], up[first + k : end + k], weight)
        add_weighted(aside[first:end], side[first + k : end + k], weight)
    return above / total, aside / total


def refit_with_packing(
    found: FittedOutline, height_map: HeightMap, settings: BundleSettings
) -> FittedOutline:
    """Refit with the packing that the gray levels show, where they show one with certainty."""
    shades = shade_profile(height_map, found.grid, found.fit)
    if shades is None:
        return found
    fit = found.fit
    packing = packing_by_shades(shades, fit, height_map.cell_m, settings)
    if packing.rest > _MAX_REST or packing.lead < _SURE:
        doubts = packing.rest < _MAX_DOUBTING and packing.rings != fit.rings
        return replace(found, doubt=packing.rings if doubts else None)
    if packing.rings != fit.rings:
        values = fit.values.copy()
        values[DIAMETER], values[ROLL] = packing.diameter_m, packing.roll_rad
        again = refine_outline(found.grid, replace(fit, rings=packing.rings, values=values), settings)
        if again is None:
            return found
        fit = again
    return FittedOutline(found.grid, fit, shades)


def _visible(rings: int, diameter_m: float, roll_rad: float) -> int:
    """Count the bars that are visible from above."""
    axes = turned_packing(rings, diameter_m, roll_rad)
    reach = bundle_width(rings, diameter_m) / 2
    highest, _ = highest_bars(axes, diameter_m / 2, np.arange(-reach, reach, STEP_M))
    return int(np.unique(highest[highest >= 0]).size)


def estimate_smoothing(found: list[FittedOutline], settings: BundleSettings) -> float:
    """Estimate the map's smoothing across the bars (m, standard deviation): the one that fits best where the
    photo settled the packing. Returns the settings' value where it settled none.

    Without the packing it can't be determined: thin bars with little smoothing look like thick bars with
    much.
    """
    known = [one for one in found if one.shades is not None and one.fit.rings > 0]
    known = known[:: 1 + len(known) // _MAX_SMOOTHED]
    misfits = []
    for one in known:
        tried = [refine_outline(one.grid, one.fit, replace(settings, smoothing_m=s)) for s in _SMOOTHINGS_M]
        rms = np.array([np.nan if fit is None else fit.rms_m for fit in tried])
        if np.isfinite(rms).all():
            misfits.append((rms / rms.min()) ** 2)
    if not misfits:
        return settings.smoothing_m
    mean = np.mean(misfits, axis=0)
    k = int(np.clip(mean.argmin(), 1, mean.size - 2))
    bend, slope, _ = np.polyfit(_SMOOTHINGS_M[k - 1 : k + 2], mean[k - 1 : k + 2], 2)
    least = -slope / (2 * bend) if bend > 0 else _SMOOTHINGS_M[mean.argmin()]
    return float(np.clip(least, _SMOOTHINGS_M[0], _SMOOTHINGS_M[-1]))
