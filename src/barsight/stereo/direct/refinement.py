"""Refine disparity directly on both images, to a few hundredths of a pixel.

Each step warps the right image with the current disparity and computes for every pixel how far it should move
(Gauss-Newton [Lucas 1981]), then fits planes to the results along supports that follow the bars. Gain and
offset between the images are removed in a window. The first steps may use half-size images. All but the last
use blurrier ones and the mean gradient of both [Malis 2004], which converges from further away; the last one
uses the left gradient alone: the noise of an interpolated image depends on the fraction of the disparity, and
its own gradient turns that into pixel locking.

Gloss: a highlight is constant along a bar but lies behind its surface, so what is constant along the axis
biases the match. Residual and gradient are therefore split into their mean along the axis and the detail. The
mean is weighted by how well it agrees with the detail: by the ratio of the residual explained by noise to the
actual residual. The mean is taken over places with similar gray values, since a strap or a shadow across the
bars would turn the highlights beside it into detail.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8
from barsight.core.errors import ConfigError
from barsight.stereo.direct.disparity_update import (
    Fit,
    blend_fits,
    complete_step,
    fit_variance,
    raise_noise,
    update_disparity,
)
from barsight.stereo.direct.kernels.cubic_spline import (
    interpolated_value,
    row_coefficients,
    row_slope,
    value_and_slope,
)
from barsight.stereo.direct.kernels.pyramid import halve, upsample_update
from barsight.stereo.direct.photometric_residuals import (
    noise_power,
    photometric_residual,
    robust_weights,
    step_gain,
)
from barsight.stereo.direct.plane_fits import SupportShape, fit_planes
from barsight.stereo.direct.plane_sums import Evidence
from barsight.stereo.direct.support_regions import MARGIN, allocate_frame, axis_means, inside, tile_axes
from barsight.stereo.noise import image_noise

Image = UInt8 | Float32

_BLUR_PX, _FIRST_BLUR_PX = 0.5, 0.7
"""Blur of the pictures in the last step and in the first, one sigma."""
_LONG_STEP_PX, _SHORT_STEP_PX, _HALF_STEP_PX = 5, 3, 3
"""Sampling step along the axis of the long support, the short one, and the long one at half size."""
_HALF_ACROSS = 0.75
"""Ratio of the long support's width at half size, in half-size pixels, to that at full size."""
_HALF_HOLD = 4
"""Weight of the hold at half size relative to full size, where a pixel stands for four."""
_MAX_HALF_STEP_PX = 0.4
"""Maximum step at half size, in half-size pixels; longer ones move pixels beside depth edges to the other
side.
"""
MIN_HALVED_PX = 128
"""Minimum length of a picture's shorter side for work at half size."""
_ALIKE_BLUR_PX = 1.5
"""Blur of the gray values at whose differences supports end, one sigma."""
_LAST_SAME_SURFACE = 0.5
"""Share of same_surface_px at which supports end in the last step: the start's steps of whole pixels are
gone by then, while dunnage of 40 mm is half a pixel high.
"""
_HOLD, _HOLD_UNMATCHED = 0.1, 0.02
"""Weight of the hold, which keeps a pixel where it is, and the share of it that an unmatched pixel has."""


@dataclass(frozen=True)
class RefinementSettings:
    """Settings of direct refinement on both images."""

    steps: int = 3
    """Number of Gauss-Newton steps."""
    half_size_steps: int = 0
    """Number of steps, the first ones, that run at half size: a quarter of the work each, with slightly
    larger errors. The last step never does.
    """
    along_px: float = 16.0
    """Length of the long support along the axis, one sigma."""
    across_px: float = 1.5
    """Width of the long support across the axis, one sigma; a bar's curvature limits it."""
    short_px: float = 3.0
    """Length of the short support along the axis, one sigma, for surfaces that the long one can't follow;
    0 disables it.
    """
    short_across_px: float = 2.0
    """Width of the short support across the axis, one sigma."""
    gloss_px: float = 10.0
    """Length along the axis over which constant brightness counts as gloss, one sigma; 0 disables the
    treatment of gloss.
    """
    alike_gray: float = 20.0
    """Difference in gray value from which places aren't one surface or the same highlight, but a strap, a
    piece of dunnage or a shadow.
    """
    gloss_trust: float = 0.02
    """Weight of the evidence that is constant along the axis, if noise explains its residual."""
    outlier_gray: float = 8.0
    """Residual at which a pixel's weight is halved, gray levels."""
    same_surface_px: float = 1.0
    """Maximum difference between disparities of one surface."""
    window_px: int = 21
    """Side of the window in which gain and offset are removed; must be odd."""

    def __post_init__(self) -> None:
        if min(self.steps, self.half_size_steps) < 0:
            raise ConfigError("refinement steps can't be negative, nor those at half the size")
        if min(self.along_px, self.across_px, self.outlier_gray, self.same_surface_px, self.alike_gray) <= 0:
            raise ConfigError(
                "the long support, outlier_gray, same_surface_px and alike_gray must be positive"
            )
        if min(self.short_px, self.gloss_px, self.gloss_trust) < 0 or self.short_across_px <= 0:
            raise ConfigError("the short support and the gloss settings can't be negative")
        if self.window_px < 3 or self.window_px % 2 == 0:
            raise ConfigError(f"window_px must be odd and at least 3, not {self.window_px}")


