"""Estimate the method's own error beyond noise, calibrated where the truth is known.

In a rectified pair the vertical disparity is zero. Where the matched images still show a vertical shift
larger than the noise explains, something not modelled (gloss, residual distortion, interpolation, differing
blur) shifts the match; whatever shifts it vertically shifts it horizontally by the same amount.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8, kernel
from barsight.core.linalg.robust import mad_sigma
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.depth_edges import mark_jumps
from barsight.stereo.direct.kernels.box_sums import mirror_index, window_means
from barsight.stereo.direct.kernels.cubic_spline import interpolated_value, row_coefficients, value_and_slope

_BLUR_PX = 0.7
"""Blur of the pictures whose vertical shift is measured, one sigma."""
_WINDOW_PX, _EVERY_PX = 21, 10
"""Side of the windows in which shifts are solved, and the distance between windows."""
_STRIPES, _STRIPE_ROWS = 4, 81
"""Number and height of the stripes that are measured of a large picture."""
_OUTLIER_GRAY = np.float32(8)
"""Residual at which a pixel's weight is halved, gray levels."""
_MIN_SLOPE_POWER, _MIN_INDEPENDENCE = 4.0, 0.05
"""Minimum mean square slope along the columns in a window, (gray levels / px)^2; minimum determinant of its
equations relative to their diagonal, below which the two shifts can't be told apart.
"""
_MAX_VARIANCE_PX2, _MIN_WINDOWS = 0.1, 30
"""Maximum noise variance of a shift that is used, and minimum number of such shifts."""
_NOISE_RATIO = 4.5
"""Factor on the shifts' median noise variance, which is subtracted from their scatter."""
_BEND_PX = 3
"""Distance to the neighbours from whose mean a bend is measured."""
_START_WINDOW_PX = 9
"""Side of the window over which start and refinement are compared."""
_EDGE_REACH_PX = 3.0
"""Distance from a depth edge at which the risk has fallen to 1 / e."""
_FAR_PX = 1e4
"""Disparity beyond any real one, in place of unknown ones."""
_OTHER_SIDE_PX, _UNSURE_SIDE_PX = 4, 2.5
"""Distance within which the other side of a depth edge is searched, and within which a pixel may be on it."""
_BAND_ROWS = 64
_NAN = np.float32(np.nan)


def vertical_error_px(left: UInt8, right: UInt8, disparity: Float32, matched: Bool) -> float:
    """Estimate the robust sigma (px) of vertical shifts between the matched images, minus the noise's part.

    disparity: (H, W), no NaN. 0 where fewer than 30 windows of 21 px have a usable shift. In a large image
    only four stripes are measured, which is enough for a single number.
    """
    height, usable = len(left), matched.astype(np.float32)
    stripes = [slice(0, height)]
    if height >= 2 * _STRIPES * _STRIPE_ROWS:
        firsts = np.linspace(0, height - _STRIPE_ROWS, _STRIPES).astype(int)
        stripes = [slice(first, first + _STRIPE_ROWS) for first in firsts]
    found = [_vertical_shifts(left[rows], right[rows], disparity[rows], usable[rows]) for rows in stripes]
    shift, variance = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if shift.size < _MIN_WINDOWS:
        return 0.0
    spread = mad_sigma(shift)
    return float(np.sqrt(max(spread * spread - _NOISE_RATIO * float(np.median(variance)), 0.0)))


def disparity_bend(disparity: Float32, widest_px: float) -> Float32:
    """Compute the bend (H, W): the deviation of the disparity from the mean of its neighbours 3 px to both
    sides, the larger of along rows and along columns, at most widest_px; no NaN in or out.

    It is zero on a plane. On a bend or an edge, a match that is one pixel off has an error of this size.
    """
    bend = np.empty_like(disparity)

    def work(first: int, end: int) -> None:
        _bends(disparity, np.float32(widest_px), bend, first, end)

    parallel_bands(work, len(disparity), _BAND_ROWS)
    return bend


