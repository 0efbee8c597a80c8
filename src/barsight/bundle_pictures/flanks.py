"""Locate a bundle's flanks by the ends of its straps in the pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from barsight.bundle_pictures.samples import bundle_axes
from barsight.bundle_pictures.strap_ends import REACH_M, StrapEnds
from barsight.core.arrays import Float64
from barsight.core.linalg.robust import nan_medians
from barsight.labels.placing import heights_at
from barsight.yard.bundles.section.packs import dip_depth
from barsight.yard.bundles.section.seen_section import is_overhung, over_floor, section_of_pack
from barsight.yard.bundles.section.straps import APART_M, MIN_STRAPS
from barsight.yard.lift_settings import UPPER
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, Doubt, DoubtKind, YardMap

_WEAK_RATIO, _STRONG = 0.5, 4
"""Minimum contrast of a strap, relative to the fourth strongest line."""
_SAME_M = 0.01
"""Maximum distance of a strap's end from the median at which it agrees with it."""
_AGREE_RATIO = 0.5
"""Share of the lines' ends that must be exceeded by those that agree."""
_FLANK_SIGMA_M, _FLANK_PIXELS, _MOVED_RATIO, _MIDDLE_SIGMA_M = 0.004, 0.5, 0.6, 0.004
"""Sigma of a flank located by straps, m and pixels (the larger one), and as a share of its distance from the
map's flank; sigma of the centre of mass, taken as the middle between the flanks.
"""
_PLANE_RATIO = 0.25
"""Uncertainty of the height at which a bundle is widest, as a share of its width."""
_CELL_M, _ROW_M, _TRIM_M = 0.01, 0.03, 0.1
"""Sample spacing of a mean section across and along the bundle, and the length left out at either end."""
_CREST_RATIO, _BESIDE_M = 0.35, 0.02
"""Half width of the crest's search interval, as a share of the width; reach by which a map blurs a gully."""
_INSIDE_M, _OUTSIDE_M, _RIM_M = 0.015, 0.02, 0.045
"""Distances inside and outside a flank within which the surface must end; reach of a gully's two sides."""
_DEEP_RATIO, _DEEP_M, _BEFORE = 0.6, 0.15, 3
"""Minimum depth under the crest, as a share of the width and absolute, that no pack's own surface has; number
of samples before a flank of which at least one must be less deep.
"""
_FALL_RATIO, _MIN_FALL_M, _FALL_BARS, _DENT_M = 0.15, 0.02, 0.5, 0.006
"""Minimum depth of a gully between neighbouring bundles, as a share of the width, absolute, and in bars;
minimum rise on either side of it.
"""
_PARTING_M, _PARTING_RATIO, _PARTING_BARS = 0.06, 0.3, 1.2
"""Minimum depth of a gully that divides the surface into two bundles: absolute, as a share of the width,
in bars.
"""
_HIDDEN_M, _MIN_HIDDEN_M, _HIDDEN_BARS = 0.04, 0.02, 0.6
"""Minimum width of a gully with an unseen floor that divides it too; then the width over which a flank may be
out of sight, absolute and in bars.
"""
_CONTRADICTED, _MAX_ASIDE_M = 4.0, 0.05
"""Disagreement between straps and the map's flanks, in sigmas and as an offset of the middle, above which the
bundle is only marked as uncertain.
"""


