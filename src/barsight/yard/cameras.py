"""Describe a crane's cameras, and count the views that show a place of the yard."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from barsight.core.arrays import Float32, Float64, Int64, kernel
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.yard.types import HeightMap

OVER_LINE_M = 0.02
"""Minimum height (m) over a line of sight of a surface that blocks it: the map's own error."""
BORDER_PX = 10.0
"""Width (px) of the pictures' border in which hardly anything is matched."""
ALIKE = 0.05
"""Maximum difference, in m and as tangents, of cameras that hang alike."""


@dataclass(frozen=True, eq=False)
class Cameras:
    """A pair's rectified cameras on the crane.

    eyes_m: (2, 3) their places from the body. axes: (3, 3) right, down and forward of their pictures. Both in
    the map's axes. bounds: (2, 4) tangents of each picture's left, right, top and bottom.
    """

    eyes_m: Float64
    axes: Float64
    bounds: Float64

    @classmethod
    def of(cls, map_from_body: Pose, body_from_left: Pose, camera: RectifiedCamera) -> Cameras:
        """Build from the pose of a frame, and the rectified left picture's in the body."""
        pose = map_from_body @ body_from_left
        eyes = pose.apply(np.array([[0.0, 0.0, 0.0], [camera.baseline_m, 0.0, 0.0]]))
        far_x, far_y = camera.width - 1 - BORDER_PX, camera.height - 1 - BORDER_PX
        edges = np.array([
            (BORDER_PX - cx_px, far_x - cx_px, BORDER_PX - camera.cy_px, far_y - camera.cy_px)
            for cx_px in (camera.cx_px, camera.cx_px + camera.doffs_px)
        ])  # fmt: skip
        return cls(eyes - map_from_body.translation, pose.rotation.T, edges / camera.focal_px)

    @classmethod
    def read(cls, content: Any) -> Cameras | None:
        """Read from result.json; None where it doesn't state them. Raises ValueError for other shapes."""
        if content is None:
            return None
        shapes = {"eyes_m": (2, 3), "axes": (3, 3), "bounds": (2, 4)}
        return cls(*(np.array(content[name], np.float64).reshape(size) for name, size in shapes.items()))

    def content(self) -> dict[str, Any]:
        """Convert to the content of result.json."""
        return {name: values.tolist() for name, values in asdict(self).items()}

    def is_like(self, other: Cameras | None) -> bool:
        """Check whether other cameras hang as these do."""
        return other is not None and all(
            np.allclose(getattr(self, name), getattr(other, name), rtol=0, atol=ALIKE)
            for name in ("eyes_m", "axes", "bounds")
        )

    def count_views(self, body_m: Float64, heights: HeightMap, places_m: Float64) -> Int64:
        """Count the views (N,) that show places (N, 3): both cameras have it in their picture, and no surface
        of the map is in the way. body_m: (F, 3) the body's places.
        """
        z = np.where(np.isnan(heights.z_m), -np.float32(np.inf), heights.z_m)
        at = np.array([heights.x0_m, heights.y0_m, heights.cell_m])
        eyes = np.ascontiguousarray(body_m[:, None] + self.eyes_m)
        axes, places = (np.ascontiguousarray(one, np.float64) for one in (self.axes, places_m))
        return _count_views(z, at, places, eyes, axes, self.bounds)


@kernel()
def _count_views(
    z: Float32, at: Float64, places: Float64, eyes: Float64, axes: Float64, bounds: Float64
) -> Int64:
    """Count the views (N,) of places (N, 3); z: map (rows, columns), -inf where unknown; at: x and y of its
    first cell, and the cells' size; eyes: (F, 2, 3); axes, bounds: see `Cameras`.
    """
    highest = z.max() if z.size else -np.inf
    found = np.zeros(len(places), np.int64)
    for n in range(len(places)):
        for f in range(len(eyes)):
            found[n] += (
                _is_pictured(places[n], eyes[f, 0], axes, bounds[0])
                and _is_pictured(places[n], eyes[f, 1], axes, bounds[1])
                and not _is_blocked(z, at, highest, places[n], eyes[f, 0])
                and not _is_blocked(z, at, highest, places[n], eyes[f, 1])
            )
    return found


@kernel()
def _is_pictured(place: Float64, eye: Float64, axes: Float64, bounds: Float64) -> bool:
    """Check whether a place (3,) lies in the picture of a camera at `eye` (3,)."""
    x, y, z = place[0] - eye[0], place[1] - eye[1], place[2] - eye[2]
    right, down, depth = (
        axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z,
        axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z,
        axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z,
    )
    within = (
        bounds[0] * depth <= right <= bounds[1] * depth and bounds[2] * depth <= down <= bounds[3] * depth
    )
    return bool(within and depth > 0)


@kernel()
def _is_blocked(z: Float32, at: Float64, highest: float, place: Float64, eye: Float64) -> bool:
    """Check whether a surface of the map (rows, columns) rises over the line from a place to an eye (3,)."""
    away = np.sqrt((eye[0] - place[0]) ** 2 + (eye[1] - place[1]) ** 2)
    steps = int(np.ceil(away / at[2]))
    for step in range(1, steps):
        part = step / steps
        level = place[2] + part * (eye[2] - place[2])
        if level > highest:
            return False
        column = int(np.floor((place[0] + part * (eye[0] - place[0]) - at[0]) / at[2] + 0.5))
        row = int(np.floor((place[1] + part * (eye[1] - place[1]) - at[1]) / at[2] + 0.5))
        if 0 <= row < z.shape[0] and 0 <= column < z.shape[1] and z[row, column] > level + OVER_LINE_M:
            return True
    return False
