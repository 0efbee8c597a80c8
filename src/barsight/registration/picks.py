"""Find targets picked by hand in the left pictures again in the right ones, and place them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import cv2
import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.records.pairs import RectifiedPair, RefusedFrame, StereoFrame
from barsight.core.records.trajectory import PosedFrame
from barsight.registration.tags import SeenTags, TagSighting, sighting_at

HALF_PX = 10
"""Half-width of the patch around a pick that is searched for in the right picture."""
ROWS_PX = 2
"""Number of rows above and below a pick's own that are searched."""
PICKED_PX, MATCHED_PX = 0.7, 0.15
"""Standard deviation of a pick by hand, and of matching it in the right picture."""
MIN_DISPARITY_PX = 1.0
"""Minimum disparity; with less, the matching error is a large part of it."""
MIN_ALIKE, MAX_RIVAL = 0.75, 0.95
"""Minimum correlation of a patch at the match, and maximum correlation elsewhere as a ratio to it."""


def see_picks(
    frames: Iterable[StereoFrame | RefusedFrame], rectifier: Rectifier, posed: Mapping[int, PosedFrame],
    picks: Mapping[int, Mapping[int, Float64]], names: tuple[str, ...], count: Callable[[], None],
) -> tuple[SeenTags, tuple[str, ...]]:  # fmt: skip
    """Place the picks of the raw pairs whose pose is known; also return messages about those not found again.

    picks: by stamp and target, pixel (2,) in the left picture. The error of picking is common to both
    pictures, so it shifts a target sideways; its height depends on how precisely the right picture is
    matched.
    """
    seen, lost = SeenTags(names=names, known_px=1.0), list[str]()
    for frame in frames:
        pair = rectifier(frame) if isinstance(frame, StereoFrame) else None
        if isinstance(pair, RectifiedPair):
            seen.pairs += 1
            for number, pixel in picks.get(pair.stamp_ns, {}).items():
                found = _sighted(pair, rectifier, posed[pair.stamp_ns], pixel)
                if isinstance(found, Failed):
                    lost.append(f"{seen.name(number)} at {pair.stamp_ns}: {found.reason}")
                else:
                    seen.sightings.setdefault(number, []).append(found)
        count()
    return seen, tuple(lost)


def _sighted(
    pair: RectifiedPair, rectifier: Rectifier, frame: PosedFrame, pixel: Float64
) -> TagSighting | Failed:
    flat = rectifier.places(pixel[None], pixel[None])[0][0]
    found = find_right(pair, flat)
    if isinstance(found, Failed):
        return found
    camera = pair.camera
    disparity, row = flat[0] - found[0] + camera.doffs_px, found[1] - flat[1]
    if disparity < MIN_DISPARITY_PX:
        return Failed("no-match", "lies out of range")
    depth = camera.focal_px * camera.baseline_m / disparity
    across = np.array([flat[0] - camera.cx_px, flat[1] - camera.cy_px]) / camera.focal_px
    ray, aside = np.append(across, 1.0), PICKED_PX * depth / camera.focal_px
    deep = MATCHED_PX * depth / disparity * ray
    noise = np.outer(deep, deep) + np.diag([aside**2, aside**2, 0.0])
    return sighting_at(depth * ray, noise, float(row), 2.0 * HALF_PX, rectifier, frame)


def find_right(pair: RectifiedPair, flat: Float64) -> Float64 | Failed:
    """Match a rectified left pixel (2,) in the right picture, to a fraction of a pixel, by the patch around
    it.

    Failed `out-of-sight` near the picture's edge, `no-match` where nothing is alike or two places are.
    """
    height, width = pair.left.shape
    x, y = (int(v) for v in np.rint(flat))
    rows = y - HALF_PX - ROWS_PX, y + HALF_PX + ROWS_PX + 1
    if not (HALF_PX <= x < width - HALF_PX and rows[0] >= 0 and rows[1] <= height):
        return Failed("out-of-sight", f"lies within {HALF_PX + ROWS_PX} pixels of the picture's edge")
    patch = pair.left[y - HALF_PX : y + HALF_PX + 1, x - HALF_PX : x + HALF_PX + 1]
    last = min(int(x + pair.camera.doffs_px) + HALF_PX + 1, width)
    strip = pair.right[rows[0] : rows[1], : max(last, 0)]
    if strip.shape[1] < patch.shape[1] or patch.std() < 2:
        return Failed("no-match", "nothing shows there that could be found again")
    alike = cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED)
    v, u = (int(k) for k in np.unravel_index(int(alike.argmax()), alike.shape))
    best = float(alike[v, u])
    others = alike.copy()
    others[:, max(u - HALF_PX, 0) : u + HALF_PX + 1] = -1
    if best < MIN_ALIKE or others.max() > MAX_RIVAL * best:
        why = "isn't found in the right picture" if best < MIN_ALIKE else "looks like another place beside it"
        return Failed("no-match", why)
    return np.array([
        u + HALF_PX + _vertex(alike[v], u) + flat[0] - x,
        v - ROWS_PX + y + _vertex(alike[:, u], v) + flat[1] - y,
    ])  # fmt: skip


def _vertex(values: Float64, k: int) -> float:
    """Interpolate the offset of a maximum from its index k, by a parabola."""
    if not 0 < k < len(values) - 1:
        return 0.0
    low, middle, high = (float(value) for value in values[k - 1 : k + 2])
    bend = low - 2 * middle + high
    return 0.5 * (low - high) / bend if bend < 0 else 0.0
