"""Degrade images: dirt, drops and glare on a lens, haze, motion blur, exposure steps, dead pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Float32, Float64, Int64, UInt8
from barsight.simulation.effects.settings import FaultSettings

HAZE_GRAY = 0.45
"""Radiance of thick haze, where 1 is white paper under the lamps."""
MIN_BLUR_PX = 0.05
DROP_SIGMA_PX = 3.0


@dataclass(frozen=True, eq=False)
class SpoiledLens:
    """Faults of one camera, the same in every image. clear: (H, W) share of the light that is transmitted.

    stray: (H, W) stray light that is added. drop: (H, W) weight of the defocused image. dead: (N, 2) row and
    column of the dead pixels; stuck: (N,) their gray levels.
    """

    clear: Float32
    stray: Float32
    drop: Float32
    dead: Int64
    stuck: UInt8

    @classmethod
    def draw(cls, settings: FaultSettings, shape: tuple[int, int], rng: np.random.Generator) -> SpoiledLens:
        """Draw the faults of one camera's lens and sensor, for images (H, W) of this shape."""
        clear, drop = np.ones(shape, np.float32), np.zeros(shape, np.float32)
        for _ in range(settings.dirt_spots):
            radius = settings.dirt_px * float(np.exp(rng.normal(0, 0.5)))
            clear *= 1 - float(rng.uniform(0.15, 0.7)) * _blot(shape, radius, rng)
        for _ in range(settings.drops):
            radius = settings.dirt_px * float(np.exp(rng.normal(0.4, 0.4)))
            drop = np.maximum(drop, _blot(shape, radius, rng))
        stray = np.zeros(shape, np.float32)
        if settings.glare_ratio > 0:
            stray = np.float32(settings.glare_ratio) * _blot(shape, 0.3 * max(shape), rng, soft=1.0)
        dead = np.column_stack([rng.integers(0, side, settings.dead_pixels) for side in shape])
        stuck = rng.choice(np.array([0, 255], np.uint8), settings.dead_pixels)
        return cls(clear, stray, drop, dead, stuck)

    def spoil(self, radiance: Float32, settings: FaultSettings, velocity_px: Float64) -> Float32:
        """Apply motion blur, haze, drops, dirt and glare to an image's radiance (H, W).

        velocity_px: (2,) velocity of the image over the sensor, right and down, px/s.
        """
        out = _motion_blur(radiance, velocity_px * settings.exposure_s)
        if settings.haze_ratio > 0:
            out = (1 - settings.haze_ratio) * out + np.float32(settings.haze_ratio * HAZE_GRAY)
        if self.drop.any():
            blurred = cv2.GaussianBlur(out, (0, 0), DROP_SIGMA_PX)
            out = out + self.drop * (blurred - out)
        return np.asarray(out * self.clear + self.stray, np.float32)

    def kill(self, image: UInt8) -> None:
        """Write the dead pixels into an image (H, W)."""
        image[self.dead[:, 0], self.dead[:, 1]] = self.stuck


def exposure_gain(settings: FaultSettings, step: float, phase_rad: float) -> float:
    """Compute the exposure of one image relative to the nominal exposure.

    step: standard normal deviate, the same for both cameras. phase_rad: phase of the lamps' flicker.
    """
    return math.exp(settings.exposure_step_ratio * step) * (1 + settings.flicker_ratio * math.sin(phase_rad))


def _blot(shape: tuple[int, int], radius: float, rng: np.random.Generator, soft: float = 0.3) -> Float32:
    """Draw a round blot (H, W), 1 at its centre, that fades out over the outer share `soft` of its radius."""
    v, u = rng.uniform(0, shape[0]), rng.uniform(0, shape[1])
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    away = np.sqrt((rows - v) ** 2 + (columns - u) ** 2) / radius
    blot: Float32 = np.clip((1 - away) / soft, 0, 1).astype(np.float32)
    return blot


def _motion_blur(radiance: Float32, smear_px: Float64) -> Float32:
    """Average an image along its straight motion (right, down), px, while the shutter is open."""
    length = float(np.hypot(*smear_px))
    if length < MIN_BLUR_PX:
        return radiance
    half = math.ceil(length / 2) + 1
    samples = max(2, math.ceil(4 * length))
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for share in (np.arange(samples) + 0.5) / samples - 0.5:
        x, y = half + share * smear_px[0], half + share * smear_px[1]
        i, j = int(y), int(x)
        b, a = y - i, x - j
        kernel[i : i + 2, j : j + 2] += np.outer([1 - b, b], [1 - a, a])
    blurred: Float32 = cv2.filter2D(radiance, -1, kernel / samples, borderType=cv2.BORDER_REPLICATE)
    return blurred
