"""Draw pairs of pictures of a plane, and a flat map of it."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from barsight.core.pose import Pose
from barsight.core.records.heights import HeightSource
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair
from barsight.labels.placing import PlacedCamera
from barsight.yard.types import HeightMap

CAMERA = RectifiedCamera(1250.0, 320.0, 255.0, 0.6, 0.0, 640, 512)
BODY = Pose.identity("body", "rect0")
TOP_M, ABOVE_M = 0.4, 7.5


@dataclass
class Pictures:
    """Pairs drawn by a function of the places (N, 2) on the plane at TOP_M, as gray levels; tiles beside it.

    blur_px: one sigma.
    """

    poses: dict[int, Pose]
    gray: Callable[[np.ndarray], np.ndarray]
    blur_px: float = 0.0

    def __post_init__(self) -> None:
        self.rectifier = SimpleNamespace(camera=CAMERA, body_from_rect0=BODY)

    def __call__(self, wanted: Container[int]) -> Iterator[RectifiedPair]:
        seen = np.ones((CAMERA.height, CAMERA.width), bool)
        for stamp, pose in self.poses.items():
            if stamp in wanted:
                left, right = (self.draw(one) for one in PlacedCamera.of_pair(pose @ BODY, CAMERA))
                yield RectifiedPair(stamp, left, right, seen, seen, CAMERA)

    def draw(self, camera: PlacedCamera) -> np.ndarray:
        """Average three by three rays per pixel."""
        fine = (np.arange(3 * CAMERA.width) - 1) / 3, (np.arange(3 * CAMERA.height) - 1) / 3
        x, y = np.meshgrid(*fine)
        ray = np.stack([x, y, np.full_like(x, camera.focal_px)], -1) - [*camera.principal_px, 0.0]
        ray = ray @ camera.map_from_rect.rotation.T
        eye = camera.map_from_rect.translation
        reach = (TOP_M - eye[2]) / ray[..., 2]
        places = eye[:2] + reach[..., None] * ray[..., :2]
        tiles = np.where(np.floor(places / 0.13).sum(axis=-1) % 2, 150.0, 40.0)
        gray = np.where(np.abs(places[..., 0]) > 0.5, tiles, self.gray(places))
        mean = gray.reshape(CAMERA.height, 3, CAMERA.width, 3).mean(axis=(1, 3))
        mean = ndimage.gaussian_filter(mean, self.blur_px) if self.blur_px else mean
        noise = np.random.default_rng(3).normal(0, 1.5, mean.shape)
        return (mean + noise).round().clip(0, 255).astype(np.uint8)


def looking_down(x_m: float, stamp: int) -> dict[int, Pose]:
    tilt = Rotation.from_euler("xyz", [180.0, 2.0, 93.0], degrees=True).as_matrix()
    return {stamp: Pose("yard", "body", tilt, np.array([x_m, 0.2, TOP_M + ABOVE_M]))}


def flat_map() -> HeightMap:
    shape = 300, 200
    z = np.full(shape, TOP_M, np.float32)
    source = np.full(shape, HeightSource.VISION, np.uint8)
    return HeightMap(-1.0, -1.5, 0.01, z, np.full_like(z, 0.003), np.full_like(z, 6.0), source)
