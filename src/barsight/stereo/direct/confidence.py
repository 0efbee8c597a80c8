"""Estimate the method's own error beyond noise, calibrated where the truth is known.

In a rectified pair the vertical disparity is zero. Where the images, matched, still show a vertical shift
beyond what noise makes, something that no model of ours covers (gloss, distortion left over, interpolation,
blur that differs) moves the match; what moves it up and down moves it left and right as much.
"""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8
from barsight.core.linalg.robust import mad_sigma
from barsight.stereo.direct.kernels.box_sums import window_means
from barsight.stereo.direct.kernels.cubic_spline import row_coefficients, value_and_slope

_BLUR_PX = 0.7
_WINDOW_PX = 21
_EVERY_PX = 10
_STRIPES = 4
_STRIPE_ROWS = 81
_OUTLIER_GRAY = np.float32(8)
_MIN_SLOPE_POWER = 4.0
_MIN_INDEPENDENCE = 0.05
_LARGEST_VARIANCE_PX2 = 0.1
_FEWEST_WINDOWS = 30
_NOISE_RATIO = 4.5
_BEND_PX = 3
_START_WINDOW_PX = 9
_EDGE_REACH_PX = 3.0
_FAR_PX = 1e4
_OTHER_SIDE_PX = 4
_UNSURE_SIDE_PX = 2.5


def vertical_error_px(left: UInt8, right: UInt8, disparity: Float32, matched: Bool) -> float:
    """Estimate the robust sigma (px) of vertical shifts between the matched images, less what noise explains.

    disparity: (H, W), no NaN. 0 where fewer than 30 windows of 21 px tell anything. Of a large image four
    stripes are asked: one number for the whole needs no more.
    """
    height, usable = len(left), matched.astype(np.float32)
    stripes = [slice(0, height)]
    if height >= 2 * _STRIPES * _STRIPE_ROWS:
        firsts = np.linspace(0, height - _STRIPE_ROWS, _STRIPES).astype(int)
        stripes = [slice(first, first + _STRIPE_ROWS) for first in firsts]
    found = [_vertical_shifts(left[rows], right[rows], disparity[rows], usable[rows]) for rows in stripes]
    shift, variance = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if shift.size < _FEWEST_WINDOWS:
        return 0.0
    spread = mad_sigma(shift)
    return float(np.sqrt(max(spread * spread - _NOISE_RATIO * float(np.median(variance)), 0.0)))


def disparity_bend(disparity: Float32, widest_px: float) -> Float32:
    """Compute the bend (H, W) of the disparity off the middle of its neighbours 3 px to both sides, the
    larger of along rows and along columns, at most widest_px; no NaN in or out.

    Zero on a plane. On a bend or an edge a match that sits one pixel beside its place errs by as much.
    """
    framed = cv2.copyMakeBorder(disparity, _BEND_PX, _BEND_PX, _BEND_PX, _BEND_PX, cv2.BORDER_REFLECT_101)
    side, inner = 2 * _BEND_PX, slice(_BEND_PX, -_BEND_PX)
    along_row = np.abs(disparity - np.float32(0.5) * (framed[inner, :-side] + framed[inner, side:]))
    along_column = np.abs(disparity - np.float32(0.5) * (framed[:-side, inner] + framed[side:, inner]))
    bend: Float32 = np.minimum(np.maximum(along_row, along_column), np.float32(widest_px))
    return bend


def start_disagreement(start: Float32, refined: Float32) -> Float32:
    """Compute how far (H, W) refinement moved the start in windows of 9 px, px. start: (H, W), NaN where
    unmatched.

    Two estimates from the same images that gloss, blur and depth edges bend differently: where they disagree
    over a whole window, noise isn't why, and either may be wrong.
    """
    side = (_START_WINDOW_PX, _START_WINDOW_PX)
    known = np.isfinite(start)
    moved = np.where(known, refined - start, np.float32(0))
    share = cv2.boxFilter(known.astype(np.float32), -1, side)
    disagreement: Float32 = np.abs(cv2.boxFilter(moved, -1, side)) / np.maximum(share, np.float32(1e-3))
    return disagreement


