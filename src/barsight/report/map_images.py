"""Render the height map as pictures: read tile by tile, downsampled and coloured for the page's SVG."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Float32, Float64, UInt8
from barsight.core.errors import MEASURE_AGAIN, InputError
from barsight.core.reading.bounded_reading import read_bytes
from barsight.core.reading.geotiff import HEIGHT_BANDS, GeoTiff, open_geotiff
from barsight.core.records.gray_levels import TornImageError
from barsight.core.records.heights import HeightSource
from barsight.recording.image_decoding import MAX_PICTURE_BYTES, decode_with_colour

MAX_SIDE_PX, MAX_PIXELS = 2400, 3_000_000
"""Maximum length of a strip's longer side, and maximum size of a map's picture, in pixels."""
MAX_STRIPS = 12
FOLD_ASPECT = 7.0
"""Ratio of length to width above which a map is folded into strips below each other."""

Codes = dict[int, tuple[int, int, int]]
SOURCE_RGB: Codes = {
    HeightSource.VISION: (68, 119, 170),
    HeightSource.LASER: (34, 136, 51),
    HeightSource.FILLED: (238, 119, 51),
}
FILLED_TINT_RGB = (255, 90, 160)
_BAND_ROWS, _SHADE_REACH_PX = 128, 8
"""Number of rows painted at a time, and margin of neighbouring pixels that the hillshade needs."""
_SLOPE_NOISE = 0.25
"""RMS slope of floors over sigma per pixel: 0.17 to 0.25 on four maps. Most of sigma is common to
neighbours.
"""


@dataclass(frozen=True, eq=False)
class Raster:
    """Downsampled height.tif: row 0 at the highest y, each pixel the mean of step x step cells.

    z_m, sigma_m, views: (H, W) float32, NaN if no cell is known. source: (H, W) uint8, the most frequent code
    of the known cells. cell_m: side of a pixel; (left_m, top_m): the outer corner of pixel (0, 0).
    """

    z_m: Float32
    sigma_m: Float32
    views: Float32
    source: UInt8
    cell_m: float
    left_m: float
    top_m: float
    step: int


@dataclass(frozen=True)
class Strip:
    """A strip of a map: the picture as a data URI and the rectangle that it covers (m)."""

    image: str
    x_min_m: float
    x_max_m: float
    y_min_m: float
    y_max_m: float


def strip_count(width: int, height: int) -> int:
    """Choose the number of strips along X into which a map of this shape is folded."""
    aspect = width / max(height, 1)
    return 1 if aspect <= FOLD_ASPECT else min(MAX_STRIPS, int(np.ceil(aspect / (FOLD_ASPECT - 1))))


def read_raster(path: Path) -> Raster:
    """Read height.tif tile by tile: memory holds the small map and a few tiles, whatever its size.

    Raises InputError if the file is damaged or is not a map of four bands.
    """
    with open_geotiff(path, HEIGHT_BANDS) as file:
        return _reduce(file)


def _reduce(file: GeoTiff) -> Raster:
    height, width = file.size
    step = _choose_step(width, height)
    small = (-(-height // step), -(-width // step))
    sums = np.zeros((3, *small))
    counts = np.zeros((3, *small), np.int32)
    codes = np.zeros((HEIGHT_BANDS, *small), np.int32)
    for band, row, column, values in file.tiles():
        if band < 3:
            known = np.isfinite(values)
            _pool(np.where(known, values, 0), sums[band], row, column, step)
            _pool(known, counts[band], row, column, step)
        else:
            for code in (HeightSource.VISION, HeightSource.LASER, HeightSource.FILLED):
                _pool(values == code, codes[code], row, column, step)
    with np.errstate(invalid="ignore"):
        z, sigma, views = np.where(counts > 0, sums / counts, np.nan).astype(np.float32)
    source = codes.argmax(axis=0).astype(np.uint8)
    source[codes.sum(axis=0) == 0] = HeightSource.UNKNOWN
    views[(source == HeightSource.UNKNOWN) | (views <= 0)] = np.nan
    z[source == HeightSource.UNKNOWN] = np.nan
    return Raster(z, sigma, views, source, file.cell_m * step, file.left_m, file.top_m, step)


def _choose_step(width: int, height: int) -> int:
    strip = -(-width // strip_count(width, height))
    longest = max(strip, height)
    return max(1, -(-longest // MAX_SIDE_PX), int(np.ceil(np.sqrt(width * height / MAX_PIXELS))))


def _pool(values: NDArray[np.generic], into: NDArray[np.generic], row: int, column: int, step: int) -> None:
    """Add a segment, whose first cell is (row, column), to the sums of the blocks that it touches."""
    first_row, first_column = row // step, column // step
    rows = _block_starts(row, values.shape[0], step)
    columns = _block_starts(column, values.shape[1], step)
    kind = np.int32 if values.dtype == np.bool_ else np.float64
    part = np.add.reduceat(np.add.reduceat(values.astype(kind), rows, axis=0), columns, axis=1)
    target = into[first_row : first_row + part.shape[0], first_column : first_column + part.shape[1]]
    np.add(target, part, out=target, casting="unsafe")


def _block_starts(first: int, count: int, step: int) -> NDArray[np.int64]:
    """Find where new blocks begin in a run of cells that starts at `first`."""
    boundaries = np.arange((first // step + 1) * step, first + count, step) - first
    return np.concatenate([[0], boundaries]).astype(np.int64)


def colours(values: Float32, low: float, high: float, scale: int) -> UInt8:
    """Convert values to RGB (H, W, 3) on one of OpenCV's uniform colour scales; NaN gets the lowest one."""
    share = np.clip((np.nan_to_num(values, nan=low) - low) / max(high - low, 1e-9), 0, 1)
    painted = cv2.applyColorMap(np.round(share * 255).astype(np.uint8), scale)
    return np.asarray(painted[..., ::-1], dtype=np.uint8)