@dataclass(frozen=True, eq=False)
class MeanSection:
    """Mean heights (N,) across a bundle at positions beside_m from its axis.

    NaN where half of the length isn't known, inf beyond the map's border. width_m: the bundle's width by the
    map.
    """

    beside_m: Float64
    level_m: Float64
    width_m: float

    @classmethod
    def of(cls, bundle: Bundle, heights: YardMap) -> MeanSection:
        """Average the map along a bundle."""
        along, across = bundle_axes(bundle)
        half = bundle.width_m / 2 + REACH_M
        beside = np.arange(-half, half, _CELL_M)
        rows = np.arange(-bundle.length_m / 2 + _TRIM_M, bundle.length_m / 2 - _TRIM_M, _ROW_M)[:, None]
        level = along * [1.0, 1.0, 0.0]
        places = bundle.centre_m + rows[..., None] * level + beside[:, None] * across
        part = part_about(heights, places[..., 0].ravel(), places[..., 1].ravel())
        z = heights_at(part, places) - rows * along[2]
        mean = np.full(beside.size, np.nan)
        known = 2 * np.isfinite(z).sum(axis=0) > len(z)
        mean[known] = nan_medians(z[:, known])
        cells = (places[..., :2] - (heights.x0_m, heights.y0_m)) / heights.cell_m
        outside = (cells < -0.5) | (cells > np.array(heights.shape[::-1]) - 0.5)
        mean[2 * outside.any(axis=-1).sum(axis=0) > len(z)] = np.inf
        return cls(beside, mean, bundle.width_m)

    def ends_at(self, flank_m: float, side: int, diameter_m: float) -> bool:
        """Check whether the surface ends at a flank. side: -1 for the lower flank position, else 1.

        It ends where it falls far, isn't seen, or rises again behind a gully that is deeper or wider than one
        between the bundle's own bars.
        """
        outwards = side * (self.beside_m - flank_m)
        order = np.argsort(outwards)
        outwards, level = outwards[order], self.level_m[order]
        crest = self.level_m[np.abs(self.beside_m) < _CREST_RATIO * self.width_m]
        near = np.flatnonzero((outwards > -_INSIDE_M) & (outwards < _OUTSIDE_M))
        if not (np.isfinite(crest).any() and near.size):
            return False
        depth = crest[np.isfinite(crest)].max() - level
        deep = depth > max(_DEEP_RATIO * self.width_m, _DEEP_M)
        if bool(deep[near].any()):
            return not bool(deep[max(near[0] - _BEFORE, 0) : near[0]].all())
        rims = round(_RIM_M / _CELL_M)
        min_depth = max(_FALL_RATIO * self.width_m, _MIN_FALL_M, _FALL_BARS * diameter_m)
        run = np.ones(round(max(_HIDDEN_BARS * diameter_m, _MIN_HIDDEN_M) / _CELL_M), bool)
        hidden = ndimage.binary_opening(np.isnan(level), run)
        for k in near.tolist():
            before, behind = level[max(k - rims, 0) : k], level[k + 1 : k + 1 + rims]
            if is_overhung(before[::-1], behind):
                return False
            if hidden[k]:
                return True
            rises = [part[np.isfinite(part)].max(initial=-np.inf) - level[k] for part in (before, behind)]
            if depth[k] >= min_depth and min(rises) >= _DENT_M:
                return True
        return False

    def is_parted(self, low_m: float, high_m: float, diameter_m: float) -> bool:
        """Check whether a gully between two flanks is as deep, or as wide, as one between two bundles."""
        inside = (self.beside_m > low_m + _BESIDE_M) & (self.beside_m < high_m - _BESIDE_M)
        level = self.level_m[inside]
        seen = np.flatnonzero(np.isfinite(level))
        if not seen.size:
            return True
        apart_m = _CELL_M * (np.diff(np.concatenate([[-1], seen, [level.size]])).max() - 1)
        width_m = min(high_m - low_m, self.width_m)
        deep_m = max(_PARTING_BARS * diameter_m, _PARTING_M, _PARTING_RATIO * width_m)
        return bool(dip_depth(level[seen]) > deep_m or apart_m > max(_HIDDEN_BARS * diameter_m, _HIDDEN_M))


def with_flanks(
    bundle: Bundle, straps: Sequence[StrapEnds], section: MeanSection, floor_m: float | None, tilt: float
) -> Bundle:
    """Move a bundle's flanks to where most of its straps end, and estimate its section again.

    floor_m: height of the floor. tilt: horizontal over vertical component of the lines of sight. Returns the
    same bundle where the straps don't agree, the map's section contradicts them, or something lies or may lie
    on the bundle. Straps that end far from the map's flanks only make the bundle uncertain.
    """
    flanks = _agreed_flanks(straps) if bundle.is_free else None
    if flanks is None:
        return bundle
    (low, high), own = (flank.beside_m for flank in flanks), bundle.sigma
    diameter = float(np.nan_to_num(bundle.bar_diameter_m + UPPER * np.nan_to_num(own.bar_diameter_m)))
    ended = (section.ends_at(flank, side, diameter) for flank, side in ((low, -1), (high, 1)))
    if not all(ended) or section.is_parted(low, high, diameter):
        return bundle
    width, middle = high - low, (low + high) / 2
    off = abs(np.array([middle, width - bundle.width_m])) / np.fmax([own.lateral_m, own.width_m], 1e-6)
    if off.max() > _CONTRADICTED or abs(middle) > _MAX_ASIDE_M:
        return _contradicted(bundle, middle, width)
    plane_m = tilt * _PLANE_RATIO * width
    moved_m = _MOVED_RATIO * math.hypot(low + bundle.width_m / 2, high - bundle.width_m / 2)
    spread = math.hypot(*(flank.sigma_m for flank in flanks), moved_m, plane_m)
    turned = own.yaw_rad * max(abs(flank.along_m) for flank in flanks)
    sigma = replace(own, width_m=spread, lateral_m=math.hypot(spread / 2, _MIDDLE_SIGMA_M, plane_m, turned))
    if not any(doubt.kind is DoubtKind.MAY_GO_ON for doubt in bundle.reasons):
        found, found_sigma = section_of_pack(width, spread, over_floor(bundle.top_z_m, floor_m))
        bundle, sigma = replace(bundle, section_m2=found), replace(sigma, section_m2=found_sigma)
    _, across = bundle_axes(bundle)
    # The axis of what is as high as wide lies half its width under its top.
    aside = middle * across + [0, 0, (bundle.width_m - width) / 2]
    return replace(
        bundle, centre_m=bundle.centre_m + aside, ends_m=bundle.ends_m + aside, width_m=width, sigma=sigma,
        reasons=tuple(doubt for doubt in bundle.reasons if doubt.kind is not DoubtKind.NO_STRAPS),
        fit_sigma=None,
    )  # fmt: skip


