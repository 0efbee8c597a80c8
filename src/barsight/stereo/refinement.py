"""Direct refinement: the disparity that makes both images agree, to a few hundredths of a pixel.

Each step warps the right image with the current disparity and asks every pixel how far it should move
(Gauss-Newton with the mean gradient of both images [Lucas 1981, Malis 2004]), then fits planes to the answers
along supports that follow the bars. Gain and offset of the images are taken off in a window.

Gloss: a highlight is constant along a bar but lies behind its surface, so what is constant along the axis
bends the match. Residual and gradient are therefore split into their mean along the axis and the detail; the
mean counts only as far as it agrees with the detail: in the ratio of the residual that noise explains to the
residual that is there.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8
from barsight.stereo.spline import row_coefficients, value_and_slope
from barsight.stereo.supports import axis_means, fit_planes, tile_axes

_BLUR_PX = 0.5
_LONGEST_STEP_PX = 0.7


@dataclass(frozen=True)
class RefinementSettings:
    """Direct refinement on both images."""

    steps: int = 4
    """Gauss-Newton steps."""
    along_px: float = 16.0
    """Support along the axis, one sigma."""
    across_px: float = 1.5
    """Support across the axis, one sigma; a bar's curvature limits it."""
    gloss_px: float = 8.0
    """Length along the axis over which what is constant counts as gloss, one sigma."""
    gloss_trust: float = 0.1
    """Weight of the evidence that is constant along the axis, where noise explains its residual."""
    outlier_grey: float = 8.0
    """Residual at which a pixel's weight is halved, grey levels."""
    same_surface_px: float = 1.0
    """Disparities further apart belong to different surfaces."""
    window_px: int = 25
    """Window in which gain and offset are taken off, odd."""


@dataclass(frozen=True, eq=False)
class Refined:
    """disparity_px: (H, W), no NaN. information: (H, W), grey levels^2 per px^2 of the support.

    residual: (H, W), left minus gain-corrected right where they are matched, grey levels.
    """

    disparity_px: Float32
    information: Float32
    residual: Float32


def refine(left: UInt8, right: UInt8, start: Float32, matched: Bool, settings: RefinementSettings) -> Refined:
    """Refine `start` (H, W; no NaN) from the pixels that are `matched`; the others only follow."""
    left_grey, right_grey = _smooth(left), _smooth(right)
    left_slope = _own_slope(row_coefficients(left_grey))
    right_coefficients = row_coefficients(right_grey)
    axes = tile_axes(left_grey)
    usable = matched.astype(np.float32)
    disparity = start
    information = residual = np.zeros_like(start)
    for _ in range(settings.steps):
        warped, right_slope = value_and_slope(right_coefficients, disparity)
        slope = (left_slope + right_slope) * np.float32(0.5)
        residual = _residual(left_grey, warped, usable, settings.window_px)
        trust = usable / (1 + np.square(residual / np.float32(settings.outlier_grey)))
        weight, pull = _evidence(residual, slope, trust, axes, settings)
        weight += _HOLD * (usable + np.float32(0.02))
        fitted, information = fit_planes(
            disparity, weight, pull, axes, settings.along_px, settings.across_px, 2, settings.same_surface_px
        )
        disparity = disparity + np.clip(fitted - disparity, -_LONGEST_STEP_PX, _LONGEST_STEP_PX)
    return Refined(disparity, information, residual)


_HOLD = np.float32(0.3)
"""Weight with which a pixel keeps its disparity where the images say nothing."""


def _smooth(image: UInt8) -> Float32:
    smooth: Float32 = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _BLUR_PX)
    return smooth


def _own_slope(coefficients: Float32) -> Float32:
    slope: Float32 = (coefficients[:, 2:-1] - coefficients[:, :-3]) * np.float32(0.5)
    return slope


def _residual(left: Float32, warped: Float32, usable: Float32, window: int) -> Float32:
    """Left minus right after their means and contrasts in a window are made equal."""

    def mean(image: Float32) -> Float32:
        averaged: Float32 = cv2.boxFilter(image, -1, (window, window))
        return averaged

    share = mean(usable) + np.float32(1e-6)
    left_mean, right_mean = mean(usable * left) / share, mean(usable * warped) / share
    left_power = mean(usable * left * left) / share - left_mean * left_mean
    right_power = mean(usable * warped * warped) / share - right_mean * right_mean
    gain = np.sqrt((np.maximum(left_power, 0) + 4) / (np.maximum(right_power, 0) + 4))
    residual: Float32 = (left - left_mean) - gain * (warped - right_mean)
    return residual


def _evidence(
    residual: Float32, slope: Float32, trust: Float32, axes: Float32, settings: RefinementSettings
) -> tuple[Float32, Float32]:
    """Each pixel's weight and pull, with what is constant along the axis weighed by how well it agrees."""
    residual_mean, slope_mean = axis_means(residual, slope, trust, axes, settings.gloss_px)
    residual_detail, slope_detail = residual - residual_mean, slope - slope_mean
    window = (settings.window_px, settings.window_px)
    detail_power = cv2.boxFilter(trust * residual_detail * residual_detail, -1, window)
    mean_power = cv2.boxFilter(trust * residual_mean * residual_mean, -1, window)
    independent = np.float32(2 * np.sqrt(np.pi) * settings.gloss_px)
    agreement = (detail_power + np.float32(1e-3)) / (independent * mean_power + np.float32(1e-3))
    share = np.minimum(np.float32(1), np.float32(settings.gloss_trust) * agreement)
    weight: Float32 = trust * (slope_detail * slope_detail + share * slope_mean * slope_mean)
    pull: Float32 = -trust * (slope_detail * residual_detail + share * slope_mean * residual_mean)
    return weight, pull