@dataclass(frozen=True, eq=False)
class RefinedDisparity:
    """disparity_px: (H, W), no NaN. variance_px2: (H, W), the part that the residual in each support
    explains.
    """

    disparity_px: Float32
    variance_px2: Float32


def refine_disparity(
    left: UInt8, right: UInt8, start: Float32, matched: Bool, settings: RefinementSettings,
    halves_rows: bool = True,
) -> RefinedDisparity:  # fmt: skip
    """Refine `start` (H, W; no NaN) from the pixels that are `matched`; the others only follow.

    halves_rows: whether half size halves the rows too.
    """
    halved = max(min(settings.half_size_steps, settings.steps - 1), 0)
    if min(left.shape) < MIN_HALVED_PX:
        halved = 0
    if halved:
        start = refine_at_half_size(left, right, start, matched, settings, halves_rows, halved)
    work = _Work.of(left.astype(np.float32), start, matched.astype(np.float32), settings)
    noise = _noise(left, right)
    variance = np.full_like(start, np.inf)
    for step in range(halved, settings.steps):
        remaining = (settings.steps - 1 - step) / max(settings.steps - 1, 1)
        blur_px = _BLUR_PX * (_FIRST_BLUR_PX / _BLUR_PX) ** remaining
        variance = work.step(left, right, blur_px, noise * _slope_gain(blur_px), remaining == 0)
    return RefinedDisparity(inside(work.disparity, start.shape).copy(), variance)


def refine_at_half_size(
    left: UInt8, right: UInt8, start: Float32, matched: Bool, settings: RefinementSettings,
    halves_rows: bool = True, steps: int = 1,
) -> Float32:  # fmt: skip
    """Run steps at half size with the long support: they take a fraction of the work, and blurrier images
    converge from further away. halves_rows: whether half size halves the rows too.
    """
    rows = 2 if halves_rows else 1
    half = replace(
        settings,
        along_px=settings.along_px / rows,
        across_px=settings.across_px * _HALF_ACROSS,
        gloss_px=settings.gloss_px / rows,
        same_surface_px=settings.same_surface_px / 2,
        window_px=max(int(settings.window_px / (2 * rows) ** 0.5) | 1, 3),
    )
    small_left, small_right, small_start, small_matched = (
        halve(image.astype(np.float32), rows=halves_rows) for image in (left, right, start, matched)
    )
    started = np.float32(0.5) * small_start
    work = _Work.of(small_left, started, small_matched, half, _HALF_HOLD * _HOLD)
    slope_noise = _noise(small_left, small_right) * _slope_gain(_BLUR_PX)
    now, moved = inside(work.disparity, started.shape), np.zeros_like(started)
    for _ in range(steps):
        work.pulls(small_left, small_right, _BLUR_PX, slope_noise, is_last=False)
        fitted, _ = work.planes([SupportShape(half.along_px, half.across_px, _HALF_STEP_PX)])[0]
        step = np.clip(fitted - now, -_MAX_HALF_STEP_PX, _MAX_HALF_STEP_PX)
        now += step
        moved += step
    return upsample_update(started, moved, start, settings.same_surface_px)