def _contradicted(bundle: Bundle, middle_m: float, width_m: float) -> Bundle:
    """Mark a bundle as uncertain whose straps end elsewhere than the map's flanks."""
    own, wider = bundle.sigma, width_m - bundle.width_m
    said = (
        f"in the pictures its straps end {1e3 * abs(middle_m) + 1e3 * abs(wider) / 2:.0f} mm off its flanks"
    )
    unsure = replace(
        own, lateral_m=math.hypot(own.lateral_m, middle_m), width_m=math.hypot(own.width_m, wider),
        section_m2=math.nan,
    )  # fmt: skip
    reasons = (*bundle.reasons, Doubt(DoubtKind.OTHER, said))
    return replace(bundle, section_m2=math.nan, sigma=unsure, reasons=reasons)


class _Flank(NamedTuple):
    """Position of a flank beside the axis with its sigma, and mean position along it of the straps behind
    it.
    """

    beside_m: float
    sigma_m: float
    along_m: float


def _agreed_flanks(straps: Sequence[StrapEnds]) -> tuple[_Flank, _Flank] | None:
    """Find where most of the clear straps end on either side; None where they don't agree."""
    contrasts = sorted((strap.contrast for strap in straps), reverse=True)
    if len(contrasts) < MIN_STRAPS:
        return None
    least = _WEAK_RATIO * contrasts[min(_STRONG, len(contrasts)) - 1]
    kept = [strap for strap in straps if strap.contrast >= least]
    along, pixel_m = np.array([strap.along_m for strap in kept]), max(strap.pixel_m for strap in kept)
    low = _agreed(np.array([strap.low_m for strap in kept]), along, pixel_m)
    high = _agreed(np.array([strap.high_m for strap in kept]), along, pixel_m)
    return None if low is None or high is None or low.beside_m >= high.beside_m else (low, high)


def _agreed(ends_m: Float64, along_m: Float64, pixel_m: float) -> _Flank | None:
    """Compute the median of the ends (S,) that agree, of straps at along_m; None where too few agree."""
    best = np.zeros(ends_m.size, bool)
    for end in ends_m[np.isfinite(ends_m)]:
        same = np.abs(ends_m - end) <= _SAME_M
        straps = 1 + int((np.diff(np.sort(along_m[same])) > APART_M / 2).sum())
        if straps >= MIN_STRAPS and same.sum() > best.sum():
            best = same
    if best.sum() <= _AGREE_RATIO * ends_m.size:
        return None
    spread = math.hypot(max(_FLANK_SIGMA_M, _FLANK_PIXELS * pixel_m), float(np.std(ends_m[best])))
    return _Flank(float(np.median(ends_m[best])), spread, float(along_m[best].mean()))


def takes_another(bundle: Bundle, others: Sequence[Bundle]) -> bool:
    """Check whether another bundle's middle is between a bundle's flanks, at about its height."""
    centres = np.array([other.centre_m for other in others]).reshape(-1, 3) - bundle.centre_m
    along, across = bundle_axes(bundle)
    beside, beyond = centres @ across, centres[:, :2] @ along[:2]
    lower = np.abs([other.top_z_m - bundle.top_z_m for other in others])
    inside = (np.abs(beside) < bundle.width_m / 2) & (np.abs(beyond) < bundle.length_m / 2)
    return bool((inside & (lower < bundle.width_m / 2)).any())
