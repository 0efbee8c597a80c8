"""Halve images, and upsample half-size results without mixing surfaces."""

from __future__ import annotations

from typing import TypeVar, cast

import cv2
import numpy as np

from barsight.core.arrays import Float32, UInt8, kernel
from barsight.core.parallel import parallel_bands

_BAND_ROWS = 64


Image = TypeVar("Image", UInt8, Float32)


def halve(image: Image, *, rows: bool = True, columns: bool = True) -> Image:
    """Average 2 x 2 pixels, or two along one axis; odd images are extended by their last row and column."""
    down, right = 2 if rows else 1, 2 if columns else 1
    height, width = image.shape
    framed = cv2.copyMakeBorder(image, 0, height % down, 0, width % right, cv2.BORDER_REPLICATE)
    size = framed.shape[1] // right, framed.shape[0] // down
    return cast(Image, cv2.resize(framed, size, interpolation=cv2.INTER_AREA))


def double_disparity(small: Float32, shape: tuple[int, ...]) -> Float32:
    """Repeat each column, and each row if the rows are halved, up to a shape (H, W), and double the
    disparities.
    """
    doubled = np.empty(shape, dtype=np.float32)
    _double(small, 1 if len(small) == shape[0] else 2, doubled)
    return doubled


@kernel()
def _double(small: Float32, rows: int, doubled: Float32) -> None:
    """Repeat columns, and each row `rows` times, with doubled disparity. Fills doubled (H, W) px."""
    height, width = doubled.shape
    for y in range(0, height, rows):
        own, row = small[y // rows], doubled[y]
        for x in range(width // 2):
            twice = np.float32(2) * own[x]
            row[2 * x] = twice
            row[2 * x + 1] = twice
        if width % 2:
            row[width - 1] = np.float32(2) * own[width // 2]
        if y + 1 < height and rows == 2:
            doubled[y + 1] = row


def upsample_update(started: Float32, moved: Float32, disparity: Float32, same_surface_px: float) -> Float32:
    """Upsample a half-size update onto `disparity` (H, W), by the bilinear mean of the four nearest pixels
    without those on another surface. started, moved: (H / 2, W / 2), or (H, W / 2) if the rows aren't
    halved, in half-size pixels.
    """
    rows = 1 if len(started) == len(disparity) else 2
    result = np.empty_like(disparity)
    seen, pulled = (
        cv2.copyMakeBorder(2 * image, 1, 1, 1, 1, cv2.BORDER_REPLICATE) for image in (started, moved)
    )

    def work(first: int, end: int) -> None:
        _carry_up(seen, pulled, disparity, np.float32(1 / same_surface_px), rows, result, first, end)

    parallel_bands(work, len(disparity), _BAND_ROWS)
    return result


@kernel()
def _carry_up(
    started: Float32, moved: Float32, disparity: Float32, inverse_px: np.float32, rows: int, result: Float32,
    first: int, end: int,
) -> None:  # fmt: skip
    """Upsample the update with bilinear weights that fall with the difference in disparity, rows first...end.

    started, moved: (ceil(H / rows) + 2, ceil(W / 2) + 2), half size with a border of one, but in full-size
    px. disparity: (H, W) px. inverse_px: one over the difference (px) at which a pixel no longer counts.
    Fills result (H, W) px.
    """
    width = disparity.shape[1]
    around = np.empty((8, width + width % 2), dtype=np.float32)
    for y in range(first, end):
        near = y // rows + 1
        far = near - 1 + 2 * (y & 1) if rows == 2 else near
        for k in range(2):
            row = near if k == 0 else far
            _repeat(started[row], around[2 * k], around[2 * k + 1])
            _repeat(moved[row], around[4 + 2 * k], around[5 + 2 * k])
        _blend_moves(around, disparity[y], inverse_px, result[y])


@kernel(inline=True)
def _repeat(small: Float32, columns: Float32, beside: Float32) -> None:
    """Repeat the half-size pixel (W / 2 + 2,) of each column, and the nearest one beside it. Fills columns
    and beside (W,), of even width.
    """
    for i in range(len(columns) // 2):
        columns[2 * i] = small[i + 1]
        columns[2 * i + 1] = small[i + 1]
    for i in range(len(beside) // 2):
        beside[2 * i] = small[i]
        beside[2 * i + 1] = small[i + 2]


@kernel(inline=True)
def _blend_moves(around: Float32, disparity: Float32, inverse_px: np.float32, result: Float32) -> None:
    """Blend the four pixels around each, see `_carry_up`: around (8, W) px, first started, then moved."""
    zero, one, tiny = np.float32(0), np.float32(1), np.float32(1e-6)
    shares = np.array([9, 3, 3, 1], dtype=np.float32)
    for x in range(len(result)):
        here, total, weights = disparity[x], zero, tiny
        for k in range(4):
            gap = (around[k, x] - here) * inverse_px
            alike = max(one - gap * gap, zero)
            weight = shares[k] * alike * alike
            weights += weight
            total += weight * around[4 + k, x]
        result[x] = here + total / weights
