"""Average pairs of rows where the picture is alike along its columns: half the pixels, hardly less is known.

Supports follow the bars over many rows. Where bars run along the columns, two rows say the same but for
their noise, which their mean has less of; disparities keep all of their columns. Where bars run across, as
rows of bricks or bars along the baseline do, nothing is averaged.
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
"""Tiles whose axis is further from a column's (35 degrees), and the most of them: of the yards' pictures
up to 0.16 are, of bars along the baseline and of roads from 0.27 on."""
_SAME_SURFACE_PX = np.float32(0.5)
_BAND_ROWS = 64
Image = TypeVar("Image", Bool, Float32)


def are_rows_alike(pair: RectifiedPair, candidates: DisparityRange, max_row_m: float) -> bool:
    """Check that the picture is alike along its columns, and pairs of its rows no wider than max_row_m on a
    surface in the middle of the candidates.
    """
    camera = pair.camera
    middle_px = (candidates.lowest_px + candidates.highest_px) / 2 + camera.doffs_px
    if not middle_px > 0 or BINNED_ROWS * camera.baseline_m / middle_px > max_row_m:
        return False
    askew = np.abs(tile_axes(pair.left.astype(np.float32))[..., 0]) > _ASKEW_SINE
    return bool(askew.mean() <= _MAX_ASKEW_RATIO)


def bin_rows(pair: RectifiedPair) -> RectifiedPair:
    """Average pairs of rows of both pictures; a last odd row stays beside itself. Pixels are then twice as
    high as wide: of the camera only what concerns columns holds.
    """
    left, right = (halve(image, columns=False) for image in (pair.left, pair.right))
    left_valid, right_valid = (_even(valid) for valid in (pair.left_valid, pair.right_valid))
    camera = replace(pair.camera, height=len(left))
    return RectifiedPair(
        pair.stamp_ns, left, right, left_valid[::2] & left_valid[1::2], right_valid[::2] & right_valid[1::2],
        camera,
    )  # fmt: skip


def bin_disparity(disparity: Float32) -> Float32:
    """Average pairs of rows (H, W) px that are one surface; else the one that is known, or the upper."""
    even = _even(disparity)
    upper, lower = even[::BINNED_ROWS], even[1::BINNED_ROWS]
    mean = np.float32(0.5) * (upper + lower)
    binned: Float32 = np.where(
        np.abs(upper - lower) < _SAME_SURFACE_PX, mean, np.where(np.isnan(upper), lower, upper)
    )
    return binned


def spread_rows(binned: Disparity, height: int) -> Disparity:
    """Spread binned rows over the picture's (height, W): linear between rows that are one surface."""
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
    """Spread rows, see `spread_rows`, over first...end. disparity, sigma: (ceil(H / 2), W) px. Fills found
    and found_sigma (H, W) px.
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
    """Repeat the last row of an odd number."""
    return cast(Image, np.concatenate([image, image[-1:]])) if len(image) % BINNED_ROWS else image
