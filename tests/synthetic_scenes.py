"""Pictures whose disparities are known: one continuous texture, sampled where each camera sees it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from barsight.core.records.pairs import RectifiedCamera, RectifiedPair

WAVES = 100


class Texture:
    """Gray levels at any place (px): a sum of waves no shorter than 4 px, so that sampling loses nothing."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        length = np.exp(rng.uniform(np.log(4.5), np.log(40), WAVES))
        heading = rng.uniform(0, 2 * np.pi, WAVES)
        self._wave = 2 * np.pi / length * np.array([np.cos(heading), np.sin(heading)])
        self._phase = rng.uniform(0, 2 * np.pi, WAVES)

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = np.asarray(x, np.float32), np.asarray(y, np.float32)
        gray = np.zeros(np.broadcast(x, y).shape, np.float32)
        for kx, ky, phase in zip(*self._wave.astype(np.float32), self._phase.astype(np.float32), strict=True):
            gray += np.cos(kx * x + ky * y + phase)
        return 128 + gray * 40 / np.sqrt(WAVES / 2)


def quantised(gray: np.ndarray) -> np.ndarray:
    return gray.round().clip(0, 255).astype(np.uint8)


def camera(width: int, height: int, doffs_px: float = 0.0) -> RectifiedCamera:
    return RectifiedCamera(400.0, width / 2 - 3, height / 2 + 2, 0.5, doffs_px, width, height)


@lru_cache
def slanted_pair(
    width: int = 240,
    height: int = 160,
    start_px: float = 20.3,
    slope: tuple[float, float] = (0.02, 0.01),
    noise: float = 0.0,
    doffs_px: float = 0.0,
) -> tuple[RectifiedPair, np.ndarray]:
    """A plane's pair and its true disparities (H, W): start_px + slope . (u, v) in the left image."""
    texture = Texture(3)
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    truth = start_px + slope[0] * u + slope[1] * v
    # x_right = u - d(u, v), solved for the left place that a right pixel shows.
    u_of_right = (u + start_px + slope[1] * v) / (1 - slope[0])
    rng = np.random.default_rng(4)
    left, right = (
        quantised(texture(x, v) + rng.normal(0, noise, u.shape) if noise else texture(x, v))
        for x in (u, u_of_right)
    )
    valid = np.ones(u.shape, dtype=np.bool_)
    return RectifiedPair(1, left, right, valid, valid, camera(width, height, doffs_px)), truth
