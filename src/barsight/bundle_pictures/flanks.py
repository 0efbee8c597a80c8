"""Place a bundle's flanks where its straps end in the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from barsight.bundle_pictures.strap_ends import APART_M, REACH_M, StrapEnds
from barsight.core.arrays import Float64
from barsight.core.linalg.robust import nan_medians
from barsight.labels.placing import heights_at
from barsight.yard.bundles.section.seen_section import over_floor, section_of_pack
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, YardMap

_WEAK_RATIO, _STRONG = 0.5, 4
"""Lines with less than this share of the fourth strongest's contrast are no straps."""
_SAME_M = 0.01
"""Ends of straps this near to their median agree."""
_AGREE_RATIO, _MIN_STRAPS = 0.5, 2
"""Share of the lines' ends of which more must agree, and of how many straps at least."""
_FLANK_SIGMA_M, _MIDDLE_SIGMA_M = 0.006, 0.004
"""Of a flank that straps tell, and at least a pixel; of the centre of mass, from the middle between the
flanks."""
_PLANE_RATIO = 0.25
"""Of the width: how well the height is known at which a bundle is widest."""
_CELL_M, _ROW_M, _TRIM_M = 0.01, 0.03, 0.1
"""Places of a mean section across and along, and what is left out at either end."""
_CREST_RATIO, _BESIDE_M = 0.35, 0.02
"""Of the width, to either side: where a bundle is highest; what a map smears of a gully."""
_INSIDE_M, _OUTSIDE_M, _RIM_M = 0.015, 0.025, 0.045
"""How far within and beyond a flank the surface must end; reach of a gully's two sides."""
_DEEP_RATIO, _DEEP_M = 0.6, 0.15
"""Depth under the crest, of the width and at least, that no pack's surface has."""
_FALL_RATIO, _MIN_FALL_M, _FALL_BARS, _DENT_M = 0.15, 0.02, 0.5, 0.006
"""Least depth of a gully that parts a bundle from the next, of the width, and in bars; least rise on either
side of it."""
_PARTING_M, _PARTING_RATIO, _PARTING_BARS = 0.06, 0.3, 1.2
"""A gully that is as deep, of the width and in bars, parts two bundles."""
_HIDDEN_M, _HIDDEN_BARS = 0.04, 0.6
"""So does one that is so wide where its ground isn't seen."""
_CONTRADICTED = 4.0
"""Sigmas of the map's flanks from which straps that end elsewhere make the bundle unsure, no more."""


@dataclass(frozen=True, eq=False)
class MeanSection:
    """Mean heights (N,) across a bundle at places beside_m; NaN where half of the length isn't known."""

    beside_m: Float64
    level_m: Float64

    @classmethod
    def of(cls, bundle: Bundle, heights: YardMap) -> MeanSection:
        """Average the map along a bundle."""
        along = bundle.direction / np.linalg.norm(bundle.direction[:2])
        across = np.array([along[1], -along[0], 0.0])
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
        return cls(beside, mean)

    def ends_at(self, flank_m: float, side: int, width_m: float, diameter_m: float) -> bool:
        """Check whether the surface ends about a flank: it falls far, isn't seen, or rises again behind a
        gully that is deeper or wider than one between the bundle's bars. side: -1 for the low flank, else 1.
        """
        outwards = side * (self.beside_m - flank_m)
        order = np.argsort(outwards)
        outwards, level = outwards[order], self.level_m[order]
        crest = self.level_m[np.abs(self.beside_m) < _CREST_RATIO * width_m]
        near = np.flatnonzero((outwards > -_INSIDE_M) & (outwards < _OUTSIDE_M))
        if not (np.isfinite(crest).any() and near.size):
            return False
        depth = np.nanmax(crest) - level
        if bool((depth[near] > max(_DEEP_RATIO * width_m, _DEEP_M)).any()):
            return True
        rims = round(_RIM_M / _CELL_M)
        min_depth = max(_FALL_RATIO * width_m, _MIN_FALL_M, _FALL_BARS * diameter_m)
        run = np.ones(max(round(_HIDDEN_BARS * diameter_m / _CELL_M), 1), bool)
        hidden = ndimage.binary_opening(np.isnan(level), run)
        for k in near.tolist():
            if hidden[k]:
                return True
            before, behind = level[max(k - rims, 0) : k], level[k + 1 : k + 1 + rims]
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
        known = level[seen]
        rims = np.minimum(np.maximum.accumulate(known), np.maximum.accumulate(known[::-1])[::-1])
        deep_m = max(_PARTING_BARS * diameter_m, _PARTING_M, _PARTING_RATIO * (high_m - low_m))
        return bool((rims - known).max() > deep_m or apart_m > max(_HIDDEN_BARS * diameter_m, _HIDDEN_M))


