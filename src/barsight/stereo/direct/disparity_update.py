"""Update the disparity from the fitted planes: blend the supports, and correct for curvature."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float32, kernel
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.curvature import curvature_row
from barsight.stereo.direct.kernels.box_sums import (
    BAND_ROWS,
    allocate_columns,
    mirror_index,
    roll_product,
    roll_sum,
    slide_window,
)
from barsight.stereo.direct.support_regions import MARGIN

_SLACK = np.float32(0.5)
"""Share of the short fit's variance by which the supports may differ before the short one counts."""
_BLEND_REACH_PX, _SAG_REACH_PX = 4, 5
"""Half side of the windows over which the supports' difference and the curvature are averaged."""
_SPREAD_ACROSS_PX2 = np.float32(3)
"""Mean square distance across the axis over which the supports average: their own width and the axis'
error.
"""
_MAX_STEP_PX = np.float32(1.5)
"""Maximum change of a disparity in one step."""
_SUPPORT = np.float32(0.5 * 1.87)
"""Factor of a fit's variance: the sum of squared weights over their sum for a Gaussian support in the
plane, times the loss due to the outlier weights, measured on rendered planes. Noise in the slopes adds in
proportion to the shortfall of a step.
"""
_MIN_INFORMATION = np.float32(0.5)

_MAX_NOISIER, _DAMPED = np.float32(1.5), np.float32(6)
"""Gain of a step up to which its shortfall counts as noise, from rendered planes. A sixth of the excess is
subtracted again, from rendered bars: a step that is short by half damps its own noise.
"""

Fit = tuple[Float32, Float32]
"""A fitted disparity and its information (inverse variance up to the noise power), (H, W)."""


def fit_variance(power: Float32, information: Float32) -> Float32:
    """Compute the variance (H, W) of a fit, px^2."""
    return np.asarray(_SUPPORT * power / np.maximum(information, _MIN_INFORMATION), dtype=np.float32)


def blend_fits(long: Fit, short: Fit, power: Float32, usable: Float32) -> tuple[Float32, Float32]:
    """Blend the fitted disparities and their variances, all (H, W): the long support's, and the short
    one's as far as they differ by more than the short one's noise, because there the surface isn't planar
    over the long support. Where both contribute, which is right is unknown: the variance is that of the
    mixture.
    """
    fitted, variance = np.empty_like(power), np.empty_like(power)

    def work(first: int, end: int) -> None:
        _blend(long, short, power, usable, _BLEND_REACH_PX, fitted, variance, first, end)

    parallel_bands(work, len(power), BAND_ROWS)
    return fitted, variance


@kernel()
def _excess(long: Float32, short: Float32, power: Float32, information: Float32, excess: Float32) -> None:
    """Compute the excess (W,) px^2 of the squared difference between the supports over half the short fit's
    variance.

    long, short: (W,) fitted disparities, px. power: (W,), see `noise_power`; information: (W,) of the short
    fit. The excess is negative where they agree better than that.
    """
    for x in range(len(excess)):
        gap = long[x] - short[x]
        excess[x] = gap * gap - _SLACK * (_SUPPORT * power[x] / max(information[x], _MIN_INFORMATION))


@kernel()
def _blend(
    long_fit: Fit, short_fit: Fit, power: Float32, usable: Float32, reach: int, fitted: Float32,
    variance: Float32, first: int, end: int,
) -> None:  # fmt: skip
    """Blend the long and short supports' fits in rows first...end, see `blend_fits`.

    long_fit, short_fit: (H, W) px with their information. power: (H, W), see `noise_power`; usable: (H, W)
    0...1. The mean excess over a window of 2 reach + 1 px determines their weights. Fills fitted (H, W) px
    and variance (H, W) px^2.
    """
    long, long_information = long_fit
    short, short_information = short_fit
    height, width = power.shape
    columns = allocate_columns(2, width, reach)
    rows = np.zeros((5, width), dtype=np.float32)
    none, ahead, behind, mean, seen = rows[0], rows[1], rows[2], rows[3], rows[4]
    zero, one, tiny = np.float32(0), np.float32(1), np.float32(1e-6)
    for coming in range(first - reach, end + reach):
        y, going = coming - reach, coming - 2 * reach - 1
        a, b = mirror_index(coming, height), mirror_index(going, height)
        came, gone = usable[a], none
        _excess(long[a], short[a], power[a], short_information[a], ahead)
        if going >= first - reach:
            gone = usable[b]
            _excess(long[b], short[b], power[b], short_information[b], behind)
        roll_product(columns[0], reach, came, ahead, gone, behind)
        roll_sum(columns[1], reach, came, gone)
        if y < first:
            continue
        slide_window(columns[0], reach, mean)
        slide_window(columns[1], reach, seen)
        noise, far, near, certain = power[y], long[y], short[y], short_information[y]
        for x in range(width):
            # Both variances are this factor times the noise power over the information.
            own = _SUPPORT * noise[x] / max(certain[x], _MIN_INFORMATION)
            excess = max(mean[x] / (seen[x] + tiny), zero)
            mean[x] = own / (own + excess + np.float32(1e-9))
        blended, unsure, long_certain = fitted[y], variance[y], long_information[y]
        for x in range(width):
            blended[x] = near[x] + mean[x] * (far[x] - near[x])
        for x in range(width):
            own = _SUPPORT * noise[x] / max(certain[x], _MIN_INFORMATION)
            other = _SUPPORT * noise[x] / max(long_certain[x], _MIN_INFORMATION)
            gap, share = near[x] - far[x], one - mean[x]
            unsure[x] = other + share * (own - other) + share * mean[x] * gap * gap


