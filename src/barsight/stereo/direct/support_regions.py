"""Build supports that follow a bar: tiles with an axis, and means along it.

The image is divided into tiles, each with one axis, the direction in which the image changes least. A support
is a fixed pattern of whole-pixel offsets rotated to that axis, so the innermost loop runs along a row of the
tile and the compiler can vectorise it. Arrays read at offsets have a margin (`allocate_frame`).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from barsight.core.arrays import Float32, Int64, kernel
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.kernels.vectors import stack_array

TILE_ROWS = 16
TILE_COLUMNS = 32
MARGIN = 48
_SUMS = 3 * TILE_COLUMNS
_LINE_FLOATS = 16
BAND_TILES = 16
"""Number of tile rows that a thread processes row by row, so that the data along a row are in the cache
when they are read.
"""
_STRIP_TILES = 8
"""Number of tiles beside each other that are averaged before those beside them: a strip's rows within reach
stay in the second cache, which a whole row's don't.
"""
_MIN_COHERENCE = 0.35
FITTED_EVERY = 4
"""Interval of rows for which supports are computed where a tile's axis is along the columns; it must
divide TILE_ROWS. The rows between are interpolated, since their supports overlap almost entirely.
"""
_COLUMN_SINE = np.float32(0.17)
_MAX_TONE_SQUARE = np.float32(0.78)
"""Maximum square of a difference in gray value, where it counts with one in disparity."""


class AxisImages(NamedTuple):
    """Two images that are averaged, their weight, and the image whose differences decide which pixels are
    alike: frames, which are (H, W) with MARGIN or more around them, or flattened frames.
    """

    first: Float32
    second: Float32
    weight: Float32
    alike: Float32


def tile_axes(image: Float32, scale_px: float = 8.0) -> Float32:
    """Compute the unit vector (tile rows, tile columns, 2) (x, y) along which the image changes least around
    each tile.

    It follows from the structure tensor [Foerstner 1987] averaged over scale_px. Where no direction is
    dominant, it is along the columns, across the baseline: there a mean along the axis costs the match least.
    """
    # Half size is fine enough for a direction, and takes a quarter of the work.
    smooth = cv2.resize(
        cv2.GaussianBlur(image, (0, 0), 1.2), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA
    )
    slope_x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8)
    slope_y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    height, width = image.shape
    rows = np.minimum(np.arange(-(-height // TILE_ROWS)) * TILE_ROWS + TILE_ROWS // 2, height - 2)
    columns = np.minimum(np.arange(-(-width // TILE_COLUMNS)) * TILE_COLUMNS + TILE_COLUMNS // 2, width - 2)
    xx, xy, yy = (
        cv2.GaussianBlur(product, (0, 0), scale_px / 2)[np.ix_(rows // 2, columns // 2)]
        for product in (slope_x * slope_x, slope_x * slope_y, slope_y * slope_y)
    )
    across = 0.5 * np.arctan2(2 * xy, xx - yy)
    coherence = np.hypot(xx - yy, 2 * xy) / (xx + yy + np.float32(1e-3))
    axes = np.stack([-np.sin(across), np.cos(across)], axis=-1).astype(np.float32)
    axes[coherence < _MIN_COHERENCE] = (0, 1)
    return axes


def allocate_frame(shape: tuple[int, ...]) -> Float32:
    """Allocate an image with a margin of zeros that contains every support offset.

    Rows begin at a cache line and take an odd number of them: with most even numbers, the rows of a column
    compete for a few sets of the nearest cache.
    """
    height, width = shape
    lines = -(-(width + 2 * MARGIN + TILE_COLUMNS) // _LINE_FLOATS) | 1
    rows, columns = height + 2 * MARGIN + TILE_ROWS, lines * _LINE_FLOATS
    room = np.zeros(rows * columns + _LINE_FLOATS, dtype=np.float32)
    first = -room.ctypes.data // room.itemsize % _LINE_FLOATS
    return room[first : first + rows * columns].reshape(rows, columns)


def inside(frame: Float32, shape: tuple[int, ...]) -> Float32:
    """Return a view of the image inside a frame."""
    return frame[MARGIN : MARGIN + shape[0], MARGIN : MARGIN + shape[1]]


def axis_means(
    first: Float32, second: Float32, weight: Float32, alike: Float32, axes: Float32, sigma_px: float,
    means: tuple[Float32, Float32],
) -> None:  # fmt: skip
    """Average two images along each tile's axis with Gaussian weights. Frames in, no NaN; (H, W) each out.

    alike: a pixel's weight falls with the difference in this image (Tukey's biweight that ends at 1), so that
    a strap or a shadow across the bars has a mean of its own.
    """
    images = AxisImages(first, second, weight, alike)
    steps = np.arange(1, min(int(2.5 * sigma_px), MARGIN - 1) + 1)
    shares = np.exp(-0.5 * (steps / sigma_px) ** 2).astype(np.float32)

    def work(first_tile: int, end_tile: int) -> None:
        _axis_means(images, axes, steps, shares, means, first_tile, end_tile)

    parallel_bands(work, len(axes), BAND_TILES)


@kernel(inline=True)
def biweight(gap: np.float32) -> np.float32:
    """Evaluate Tukey's biweight that ends at 1."""
    rest = np.float32(1) - gap * gap
    rest = rest if rest > np.float32(0) else np.float32(0)
    return rest * rest


