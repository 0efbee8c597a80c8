"""What the viewer shows as points: every height seen or the elected surface, coloured by a property."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Float32, UInt8
from barsight.core.types import Source
from barsight.result_folder import Cloud
from barsight.yard.types import HeightMap

SOURCE_RGB = {
    Source.VISION: ("vision", (46, 125, 190)),
    Source.LASER: ("laser", (90, 170, 60)),
    Source.FILLED: ("filled", (230, 120, 30)),
}


@dataclass(frozen=True, eq=False)
class Layer:
    """xyz_m: (N, 3) float32. properties: (N,) each, by the names that it can be coloured by (height and sigma
    in mm). total: points before thinning."""

    xyz_m: Float32
    properties: dict[str, Float32]
    total: int


@dataclass(frozen=True, eq=False)
class Colouring:
    """rgb: (N, 3) uint8. ramp: (256, 3) uint8, the scale's colours from left to right. caption: what they
    mean."""

    rgb: UInt8
    ramp: UInt8
    caption: str


def seen_layer(cloud: Cloud) -> Layer:
    """Every height that enough views support: sides and lower surfaces too."""
    values = {
        "height": cloud.xyz_m[:, 2] * 1e3,
        "intensity": cloud.intensity,
        "sigma": cloud.sigma_m * 1e3,
        "views": cloud.views,
    }
    return Layer(cloud.xyz_m, values, cloud.total)


def surface_layer(heights: HeightMap, most_points: int) -> Layer:
    """The known cells of the map, filled ones too, at most `most_points` of them, evenly drawn."""
    known = np.flatnonzero(heights.source.ravel() != Source.UNKNOWN)
    count = min(known.size, most_points)
    drawn = known[np.arange(count) * known.size // max(count, 1)]
    row, column = np.divmod(drawn, heights.z_m.shape[1])
    z, sigma, views, source = (
        np.asarray(band.ravel()[drawn], np.float32)
        for band in (heights.z_m, heights.sigma_m, heights.views, heights.source)
    )
    x, y = heights.x0_m + column * heights.cell_m, heights.y0_m + row * heights.cell_m
    xyz = np.column_stack([x, y, z]).astype(np.float32)
    return Layer(xyz, {"height": z * 1e3, "source": source, "sigma": sigma * 1e3, "views": views}, known.size)


def colour(layer: Layer, by: str) -> Colouring:
    """Colour the points by one of their properties; the ends of a scale leave out 1 % of outliers."""
    values = layer.properties[by]
    if by == "source":
        return _by_source(values)
    scale, unit = {
        "height": (cv2.COLORMAP_VIRIDIS, "mm"),
        "intensity": (None, "grey levels"),
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
    """(256, 3) RGB from low to high on one of OpenCV's scales; None is grey."""
    levels = np.arange(256, dtype=np.uint8)[:, None]
    painted = np.repeat(levels, 3, axis=1) if scale is None else cv2.applyColorMap(levels, scale)[:, 0, ::-1]
    return np.ascontiguousarray(painted, dtype=np.uint8)
