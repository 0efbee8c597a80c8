"""Find what lies across a bundle by its straight edges in the pictures, which continue over a flank.

A strap ends at the flanks, and the bundle hides dunnage under it. Edges are found as line segments [Grompone
von Gioi 2010, LSD], dark or bright; segments in line with each other may be separated by gaps.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from barsight.bundle_pictures.samples import (
    DARKEST,
    BundleWindow,
    PlacedFrames,
    bundle_axes,
    is_placed,
    windows_along,
)
from barsight.core.arrays import Bool, Float64, UInt8
from barsight.yard.types import Bundle, Doubt, DoubtKind

_STEP_M, _BESIDE_M = 0.005, 0.15
"""Spacing of the samples along and across the bundle, and how far the window reaches beyond the flanks."""
_DENSITY = 0.5
"""Minimum share of a segment's rectangle that its points fill (LSD's density threshold)."""
_DARK_LOG, _LOG_RANGE = 2.0, 3.6
"""Lowest logarithm of the gray levels, and their range: levels 8 to 255, with DARKEST added."""
_MAX_SLOPE, _MIN_ACROSS_M, _MIN_FIRST_M = 0.6, 0.03, 0.06
"""Maximum slope of a segment against the direction across the axis; minimum extent across of any segment, and
of the first segment of an edge.
"""
_SAME_SLOPE, _SAME_M = 0.06, 0.008
"""Maximum difference in slope, and maximum distance from a segment's line, of segments in line with it."""
_BESIDE_FREE_M, _BELOW_FREE_M = 0.8, 0.3
"""Distance from a free bundle, and depth of a top below that bundle's top, within which a thing on another
bundle may reach the free one.
"""
_SAME_PLACE_M = 0.1
"""Maximum distance (m) along the axis between a line, where it crosses the axis, and an edge, where it
crosses a flank, of the same object.
"""
_REACH_M, _MIN_COVERED_RATIO, _MAX_GAP_M = 0.1, 0.6, 0.06
"""An edge runs over a flank if it shows on at least this share of the reach to either side of the flank,
without a longer gap.
"""


class _Segments(NamedTuple):
    """Line segments (S,): start and end beside the axis, and their middles, m; the middles along the axis, m
    from the bundle's middle; slopes; the side that is darker, 1 or -1.
    """

    low: Float64
    high: Float64
    beside: Float64
    along: Float64
    slope: Float64
    side: Float64

    def chosen(self, those: Bool) -> _Segments:
        """Return the selected segments."""
        return _Segments(*(part[those] for part in self))


class _FreeBundles(NamedTuple):
    """Free bundles (F,): middles (F, 2) and tops (F,), m; horizontal axes (F, 2, 2), along and across; half
    their lengths and widths (F, 2).
    """

    middle_m: Float64
    top_z_m: Float64
    axes: Float64
    half_m: Float64

    @classmethod
    def of(cls, bundles: Sequence[Bundle]) -> _FreeBundles:
        """Gather bundles."""
        return cls(
            np.array([one.centre_m[:2] for one in bundles]).reshape(-1, 2),
            np.array([one.top_z_m for one in bundles]),
            np.array([_level_axes(one) for one in bundles]).reshape(-1, 2, 2),
            np.array([(one.length_m / 2, one.width_m / 2) for one in bundles]).reshape(-1, 2),
        )

    def reached_from(self, bundle: Bundle) -> bool:
        """Check whether something on a bundle may reach over or beside a free one.

        The bundle may itself be one of the free ones. Compared are the heights, and the rectangle around the
        bundle along the free bundle's axes.
        """
        half = np.array([bundle.length_m, bundle.width_m]) / 2
        near = np.abs(self.axes @ _level_axes(bundle).T) @ half + self.half_m + _BESIDE_FREE_M
        away = np.abs(np.einsum("fij,fj->fi", self.axes, bundle.centre_m[:2] - self.middle_m))
        beside = (away <= near).all(axis=1) & (bundle.top_z_m > self.top_z_m - _BELOW_FREE_M)
        return bool(beside.any())


def _level_axes(bundle: Bundle) -> Float64:
    """Stack a bundle's horizontal axes (2, 2), along and across."""
    return np.array([axis[:2] for axis in bundle_axes(bundle)])


