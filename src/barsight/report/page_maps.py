"""Lay out the page's maps for SVG: pictures of the height map with axes, a colour bar and a key."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import UInt8
from barsight.core.records.heights import HeightSource
from barsight.core.records.sensor_samples import LaserProfile
from barsight.report.map_images import (
    FILLED_TINT_RGB,
    SOURCE_RGB,
    Raster,
    Strip,
    cut_strips,
    gradient_stops,
    paint_height,
    paint_scale,
    paint_source,
    robust_range,
)

WIDTH, MAX_HEIGHT = 1000.0, 680.0
"""Width of a drawing and maximum height of its map, in drawing units."""
LARGE_TEXT, SMALL_MAP_TEXT = 13.0, 32.0
"""Font sizes in drawing units; the three smaller maps are shown at a third of the size."""


@dataclass(frozen=True)
class Tick:
    """A tick on an axis: its position in the drawing and its label."""

    place: float
    label: str


@dataclass(frozen=True)
class MapLine:
    """A dashed line across the map, for a laser profile."""

    place: float
    label: str


@dataclass(frozen=True)
class Shape:
    """A line over a map, in m or in drawing units, with an optional label at its middle."""

    points: tuple[tuple[float, float], ...]
    colour: str
    width: float
    dashed: bool = False
    label: str = ""

    @property
    def path(self) -> str:
        """Format the points as an SVG path."""
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in self.points)

    @property
    def middle(self) -> tuple[float, float]:
        """Return the label's position."""
        low, high = np.min(self.points, axis=0), np.max(self.points, axis=0)
        return float((low[0] + high[0]) / 2), float((low[1] + high[1]) / 2)


@dataclass(frozen=True)
class Drawing:
    """One strip of a map in SVG units, WIDTH wide. scale: units per m; corner_m: x, y of its upper left."""

    image: str
    x: float
    y: float
    width: float
    height: float
    total_height: float
    text_size: float
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    levels: tuple[MapLine, ...]
    scale: float
    corner_m: tuple[float, float]
    shapes: tuple[Shape, ...] = ()


@dataclass(frozen=True)
class ColourBar:
    """CSS colours from low to high with labels at equal distances."""

    stops: tuple[str, ...]
    labels: tuple[str, ...]
    unit: str


@dataclass(frozen=True)
class Key:
    """A legend entry: the colour of a kind of cell, or no colour for the hatch of unknown cells."""

    label: str
    colour: str = ""


@dataclass(frozen=True)
class MapFigure:
    """A map with everything drawn around it."""

    name: str
    title: str
    caption: str
    drawings: tuple[Drawing, ...]
    bar: ColourBar | None
    keys: tuple[Key, ...]


UNKNOWN_KEY = Key("unknown")