@kernel(inline=True)
def biweight_of_both(gap: np.float32, tone: np.float32) -> np.float32:
    """Evaluate Tukey's biweight of two differences, which ends where their squares add up to 1; a tone of any
    size alone leaves 5 %, so that a strap without texture of its own still has a fit.
    """
    rest = np.float32(1) - gap * gap - min(tone * tone, _MAX_TONE_SQUARE)
    rest = rest if rest > np.float32(0) else np.float32(0)
    return rest * rest


@kernel(inline=True)
def is_along_column(axis: Float32) -> bool:
    """Check whether an axis (2,) (x, y) is so close to a column's direction that its rows can share their
    fits.
    """
    return bool(abs(axis[0]) < _COLUMN_SINE)


@kernel(inline=True)
def fitted_rows(y: int, height: int) -> tuple[int, int]:
    """Return the fitted rows (every FITTED_EVERYth, and the last one) between which row y lies."""
    above = y - y % FITTED_EVERY
    return above, min(above + FITTED_EVERY, height - 1)


@kernel(borrows=True)
def share_rows(frame: Float32, y: int, x0: int, height: int, alike: np.float32, shares: Float32) -> bool:
    """Compute the weights with which TILE_COLUMNS pixels of row y are interpolated between the fitted rows
    above and below: by distance where both are alike there; otherwise the one that is alike counts alone.

    frame: values that differ by less than `alike` are alike. Fills shares (TILE_COLUMNS,), weights of the row
    below. Returns False if some pixel is like neither.
    """
    above, below = fitted_rows(y, height)
    lanes = slice(MARGIN + x0, MARGIN + x0 + TILE_COLUMNS)
    here, up, down = frame[y + MARGIN, lanes], frame[above + MARGIN, lanes], frame[below + MARGIN, lanes]
    part, alone = np.float32(y - above) / np.float32(below - above), np.int32(0)
    for i in range(TILE_COLUMNS):
        from_up, from_down = abs(up[i] - here[i]), abs(down[i] - here[i])
        share = part if from_up < alike else np.float32(1)
        shares[i] = share if from_down < alike else np.float32(0)
    for i in range(TILE_COLUMNS):
        near = min(abs(up[i] - here[i]), abs(down[i] - here[i]))
        alone += np.int32(0) if near < alike else np.int32(1)
    return bool(alone == 0)


@kernel(borrows=True)
def blend_rows(above: Float32, below: Float32, shares: Float32, row: Float32) -> None:
    """Blend two rows (N,) with the weights `shares` of the one below. Fills row (N,)."""
    for i in range(len(row)):
        row[i] = above[i] + shares[i] * (below[i] - above[i])


