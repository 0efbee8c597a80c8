"""Draw a small picture of a height map for notebooks."""

from __future__ import annotations

from base64 import b64encode

import cv2
import numpy as np

from barsight.core.arrays import Float32, Float64

_MAX_SIDE_PX = 900
"""Maximum length of the picture's longer side."""


def picture_html(x_m: Float64, y_m: Float64, z_m: Float32) -> str:
    """Draw heights (H, W) at x_m (W,), y_m (H,) in colours as an HTML figure: y upwards, unknown cells white,
    the range of heights below.
    """
    known = np.isfinite(z_m)
    if not known.any():
        return "<p>height map: nothing is known</p>"
    low, high = (float(level) for level in np.percentile(z_m[known], (1, 99)))
    levels = np.where(known, (z_m - low) / max(high - low, 1e-6) * 255, 0).clip(0, 255)
    colours = cv2.applyColorMap(levels.astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    colours[~known] = 255
    scale = min(1.0, _MAX_SIDE_PX / max(z_m.shape))
    small = cv2.resize(colours[::-1], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    data = b64encode(cv2.imencode(".png", small)[1].tobytes()).decode()
    return (
        f'<figure><img alt="height map" src="data:image/png;base64,{data}"/>'
        f"<figcaption>x {x_m[0]:.2f} to {x_m[-1]:.2f} m, y {y_m[0]:.2f} to {y_m[-1]:.2f} m, "
        f"height {low:.2f} (dark) to {high:.2f} m (light), {100 * known.mean():.0f} % known</figcaption>"
        "</figure>"
    )
