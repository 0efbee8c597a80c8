"""Draw bundles as boxes with axes, and the magnet's poles at each offered lift, as line segments."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.arrays import Float32, Float64
from barsight.yard.axes import axes_of
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.lifting.lift_file import read_lifts
from barsight.yard.types import Bundle

POLE_HEIGHT_M = 0.15
"""Height in metres of a pole drawn above its face."""
_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]


def yard_lines(out_dir: Path) -> dict[str, Float32]:
    """Collect segments (N, 2, 3) by name: boxes of free and covered bundles, axes, poles; absent ones are
    left out.
    """
    lines: dict[str, list[Float64]] = {"free": [], "covered": [], "axes": [], "poles": []}
    if (out_dir / "bundles.json").is_file():
        for bundle in read_bundles(out_dir / "bundles.json"):
            lines["free" if bundle.is_free else "covered"].append(bundle_box(bundle))
            lines["axes"].append(bundle.ends_m[None])
    if (out_dir / "lifts.json").is_file():
        lifts = read_lifts(out_dir / "lifts.json")
        lines["poles"] += [pole_boxes(lift, lifts["magnet"]["poles"]) for lift in lifts["lifts"]]
    return {name: np.concatenate(parts).astype(np.float32) for name, parts in lines.items() if parts}


def bundle_box(bundle: Bundle) -> Float64:
    """Compute edges (12, 2, 3) of the box around a bundle: its width, its length, and its width as the
    height.
    """
    along = bundle.direction
    across = np.append(bundle.axes[0], 0.0)
    up = np.cross(across, along)
    middle = bundle.centre_m + up * (bundle.top_z_m - bundle.centre_m[2] - bundle.width_m / 2)
    half = bundle.width_m / 2
    return _box(middle, across * half, along * bundle.length_m / 2, up * half)


def pole_boxes(lift: dict[str, Any], poles: list[dict[str, float]]) -> Float64:
    """Compute edges (12 * P, 2, 3) of the poles at their places."""
    target = lift["target"]
    rises = np.tan(np.radians([lift["roll_deg"], lift["pitch_deg"]]))
    across, along = np.column_stack([axes_of(math.radians(target["yaw_deg"])), rises])
    up = np.array([0.0, 0.0, POLE_HEIGHT_M / 2])
    origin = np.array([target["x_m"], target["y_m"], target["z_m"]]) + up
    boxes = [
        _box(
            origin + pole["along_m"] * along + pole["across_m"] * across,
            across * pole["width_m"] / 2,
            along * pole["length_m"] / 2,
            up,
        )
        for pole in poles
    ]
    return np.concatenate(boxes)


def _box(middle: Float64, a: Float64, b: Float64, c: Float64) -> Float64:
    """Compute edges (12, 2, 3) of a box from its centre and half sides."""
    corners = np.array([middle + s * c + p for s in (-1, 1) for p in (-a - b, a - b, a + b, b - a)])
    edges: Float64 = corners[np.array(_EDGES)]
    return edges