def edge_windows(
    frames: PlacedFrames, preferred: Collection[int], bundles: Sequence[Bundle]
) -> Iterator[tuple[int, BundleWindow]]:
    """List windows along each free bundle and its neighbours, at the height of their tops.

    Each comes with the nearest frame over it, from `preferred` if one of these shows it.
    """
    placed = [(k, one) for k, one in enumerate(bundles) if one.on_top is not False and is_placed(one)]
    free = _FreeBundles.of([one for _, one in placed if one.is_free])
    for number, bundle in placed:
        if not free.reached_from(bundle):
            continue
        half = round((bundle.width_m / 2 + _BESIDE_M) / _STEP_M)
        beside = _STEP_M * np.arange(-half, half + 1.0)
        for window in windows_along(number, bundle, beside, bundle.top_z_m, _STEP_M):
            k = frames.nearest(window, preferred)
            if k is not None:
                yield k, window


def find_edge(gray: UInt8, window: BundleWindow, bundle: Bundle) -> float | None:
    """Find an edge that runs over a flank: its position along the axis, m from the middle; None without
    one.
    """
    along, _ = bundle_axes(bundle)
    segments = _find_segments(gray, float(window.rows_m[0] @ along / (along @ along)))
    for flank in (-bundle.width_m / 2, bundle.width_m / 2):
        first, last = flank - _REACH_M, flank + _REACH_M
        near = segments.chosen((segments.high > first) & (segments.low < last))
        for k in np.flatnonzero(near.high - near.low >= _MIN_FIRST_M).tolist():
            off = near.along - near.along[k] - near.slope[k] * (near.beside - near.beside[k])
            alike = np.abs(near.slope - near.slope[k]) < _SAME_SLOPE
            line = near.chosen((np.abs(off) < _SAME_M) & alike & (near.side == near.side[k]))
            if _is_covered(np.maximum(line.low, first), np.minimum(line.high, last), first, last):
                return float(near.along[k] + near.slope[k] * (flank - near.beside[k]))
    return None


def _find_segments(gray: UInt8, first_m: float) -> _Segments:
    """Find line segments across the bars. first_m: position along the axis of the first row."""
    level = (np.log(gray + DARKEST) - _DARK_LOG) * (255 / _LOG_RANGE)
    detector = cv2.createLineSegmentDetector(scale=1.0, density_th=_DENSITY)
    found = detector.detect(np.clip(level, 0, 255).astype(np.uint8))[0]
    ends = np.zeros((0, 4)) if found is None else found[:, 0, :].astype(np.float64)
    middle = (gray.shape[1] - 1) / 2
    beside, along = _STEP_M * (ends[:, [0, 2]] - middle), first_m + _STEP_M * ends[:, [1, 3]]
    across = beside[:, 1] - beside[:, 0]
    kept = np.abs(across) > np.maximum(_MIN_ACROSS_M, np.abs(along[:, 1] - along[:, 0]) / _MAX_SLOPE)
    beside, along, across = beside[kept], along[kept], across[kept]
    return _Segments(
        beside.min(axis=1), beside.max(axis=1), beside.mean(axis=1), along.mean(axis=1),
        (along[:, 1] - along[:, 0]) / across, np.sign(across),
    )  # fmt: skip


def _is_covered(low: Float64, high: Float64, first: float, last: float) -> bool:
    """Check whether spans (N,) cover enough of an interval without a gap that is too long."""
    covered, gap, at = 0.0, 0.0, first
    for k in np.argsort(low, kind="stable").tolist():
        gap = max(gap, low[k] - at)
        covered += max(high[k] - max(low[k], at), 0.0)
        at = max(at, high[k])
    return covered >= _MIN_COVERED_RATIO * (last - first) and max(gap, last - at) <= _MAX_GAP_M


def with_edge(bundle: Bundle, along_m: float) -> Bundle:
    """Return the bundle with the doubt that an edge runs across it. Whether it is free isn't known where a
    faint line runs across it at the same place: a line alone is most often a strap, but that has no edge
    beyond the flanks.
    """
    doubt = Doubt(
        DoubtKind.CROSSING_EDGE,
        f"{DoubtKind.CROSSING_EDGE.value} {along_m:+.2f} m from its middle: something may lie over it",
    )
    lines = [one.along_m for one in bundle.cover_doubts if one.kind is DoubtKind.FAINT_LINE]
    if bundle.on_top and any(abs(line_m - along_m) < _SAME_PLACE_M for line_m in lines):
        bundle = replace(bundle, on_top=None)
    return bundle.with_cover_doubt(doubt)
