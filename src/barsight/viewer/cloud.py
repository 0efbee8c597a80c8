"""The cloud as the viewer shows it: thinned to a budget and coloured by one of its properties."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import UInt8
from barsight.result_folder import Cloud

COLOURINGS = ("height", "intensity", "sigma", "views")


@dataclass(frozen=True, eq=False)
class Colouring:
    """rgb: (N, 3) uint8. ramp: (256, 3) uint8, the colours from `low` to `high`, both in `unit`."""

    rgb: UInt8
    ramp: UInt8
    low: float
    high: float
    unit: str


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
