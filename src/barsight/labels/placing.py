"""Locate on the map what a picture shows: the first surface along its line of sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from barsight.core.arrays import Float32, Float64
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.stamps import NS_PER_S
from barsight.result_folder import CameraPath
from barsight.yard.map_lookup import nearest_cells
from barsight.yard.types import HeightMap

MAX_GAP_S = 1.0
"""Maximum time between a picture and the nearest pose of the trajectory for the picture to have a pose."""


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A rectified camera in the map's frame. principal_px: its principal point (cx, cy); it differs
    between left and right.
    """

    map_from_rect: Pose
    focal_px: float
    principal_px: tuple[float, float]

    @classmethod
    def of_pair(cls, map_from_rect0: Pose, camera: RectifiedCamera) -> tuple[PlacedCamera, PlacedCamera]:
        """Create both cameras of a rectified pair."""
        aside = Pose("rect0", "rect1", np.eye(3), np.array([camera.baseline_m, 0.0, 0.0]))
        left = cls(map_from_rect0, camera.focal_px, (camera.cx_px, camera.cy_px))
        principal = (camera.cx_px + camera.doffs_px, camera.cy_px)
        return left, cls(map_from_rect0 @ aside, camera.focal_px, principal)

    def line_of_sight(self, pixel: Float64) -> tuple[Float64, Float64]:
        """Return the line of sight of a pixel (2,): its origin (3,) and its direction (3,), scaled to
        depth 1.
        """
        ray = np.array([*(pixel - np.array(self.principal_px)) / self.focal_px, 1.0])
        return self.map_from_rect.translation, self.map_from_rect.rotation @ ray

    @property
    def projection(self) -> Float64:
        """Compute the matrix (3, 4) that projects homogeneous positions in the map to homogeneous pixels."""
        into, (cx, cy) = self.map_from_rect.inverse(), self.principal_px
        right, down, depth = np.column_stack([into.rotation, into.translation])
        return np.stack([self.focal_px * right + cx * depth, self.focal_px * down + cy * depth, depth])

    def project(self, places_m: Float64) -> tuple[Float64, Float64]:
        """Project positions (..., 3) to pixels (..., 2), NaN behind the camera, and depth (...), m."""
        seen = self.map_from_rect.inverse().apply(places_m.reshape(-1, 3)).reshape(places_m.shape)
        depth = seen[..., 2]
        ahead = np.where(depth > 0, depth, np.nan)[..., None]
        return self.focal_px * seen[..., :2] / ahead + np.array(self.principal_px), depth

    def project_sums(self, ways_m: Float64, places_m: Float64) -> tuple[Float32, Float32, Float64]:
        """Project the sums of offsets (R, 3) and positions (N, 3), which are linear before the division:
        pixels x, y and depth, m, (R, N) each. Pixels are valid only where the depth is positive.
        """
        into = self.map_from_rect.inverse()
        ways, places = ways_m @ into.rotation.T, into.apply(places_m)
        right, down, depth = (ways[:, k, None] + places[:, k] for k in range(3))
        x, y = (
            (self.focal_px * way / depth + middle).astype(np.float32)
            for way, middle in zip((right, down), self.principal_px, strict=True)
        )
        return x, y, depth


def pose_at(path: CameraPath, stamp_ns: int) -> Pose | None:
    """Interpolate the body's pose between the poses around a stamp; None if the nearest is more than
    `MAX_GAP_S` away.
    """
    after = int(np.searchsorted(path.stamp_ns, stamp_ns))
    near = path.stamp_ns[max(after - 1, 0) : after + 1] - stamp_ns
    if not near.size or np.abs(near).min() > MAX_GAP_S * NS_PER_S:
        return None
    if after in (0, len(path.stamp_ns)) or path.stamp_ns[after] == stamp_ns:
        k = min(after, len(path.stamp_ns) - 1)
        turn = Rotation.from_quat(path.quaternion_xyzw[k])
        return Pose("map", "body", turn.as_matrix(), path.position_m[k])
    pair = slice(after - 1, after + 1)
    share = (stamp_ns - path.stamp_ns[after - 1]) / (path.stamp_ns[after] - path.stamp_ns[after - 1])
    turn = Slerp([0.0, 1.0], Rotation.from_quat(path.quaternion_xyzw[pair]))(share)
    first, second = path.position_m[pair]
    return Pose("map", "body", turn.as_matrix(), first + share * (second - first))


def first_surface(heights: HeightMap, origin: Float64, direction: Float64) -> Float64 | None:
    """Intersect a downward line of sight with the map; (3,), None if it meets only unknown cells.

    The line is sampled in steps of at most half a cell; the first sample at or below the surface counts.
    """
    if direction[2] >= 0:
        return None
    known = heights.z_m[np.isfinite(heights.z_m)]
    if not known.size:
        return None
    low, high = float(known.min()), float(known.max())
    near, far = (high - origin[2]) / direction[2], (low - origin[2]) / direction[2]
    drop, level = abs(direction[2]), float(np.hypot(direction[0], direction[1]))
    step = 0.5 * heights.cell_m / max(level, drop)
    depth = np.arange(max(near, 0.0), far + 2 * step, step)
    places = origin + depth[:, None] * direction
    z = heights_at(heights, places)
    hit = np.flatnonzero(np.isfinite(z) & (places[:, 2] <= z))
    if not hit.size:
        return None
    found: Float64 = places[hit[0]]
    return found


def heights_at(heights: HeightMap, places: Float64) -> Float64:
    """Look up the height (...) of the cell at each position (..., 2 or 3), filled ones too; NaN outside the
    map and where unknown.
    """
    column, row, inside = nearest_cells(heights, places[..., 0], places[..., 1])
    z = np.full(inside.shape, np.nan)
    z[inside] = heights.z_m[row[inside], column[inside]]
    return z