@kernel(borrows=True)
def _take_means(
    images: AxisImages, middle: int, offsets: Int64, shares: Float32, first_mean: Float32,
    second_mean: Float32,
) -> None:  # fmt: skip
    """Average the first and the second image for up to TILE_COLUMNS pixels from `middle` on.

    images: flat. offsets: (K,), from a pixel to its support's points on one side; those on the other side are
    mirrored; shares: (K,) their Gaussian weights. Fills both means (N,), which determine the number of
    pixels.
    """
    first, second, weight, alike = images
    sums = stack_array(_SUMS, np.float32)
    # Unsigned: a loop whose index might be negative, and count from the end, isn't vectorised.
    here = np.uint64(middle)
    for i in range(TILE_COLUMNS):
        sums[i] = weight[here + np.uint64(i)]
    for i in range(TILE_COLUMNS):
        sums[TILE_COLUMNS + i] = sums[i] * first[here + np.uint64(i)]
    for i in range(TILE_COLUMNS):
        sums[2 * TILE_COLUMNS + i] = sums[i] * second[here + np.uint64(i)]
    for j in range(len(offsets)):
        forth, back, share = np.uint64(middle + offsets[j]), np.uint64(middle - offsets[j]), shares[j]
        for i in range(TILE_COLUMNS):
            lane = np.uint64(i)
            centre = alike[here + lane]
            one = biweight(alike[forth + lane] - centre) * weight[forth + lane]
            other = biweight(alike[back + lane] - centre) * weight[back + lane]
            sums[i] += share * (one + other)
            sums[TILE_COLUMNS + i] += share * (one * first[forth + lane] + other * first[back + lane])
            sums[2 * TILE_COLUMNS + i] += share * (one * second[forth + lane] + other * second[back + lane])
    for i in range(len(first_mean)):
        first_mean[i] = sums[TILE_COLUMNS + i] / (sums[i] + np.float32(1e-6))
    for i in range(len(second_mean)):
        second_mean[i] = sums[2 * TILE_COLUMNS + i] / (sums[i] + np.float32(1e-6))


@kernel()
def _axis_means(
    images: AxisImages, axes: Float32, steps: Int64, shares: Float32, means: tuple[Float32, Float32],
    first_tile: int, end_tile: int,
) -> None:  # fmt: skip
    """Average two images along the axes in tile rows first_tile...end_tile, see `axis_means`.

    images: frames, no NaN. axes: (tile rows, tile columns, 2). steps: (K,) px to one side, shares: (K,) their
    Gaussian weights. Fills both means (H, W).
    """
    first_mean, second_mean = means
    height = first_mean.shape[0]
    framed_width = images.first.shape[1]
    flat = AxisImages(
        images.first.reshape(-1),
        images.second.reshape(-1),
        images.weight.reshape(-1),
        images.alike.reshape(-1),
    )
    offsets = np.empty((_STRIP_TILES, len(steps)), dtype=np.int64)
    for first_x in range(0, axes.shape[1], _STRIP_TILES):
        end_x = min(first_x + _STRIP_TILES, axes.shape[1])
        for tile_y in range(first_tile, end_tile):
            for tile_x in range(first_x, end_x):
                axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
                for j in range(len(steps)):
                    offset = round(steps[j] * axis_y) * framed_width + round(steps[j] * axis_x)
                    offsets[tile_x - first_x, j] = offset
            for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
                for tile_x in range(first_x, end_x):
                    x0 = tile_x * TILE_COLUMNS
                    row = first_mean[y, x0 : x0 + TILE_COLUMNS], second_mean[y, x0 : x0 + TILE_COLUMNS]
                    middle = (y + MARGIN) * framed_width + x0 + MARGIN
                    _take_means(flat, middle, offsets[tile_x - first_x], shares, row[0], row[1])
