"""Build the viewer's points: all measured heights or the map's surface, coloured by a property."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Float32, UInt8
from barsight.core.records.heights import HeightSource
from barsight.result_folder import Cloud
from barsight.yard.sections import patches
from barsight.yard.types import YardMap

SOURCE_RGB = {
    HeightSource.VISION: ("vision", (46, 125, 190)),
    HeightSource.LASER: ("laser", (90, 170, 60)),
    HeightSource.FILLED: ("filled", (230, 120, 30)),
}
"""Name and colour of each source."""
_PATCH_CELLS = 2048
"""Side, in cells, of the squares in which a map is read."""


@dataclass(frozen=True, eq=False)
class Layer:
    """xyz_m: (N, 3) float32. properties: (N,) each, by name, for colouring (height and sigma in mm). total:
    number of points before thinning.
    """

    xyz_m: Float32
    properties: dict[str, Float32]
    total: int


@dataclass(frozen=True, eq=False)
class Colouring:
    """rgb: (N, 3) uint8. ramp: (256, 3) uint8, the colour scale from left to right. caption: its meaning."""

    rgb: UInt8
    ramp: UInt8
    caption: str


def seen_layer(cloud: Cloud) -> Layer:
    """Collect every height supported by enough views, including sides and lower surfaces."""
    values = {
        "height": cloud.xyz_m[:, 2] * 1e3,
        "intensity": cloud.intensity,
        "sigma": cloud.sigma_m * 1e3,
        "views": cloud.views,
    }
    return Layer(cloud.xyz_m, values, cloud.total)


def surface_layer(yard: YardMap, max_points: int) -> Layer:
    """Collect at most `max_points` evenly drawn known cells of the map, including filled ones."""
    cuts = list(patches(yard, _PATCH_CELLS))
    known = np.cumsum([0, *((yard.part(*cut).source != HeightSource.UNKNOWN).sum() for cut in cuts)])
    total = int(known[-1])
    count = min(total, max_points)
    drawn = np.arange(count) * total // max(count, 1)
    parts = [np.empty((6, 0), np.float32)]
    for cut, first, last in zip(cuts, known, known[1:], strict=False):
        if first == last:
            continue
        part = yard.part(*cut)
        row, column = np.nonzero(part.source != HeightSource.UNKNOWN)
        own = drawn[(drawn >= first) & (drawn < last)] - first
        cells = row[own], column[own]
        x, y = part.x0_m + part.cell_m * column[own], part.y0_m + part.cell_m * row[own]
        figures = (band[cells] for band in (part.z_m, part.sigma_m, part.views, part.source))
        parts.append(np.stack([x, y, *figures]).astype(np.float32))
    x, y, z, sigma, views, source = np.concatenate(parts, axis=1)
    values = {"height": z * 1e3, "source": source, "sigma": sigma * 1e3, "views": views}
    return Layer(np.column_stack([x, y, z]), values, total)


def colour_layer(layer: Layer, by: str) -> Colouring:
    """Colour the points by one of their properties; 1 % of outliers are outside the colour scale."""
    values = layer.properties[by]
    if by == "source":
        return _by_source(values)
    scale, unit = {
        "height": (cv2.COLORMAP_VIRIDIS, "mm"),
        "intensity": (None, "gray levels"),
        "sigma": (cv2.COLORMAP_MAGMA, "mm"),
        "views": (cv2.COLORMAP_CIVIDIS, "views"),
    }[by]
    ramp = _ramp(scale)
    low, high = (float(v) for v in np.nanpercentile(values, (1, 99)))
    share = np.clip((values - low) / max(high - low, 1e-6), 0, 1)
    levels = np.round(np.nan_to_num(share) * 255).astype(np.uint8)
    return Colouring(ramp[levels], ramp, f"{low:.4g} to {high:.4g} {unit}")


def _by_source(codes: Float32) -> Colouring:
    table = np.zeros((256, 3), np.uint8)
    for code, (_, rgb) in SOURCE_RGB.items():
        table[code] = rgb
    present = [code for code in SOURCE_RGB if (codes == code).any()]
    bands = np.array_split(np.arange(256), max(len(present), 1))
    ramp = np.zeros((256, 3), np.uint8)
    told = []
    for code, band in zip(present, bands, strict=False):
        ramp[band] = SOURCE_RGB[code][1]
        told.append(f"{SOURCE_RGB[code][0]} {100 * (codes == code).mean():.1f} %")
    return Colouring(table[codes.astype(np.uint8)], ramp, ", ".join(told))


def _ramp(scale: int | None) -> UInt8:
    """Sample (256, 3) RGB from low to high on one of OpenCV's scales; None for gray."""
    levels = np.arange(256, dtype=np.uint8)[:, None]
    painted = np.repeat(levels, 3, axis=1) if scale is None else cv2.applyColorMap(levels, scale)[:, 0, ::-1]
    return np.ascontiguousarray(painted, dtype=np.uint8)
