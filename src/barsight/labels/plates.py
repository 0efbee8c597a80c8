"""Find bright plates of a label's size on bundles, in the orthophoto: labels that no picture could read."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, YardMap

STEP_M = 0.01
BRIGHTER_RATIO, DARK_LEVEL = 1.6, 10.0
"""Gray level of a plate over the median of the bundle around it, and what is added to both."""
SIZE_RATIO = (0.5, 1.6)
"""A plate's sides over a label's; the map's cells and the code's own dark squares eat at its rim."""
MIN_FULL_RATIO = 0.6
"""Share of the smallest rectangle around a plate that is bright."""


def find_plates(bundle: Bundle, heights: YardMap, size_m: tuple[float, float]) -> list[Float64]:
    """Find the middles (2,) of bright rectangles of about size_m on a bundle's top, m; none without an
    orthophoto.
    """
    across = np.arange(-bundle.width_m / 2, bundle.width_m / 2 + STEP_M / 2, STEP_M)
    along = np.arange(-bundle.length_m / 2, bundle.length_m / 2 + STEP_M / 2, STEP_M)
    c, s = np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad)
    x = bundle.centre_m[0] + c * across[None] - s * along[:, None]
    y = bundle.centre_m[1] + s * across[None] + c * along[:, None]
    part = part_about(heights, x.ravel(), y.ravel())
    if part.gray is None or not part.gray.any():
        return []
    rows = np.rint((y - part.y0_m) / part.cell_m).astype(np.int64).clip(0, part.shape[0] - 1)
    columns = np.rint((x - part.x0_m) / part.cell_m).astype(np.int64).clip(0, part.shape[1] - 1)
    gray = part.gray[rows, columns].astype(np.float64)
    limit = BRIGHTER_RATIO * (float(np.median(gray[gray > 0])) + DARK_LEVEL) - DARK_LEVEL
    bright = (gray >= limit).astype(np.uint8)
    bright = cv2.morphologyEx(bright, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, numbers = cv2.connectedComponents(bright)
    found = []
    for number in range(1, count):
        i, j = np.nonzero(numbers == number)
        (_, _), sides, _ = cv2.minAreaRect(np.stack([j, i], axis=1).astype(np.float32))
        sides = (np.sort(sides)[::-1] + 1) * STEP_M
        ratio = sides / np.sort(size_m)[::-1]
        full = i.size * STEP_M**2 / np.prod(sides)
        if (ratio >= SIZE_RATIO[0]).all() and (ratio <= SIZE_RATIO[1]).all() and full >= MIN_FULL_RATIO:
            middle = round(float(i.mean())), round(float(j.mean()))
            found.append(np.array([x[middle], y[middle]]))
    return found