@kernel()
def raise_noise(short_of: Float32, power: Float32) -> None:
    """Multiply the noise power (H, W), in place, by the steps' gain short_of (H, W), 1 or more, which is
    damped beyond _MAX_NOISIER.
    """
    height, width = power.shape
    for y in range(height):
        short, noise = short_of[y], power[y]
        for x in range(width):
            damped = _MAX_NOISIER - (short[x] - _MAX_NOISIER) / _DAMPED
            noise[x] *= short[x] if short[x] < damped else damped


@kernel()
def complete_step(moved: Float32, usable: Float32, short_of: Float32, disparity: Float32) -> None:
    """Complete a step that fell short: add the missing part of its mean to the disparity (a frame, px, in
    place).

    moved, usable: (H, W) means over windows, of the usable steps and of usable. short_of: (H, W), 1 or more.
    """
    height, width = moved.shape
    one, tiny = np.float32(1), np.float32(1e-6)
    for y in range(height):
        mean, share, short = moved[y], usable[y], short_of[y]
        here = disparity[y + MARGIN, MARGIN : MARGIN + width]
        for x in range(width):
            here[x] += (short[x] - one) * mean[x] / (share[x] + tiny)


def update_disparity(fitted: Float32, axes: Float32, disparity: Float32, variance: Float32) -> None:
    """Move the disparity (a frame) to the fitted one, corrected for curvature, and increase the variance.

    A plane fitted to a surface that is round across the axis is off by half its curvature times the support's
    mean square width. A bar's curvature is constant along it, so its mean over a window adds hardly any
    noise. Half of the correction may still be wrong.
    """

    def work(first: int, end: int) -> None:
        _settle(fitted, axes, _SAG_REACH_PX, disparity, variance, first, end)

    parallel_bands(work, len(fitted), BAND_ROWS)


@kernel()
def _settle(
    fitted: Float32, axes: Float32, reach: int, disparity: Float32, variance: Float32, first: int, end: int,
) -> None:  # fmt: skip
    """Update the disparity in rows first...end to the fitted one, corrected for curvature, in place.

    fitted: (H, W) px. axes: (tile rows, tile columns, 2). reach: px, half width of the window over which the
    curvature is averaged. disparity: a frame, px, moved by at most 1.5 px; variance: (H, W) px^2, increased.
    """
    height, width = fitted.shape
    column = allocate_columns(1, width, reach)[0]
    rows = np.zeros((4, width), dtype=np.float32)
    none, ahead, behind, sag = rows[0], rows[1], rows[2], rows[3]
    half, quarter = np.float32(0.5) * _SPREAD_ACROSS_PX2, np.float32(0.25)
    for coming in range(first - reach, end + reach):
        y, going = coming - reach, coming - 2 * reach - 1
        curvature_row(fitted, axes, mirror_index(coming, height), ahead)
        gone = none
        if going >= first - reach:
            curvature_row(fitted, axes, mirror_index(going, height), behind)
            gone = behind
        roll_sum(column, reach, ahead, gone)
        if y < first:
            continue
        slide_window(column, reach, sag)
        wanted, unsure = fitted[y], variance[y]
        here = disparity[y + MARGIN, MARGIN : MARGIN + width]
        for x in range(width):
            off = wanted[x] - half * sag[x] - here[x]
            ahead[x] = min(max(off, -_MAX_STEP_PX), _MAX_STEP_PX)
        for x in range(width):
            here[x] += ahead[x]
        for x in range(width):
            sagged = half * sag[x]
            unsure[x] += quarter * sagged * sagged
