"""The cloud as the viewer shows it: thinned to a budget and coloured by one of its properties."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from plyfile import PlyData, PlyParseError

from barsight.core.arrays import Float32, UInt8
from barsight.core.errors import InputError

PROPERTIES = ("x", "y", "z", "intensity", "sigma_z", "views")
COLOURINGS = ("height", "intensity", "sigma", "views")


@dataclass(frozen=True, eq=False)
class Cloud:
    """xyz_m: (N, 3) float32. intensity, sigma_m, views: (N,) float32. total: points in the file."""

    xyz_m: Float32
    intensity: Float32
    sigma_m: Float32
    views: Float32
    total: int


@dataclass(frozen=True, eq=False)
class Colouring:
    """rgb: (N, 3) uint8. The colours run from `low` to `high` in `unit`; `scale` is OpenCV's number."""

    rgb: UInt8
    low: float
    high: float
    unit: str
    scale: int


def read_cloud(path: Path, most_points: int) -> Cloud:
    """cloud.ply, of which at most `most_points` evenly drawn points are read from disk.

    Raises InputError where the file is missing, torn, empty or has other properties than formats.md says.
    """
    remedy = "measure the recording again"
    if not path.is_file():
        raise InputError(path, "no such file", remedy)
    try:
        vertex = PlyData.read(path)["vertex"]
    except (PlyParseError, KeyError, ValueError, OSError) as error:
        raise InputError(path, f"is torn ({error})", remedy) from error
    data = vertex.data
    missing = [name for name in PROPERTIES if name not in (data.dtype.names or ())]
    if missing:
        raise InputError(path, f"has no property {missing[0]}", remedy)
    if data.size == 0:
        raise InputError(path, "has no points", remedy)
    count = min(int(data.size), most_points)
    drawn = data[np.arange(count) * data.size // count]
    column = {name: np.asarray(drawn[name], dtype=np.float32) for name in PROPERTIES}
    return Cloud(
        np.stack([column["x"], column["y"], column["z"]], axis=1),
        column["intensity"],
        column["sigma_z"],
        column["views"],
        int(data.size),
    )


def colour(cloud: Cloud, by: str) -> Colouring:
    """Colour the points by one of `COLOURINGS`; the ends of the scale leave out 1 % of outliers."""
    values, scale, unit = {
        "height": (cloud.xyz_m[:, 2] * 1e3, cv2.COLORMAP_VIRIDIS, "mm"),
        "intensity": (cloud.intensity, cv2.COLORMAP_BONE, "grey levels"),
        "sigma": (cloud.sigma_m * 1e3, cv2.COLORMAP_MAGMA, "mm"),
        "views": (cloud.views, cv2.COLORMAP_CIVIDIS, "views"),
    }[by]
    low, high = (float(v) for v in np.nanpercentile(values, (1, 99)))
    share = np.clip((values - low) / max(high - low, 1e-6), 0, 1)
    levels = np.round(np.nan_to_num(share) * 255).astype(np.uint8)
    painted = cv2.applyColorMap(levels[:, None], scale)[:, 0, ::-1]
    return Colouring(np.ascontiguousarray(painted, dtype=np.uint8), low, high, unit, scale)


def ramp(scale: int) -> UInt8:
    """(12, 256, 3) RGB: the colour scale as a picture, low at the left."""
    levels = np.tile(np.arange(256, dtype=np.uint8), (12, 1))
    return np.ascontiguousarray(cv2.applyColorMap(levels, scale)[..., ::-1], dtype=np.uint8)
