"""Find the disparity range from the images, and detect swapped left and right images.

A coarse match at a quarter of the size covers every possible disparity; its consistent part determines the
range. A swapped pair has disparities of the wrong sign, so the coarse match of the exchanged images is far
more consistent than that of the images as given.
"""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8
from barsight.core.errors import Failed
from barsight.core.records.disparity import DisparityRange
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair

_SCALE = 4
_USUAL_RATIO = 0.4
_WIDEST_RATIO = 0.8
_TOP_PX = 16
_POOR = 0.6
_MARGIN_RATIO = 0.12
_MARGIN_PX = 6
_FOLLOW_MARGIN_PX = 4
_MIN_CONSISTENT = 0.03
_SPAN_PERCENT = (0.1, 99.9)


def find_disparity_range(pair: RectifiedPair) -> DisparityRange | Failed:
    """Find the range of disparities in a pair, widened by a margin.

    Returns Failed `no-texture` where too little matches either way, `swapped` where left and right are
    exchanged; see also `check_matchable`.
    """
    nothing = check_matchable(pair)
    if nothing is not None:
        return nothing
    doffs = pair.camera.doffs_px
    disparity = coarse_disparity(pair.left, pair.right, doffs)
    share = _finite_ratio(disparity)
    top = _USUAL_RATIO * pair.camera.width - doffs - _TOP_PX
    ends_at_top = share > 0 and np.nanpercentile(disparity, 99) > top
    if ends_at_top or share < _POOR:
        # The surface may be nearer than the usual search reaches.
        wider = coarse_disparity(pair.left, pair.right, doffs, _WIDEST_RATIO)
        found = _finite_ratio(wider)
        if found >= (share if ends_at_top else max(1.4 * share, 0.1)):
            disparity, share = wider, found
    if share < _POOR:
        exchanged = _finite_ratio(coarse_disparity(pair.right, pair.left, -doffs))
        if exchanged > 1.5 * share and exchanged > 0.1:
            return Failed(
                "swapped",
                f"left and right images are swapped: {100 * exchanged:.0f} % of the pixels match "
                f"when they are exchanged, {100 * share:.0f} % as given",
            )
    if share < _MIN_CONSISTENT:
        return Failed("no-texture", f"too little can be matched: {100 * share:.1f} % of the pixels")
    low, high = np.nanpercentile(disparity, _SPAN_PERCENT)
    return _range_around(low, high, _MARGIN_PX + _MARGIN_RATIO * (high - low), pair.camera)


def follow_disparity_range(pair: RectifiedPair, predicted: Float32) -> DisparityRange | Failed:
    """Find the range of a pair for which most disparities are predicted, (H, W) px, NaN where not; new
    surfaces are found by a match at an eighth of the size. Falls back to `find_disparity_range` where
    either covers too little.
    """
    nothing = check_matchable(pair)
    if nothing is not None:
        return nothing
    coarse = coarse_disparity(pair.left, pair.right, pair.camera.doffs_px, shrink=2 * _SCALE)
    known = predicted[::_SCALE, ::_SCALE]
    if min(_finite_ratio(coarse), _finite_ratio(known)) < _POOR:
        return find_disparity_range(pair)
    lows, highs = np.array([np.nanpercentile(seen, _SPAN_PERCENT) for seen in (coarse, known)]).T
    return _range_around(lows.min(), highs.max(), _FOLLOW_MARGIN_PX, pair.camera)


def is_well_textured(pair: RectifiedPair) -> bool:
    """Check quickly whether most of a pair matches, at an eighth of the size: then it has a range."""
    if check_matchable(pair) is not None:
        return False
    coarse = coarse_disparity(pair.left, pair.right, pair.camera.doffs_px, shrink=2 * _SCALE)
    return _finite_ratio(coarse) >= _POOR


