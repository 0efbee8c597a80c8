"""Direct refinement: the disparity that makes both images agree, to a few hundredths of a pixel.

Each step warps the right image with the current disparity and asks every pixel how far it should move
(Gauss-Newton [Lucas 1981]), then fits planes to the answers along supports that follow the bars. Gain and
offset of the images are taken off in a window. The first steps see the images a little softer and use the
mean gradient of both [Malis 2004], which carries them further; the last one uses the left gradient alone: an
interpolated image's noise falls with the fraction of the disparity, and its own gradient turns that into
pixel locking.

Gloss: a highlight is constant along a bar but lies behind its surface, so what is constant along the axis
bends the match. Residual and gradient are therefore split into their mean along the axis and the detail; the
mean counts only as far as it agrees with the detail: in the ratio of the residual that noise explains to the
residual that is there. The mean is taken over places alike in grey: a strap or a shadow across the bars would
turn the highlights beside it into detail.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8
from barsight.core.errors import ConfigError
from barsight.stereo.curvature import curvature_across
from barsight.stereo.plane_fits import SupportShape, fit_planes
from barsight.stereo.sgbm import image_noise
from barsight.stereo.spline import row_coefficients, value_and_slope
from barsight.stereo.supports import axis_means, tile_axes
from barsight.stereo.windows import equalised_difference

_BLUR_PX = 0.5
_FIRST_BLUR_PX = 0.7
_LONGEST_STEP_PX = 1.5
_CONTRAST_FLOOR = np.float32(4)
_SLACK = np.float32(0.5)
_BLEND_WINDOW_PX = 9
_LONG_STEP_PX = 5
_SHORT_STEP_PX = 3
_BLOCK_PX = 3
_ALIKE_BLUR_PX = 1.5
_HOLD = np.float32(0.1)
_HOLD_UNMATCHED = np.float32(0.02)
_SUPPORT = np.float32(0.5 * 1.87)
"""Sum of squared weights over their sum for a Gaussian support in the plane, times what the outlier weights
cost: measured on rendered planes. What noise in the slopes costs grows with what a step falls short of."""
_MOST_UNDAMPED = np.float32(1.5)
_SPREAD_ACROSS_PX2 = np.float32(3)
"""Mean square distance across the axis that the supports average over: their own and the axis' error."""
_SAG_WINDOW_PX = 11
_LEAST_INFORMATION = np.float32(0.5)


@dataclass(frozen=True)
class RefinementSettings:
    """Direct refinement on both images."""

    steps: int = 3
    """Gauss-Newton steps."""
    along_px: float = 16.0
    """The long support along the axis, one sigma."""
    across_px: float = 1.5
    """The long support across the axis, one sigma; a bar's curvature limits it."""
    short_px: float = 3.0
    """The short support along the axis, for surfaces that the long one can't follow; 0 does without."""
    short_across_px: float = 2.0
    """The short support across the axis."""
    gloss_px: float = 10.0
    """Length along the axis over which what is constant counts as gloss, one sigma; 0 trusts everything."""
    alike_grey: float = 20.0
    """Places along the axis whose grey values differ by this are not one highlight: a strap, a shadow."""
    gloss_trust: float = 0.02
    """Weight of the evidence that is constant along the axis, where noise explains its residual."""
    outlier_grey: float = 8.0
    """Residual at which a pixel's weight is halved, grey levels."""
    same_surface_px: float = 1.0
    """Disparities further apart belong to different surfaces."""
    window_px: int = 21
    """Window in which gain and offset are taken off, odd."""

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise ConfigError(f"refinement steps can't be negative, {self.steps} is")
        if min(self.along_px, self.across_px, self.outlier_grey, self.same_surface_px, self.alike_grey) <= 0:
            raise ConfigError(
                "the long support, outlier_grey, same_surface_px and alike_grey must be positive"
            )
        if min(self.short_px, self.gloss_px, self.gloss_trust) < 0 or self.short_across_px <= 0:
            raise ConfigError("the short support and the gloss settings can't be negative")
        if self.window_px < 3 or self.window_px % 2 == 0:
            raise ConfigError(f"window_px must be odd and at least 3, not {self.window_px}")


