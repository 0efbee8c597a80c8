"""Average pairs of rows where the picture is alike along its columns: this halves the pixels and loses hardly
any information.

Supports follow the bars over many rows. Where bars run along the columns, two rows are the same but for their
noise, which averaging reduces; disparities keep all of their columns. Where bars run across, as rows of
bricks or bars along the baseline do, nothing is averaged.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar, cast

import numpy as np

from barsight.core.arrays import Bool, Float32, kernel
from barsight.core.parallel import parallel_bands
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.stereo.direct.kernels.pyramid import halve
from barsight.stereo.direct.support_regions import tile_axes

BINNED_ROWS = 2
_ASKEW_SINE, _MAX_ASKEW_RATIO = 0.57, 0.2
"""Sine of the angle from the columns (35 degrees) beyond which a tile's axis is askew, and the maximum
share of askew tiles: yard pictures have up to 0.16, bars along the baseline and roads 0.27 or more.
"""
_SAME_SURFACE_PX = np.float32(0.5)
_BAND_ROWS = 64
Image = TypeVar("Image", Bool, Float32)


def are_rows_alike(pair: RectifiedPair, candidates: DisparityRange, max_row_m: float) -> bool:
    """Check that the picture is alike along its columns, and that pairs of its rows are no wider than
    max_row_m on a surface at the middle of the candidates.
    """
    camera = pair.camera
    middle_px = (candidates.lowest_px + candidates.highest_px) / 2 + camera.doffs_px
    if not middle_px > 0 or BINNED_ROWS * camera.baseline_m / middle_px > max_row_m:
        return False
    askew = np.abs(tile_axes(pair.left.astype(np.float32))[..., 0]) > _ASKEW_SINE
    return bool(askew.mean() <= _MAX_ASKEW_RATIO)


def bin_rows(pair: RectifiedPair) -> RectifiedPair:
    """Average pairs of rows of both pictures; an odd last row is duplicated. Pixels are then twice as high
    as wide, so only what concerns columns remains valid in the camera.
    """
    left, right = (halve(image, columns=False) for image in (pair.left, pair.right))
    left_valid, right_valid = (_even(valid) for valid in (pair.left_valid, pair.right_valid))
    camera = replace(pair.camera, height=len(left))
    return RectifiedPair(
        pair.stamp_ns, left, right, left_valid[::2] & left_valid[1::2], right_valid[::2] & right_valid[1::2],
        camera,
    )  # fmt: skip


def bin_disparity(disparity: Float32) -> Float32:
    """Average pairs of rows (H, W) px where they are one surface; else take the known one, or the upper."""
    even = _even(disparity)
    upper, lower = even[::BINNED_ROWS], even[1::BINNED_ROWS]
    mean = np.float32(0.5) * (upper + lower)
    binned: Float32 = np.where(
        np.abs(upper - lower) < _SAME_SURFACE_PX, mean, np.where(np.isnan(upper), lower, upper)
    )
    return binned


def spread_rows(binned: Disparity, height: int) -> Disparity:
    """Upsample binned rows to the picture's (height, W), linearly between rows that are one surface."""
    shape = height, binned.disparity_px.shape[1]
    found, sigma = np.empty(shape, np.float32), np.empty(shape, np.float32)

    def work(first: int, end: int) -> None:
        _spread(binned.disparity_px, binned.sigma_px, found, sigma, first, end)

    parallel_bands(work, height, _BAND_ROWS)
    return Disparity(found, sigma)


@kernel()
def _spread(
    disparity: Float32, sigma: Float32, found: Float32, found_sigma: Float32, first: int, end: int
) -> None:
    """Upsample rows first...end, see `spread_rows`. disparity, sigma: (ceil(H / 2), W) px. Fills found and
    found_sigma (H, W) px.
    """
    last = len(disparity) - 1
    near, far = np.float32(0.75), np.float32(0.25)
    for y in range(first, end):
        row = y // BINNED_ROWS
        beside = min(max(row - 1 + 2 * (y % BINNED_ROWS), 0), last)
        own, other, own_sigma, other_sigma = disparity[row], disparity[beside], sigma[row], sigma[beside]
        for x in range(found.shape[1]):
            alike = abs(other[x] - own[x]) < _SAME_SURFACE_PX
            found[y, x] = near * own[x] + far * other[x] if alike else own[x]
            found_sigma[y, x] = near * own_sigma[x] + far * other_sigma[x] if alike else own_sigma[x]


def _even(image: Image) -> Image:
    """Repeat the last row of an image with an odd number of rows."""
    return cast(Image, np.concatenate([image, image[-1:]])) if len(image) % BINNED_ROWS else image
