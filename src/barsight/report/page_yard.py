"""Draw bundles and lifts on the orthophoto and on the height map, with their tables."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from barsight.core.arrays import UInt8
from barsight.core.errors import MEASURE_AGAIN, InputError
from barsight.core.reading.bounded_reading import read_bytes
from barsight.core.records.gray_levels import TornImageError
from barsight.recording.image_decoding import MAX_PICTURE_BYTES, decode_gray
from barsight.report.map_images import Raster, paint_height, robust_range
from barsight.report.page_maps import LARGE_TEXT, Drawing, Key, MapFigure, Shape, draw_map
from barsight.yard.axes import axes_of, corners
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.lifting.lift_file import read_lifts, read_unseen
from barsight.yard.types import Bundle

FREE_RGB, COVERED_RGB, LIFT_RGB = "#39d353", "#f2b134", "#ff2fb3"


@dataclass(frozen=True)
class YardPart:
    """Part of the page on bundles and lifts. lifts: content of lifts.json, None if there is none. unseen:
    sentences on what would show what was not seen of the refused ones.
    """

    figures: tuple[MapFigure, ...]
    bundles: tuple[Bundle, ...]
    lifts: dict[str, Any] | None
    unseen: tuple[str, ...]


def yard_pictures(out_dir: Path, raster: Raster) -> tuple[MapFigure, ...]:
    """Draw the orthophoto, if there is one, and the height map, without bundles and lifts; none if the folder
    has no bundles.json.
    """
    if not (out_dir / "bundles.json").is_file():
        return ()
    keys = (
        Key("bundle, free", FREE_RGB), Key("bundle, covered or not known", COVERED_RGB),
        Key("magnet of an offered lift, its rank", LIFT_RGB),
    )  # fmt: skip
    low, high = robust_range(raster.z_m, 1, 99)
    pictures = [("yard-height", "Bundles and lifts on the height map", paint_height(raster, low, high))]
    if (out_dir / "ortho.png").is_file():
        photo = _orthophoto(out_dir / "ortho.png", raster)
        pictures.insert(0, ("yard-ortho", "Bundles and lifts on the orthophoto", photo))
    caption = (
        "Outline and axis of each bundle with its number, an open end dashed; the magnet's poles where a "
        "lift is offered. The coordinates are those of lifts.json."
    )
    return tuple(
        MapFigure(name, title, caption, draw_map(picture, raster, (), LARGE_TEXT), None, keys)
        for name, title, picture in pictures
    )


def yard_part(out_dir: Path, pictures: tuple[MapFigure, ...]) -> YardPart | None:
    """Collect bundles and lifts and draw them on the pictures; None if the folder has no bundles.json."""
    if not (out_dir / "bundles.json").is_file():
        return None
    bundles = read_bundles(out_dir / "bundles.json")
    lifts = read_lifts(out_dir / "lifts.json") if (out_dir / "lifts.json").is_file() else None
    shapes = (*bundle_shapes(bundles), *(lift_shapes(lifts) if lifts else ()))
    figures = tuple(
        replace(figure, drawings=tuple(_with(drawing, shapes) for drawing in figure.drawings))
        for figure in pictures
    )
    unseen = read_unseen(lifts) if lifts else None
    return YardPart(figures, bundles, lifts, unseen.sentences if unseen else ())


def _orthophoto(path: Path, raster: Raster) -> UInt8:
    """Resample the orthophoto (H, W, 4) to the raster's size, transparent where nothing was seen."""
    step, (rows, columns) = raster.step, raster.z_m.shape
    try:
        gray = decode_gray(
            read_bytes(path, MAX_PICTURE_BYTES, MEASURE_AGAIN), max_pixels=rows * columns * step**2
        )
    except TornImageError as error:
        raise InputError(path, str(error), MEASURE_AGAIN) from None
    whole = np.zeros((rows * step, columns * step), np.uint8)
    whole[: gray.shape[0], : gray.shape[1]] = gray[: rows * step, : columns * step]
    small = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    bright = np.clip(small.astype(np.float32) * (235 / max(np.percentile(small[small > 0], 99), 1)
                     if (small > 0).any() else 1), 0, 255).astype(np.uint8)  # fmt: skip
    return np.dstack([bright, bright, bright, np.where(small > 0, 255, 0).astype(np.uint8)])


def _with(drawing: Drawing, shapes: tuple[Shape, ...]) -> Drawing:
    """Add the shapes that touch the drawing, in its own units."""
    scale, (x0, y1) = drawing.scale, drawing.corner_m
    inside = []
    for shape in shapes:
        x = drawing.x + (np.array([p[0] for p in shape.points]) - x0) * scale
        y = drawing.y + (y1 - np.array([p[1] for p in shape.points])) * scale
        if x.max() > drawing.x and x.min() < drawing.x + drawing.width:
            inside.append(replace(shape, points=tuple(zip(x.tolist(), y.tolist(), strict=True))))
    return replace(drawing, shapes=tuple(inside))


def bundle_shapes(bundles: tuple[Bundle, ...]) -> tuple[Shape, ...]:
    """Draw outline and axis of each bundle, in m; open ends are dashed."""
    shapes = []
    for bundle in bundles:
        colour = FREE_RGB if bundle.is_free else COVERED_RGB
        outline = bundle.corners_m.tolist()
        low, high = bundle.ends_m[:, :2].tolist()
        for a, b, dashed in (
            (outline[0], outline[1], bundle.ends_open[0]), (outline[1], outline[2], False),
            (outline[2], outline[3], bundle.ends_open[1]), (outline[3], outline[0], False),
        ):  # fmt: skip
            shapes.append(Shape((tuple(a), tuple(b)), colour, 1.6, dashed))
        shapes.append(Shape((tuple(low), tuple(high)), colour, 0.8, False, str(bundle.id)))
    return tuple(shapes)


def lift_shapes(lifts: dict[str, Any]) -> tuple[Shape, ...]:
    """Draw the magnet's poles at each offered lift, with its rank."""
    shapes = []
    for lift in lifts["lifts"]:
        label = f"#{lift['rank']}"
        target = lift["target"]
        yaw_rad = math.radians(target["yaw_deg"])
        across, along = axes_of(yaw_rad)
        for pole in lifts["magnet"]["poles"]:
            centre = (target["x_m"], target["y_m"]) + pole["across_m"] * across + pole["along_m"] * along
            points = tuple(map(tuple, corners(centre, yaw_rad, pole["width_m"], pole["length_m"]).tolist()))
            shapes.append(Shape((*points, points[0]), LIFT_RGB, 2.2, False, label))
            label = ""
    return tuple(shapes)
