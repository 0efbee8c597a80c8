"""Compute truncated differences of gray and horizontal gradient as a matching cost [Hosni 2013, Zhang 2014].

Costs are stored candidate by candidate, (K, H, W) float32, because aggregation works slice by slice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from barsight.core.arrays import Bool, Float32, kernel
from barsight.core.settings.values import POSITIVE, SHARE, expect_ranges


@dataclass(frozen=True)
class GradientCostSettings:
    """Settings of the cost of one pixel against another."""

    gray_weight: float = 0.11
    """Weight of the gray difference; the gradient has the rest."""
    gray_limit: float = 7.0
    """Value at which gray differences are truncated."""
    gradient_limit: float = 2.0
    """Value at which differences of the gradient (next pixel minus previous) are truncated."""

    def __post_init__(self) -> None:
        expect_ranges(self, "cost.", gray_weight=SHARE, gray_limit=POSITIVE, gradient_limit=POSITIVE)

    @property
    def worst(self) -> float:
        """Return the cost where both differences are truncated, or there is nothing to compare."""
        return self.gray_weight * self.gray_limit + (1 - self.gray_weight) * self.gradient_limit


@dataclass(frozen=True, eq=False)
class CostImages:
    """Inputs of the cost, of one pair: gray and gradient (H, W) float32, valid (H, W) bool."""

    left: Float32
    right: Float32
    left_gradient: Float32
    right_gradient: Float32
    left_valid: Bool
    right_valid: Bool


def cost_images(left: Float32, right: Float32, left_valid: Bool, right_valid: Bool) -> CostImages:
    """Prepare the cost's inputs from left and right gray values 0...255, (H, W) float32."""
    return CostImages(
        left, right, horizontal_gradient(left), horizontal_gradient(right), left_valid, right_valid
    )


def horizontal_gradient(image: Float32) -> Float32:
    """Subtract the previous pixel from the next (H, W); zero in the first and last column."""
    gradient = np.zeros_like(image)
    gradient[:, 1:-1] = image[:, 2:] - image[:, :-2]
    return gradient


def gradient_cost(
    images: CostImages, lowest_px: int, settings: GradientCostSettings, slices: Float32
) -> None:
    """Fill (K, H, W) slices with the costs of the candidates lowest_px...; `settings.worst` where either
    pixel is invalid or outside.
    """
    _fill(
        (images.left, images.right),
        (images.left_gradient, images.right_gradient),
        (images.left_valid, images.right_valid),
        lowest_px,
        np.float32(settings.gray_weight),
        np.float32(settings.gray_limit),
        np.float32(settings.gradient_limit),
        slices,
    )


@kernel(parallel=True)
def _fill(
    images: tuple[Float32, Float32],
    gradients: tuple[Float32, Float32],
    valid: tuple[Bool, Bool],
    lowest: int,
    share: np.float32,
    gray_limit: np.float32,
    gradient_limit: np.float32,
    slices: Float32,
) -> None:
    """Compute truncated gray and gradient costs of the candidates from `lowest` px on [Hosni 2013].

    images, gradients, valid: of the left and the right image, (H, W), gray levels. share: weight of the gray
    difference. Fills slices (K, H, W): left pixel x against right pixel x - d, the worst cost where either is
    invalid or outside.
    """
    (left, right), (left_gradient, right_gradient), (left_valid, right_valid) = images, gradients, valid
    count, height, width = slices.shape
    rest = np.float32(1) - share
    worst = share * gray_limit + rest * gradient_limit
    for row in numba.prange(height):
        for index in range(count):
            shift = lowest + index
            first, end = max(0, shift), min(width, width + shift)
            slices[index, row, :] = worst
            if end > first:
                _compare(
                    left[row, first:end],
                    right[row, first - shift : end - shift],
                    left_gradient[row, first:end],
                    right_gradient[row, first - shift : end - shift],
                    left_valid[row, first:end],
                    right_valid[row, first - shift : end - shift],
                    share,
                    gray_limit,
                    gradient_limit,
                    slices[index, row, first:end],
                )


@kernel()
def _compare(
    left: Float32,
    right: Float32,
    left_gradient: Float32,
    right_gradient: Float32,
    left_valid: Bool,
    right_valid: Bool,
    share: np.float32,
    gray_limit: np.float32,
    gradient_limit: np.float32,
    costs: Float32,
) -> None:
    """Compute a row's truncated gray and gradient costs at one candidate.

    All arrays are (W,), and right pixel i is the match of left pixel i. Limits in gray levels. Fills costs;
    the worst cost where either pixel is invalid.
    """
    rest = np.float32(1) - share
    worst = share * gray_limit + rest * gradient_limit
    for x in range(costs.shape[0]):
        gray = min(abs(left[x] - right[x]), gray_limit)
        steep = min(abs(left_gradient[x] - right_gradient[x]), gradient_limit)
        costs[x] = share * gray + rest * steep if left_valid[x] & right_valid[x] else worst