@dataclass(frozen=True, eq=False)
class Refined:
    """disparity_px: (H, W), no NaN. variance_px2: (H, W), what the residual in each support explains."""

    disparity_px: Float32
    variance_px2: Float32


def refine(left: UInt8, right: UInt8, start: Float32, matched: Bool, settings: RefinementSettings) -> Refined:
    """Refine `start` (H, W; no NaN) from the pixels that are `matched`; the others only follow."""
    axes = tile_axes(left.astype(np.float32))
    usable = matched.astype(np.float32)
    noise = 0.5 * (image_noise(left) ** 2 + image_noise(right) ** 2)
    disparity, variance = start, np.full_like(start, np.inf)
    for step in range(settings.steps):
        remaining = (settings.steps - 1 - step) / max(settings.steps - 1, 1)
        blur_px = _BLUR_PX * (_FIRST_BLUR_PX / _BLUR_PX) ** remaining
        left_grey, right_grey = _smooth(left, blur_px), _smooth(right, blur_px)
        warped, right_slope = value_and_slope(row_coefficients(right_grey), disparity)
        slope, slope_noise = _own_slope(row_coefficients(left_grey)), noise * _slope_gain(blur_px)
        if remaining > 0:
            slope, slope_noise = (slope + right_slope) * np.float32(0.5), 0.5 * slope_noise
        residual = equalised_difference(left_grey, warped, usable, settings.window_px, _CONTRAST_FLOOR)
        trust = usable / (1 + np.square(residual / np.float32(settings.outlier_grey)))
        weight, pull = _evidence(residual, slope, trust, left_grey, axes, settings)
        short_of = _undamped(weight, trust, slope_noise, settings.window_px)
        if remaining > 0:
            pull *= short_of
        power = short_of * _power(weight, pull, usable, settings.window_px)
        weight += _HOLD * (usable + _HOLD_UNMATCHED)
        fitted, variance = _fit(disparity, weight, pull, power, usable, axes, settings)
        sagged = _sag(fitted, axes)
        move = np.clip(fitted - sagged - disparity, -_LONGEST_STEP_PX, _LONGEST_STEP_PX)
        disparity = disparity + move
        # What the last step fell short of, and half of what was put right for curvature, may still be wrong.
        variance = variance + np.square((short_of - 1) * move) + np.float32(0.25) * np.square(sagged)
    return Refined(disparity, variance)


def _smooth(image: UInt8, blur_px: float) -> Float32:
    smooth: Float32 = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur_px)
    return smooth


def _own_slope(coefficients: Float32) -> Float32:
    slope: Float32 = (coefficients[:, 2:-1] - coefficients[:, :-3]) * np.float32(0.5)
    return slope


def _undamped(weight: Float32, trust: Float32, slope_noise: float, side: int) -> Float32:
    """(H, W) what a step must be multiplied by: noise in the slopes adds to the weights and nothing to the
    pulls, so that each step falls short by its share of the weights. At most 1.5, where a step may still not
    overshoot by more than half.
    """
    spurious = np.float32(slope_noise) * _mean(trust, side)
    mean_weight = _mean(weight, side)
    factor: Float32 = mean_weight / np.maximum(
        mean_weight - spurious, mean_weight / _MOST_UNDAMPED + np.float32(1e-6)
    )
    return factor


def _sag(fitted: Float32, axes: Float32) -> Float32:
    """(H, W) what a plane over the support takes off a surface that is round across the axis: half its
    curvature times the support's mean square width. A bar's curvature is the same all along, so that its
    mean over a window adds hardly any noise.
    """
    return 0.5 * _SPREAD_ACROSS_PX2 * _mean(curvature_across(fitted, axes), _SAG_WINDOW_PX)


@lru_cache
def _slope_gain(blur_px: float) -> float:
    """Variance of `_own_slope` per variance of a white noise in the image before `_smooth`."""
    impulse = np.zeros((33, 33), dtype=np.uint8)
    impulse[16, 16] = 100
    response = _own_slope(row_coefficients(_smooth(impulse, blur_px))) / 100
    return float(np.square(response).sum())


