"""Render a level plate that hangs from the crane into the images; it travels along and sways with the rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float32, Float64
from barsight.core.pose import Pose
from barsight.simulation.settings.travel import MagnetSettings
from barsight.simulation.textures import ALONG_M, TILE

ALBEDO = 0.3


@dataclass(frozen=True, eq=False)
class MagnetPlate:
    """The plate in one frame, a level rectangle. centre_m: (3,) in the yard. half_m: (2,) along x and y."""

    centre_m: Float64
    half_m: Float64

    def covers(self, origin: Float64, directions: Float64) -> tuple[Bool, Float64, Float64]:
        """Intersect rays (..., 3) from `origin`: whether they hit, the ray parameter of the hit, and its
        position from the centre (..., 2), m. A hit with a parameter above 1 lies beyond the ray's end.
        """
        share = (self.centre_m[2] - origin[2]) / np.minimum(directions[..., 2], -1e-9)
        place = origin[:2] + share[..., None] * directions[..., :2] - self.centre_m[:2]
        hit: Bool = (np.abs(place) <= self.half_m).all(axis=-1) & (directions[..., 2] < -1e-9) & (share > 0)
        return hit, share, place


def plate_at(settings: MagnetSettings, share: float, yard_from_body: Pose) -> MagnetPlate | None:
    """Place the plate at `share` of the frames, None while it is hoisted out of view."""
    if min(settings.size_m) == 0 or not settings.first_ratio <= share <= settings.last_ratio:
        return None
    offset = np.array([*settings.offset_m, -settings.below_body_m])
    return MagnetPlate(yard_from_body.translation + offset, np.array(settings.size_m) / 2)


def paint_plate(
    radiance: Float32, plate: MagnetPlate, rays: Float32, side: int, yard_from_cam: Pose, tile: Float32
) -> None:
    """Paint the plate over a view in place; `rays` and `side` as for `render_view`."""
    directions = np.dstack([rays, np.ones(rays.shape[:2])]) @ yard_from_cam.rotation.T
    hit, _, place = plate.covers(yard_from_cam.translation, directions)
    texel = np.floor(place[hit] / ALONG_M).astype(np.int64) & (TILE - 1)
    light = np.zeros(hit.shape, dtype=np.float32)
    light[hit] = ALBEDO * tile[texel[:, 0], texel[:, 1], 3]
    shape = (radiance.shape[0], side, radiance.shape[1], side)
    taken = hit.reshape(shape).mean(axis=(1, 3), dtype=np.float32)
    radiance *= 1 - taken
    radiance += light.reshape(shape).mean(axis=(1, 3))
