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
    """rgb: (N, 3) uint8. ramp: (256, 3) uint8, the colours from `low` to `high`, both in `unit`."""

    rgb: UInt8
    ramp: UInt8
    low: float
    high: float
    unit: str


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
        "intensity": (cloud.intensity, None, "grey levels"),
        "sigma": (cloud.sigma_m * 1e3, cv2.COLORMAP_MAGMA, "mm"),
        "views": (cloud.views, cv2.COLORMAP_CIVIDIS, "views"),
    }[by]
    ramp = _ramp(scale)
    low, high = (float(v) for v in np.nanpercentile(values, (1, 99)))
    share = np.clip((values - low) / max(high - low, 1e-6), 0, 1)
    levels = np.round(np.nan_to_num(share) * 255).astype(np.uint8)
    return Colouring(ramp[levels], ramp, low, high, unit)


def _ramp(scale: int | None) -> UInt8:
    """(256, 3) RGB from low to high on one of OpenCV's scales; None is grey."""
    levels = np.arange(256, dtype=np.uint8)[:, None]
    painted = np.repeat(levels, 3, axis=1) if scale is None else cv2.applyColorMap(levels, scale)[:, 0, ::-1]
    return np.ascontiguousarray(painted, dtype=np.uint8)