def map_figures(raster: Raster, laser: tuple[LaserProfile, ...]) -> tuple[MapFigure, ...]:
    """Draw height first, then sigma, views and source."""
    low, high = robust_range(raster.z_m, 1, 99)
    scaled = f" Each pixel is the mean of {raster.step} × {raster.step} cells." if raster.step > 1 else ""
    levels = tuple((f"profile {p.profile}", float(np.median(p.y_m))) for p in laser if p.y_m.size)
    tint = Key("filled", "rgb({},{},{})".format(*FILLED_TINT_RGB))
    height = MapFigure(
        "height",
        "Height",
        "Height above z = 0, lit from the upper left. The colours end at the 1st and 99th percentile."
        + (" Dashed: laser profiles." if levels else "")
        + scaled,
        draw_map(paint_height(raster, low, high), raster, levels, LARGE_TEXT),
        _bar(low * 1e3, high * 1e3, cv2.COLORMAP_VIRIDIS, "mm"),
        (tint, UNKNOWN_KEY),
    )
    _, worst = robust_range(raster.sigma_m[HeightSource.measured(raster.source)], 1, 95)
    sigma = MapFigure(
        "sigma",
        "Uncertainty",
        "One standard deviation of the height; the colours end at the seen cells' 95th percentile." + scaled,
        draw_map(paint_scale(raster.sigma_m, 0, worst, cv2.COLORMAP_MAGMA), raster, (), SMALL_MAP_TEXT),
        _bar(0, worst * 1e3, cv2.COLORMAP_MAGMA, "mm"),
        (UNKNOWN_KEY,),
    )
    most = 4 * np.ceil(robust_range(raster.views, 0, 100)[1] / 4)
    views = MapFigure(
        "views",
        "Views",
        "How many frames support the height of a cell." + scaled,
        draw_map(paint_scale(raster.views, 0, most, cv2.COLORMAP_CIVIDIS), raster, (), SMALL_MAP_TEXT),
        _bar(0, most, cv2.COLORMAP_CIVIDIS, "views"),
        (UNKNOWN_KEY,),
    )
    names = {HeightSource.VISION: "vision", HeightSource.LASER: "laser", HeightSource.FILLED: "filled"}
    source = MapFigure(
        "source",
        "Source",
        "Where each cell's height comes from; filled cells were not seen." + scaled,
        draw_map(paint_source(raster.source), raster, (), SMALL_MAP_TEXT, lossless=True),
        None,
        (*(Key(names[code], "rgb({},{},{})".format(*rgb)) for code, rgb in SOURCE_RGB.items()), UNKNOWN_KEY),
    )
    return height, sigma, views, source


def draw_map(
    picture: UInt8,
    raster: Raster,
    levels: tuple[tuple[str, float], ...],
    text: float,
    *,
    lossless: bool = False,
) -> tuple[Drawing, ...]:
    """Draw a picture in strips with axes around them.

    levels: label and y (m) of lines across; text: font size.
    """
    strips = cut_strips(picture, raster, lossless=lossless)
    widest = max(strip.x_max_m - strip.x_min_m for strip in strips)
    tall = raster.z_m.shape[0] * raster.cell_m
    scale = min((WIDTH - 5.6 * text) / widest, MAX_HEIGHT / tall)
    return tuple(_drawing(strip, scale, levels, text) for strip in strips)


def _drawing(strip: Strip, scale: float, levels: tuple[tuple[str, float], ...], text: float) -> Drawing:
    """Lay out one strip; `scale` is drawing units per metre."""
    left, top = 4.6 * text, 0.8 * text
    height = (strip.y_max_m - strip.y_min_m) * scale
    return Drawing(
        image=strip.image,
        x=left,
        y=top,
        width=(strip.x_max_m - strip.x_min_m) * scale,
        height=height,
        total_height=top + height + 3.2 * text,
        text_size=text,
        x_ticks=tuple(
            Tick(left + (value - strip.x_min_m) * scale, label)
            for value, label in _ticks(strip.x_min_m, strip.x_max_m, 6 * text / scale)
        ),
        y_ticks=tuple(
            Tick(top + (strip.y_max_m - value) * scale, label)
            for value, label in _ticks(strip.y_min_m, strip.y_max_m, 2.5 * text / scale)
        ),
        levels=tuple(
            MapLine(top + (strip.y_max_m - y) * scale, label)
            for label, y in levels
            if strip.y_min_m < y < strip.y_max_m
        ),
        scale=scale,
        corner_m=(strip.x_min_m, strip.y_max_m),
    )


def _ticks(low: float, high: float, min_step: float) -> list[tuple[float, str]]:
    """Choose round values between low and high, at least `min_step` apart."""
    power = 10.0 ** np.floor(np.log10(min_step))
    step = next(power * factor for factor in (1, 2, 5, 10, 20) if power * factor >= min_step)
    decimals = max(0, int(-np.floor(np.log10(step) + 1e-9)))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [(k * step, f"{k * step:.{decimals}f}".replace("-", "−")) for k in range(first, last + 1)]


def _bar(low: float, high: float, scale: int, unit: str) -> ColourBar:
    decimals = 0 if high - low >= 8 else 1
    labels = tuple(f"{value:.{decimals}f}".replace("-", "−") for value in np.linspace(low, high, 5))
    return ColourBar(gradient_stops(scale), labels, unit)