@kernel()
def _bends(disparity: Float32, widest: np.float32, bend: Float32, first: int, end: int) -> None:
    """Compute bends (H, W) px of rows first...end, see `disparity_bend`; borders are mirrored."""
    height, width = disparity.shape
    half = np.float32(0.5)
    framed = np.empty(width + 2 * _BEND_PX, dtype=np.float32)
    for y in range(first, end):
        here, found = disparity[y], bend[y]
        above = disparity[mirror_index(y - _BEND_PX, height)]
        below = disparity[mirror_index(y + _BEND_PX, height)]
        framed[_BEND_PX : _BEND_PX + width] = here
        for step in range(1, _BEND_PX + 1):
            framed[_BEND_PX - step] = here[mirror_index(-step, width)]
            framed[_BEND_PX + width - 1 + step] = here[mirror_index(width - 1 + step, width)]
        before, after = framed[:width], framed[2 * _BEND_PX :]
        for x in range(width):
            along_row = abs(here[x] - half * (before[x] + after[x]))
            along_column = abs(here[x] - half * (above[x] + below[x]))
            larger = along_row if along_row > along_column else along_column
            found[x] = larger if larger < widest else widest


def start_disagreement(start: Float32, refined: Float32) -> Float32:
    """Compute the mean distance (H, W), px, by which refinement moved the start in windows of 9 px. start:
    (H, W), NaN where unmatched.

    The two are estimates from the same images on which gloss, blur and depth edges act differently: where
    they disagree over a whole window, noise isn't the reason, and either may be wrong.
    """
    side = (_START_WINDOW_PX, _START_WINDOW_PX)
    moved, known = np.empty_like(refined), np.empty_like(refined)
    _note_moves(start, refined, moved, known)
    cv2.boxFilter(moved, -1, side, moved)
    share = cv2.boxFilter(known, -1, side, known)
    np.maximum(share, np.float32(1e-3), out=share)
    np.abs(moved, out=moved)
    np.divide(moved, share, out=moved)
    return moved


@kernel()
def _note_moves(start: Float32, refined: Float32, moved: Float32, known: Float32) -> None:
    """Compute the distance (H, W) px by which refinement moved the start, and 1 where there is a start;
    else both are 0.
    """
    height, width = start.shape
    zero, one = np.float32(0), np.float32(1)
    for y in range(height):
        begun, found, step, is_known = start[y], refined[y], moved[y], known[y]
        for x in range(width):
            step[x] = found[x] - begun[x] if begun[x] == begun[x] else zero
        for x in range(width):
            is_known[x] = one if begun[x] == begun[x] else zero


class Doubts(NamedTuple):
    """Coefficients of the error model. unexplained: variance of each pixel, px^2. edge: variance per
    squared bend; start: sigma per disagreement with the start. furthest: distance from the start, sigma:
    sigma, both px, beyond which a match is dropped.
    """

    unexplained: np.float32
    edge: np.float32
    start: np.float32
    furthest: np.float32
    sigma: np.float32


def judge_matches(
    start: Float32, refined: Float32, variance: Float32, bend: Float32, disagreement: Float32, doubts: Doubts
) -> tuple[Float32, Float32]:
    """Combine the noise, the unexplained error, and those due to bends and to disagreement with the start
    into the disparity and its sigma (H, W) px; NaN where the start is, and where the match is dropped.
    start: NaN where unmatched.
    """
    disparity, sigma = np.empty_like(refined), np.empty_like(refined)

    def work(first: int, end: int) -> None:
        _judge(start, refined, variance, (bend, disagreement), doubts, disparity, sigma, first, end)

    parallel_bands(work, len(refined), _BAND_ROWS)
    return disparity, sigma