def _mean(image: Float32, side: int) -> Float32:
    averaged: Float32 = cv2.boxFilter(image, -1, (side, side))
    return averaged


def _weighted_mean(image: Float32, weight: Float32, side: int) -> Float32:
    return _mean(weight * image, side) / (_mean(weight, side) + np.float32(1e-6))


def _evidence(
    residual: Float32,
    slope: Float32,
    trust: Float32,
    grey: Float32,
    axes: Float32,
    settings: RefinementSettings,
) -> tuple[Float32, Float32]:
    """Each pixel's weight and pull, with what is constant along the axis weighed by how well it agrees."""
    if settings.gloss_px == 0:
        return trust * slope * slope, -trust * slope * residual
    alike = cv2.GaussianBlur(grey, (0, 0), _ALIKE_BLUR_PX) / np.float32(settings.alike_grey)
    residual_mean, slope_mean = axis_means(residual, slope, trust, alike, axes, settings.gloss_px)
    residual_detail, slope_detail = residual - residual_mean, slope - slope_mean
    detail_power = _mean(trust * residual_detail * residual_detail, settings.window_px)
    mean_power = _mean(trust * residual_mean * residual_mean, settings.window_px)
    # So many independent samples stand behind a Gaussian mean: noise leaves that much less power in it.
    samples = np.float32(2 * math.sqrt(math.pi) * settings.gloss_px)
    agreement = (detail_power + np.float32(1e-3)) / (samples * mean_power + np.float32(1e-3))
    share = np.minimum(np.float32(1), np.float32(settings.gloss_trust) * agreement)
    weight: Float32 = trust * (slope_detail * slope_detail + share * slope_mean * slope_mean)
    pull: Float32 = -trust * (slope_detail * residual_detail + share * slope_mean * residual_mean)
    return weight, pull


def _power(weight: Float32, pull: Float32, usable: Float32, side: int) -> Float32:
    """The noise power (grey levels^2) that the pulls show, per unit of what holds a disparity in place: from
    their sums over blocks, so that neighbours which err alike count as what they are. Where the images say
    little the plain hold takes their place and the power grows.
    """
    blocks = cv2.boxFilter(pull, -1, (_BLOCK_PX, _BLOCK_PX), normalize=False)
    block_power = _mean(usable * blocks * blocks, side) / np.float32(_BLOCK_PX * _BLOCK_PX)
    mean_weight = _mean(weight, side) + np.float32(1e-3)
    seen = _mean(usable, side) + np.float32(1e-6)
    power: Float32 = block_power / mean_weight * (mean_weight + _HOLD * seen) / mean_weight
    return power


def _fit(
    disparity: Float32,
    weight: Float32,
    pull: Float32,
    power: Float32,
    usable: Float32,
    axes: Float32,
    settings: RefinementSettings,
) -> tuple[Float32, Float32]:
    """The fitted disparity and its variance: of the long support, and of the short one as far as both differ
    by more than the short one's noise: there the surface is no plane over the long one.
    """
    long_shape = SupportShape(settings.along_px, settings.across_px, _LONG_STEP_PX)
    long, long_information = fit_planes(disparity, weight, pull, axes, long_shape, settings.same_surface_px)
    long_variance = _variance(power, long_information)
    if settings.short_px == 0:
        return long, long_variance
    short_shape = SupportShape(settings.short_px, settings.short_across_px, _SHORT_STEP_PX)
    short, short_information = fit_planes(
        disparity, weight, pull, axes, short_shape, settings.same_surface_px
    )
    short_variance = _variance(power, short_information)
    gap = long - short
    excess = np.maximum(_weighted_mean(gap * gap - _SLACK * short_variance, usable, _BLEND_WINDOW_PX), 0)
    share = short_variance / (short_variance + excess + np.float32(1e-9))
    return short + share * gap, long_variance + (1 - share) * (short_variance - long_variance)


def _variance(power: Float32, information: Float32) -> Float32:
    return np.asarray(_SUPPORT * power / np.maximum(information, _LEAST_INFORMATION), dtype=np.float32)