@dataclass(frozen=True, eq=False)
class _Work:
    """State shared by the steps. usable, its mean over windows, hold: (H, W). The others are frames."""

    settings: RefinementSettings
    axes: Float32
    usable: Float32
    mean_usable: Float32
    hold: Float32
    disparity: Float32
    residual: Float32
    slope: Float32
    trust: Float32
    weight: Float32
    pull: Float32
    gray: Float32

    @classmethod
    def of(
        cls, left: Float32, start: Float32, usable: Float32, settings: RefinementSettings, hold: float = _HOLD
    ) -> _Work:
        mean_usable = cv2.boxFilter(usable, -1, (settings.window_px, settings.window_px))
        frames = [allocate_frame(start.shape) for _ in range(7)]
        inside(frames[0], start.shape)[:] = start
        gray = cv2.GaussianBlur(left, (0, 0), _ALIKE_BLUR_PX)
        np.multiply(gray, np.float32(1 / settings.alike_gray), out=inside(frames[6], start.shape))
        hold_each = np.float32(hold) * (usable + np.float32(_HOLD_UNMATCHED))
        return cls(settings, tile_axes(left), usable, mean_usable, hold_each, *frames)

    def step(self, left: Image, right: Image, blur_px: float, slope_noise: float, is_last: bool) -> Float32:
        """Run one step of the disparity and return its variance. slope_noise: variance of the left image's
        slope.
        """
        shape, side = self.usable.shape, self.settings.window_px
        short_of, mean_weight = self.pulls(left, right, blur_px, slope_noise, is_last)
        power = noise_power(self.pull, self.usable, self.mean_usable, mean_weight, _HOLD, side)
        raise_noise(short_of, power)
        fitted, variance = self._fit(power, _LAST_SAME_SURFACE if is_last else 1.0)
        before = inside(self.disparity, shape).copy()
        update_disparity(fitted, self.axes, self.disparity, variance)
        if is_last:
            self._complete(before, short_of)
        return variance

    def pulls(
        self, left: Image, right: Image, blur_px: float, slope_noise: float, is_last: bool
    ) -> tuple[Float32, Float32]:
        """Compute weights and pulls of this step; the weights include the hold.

        Returns the gain by which the step falls short, and the weights' means over windows, (H, W).
        """
        settings, shape = self.settings, self.usable.shape
        left_gray = cv2.GaussianBlur(left.astype(np.float32), (0, 0), blur_px)
        coefficients = row_coefficients(right, blur_px)
        slope = inside(self.slope, shape)
        left_slope = row_slope(left, blur_px)
        if is_last:
            warped = interpolated_value(coefficients, self.disparity, MARGIN)
            slope[:] = left_slope
        else:
            warped, right_slope = value_and_slope(coefficients, self.disparity, MARGIN)
            left_slope += right_slope
            np.multiply(left_slope, np.float32(0.5), out=slope)
            slope_noise *= 0.5
        side = settings.window_px
        photometric_residual(
            left_gray, warped, self.usable, side, settings.outlier_gray, self.residual, self.trust
        )
        gloss = settings.gloss_px, settings.gloss_trust
        evidence = self.residual, self.slope, self.trust
        robust_weights(*evidence, self._along(), side, *gloss, self.weight, self.pull)
        mean_weight = np.empty(shape, dtype=np.float32)
        short_of = step_gain(self.weight, self.trust, slope_noise, side, is_last, self.pull, mean_weight)
        weight = inside(self.weight, shape)
        weight += self.hold
        return short_of, mean_weight

    def _complete(self, before: Float32, short_of: Float32) -> None:
        """Complete a step that fell short, using its mean over a window: a start biased by gloss is off as
        a whole, while each pixel's own remainder is mostly noise.
        """
        now, side = inside(self.disparity, before.shape), self.settings.window_px
        np.subtract(now, before, out=before)
        before *= self.usable
        complete_step(cv2.boxFilter(before, -1, (side, side)), self.mean_usable, short_of, self.disparity)

    def _along(self) -> tuple[Float32, Float32]:
        """Average residual and slope along the axis, (H, W)."""
        settings, shape = self.settings, self.usable.shape
        if settings.gloss_px == 0:
            return np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
        means = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
        images = self.residual, self.slope, self.trust, self.gray
        axis_means(*images, self.axes, settings.gloss_px, means)
        return means

    def _fit(self, power: Float32, same_surface: float) -> tuple[Float32, Float32]:
        settings = self.settings
        supports = [SupportShape(settings.along_px, settings.across_px, _LONG_STEP_PX)]
        if settings.short_px > 0:
            supports.append(SupportShape(settings.short_px, settings.short_across_px, _SHORT_STEP_PX))
        fits = self.planes(supports, same_surface)
        if settings.short_px == 0:
            return fits[0][0], fit_variance(power, fits[0][1])
        return blend_fits(fits[0], fits[1], power, self.usable)

    def planes(self, supports: list[SupportShape], same_surface: float = 1.0) -> list[Fit]:
        """Fit the planes of each support; same_surface: the share of same_surface_px at which they end."""
        # The inputs of the weights and pulls are no longer needed, nor will the pulls be.
        room = self.residual, self.trust, self.slope
        evidence = Evidence(self.disparity, self.weight, self.pull, self.gray)
        reach_px = same_surface * self.settings.same_surface_px
        return fit_planes(evidence, self.axes, supports, reach_px, room, self.usable.shape)


def _noise(left: Image, right: Image) -> float:
    """Average the variance of both images' noise."""
    return 0.5 * (image_noise(left) ** 2 + image_noise(right) ** 2)


@lru_cache
def _slope_gain(blur_px: float) -> float:
    """Compute the ratio of the variance of `row_slope` to that of white noise in the image."""
    impulse = np.zeros((33, 33), dtype=np.uint8)
    impulse[16, 16] = 100
    return float(np.square(row_slope(impulse, blur_px) / 100).sum())
