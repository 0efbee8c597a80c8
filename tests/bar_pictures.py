"""Pictures of bars side by side under a crane: rows of round bars along Y, all shaded alike."""

from __future__ import annotations

import numpy as np

from barsight.core.records.pairs import RectifiedCamera, RectifiedPair
from barsight.features.patch_alignment import PatchPair, patch_pair
from synthetic_scenes import Texture, quantised

CAMERA = RectifiedCamera(900.0, 320.0, 240.0, 0.4, 0.0, 640, 480)
RANGE_M = 6.0
SUB = 4
"""Rays a pixel along the row."""


def bar_view(pitch_m: float, x_m: float, contrast: float = 12.0, seed: int = 0) -> PatchPair:
    """Render the view of a rig whose left camera hangs `RANGE_M` above the bars' axes at x_m.

    contrast: the sigma of what tells one bar from the next, gray levels; the shading swings by 100.
    """
    whole = np.ones((CAMERA.height, CAMERA.width), np.bool_)
    left, right = (_picture(pitch_m, x_m + side, contrast, seed + k) for k, side in enumerate((0, 0.4)))
    return patch_pair(RectifiedPair(0, left, right, whole, whole, CAMERA))


def _picture(pitch_m: float, x_m: float, contrast: float, seed: int) -> np.ndarray:
    radius = pitch_m / 2
    reach = RANGE_M * CAMERA.width / CAMERA.focal_px
    x = np.linspace(x_m - reach, x_m + reach, 60_000)
    across = (x + radius) % pitch_m - radius  # from the nearest bar's axis
    height = np.sqrt(np.maximum(radius**2 - across**2, 0))
    z = RANGE_M - height
    u = CAMERA.focal_px * (x - x_m) / z + CAMERA.cx_px
    lit = np.maximum.accumulate(u) <= u  # a nearer bar hides what falls back
    columns = (np.arange(CAMERA.width * SUB) + 0.5) / SUB - 0.5
    x, z, up = (np.interp(columns, u[lit], q[lit]) for q in (x, z, height / radius))
    v = np.arange(CAMERA.height, dtype=float)[:, None]
    y = (v - CAMERA.cy_px) * z / CAMERA.focal_px
    per_m = CAMERA.focal_px / RANGE_M
    steel = (Texture(7)(x * per_m, y * per_m) - 128) / 40 * contrast
    picture = (50 + 100 * up + steel).reshape(CAMERA.height, CAMERA.width, SUB).mean(axis=2)
    return quantised(picture + np.random.default_rng(seed).normal(0, 1.5, picture.shape))