@kernel()
def _judge(
    start: Float32, refined: Float32, variance: Float32, opinions: tuple[Float32, Float32], doubts: Doubts,
    disparity: Float32, sigma: Float32, first: int, end: int,
) -> None:  # fmt: skip
    """Judge rows first...end, see `judge_matches`. opinions: bend and disagreement (H, W) px. Fills
    disparity and sigma (H, W) px.
    """
    zero = np.float32(0)
    for y in range(first, end):
        begun, found, noise, bent, moved = start[y], refined[y], variance[y], opinions[0][y], opinions[1][y]
        kept, error = disparity[y], sigma[y]
        for x in range(len(found)):
            off = bent[x] * bent[x] - noise[x]
            off = off if off > zero else zero
            apart = doubts.start * moved[x]
            error[x] = np.sqrt(noise[x] + doubts.unexplained + doubts.edge * off + apart * apart)
        for x in range(len(found)):
            # A NaN of the start fails the comparison.
            is_match = (abs(found[x] - begun[x]) < doubts.furthest) & (error[x] <= doubts.sigma)
            kept[x] = found[x] if is_match else _NAN
            error[x] = error[x] if is_match else _NAN


def edge_risk(disparity: Float32, jump_px: float, other_side: bool = True) -> tuple[Float32, Float32 | None]:
    """Estimate the risk at depth edges, two arrays (H, W), for pixels that may have been assigned to the
    wrong side of a jump of more than jump_px between neighbours: first, 1 on the jump, falling to 1 / e
    within 3 px; second, the distance (px) in disparity to the other side within 4 px, zero further than
    2.5 px from the jump, None if not requested. NaN in `disparity` is no jump.
    """
    distance = cv2.distanceTransform(mark_jumps(disparity, jump_px) ^ 1, cv2.DIST_L2, 5)
    beside: Float32 = np.divide(distance, np.float32(-_EDGE_REACH_PX))
    np.exp(beside, out=beside)
    if not other_side:
        return beside, None
    known = np.isfinite(disparity)
    for_highest = np.where(known, disparity, np.float32(-_FAR_PX))
    for_lowest = np.where(known, disparity, np.float32(_FAR_PX))
    window = np.ones((2 * _OTHER_SIDE_PX + 1,) * 2, dtype=np.uint8)
    away = np.maximum(cv2.dilate(for_highest, window) - disparity, disparity - cv2.erode(for_lowest, window))
    other: Float32 = np.where(known & (distance < _UNSURE_SIDE_PX) & (away > jump_px), away, np.float32(0))
    return beside, other


def add_edge_sigma(
    disparity: Float32, sharp: Float32, beside: Float32, wrong_side_px: float, valid: Bool, sigma: Float32
) -> None:
    """Add to sigma (H, W) px, in quadrature, the distance by which sharpening moved the disparity, and
    wrong_side_px times `beside`, the risk of an edge. Where it isn't valid, `sharp` and sigma become NaN.
    """

    def work(first: int, end: int) -> None:
        _add_edge_sigma(disparity, sharp, beside, np.float32(wrong_side_px), valid, sigma, first, end)

    parallel_bands(work, len(sharp), _BAND_ROWS)


@kernel()
def _add_edge_sigma(
    disparity: Float32, sharp: Float32, beside: Float32, wrong_side: np.float32, valid: Bool, sigma: Float32,
    first: int, end: int,
) -> None:  # fmt: skip
    """Add to sigma (H, W) px in rows first...end, see `add_edge_sigma`."""
    for y in range(first, end):
        blurred, moved, near, usable, error = disparity[y], sharp[y], beside[y], valid[y], sigma[y]
        for x in range(len(error)):
            step, risk = moved[x] - blurred[x], wrong_side * near[x]
            both = np.sqrt(error[x] * error[x] + step * step)
            both = np.sqrt(both * both + risk * risk)
            error[x] = both if usable[x] else _NAN
        for x in range(len(error)):
            moved[x] = moved[x] if usable[x] else _NAN


