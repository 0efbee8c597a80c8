"""Compute photometric residuals and their robustly weighted Gauss-Newton terms, pixel by pixel.

Each pass goes through bands of rows with rolling sums (`box_sums.py`). `Frames` are images with the supports'
margin around them. A pixel's weight is its Gauss-Newton Hessian, its pull the negative gradient.
"""

from __future__ import annotations

import math

import numpy as np

from barsight.core.arrays import Float32, kernel
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.kernels.box_sums import (
    BAND_ROWS,
    allocate_columns,
    mirror_index,
    roll_product,
    roll_square,
    roll_sum,
    slide_window,
)
from barsight.stereo.direct.support_regions import MARGIN

_CONTRAST_FLOOR = np.float32(4)
"""Variance added to both pictures' contrast, gray levels^2."""
_BLOCK_PX = 3
"""Side of the blocks over which pulls are summed to estimate their noise."""
_MAX_UNDAMPED = np.float32(3)
"""Maximum gain of a step."""


def photometric_residual(
    left: Float32, right: Float32, usable: Float32, side: int, outlier_gray: float, residual: Float32,
    trust: Float32,
) -> None:  # fmt: skip
    """Subtract right from left after equalising the means and contrasts of the `usable` (0...1) pixels in
    a window of side x side pixels, and compute each residual's robust weight `trust`, which is half at
    outlier_gray. Both contrasts are raised by 2 gray levels. (H, W) in, frames out.
    """

    def work(first: int, end: int) -> None:
        _compare(left, right, usable, side // 2, np.float32(outlier_gray), residual, trust, first, end)

    parallel_bands(work, len(left), BAND_ROWS)


@kernel()
def _compare(
    left: Float32, right: Float32, usable: Float32, reach: int, outlier: np.float32, residual: Float32,
    trust: Float32, first: int, end: int,
) -> None:  # fmt: skip
    """Compute photometric residuals and Cauchy weights in rows first...end, see `photometric_residual`.

    left, right: (H, W) gray levels; usable: (H, W) 0...1. Mean and contrast are taken over windows of 2 reach
    + 1 px; outlier: gray levels. Fills the frames residual (gray levels) and trust (0...1).
    """
    height, width = left.shape
    columns = allocate_columns(5, width, reach)
    means = np.empty((5, width), dtype=np.float32)
    none = np.zeros(width, dtype=np.float32)
    one, zero, floor = np.float32(1), np.float32(0), _CONTRAST_FLOOR
    for coming in range(first - reach, end + reach):
        y, going = coming - reach, coming - 2 * reach - 1
        a, b = mirror_index(coming, height), mirror_index(going, height)
        came = usable[a]
        gone = usable[b] if going >= first - reach else none
        roll_sum(columns[0], reach, came, gone)
        roll_product(columns[1], reach, came, left[a], gone, left[b])
        roll_product(columns[2], reach, came, right[a], gone, right[b])
        roll_square(columns[3], reach, came, left[a], gone, left[b])
        roll_square(columns[4], reach, came, right[a], gone, right[b])
        if y < first:
            continue
        for part in range(5):
            slide_window(columns[part], reach, means[part])
        here, there, use = left[y], right[y], usable[y]
        apart = residual[y + MARGIN, MARGIN : MARGIN + width]
        trusted = trust[y + MARGIN, MARGIN : MARGIN + width]
        for x in range(width):
            share = one / (means[0, x] + np.float32(1e-6))
            left_mean, right_mean = means[1, x] * share, means[2, x] * share
            left_power = max(means[3, x] * share - left_mean * left_mean, zero) + floor
            right_power = max(means[4, x] * share - right_mean * right_mean, zero) + floor
            gain = np.sqrt(left_power / right_power)
            apart[x] = (here[x] - left_mean) - gain * (there[x] - right_mean)
        for x in range(width):
            scaled = apart[x] / outlier
            trusted[x] = use[x] / (one + scaled * scaled)


def robust_weights(
    residual: Float32, slope: Float32, trust: Float32, means: tuple[Float32, Float32], side: int,
    gloss_px: float, gloss_trust: float, weight: Float32, pull: Float32,
) -> None:  # fmt: skip
    """Compute each pixel's weight and pull; the part that is constant along the axis is weighted by how well
    it agrees.

    means: (H, W) of residual and slope along the axis. Frames in and out.
    """
    # Independent samples in a Gaussian mean: it has that much less of the noise's power.
    samples = np.float32(2 * math.sqrt(math.pi) * gloss_px)

    def work(first: int, end: int) -> None:
        _weigh(
            residual, slope, trust, means, side // 2, samples, np.float32(gloss_trust), (weight, pull), first,
            end,
        )  # fmt: skip

    parallel_bands(work, len(means[0]), BAND_ROWS)


@kernel()
def _weigh(
    residual: Float32, slope: Float32, trust: Float32, means: tuple[Float32, Float32], reach: int,
    samples: np.float32, gloss_trust: np.float32, evidence: tuple[Float32, Float32], first: int, end: int,
) -> None:  # fmt: skip
    """Compute the Gauss-Newton weights and pulls of rows first...end, see `robust_weights`.

    residual (gray levels), slope (gray levels per px), trust (0...1): frames. means: of residual and slope
    along the axis, (H, W). samples: number of independent pixels in a mean; windows are 2 reach + 1 px. Fills
    the evidence, two frames: weight ((gray levels / px)^2) and pull (gray levels^2 / px).
    """
    (residual_mean, slope_mean), (weight, pull) = means, evidence
    height, width = residual_mean.shape
    columns = allocate_columns(2, width, reach)
    powers = np.empty((2, width), dtype=np.float32)
    rows = np.zeros((4, width), dtype=np.float32)
    none, coming_detail, going_detail, share = rows[0], rows[1], rows[2], rows[3]
    one, least = np.float32(1), np.float32(1e-3)
    inner = slice(MARGIN, MARGIN + width)
    for coming in range(first - reach, end + reach):
        y, going = coming - reach, coming - 2 * reach - 1
        a, b = mirror_index(coming, height), mirror_index(going, height)
        came = trust[a + MARGIN, inner]
        gone = trust[b + MARGIN, inner] if going >= first - reach else none
        coming_residual, coming_mean = residual[a + MARGIN, inner], residual_mean[a]
        going_residual, going_mean = residual[b + MARGIN, inner], residual_mean[b]
        for x in range(width):
            coming_detail[x] = coming_residual[x] - coming_mean[x]
        for x in range(width):
            going_detail[x] = going_residual[x] - going_mean[x]
        roll_square(columns[0], reach, came, coming_detail, gone, going_detail)
        roll_square(columns[1], reach, came, coming_mean, gone, going_mean)
        if y < first:
            continue
        for part in range(2):
            slide_window(columns[part], reach, powers[part])
        trusted, own, own_slope = (
            trust[y + MARGIN, inner],
            residual[y + MARGIN, inner],
            slope[y + MARGIN, inner],
        )
        mean, mean_slope = residual_mean[y], slope_mean[y]
        for x in range(width):
            share[x] = min(one, gloss_trust * (powers[0, x] + least) / (samples * powers[1, x] + least))
        weights, pulls = weight[y + MARGIN, inner], pull[y + MARGIN, inner]
        for x in range(width):
            detail = own_slope[x] - mean_slope[x]
            weights[x] = trusted[x] * (detail * detail + share[x] * mean_slope[x] * mean_slope[x])
        for x in range(width):
            detail = (own_slope[x] - mean_slope[x]) * (own[x] - mean[x])
            pulls[x] = -trusted[x] * (detail + share[x] * mean_slope[x] * mean[x])


def step_gain(
    weight: Float32, trust: Float32, slope_noise: float, side: int, is_last: bool, pull: Float32,
    mean_weight: Float32,
) -> Float32:  # fmt: skip
    """Compute the step's gain (H, W), at most 3: noise in the slopes adds to the weights but not to the
    pulls, so each step falls short by the noise's share of the weights. Unless the step is the last, the
    pulls are multiplied by the gain.

    mean_weight: (H, W), filled with the weights' means over the windows. The others are frames.
    """
    short_of = np.empty_like(mean_weight)

    def work(first: int, end: int) -> None:
        _apply_step_gain(
            weight,
            trust,
            np.float32(slope_noise),
            side // 2,
            is_last,
            pull,
            mean_weight,
            short_of,
            first,
            end,
        )

    parallel_bands(work, len(mean_weight), BAND_ROWS)
    return short_of


@kernel()
def _apply_step_gain(
    weight: Float32, trust: Float32, slope_noise: np.float32, reach: int, is_last: bool, pull: Float32,
    mean_weight: Float32, short_of: Float32, first: int, end: int,
) -> None:  # fmt: skip
    """Compute the step's gain in rows first...end, see `step_gain`.

    weight, trust, pull: frames; pull is multiplied by the gain unless the step is the last. slope_noise:
    variance of a slope, (gray levels / px)^2. Windows are 2 reach + 1 px. Fills mean_weight and short_of (the
    gain, at most 3), (H, W).
    """
    height, width = mean_weight.shape
    columns = allocate_columns(2, width, reach)
    rows = np.zeros((2, width), dtype=np.float32)
    none, spurious = rows[0], rows[1]
    inner, share = slice(MARGIN, MARGIN + width), np.float32(1) / _MAX_UNDAMPED
    for coming in range(first - reach, end + reach):
        y, going = coming - reach, coming - 2 * reach - 1
        a, b = mirror_index(coming, height) + MARGIN, mirror_index(going, height) + MARGIN
        has_gone = going >= first - reach
        roll_sum(columns[0], reach, weight[a, inner], weight[b, inner] if has_gone else none)
        roll_sum(columns[1], reach, trust[a, inner], trust[b, inner] if has_gone else none)
        if y < first:
            continue
        mean, longer, pulls = mean_weight[y], short_of[y], pull[y + MARGIN, inner]
        slide_window(columns[0], reach, mean)
        slide_window(columns[1], reach, spurious)
        for x in range(width):
            sound = max(mean[x] - slope_noise * spurious[x], mean[x] * share + np.float32(1e-6))
            longer[x] = mean[x] / sound
        if not is_last:
            for x in range(width):
                pulls[x] *= longer[x]


def noise_power(
    pull: Float32, usable: Float32, mean_usable: Float32, mean_weight: Float32, hold: float, side: int
) -> Float32:
    """Estimate the noise power (H, W) (gray levels^2) of the pulls per unit of weight, from their sums
    over blocks, so that correlated errors of neighbours are accounted for. Where the weights are small,
    the plain hold dominates and the power grows. pull is a frame.
    """
    power = np.empty_like(usable)

    def work(first: int, end: int) -> None:
        _noise_power(pull, usable, mean_usable, mean_weight, np.float32(hold), side // 2, power, first, end)

    parallel_bands(work, len(usable), BAND_ROWS)
    return power


@kernel()
def _blocks(pull: Float32, y: int, height: int, line: Float32, blocks: Float32) -> None:
    """Sum (W,) over 3 x 3 pixels around row y. line: (W + 2,) scratch."""
    width = len(blocks)
    inner = slice(MARGIN, MARGIN + width)
    above, below = mirror_index(y - 1, height) + MARGIN, mirror_index(y + 1, height) + MARGIN
    one, two, three = pull[above, inner], pull[y + MARGIN, inner], pull[below, inner]
    for x in range(width):
        line[x + 1] = one[x] + two[x] + three[x]
    line[0], line[width + 1] = line[1 + mirror_index(-1, width)], line[1 + mirror_index(width, width)]
    for x in range(width):
        blocks[x] = line[x] + line[x + 1] + line[x + 2]


@kernel()
def _noise_power(
    pull: Float32, usable: Float32, mean_usable: Float32, mean_weight: Float32, hold: np.float32, reach: int,
    power: Float32, first: int, end: int,
) -> None:  # fmt: skip
    """Estimate the noise power in rows first...end, see `noise_power`.

    pull: a frame. usable (0...1), mean_usable, mean_weight: (H, W), the means over windows of 2 reach + 1 px.
    hold: weight of the plain hold. Fills power (H, W), gray levels^2.
    """
    height, width = usable.shape
    column = allocate_columns(1, width, reach)[0]
    rows = np.zeros((3, width), dtype=np.float32)
    none, ahead, behind = rows[0], rows[1], rows[2]
    line = np.empty(width + 2, dtype=np.float32)
    size, one = np.float32(_BLOCK_PX * _BLOCK_PX), np.float32(1)
    for coming in range(first - reach, end + reach):
        y, going = coming - reach, coming - 2 * reach - 1
        a, b = mirror_index(coming, height), mirror_index(going, height)
        _blocks(pull, a, height, line, ahead)
        gone = none
        if going >= first - reach:
            _blocks(pull, b, height, line, behind)
            gone = usable[b]
        roll_square(column, reach, usable[a], ahead, gone, behind)
        if y < first:
            continue
        found, weights, seen = power[y], mean_weight[y], mean_usable[y]
        slide_window(column, reach, found)
        for x in range(width):
            each = one / (weights[x] + np.float32(1e-3))
            # Rounding makes sliding sums of squares slightly negative where no pull is left.
            square = max(found[x], np.float32(0)) / size
            found[x] = square * each * (one + hold * (seen[x] + np.float32(1e-6)) * each)
