"""Draw a small picture of a height map for notebooks."""

from __future__ import annotations

from base64 import b64encode
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from barsight.yard.types import HeightMap

_WIDEST_PX = 900


def picture_html(heights: HeightMap) -> str:
    """Return an `img` element of the heights in colours, y upwards, unknown cells white, with its scale
    beneath.
    """
    known = np.isfinite(heights.z_m)
    if not known.any():
        return "<p>height map: nothing is known</p>"
    low, high = (float(level) for level in np.percentile(heights.z_m[known], (1, 99)))
    levels = np.where(known, (heights.z_m - low) / max(high - low, 1e-6) * 255, 0).clip(0, 255)
    colours = cv2.applyColorMap(levels.astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    colours[~known] = 255
    scale = min(1.0, _WIDEST_PX / max(heights.shape))
    small = cv2.resize(colours[::-1], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    data = b64encode(cv2.imencode(".png", small)[1].tobytes()).decode()
    x, y = heights.x_m, heights.y_m
    return (
        f'<figure><img alt="height map" src="data:image/png;base64,{data}"/>'
        f"<figcaption>x {x[0]:.2f} to {x[-1]:.2f} m, y {y[0]:.2f} to {y[-1]:.2f} m, "
        f"height {low:.2f} (dark) to {high:.2f} m (light), {100 * known.mean():.0f} % known</figcaption>"
        "</figure>"
    )