def with_flanks(
    bundle: Bundle, straps: Sequence[StrapEnds], section: MeanSection, floor_m: float | None, tilt: float
) -> Bundle:
    """Place a bundle's flanks where most of its straps end; the same bundle where they don't agree, or the
    map's section speaks against it.

    floor_m: height of the floor. tilt: way aside of the lines of sight over their height. The section is
    estimated anew, unless something may lie over a flank. Where straps end far off the flanks that the map
    told, the bundle is only made unsure.
    """
    flanks = _agreed_flanks(straps) if bundle.on_top else None
    if flanks is None:
        return bundle
    low, high = flanks
    diameter = float(np.nan_to_num(bundle.bar_diameter_m))
    ended = (
        section.ends_at(flank, side, bundle.width_m, diameter)
        for flank, side in zip(flanks, (-1, 1), strict=True)
    )
    if not all(ended) or section.is_parted(low, high, diameter):
        return bundle
    plane_m = tilt * _PLANE_RATIO * (high - low)
    width, middle = high - low, (low + high) / 2
    own = bundle.sigma
    off = abs(np.array([middle, width - bundle.width_m])) / np.fmax([own.lateral_m, own.width_m], 1e-6)
    if off.max() > _CONTRADICTED:
        unsure = replace(
            own, lateral_m=float(np.hypot(own.lateral_m, middle)),
            width_m=float(np.hypot(own.width_m, width - bundle.width_m)), section_m2=np.nan,
        )  # fmt: skip
        return replace(bundle, section_m2=np.nan, sigma=unsure)
    flank_m = max(_FLANK_SIGMA_M, *(strap.pixel_m for strap in straps))
    spread = float(np.hypot(2**0.5 * flank_m, plane_m))
    found, found_sigma = section_of_pack(width, spread, over_floor(bundle.top_z_m, floor_m))
    if bundle.cover_doubts:
        found = found_sigma = np.nan
    along = bundle.direction / np.linalg.norm(bundle.direction[:2])
    aside = middle * np.array([along[1], -along[0], 0.0])
    sigma = replace(
        own, width_m=spread, lateral_m=float(np.hypot(spread / 2, np.hypot(_MIDDLE_SIGMA_M, plane_m))),
        section_m2=found_sigma,
    )  # fmt: skip
    return replace(
        bundle, centre_m=bundle.centre_m + aside, ends_m=bundle.ends_m + aside, width_m=width,
        section_m2=found, sigma=sigma, fit_sigma=None,
    )  # fmt: skip


def _agreed_flanks(straps: Sequence[StrapEnds]) -> tuple[float, float] | None:
    """Find where most straps end on either side, of those that stand out; None where they don't agree."""
    contrasts = sorted((strap.contrast for strap in straps), reverse=True)
    if len(contrasts) < _MIN_STRAPS:
        return None
    least = _WEAK_RATIO * contrasts[min(_STRONG, len(contrasts)) - 1]
    kept = np.array([strap for strap in straps if strap.contrast >= least])
    low, high = (_agreed(kept[:, k], kept[:, 0]) for k in (1, 2))
    return None if low is None or high is None or low >= high else (low, high)


def _agreed(ends_m: Float64, along_m: Float64) -> float | None:
    """Compute the median of the ends (S,) that agree, of straps at along_m; None where they are too few."""
    best = np.zeros(0)
    for end in ends_m[np.isfinite(ends_m)]:
        same = np.abs(ends_m - end) <= _SAME_M
        rows = np.sort(along_m[same])
        straps = 1 + int((np.diff(rows) > APART_M / 2).sum())
        if straps >= _MIN_STRAPS and same.sum() > best.size:
            best = ends_m[same]
    return float(np.median(best)) if best.size > _AGREE_RATIO * ends_m.size else None