def edge_risk(disparity: Float32, jump_px: float, other_side: bool = True) -> tuple[Float32, Float32]:
    """Estimate the risk at depth edges: two arrays (H, W) for pixels that may have been given to the wrong
    side of a jump of more than jump_px between neighbours: 1 on the jump, falling to 1 / e within 3 px; and
    how far away (px) the other side lies within 4 px, zero further than 2.5 px from the jump, or everywhere
    where that isn't asked for. NaN in `disparity` is no jump.
    """
    known = np.isfinite(disparity)
    for_highest = np.where(known, disparity, np.float32(-_FAR_PX))
    for_lowest = np.where(known, disparity, np.float32(_FAR_PX))
    three = np.ones((3, 3), dtype=np.uint8)
    level = (cv2.dilate(for_highest, three) - cv2.erode(for_lowest, three) <= jump_px).astype(np.uint8)
    distance = cv2.distanceTransform(level, cv2.DIST_L2, 5)
    beside: Float32 = np.exp(-distance / np.float32(_EDGE_REACH_PX))
    if not other_side:
        return beside, np.zeros_like(beside)
    window = np.ones((2 * _OTHER_SIDE_PX + 1,) * 2, dtype=np.uint8)
    away = np.maximum(cv2.dilate(for_highest, window) - disparity, disparity - cv2.erode(for_lowest, window))
    other: Float32 = np.where(known & (distance < _UNSURE_SIDE_PX) & (away > jump_px), away, np.float32(0))
    return beside, other


def _vertical_shifts(
    left: UInt8, right: UInt8, disparity: Float32, usable: Float32
) -> tuple[Float32, Float32]:
    """Solve vertical shifts (N,) and their noise variances with the horizontal ones in windows."""
    left_gray, right_gray = (
        cv2.GaussianBlur(image.astype(np.float32), (0, 0), _BLUR_PX) for image in (left, right)
    )
    warped, right_x = value_and_slope(row_coefficients(right_gray), disparity)
    right_y, _ = value_and_slope(row_coefficients(_derivative(right_gray, (0, 1))), disparity)
    x = (_derivative(left_gray, (1, 0)) + right_x) * np.float32(0.5)
    y = (_derivative(left_gray, (0, 1)) + right_y) * np.float32(0.5)
    share = _mean(usable) + np.float32(1e-6)
    residual = (left_gray - _mean(usable * left_gray) / share) - (warped - _mean(usable * warped) / share)
    trust = usable / (1 + np.square(residual / _OUTLIER_GRAY))
    products = np.stack([x * x, x * y, y * y, x * residual, y * residual, trust * np.square(y * residual)])
    xx, xy, yy, xr, yr, power = window_means(products, trust, _WINDOW_PX, _EVERY_PX)
    chosen = (slice(None, None, _EVERY_PX), slice(None, None, _EVERY_PX))
    determinant = xx * yy - xy * xy
    told = (usable[chosen] > 0) & (determinant > _MIN_INDEPENDENCE * xx * yy) & (yy > _MIN_SLOPE_POWER)
    # Half of these windows is a mirror image.
    told[[0, -1]] = False
    xx, xy, yy, xr, yr, power, determinant = (a[told] for a in (xx, xy, yy, xr, yr, power, determinant))
    variance = power * np.square(xx / determinant) / np.float32(_WINDOW_PX * _WINDOW_PX)
    sure = variance < _LARGEST_VARIANCE_PX2
    shift = (xx * yr - xy * xr) / determinant
    return np.asarray(shift[sure], dtype=np.float32), np.asarray(variance[sure], dtype=np.float32)


def _derivative(image: Float32, order: tuple[int, int]) -> Float32:
    slope: Float32 = cv2.Sobel(image, cv2.CV_32F, order[0], order[1], ksize=1, scale=0.5)
    return slope


def _mean(image: Float32) -> Float32:
    averaged: Float32 = cv2.boxFilter(image, -1, (_WINDOW_PX, _WINDOW_PX))
    return averaged