def gradient_stops(scale: int, count: int = 9) -> tuple[str, ...]:
    """Sample the colour scale as CSS colours from low to high."""
    ramp = colours(np.linspace(0, 1, count, dtype=np.float32)[None], 0.0, 1.0, scale)[0]
    return tuple(f"rgb({r},{g},{b})" for r, g, b in ramp.tolist())


def hillshade(z_m: Float32, cell_m: float, sigma_m: Float32 | float = 0.0) -> Float32:
    """Shade (H, W) by a light in the north-west at 45 degrees, 1 on a flat floor [Horn 1981]; NaN is flat.

    A slope s with noise n = _SLOPE_NOISE sigma_m / cell_m is weighted by s^2 / (s^2 + n^2) [Wiener 1949]; it
    is used in full if sigma is unknown.
    """
    known = np.isfinite(z_m)
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), 1.0)
    smooth = cv2.GaussianBlur(np.where(known, z_m, 0).astype(np.float32), (0, 0), 1.0)
    surface = np.where(known, smooth / np.maximum(weight, 1e-6), np.nan)
    with np.errstate(invalid="ignore"):
        east = np.gradient(surface, cell_m, axis=1) if surface.shape[1] > 1 else np.zeros_like(surface)
        north = -np.gradient(surface, cell_m, axis=0) if surface.shape[0] > 1 else np.zeros_like(surface)
        noise = (_SLOPE_NOISE / cell_m * np.nan_to_num(sigma_m, nan=0, posinf=0)) ** 2
        squares = east**2 + north**2
        gain = squares / np.maximum(squares + noise, 1e-12)
        east, north = gain * east, gain * north
    facing: Float64 = (1 + (east - north) / np.sqrt(2)) / np.sqrt(1 + east**2 + north**2)
    return np.nan_to_num(facing, nan=1.0).astype(np.float32)


def paint_height(raster: Raster, low_m: float, high_m: float) -> UInt8:
    """Paint (H, W, 4): colour by height, brightness by the hillshade; filled cells are tinted pink."""
    height, width = raster.z_m.shape
    painted = np.empty((height, width, 4), np.uint8)
    for first in range(0, height, _BAND_ROWS):
        end, above = min(first + _BAND_ROWS, height), min(first, _SHADE_REACH_PX)
        band = slice(first - above, min(end + _SHADE_REACH_PX, height))
        light = hillshade(raster.z_m[band], raster.cell_m, raster.sigma_m[band])[above:][: end - first]
        z_m, source = raster.z_m[first:end], raster.source[first:end]
        painted[first:end] = _paint_shaded(z_m, light, source, low_m, high_m)
    return painted