def _vertical_shifts(
    left: UInt8, right: UInt8, disparity: Float32, usable: Float32
) -> tuple[Float32, Float32]:
    """Solve for the vertical shifts (N,) in windows, together with the horizontal ones; return them with
    their noise variances.
    """
    left_gray, right_gray = (
        cv2.GaussianBlur(image.astype(np.float32), (0, 0), _BLUR_PX) for image in (left, right)
    )
    warped, right_x = value_and_slope(row_coefficients(right_gray), disparity)
    right_y = interpolated_value(row_coefficients(_derivative(right_gray, (0, 1))), disparity)
    left_x, left_y = _derivative(left_gray, (1, 0)), _derivative(left_gray, (0, 1))
    means = _mean(usable), _mean(usable * left_gray), _mean(usable * warped)
    products, trust = np.empty((6, *usable.shape), np.float32), np.empty_like(usable)
    _multiply_out(usable, (left_gray, warped), means, (left_x, right_x), (left_y, right_y), products, trust)
    xx, xy, yy, xr, yr, power = window_means(products, trust, _WINDOW_PX, _EVERY_PX)
    chosen = (slice(None, None, _EVERY_PX), slice(None, None, _EVERY_PX))
    determinant = xx * yy - xy * xy
    told = (usable[chosen] > 0) & (determinant > _MIN_INDEPENDENCE * xx * yy) & (yy > _MIN_SLOPE_POWER)
    # Half of each of these windows is a mirror image.
    told[[0, -1]] = False
    xx, xy, yy, xr, yr, power, determinant = (a[told] for a in (xx, xy, yy, xr, yr, power, determinant))
    variance = power * np.square(xx / determinant) / np.float32(_WINDOW_PX * _WINDOW_PX)
    sure = variance < _MAX_VARIANCE_PX2
    shift = (xx * yr - xy * xr) / determinant
    return np.asarray(shift[sure], dtype=np.float32), np.asarray(variance[sure], dtype=np.float32)


@kernel()
def _multiply_out(
    usable: Float32, grays: tuple[Float32, Float32], means: tuple[Float32, Float32, Float32],
    x_slopes: tuple[Float32, Float32], y_slopes: tuple[Float32, Float32], products: Float32, trust: Float32,
) -> None:  # fmt: skip
    """Compute, pixel by pixel (H, W), the products from which the vertical shifts are solved.

    grays, x_slopes, y_slopes: left and right; means over windows: of usable, and of it times each gray. The
    mean slopes x, y and the residual r of the grays about their means fill products (6, H, W): x x, x y, y y,
    x r, y r and trust (y r)^2, and trust (H, W), Cauchy's weight of r.
    """
    half, least, one, outlier = np.float32(0.5), np.float32(1e-6), np.float32(1), np.float32(_OUTLIER_GRAY)
    for i in range(usable.shape[0]):
        known, left, right, mean = usable[i], grays[0][i], grays[1][i], means[0][i]
        left_mean, right_mean = means[1][i], means[2][i]
        left_x, right_x, left_y, right_y = x_slopes[0][i], x_slopes[1][i], y_slopes[0][i], y_slopes[1][i]
        xx, xy, yy = products[0, i], products[1, i], products[2, i]
        xr, yr, power, sure = products[3, i], products[4, i], products[5, i], trust[i]
        for j in range(len(known)):
            x, y, share = (left_x[j] + right_x[j]) * half, (left_y[j] + right_y[j]) * half, mean[j] + least
            residual = (left[j] - left_mean[j] / share) - (right[j] - right_mean[j] / share)
            off = residual / outlier
            sure[j] = known[j] / (one + off * off)
            xx[j], xy[j], yy[j] = x * x, x * y, y * y
            xr[j], yr[j] = x * residual, y * residual
            power[j] = sure[j] * ((y * residual) * (y * residual))


def _derivative(image: Float32, order: tuple[int, int]) -> Float32:
    slope: Float32 = cv2.Sobel(image, cv2.CV_32F, order[0], order[1], ksize=1, scale=0.5)
    return slope


def _mean(image: Float32) -> Float32:
    averaged: Float32 = cv2.boxFilter(image, -1, (_WINDOW_PX, _WINDOW_PX))
    return averaged
