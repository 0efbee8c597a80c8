"""Start a pair from a predicted disparity where its own pictures confirm it.

The evidence comes from the pair itself: it is matched without a prediction at half size, and where the two
differ by more than a pixel, the one whose 5x5 census, slopes and gray values fit better at full size is kept.
What only the half-size match has found beside depth edges is left unknown: it is blurred there, and other
views see it.
"""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8, kernel
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.consistency import agrees_with
from barsight.stereo.direct.semiglobal.cost import (
    UNKNOWN_COST,
    PixelDescriptors,
    describe_pixels,
    descriptor_cost,
)

_SAME_PX = np.float32(1.0)
"""Difference from which a prediction and the pair's own match are in dispute."""
_CONSISTENT_PX = 2.0
"""Maximum difference between a prediction and the right picture's match, if there is no other."""
_COST_WINDOW_PX, EDGE_WINDOW_PX = 7, 9
"""Side of the windows over which costs are summed, and in which depth edges are detected."""
_BAND_ROWS = 64
_NAN = np.float32(np.nan)
_FAR = -1e6


def confirmed_start(
    left: UInt8, right: UInt8, predicted: Float32, matched: Float32, matched_right: Float32,
    edge_rows: int = EDGE_WINDOW_PX,
) -> Float32:  # fmt: skip
    """Merge a prediction and the pair's own half-size match into a start (H, W), NaN where unknown.

    predicted, matched: (H, W) px of the left picture, NaN where unknown; matched_right: (H, W) of the right
    one. Where there is no match, the prediction is kept if the right picture's match agrees within 2 px.
    edge_rows: height, in rows, of the window in which edges are detected.
    """
    disputed, known = np.empty(matched.shape, dtype=np.bool_), np.empty_like(matched)
    _find_disputes(predicted, matched, disputed, known)
    better = disputed
    if disputed.any():
        better = _fits_better(describe_pixels(left), describe_pixels(right), predicted, matched, disputed)
    window = np.ones((edge_rows, EDGE_WINDOW_PX), dtype=np.uint8)
    around, start = (cv2.dilate(known, window), cv2.erode(known, window)), np.empty_like(matched)

    def merge(first: int, end: int) -> None:
        _merge((predicted, matched, matched_right), better, around, start, first, end)

    parallel_bands(merge, len(start), _BAND_ROWS)
    return start


@kernel()
def _find_disputes(predicted: Float32, matched: Float32, disputed: Bool, known: Float32) -> None:
    """Mark the pixels (H, W) where both are known and differ by 1 px or more. Fills known (H, W) px: the
    match, _FAR where there is none.
    """
    height, width = matched.shape
    far = np.float32(_FAR)
    for y in range(height):
        one, other, differ, filled = predicted[y], matched[y], disputed[y], known[y]
        for x in range(width):
            differ[x] = abs(one[x] - other[x]) >= _SAME_PX
        for x in range(width):
            filled[x] = other[x] if other[x] == other[x] else far


@kernel()
def _merge(
    px: tuple[Float32, Float32, Float32], better: Bool, around: tuple[Float32, Float32], start: Float32,
    first: int, end: int,
) -> None:  # fmt: skip
    """Merge prediction and match in rows first...end, see `confirmed_start`.

    px: predicted, matched, and matched of the right picture. better: True where the prediction costs less, if
    they differ. around: the largest and the smallest match nearby, with holes far off. Fills start (H, W) px.
    """
    predicted, matched, matched_right = px
    highest, lowest = around
    tolerance = np.float32(_CONSISTENT_PX)
    for y in range(first, end):
        seen = matched_right[y]
        for x in range(start.shape[1]):
            one, other = predicted[y, x], matched[y, x]
            if np.isnan(other):
                stays = agrees_with(seen, x, one, tolerance)
            else:
                stays = abs(one - other) < _SAME_PX or (abs(one - other) >= _SAME_PX and better[y, x])
            if stays:
                start[y, x] = one
            else:
                start[y, x] = _NAN if highest[y, x] - lowest[y, x] > _SAME_PX else other


def _fits_better(
    left: PixelDescriptors, right: PixelDescriptors, one: Float32, other: Float32, asked: Bool
) -> Bool:  # fmt: skip
    """Check (H, W), where asked, whether one disparity costs less than the other, summed over the pixels
    of 7 px windows that have both.
    """
    window = (_COST_WINDOW_PX, _COST_WINDOW_PX)
    near = cv2.dilate(asked.view(np.uint8), np.ones(window, dtype=np.uint8)).view(np.bool_)
    dearer = np.zeros(one.shape, dtype=np.float32)

    def work(first: int, end: int) -> None:
        _cost_differences(left, right, (one, other), near, dearer, first, end)

    parallel_bands(work, len(one), _BAND_ROWS)
    better: Bool = cv2.boxFilter(dearer, -1, window, normalize=False) < 0
    return better


@kernel()
def _cost_differences(
    left: PixelDescriptors, right: PixelDescriptors, disparities: tuple[Float32, Float32], asked: Bool,
    dearer: Float32, first: int, end: int,
) -> None:  # fmt: skip
    """Compute the cost of the first disparity (H, W) px minus that of the second, at the nearest column, for
    each asked pixel in rows first...end.

    Fills dearer (H, W) where both are known: a disparity that leaves the picture costs UNKNOWN_COST.
    """
    width = dearer.shape[1]
    for y in range(first, end):
        for x in range(width):
            if not asked[y, x] or not np.isfinite(disparities[0][y, x] + disparities[1][y, x]):
                continue
            for k in range(2):
                cost, there = UNKNOWN_COST, np.float32(x) - disparities[k][y, x]
                if there > np.float32(-0.5) and there < np.float32(width) - np.float32(0.5):
                    cost = descriptor_cost(left, right, y, x, int(there + np.float32(0.5)))
                dearer[y, x] += np.float32(cost if k == 0 else -cost)