def _paint_shaded(z_m: Float32, light: Float32, source: UInt8, low_m: float, high_m: float) -> UInt8:
    """Paint (H, W, 4) with the given hillshade (H, W)."""
    base = colours(z_m, low_m, high_m, cv2.COLORMAP_VIRIDIS).astype(np.float32)
    light = np.clip(light, 0.0, 1.4)[..., None]
    shaded = np.where(light < 1, base * (0.35 + 0.65 * light), base + (255 - base) * (light - 1) * 0.9)
    filled = source == HeightSource.FILLED
    shaded[filled] = 0.3 * shaded[filled] + 0.7 * np.array(FILLED_TINT_RGB)
    return _with_alpha(shaded, np.isfinite(z_m))


def paint_scale(values: Float32, low: float, high: float, scale: int) -> UInt8:
    """Paint (H, W, 4) with a plain colour scale, transparent for NaN."""
    return _with_alpha(colours(values, low, high, scale), np.isfinite(values))


def paint_source(source: UInt8) -> UInt8:
    """Paint (H, W, 4): a colour for each source code, transparent if unknown."""
    picture = np.zeros((*source.shape, 3), np.uint8)
    for code, rgb in SOURCE_RGB.items():
        picture[source == code] = rgb
    return _with_alpha(picture, source != HeightSource.UNKNOWN)


def _with_alpha(rgb: NDArray[np.generic], opaque: NDArray[np.bool_]) -> UInt8:
    alpha = np.where(opaque, 255, 0).astype(np.uint8)
    return np.dstack([np.clip(rgb, 0, 255).astype(np.uint8), alpha])


def cut_strips(picture: UInt8, raster: Raster, *, lossless: bool) -> tuple[Strip, ...]:
    """Cut the picture into strips that fit a page, each a data URI of a WebP image."""
    height, width = picture.shape[:2]
    strips = []
    count = strip_count(width, height)
    breadth = -(-width // count)
    for left in range(0, width, breadth):
        part = picture[:, left : left + breadth]
        strips.append(
            Strip(
                image=data_uri(part, lossless=lossless),
                x_min_m=raster.left_m + left * raster.cell_m,
                x_max_m=raster.left_m + (left + part.shape[1]) * raster.cell_m,
                y_min_m=raster.top_m - height * raster.cell_m,
                y_max_m=raster.top_m,
            )
        )
    return tuple(strips)


def data_uri(rgba: UInt8, *, lossless: bool) -> str:
    """Encode a picture (H, W, 4) as a data URI; OpenCV's WebP takes a quality over 100 for lossless."""
    quality = 101 if lossless else 88
    bgra = np.ascontiguousarray(rgba[..., [2, 1, 0, 3]])
    encoded: UInt8 = cv2.imencode(".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, quality])[1]
    return "data:image/webp;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")


def preview_uri(path: Path) -> str:
    """Encode preview.png as a smaller data URI; empty if there is none.

    Raises InputError if it is damaged or too large.
    """
    if not path.is_file():
        return ""
    try:
        gray, colour = decode_with_colour(read_bytes(path, MAX_PICTURE_BYTES, MEASURE_AGAIN))
    except TornImageError as error:
        raise InputError(path, str(error), MEASURE_AGAIN) from None
    picture = np.dstack([gray, gray, gray]) if colour is None else colour
    opaque = np.full(picture.shape[:2], 255, np.uint8)
    return data_uri(np.dstack([picture[..., ::-1], opaque]).astype(np.uint8), lossless=False)


def robust_range(values: Float32 | Float64, low_pct: float, high_pct: float) -> tuple[float, float]:
    """Compute percentiles of the finite values; (0, 1) if there are none, and never an empty range."""
    known = values[np.isfinite(values)]
    if known.size == 0:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(known, (low_pct, high_pct)))
    return low, max(high, low + 1e-3)
