"""Describe a crane's cameras, and count the views that show a place of the yard."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from barsight.core.arrays import Float64, Int64, kernel
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.yard.map_lookup import CellGrid, is_blocked

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

    def count_views(self, body_m: Float64, grid: CellGrid, places_m: Float64, enough: int) -> Int64:
        """Count the views (N,) that show places (N, 3), up to `enough`: both cameras have a place in their
        pictures, and no surface of the map is in the way. body_m: (F, 3) the body's places.
        """
        eyes = np.ascontiguousarray(body_m[:, None] + self.eyes_m)
        axes, places = (np.ascontiguousarray(one, np.float64) for one in (self.axes, places_m))
        return _count_views(grid, places, eyes, axes, self.bounds, enough)


@kernel()
def _count_views(
    grid: CellGrid, places: Float64, eyes: Float64, axes: Float64, bounds: Float64, enough: int
) -> Int64:
    """Count the views (N,) of places (N, 3) from eyes (F, 2, 3), up to `enough`. axes, bounds: as in
    `Cameras`.
    """
    found = np.zeros(len(places), np.int64)
    for n in range(len(places)):
        place = (places[n, 0], places[n, 1], places[n, 2])
        for f in range(len(eyes)):
            if found[n] == enough:
                break
            found[n] += (
                _is_pictured(place, eyes[f, 0], axes, bounds[0])
                and _is_pictured(place, eyes[f, 1], axes, bounds[1])
                and not is_blocked(grid, place, eyes[f, 0], OVER_LINE_M)
                and not is_blocked(grid, place, eyes[f, 1], OVER_LINE_M)
            )
    return found


@kernel()
def _is_pictured(place: tuple[float, float, float], eye: Float64, axes: Float64, bounds: Float64) -> bool:
    """Check whether a place lies in the picture of a camera at `eye` (3,). axes: (3, 3); bounds: (4,)."""
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