def _range_around(low: float, high: float, margin: float, camera: RectifiedCamera) -> DisparityRange:
    """Widen a span of disparities, px, by a margin, to a range of a multiple of 16 candidates."""
    ceiling = int(camera.width * 0.9)
    lowest = int(np.floor(min(max(low - margin, -camera.doffs_px), ceiling - 16)))
    highest = int(np.ceil(min(high + margin, ceiling)))
    return DisparityRange(lowest, lowest + max(16, -(-(highest - lowest) // 16) * 16))


def check_matchable(pair: RectifiedPair) -> Failed | None:
    """Return Failed `no-texture` if an image is one uniform gray, `same-image` if both images are the
    same.
    """
    for name, image in (("left", pair.left), ("right", pair.right)):
        gray = int(image[0, 0])
        if (image == gray).all():
            shade = {0: "black", 255: "white"}.get(gray, f"gray {gray}")
            return Failed("no-texture", f"nothing can be matched: the {name} image is {shade} all over")
    if np.array_equal(pair.left, pair.right):
        return Failed("same-image", "nothing has a depth: left and right are the same image")
    return None


def coarse_disparity(
    left: UInt8, right: UInt8, doffs_px: float = 0.0, width_ratio: float = _USUAL_RATIO,
    known: tuple[float, float] | None = None, both_ways: bool = True, shrink: int = _SCALE,
) -> Float32:  # fmt: skip
    """Match at quarter size (`shrink`) with left-right check; NaN where it fails or the image has no
    gradient.

    The search begins 1 px above -doffs_px, which is infinitely far, and covers `width_ratio` of the width;
    within that, it is limited to the lowest and highest disparity `known` beforehand, px. Without `both_ways`
    the match from right to left is omitted, which saves half the time, for guesses that are verified in both
    pictures later. Returns (H / 4, W / 4) float32 in full-size px.
    """
    size = (max(left.shape[1] // shrink, 32), max(left.shape[0] // shrink, 32))
    small_left = cv2.resize(left, size, interpolation=cv2.INTER_AREA)
    small_right = cv2.resize(right, size, interpolation=cv2.INTER_AREA)
    count = max(16, int(size[0] * width_ratio) // 16 * 16)
    scale = left.shape[1] / size[0]
    infinity = -doffs_px / scale
    lowest = int(np.floor(infinity))
    if known is not None:
        first = max(lowest, int(np.floor(known[0] / scale)))
        last = min(lowest + count, int(np.ceil(known[1] / scale)))
        lowest, count = first, max(16, -(-(last - first) // 16) * 16)
    forward = _match(small_left, small_right, lowest, count)
    column = np.arange(size[0], dtype=np.float32)[None, :]
    target = np.rint(column - forward).astype(np.int32)
    consistent = (forward > infinity + 1 / scale) & (target >= 0) & (target < size[0])
    if both_ways:
        # The right image's disparity: the same match with both images mirrored and exchanged.
        backward = _match(cv2.flip(small_right, 1), cv2.flip(small_left, 1), lowest, count)[:, ::-1]
        there = np.take_along_axis(backward, target.clip(0, size[0] - 1), axis=1)
        consistent &= np.abs(there - forward) <= 1
    consistent &= _changes(small_left)
    return np.where(consistent, forward * np.float32(scale), np.float32(np.nan))


def _match(left: UInt8, right: UInt8, lowest: int, count: int) -> Float32:
    matcher = cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=count,
        blockSize=5,
        P1=200,
        P2=2400,
        uniquenessRatio=10,
        speckleWindowSize=40,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    before, after = max(lowest + count, 0), max(-lowest, 0)
    padded = [cv2.copyMakeBorder(image, 0, 0, before, after, cv2.BORDER_REPLICATE) for image in (left, right)]
    matched = matcher.compute(*padded)[:, before : before + left.shape[1]]
    disparity: Float32 = matched.astype(np.float32) / 16
    return disparity


def _changes(image: UInt8) -> Bool:
    """Check (H, W) for any gradient along the row in a 5 x 5 block; uniform places match anything."""
    steps = cv2.convertScaleAbs(cv2.Sobel(image, cv2.CV_16S, 1, 0, ksize=3))
    changes: Bool = cv2.dilate(steps, np.ones((5, 5), np.uint8)) > 0
    return changes


def _finite_ratio(disparity: Float32) -> float:
    return float(np.isfinite(disparity).mean())
