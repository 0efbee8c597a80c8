"""Height maps of bundles drawn from their geometry alone, with noise; no part of the package is used."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from barsight.yard.types import HeightMap

CELL_M = 0.01
RINGS = {1: 0, 7: 1, 19: 2, 37: 3, 61: 4}


@dataclass(frozen=True)
class Laid:
    """A bundle as laid: middle of its axis, yaw from +Y, kind, length."""

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    diameter_m: float = 0.09
    bars: int = 7
    length_m: float = 3.0
    roll_deg: float = 10.0

    @property
    def axes_m(self) -> NDArray[np.float64]:
        """(bars, 2) the bars' axes about the bundle's, sideways and up."""
        rings = RINGS[self.bars]
        span = range(-rings, rings + 1)
        cells = [(q + r / 2, r * 0.75**0.5) for q in span for r in span if abs(q + r) <= rings]
        angle = np.radians(self.roll_deg)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return self.diameter_m * 1.003 * np.array(cells).reshape(-1, 2) @ turn.T

    @property
    def width_m(self) -> float:
        return self.diameter_m * (2 * 1.003 * RINGS[self.bars] + 1)

    @property
    def top_z_m(self) -> float:
        return float(self.z_m + self.axes_m[:, 1].max() + self.diameter_m / 2)

    def over(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height of its upper side over each place, -inf beside it."""
        yaw = np.radians(self.yaw_deg)
        across = (x - self.x_m) * np.cos(yaw) + (y - self.y_m) * np.sin(yaw)
        along = -(x - self.x_m) * np.sin(yaw) + (y - self.y_m) * np.cos(yaw)
        top = np.full(x.shape, -np.inf)
        for side, up in self.axes_m:
            inside = (self.diameter_m / 2) ** 2 - (across - side) ** 2
            height = self.z_m + up + np.sqrt(np.maximum(inside, 0))
            top = np.maximum(top, np.where(inside >= 0, height, -np.inf))
        return np.where(np.abs(along) <= self.length_m / 2, top, -np.inf)


def draw(
    bundles: list[Laid],
    x_m: tuple[float, float] = (-0.5, 2.5),
    y_m: tuple[float, float] = (-2.0, 2.0),
    sigma_m: float = 0.004,
    seed: int = 0,
    floor: bool = True,
) -> HeightMap:
    """The map that sees everything from straight above, half of the noise shared along a row of cells."""
    rng = np.random.default_rng(seed)
    xs = np.arange(round(x_m[0] / CELL_M), round(x_m[1] / CELL_M)) * CELL_M
    ys = np.arange(round(y_m[0] / CELL_M), round(y_m[1] / CELL_M)) * CELL_M
    x, y = np.meshgrid(xs, ys)
    z = np.zeros(x.shape) if floor else np.full(x.shape, -np.inf)
    for bundle in bundles:
        z = np.maximum(z, bundle.over(x, y))
    noise = rng.normal(0, sigma_m / 2**0.5, z.shape) + rng.normal(0, sigma_m / 2**0.5, (1, z.shape[1]))
    known = np.isfinite(z)
    z = np.where(known, z + noise, np.nan).astype(np.float32)
    sigma = np.where(known, sigma_m, np.nan).astype(np.float32)
    views = np.where(known, 5, 0).astype(np.float32)
    return HeightMap(float(xs[0]), float(ys[0]), CELL_M, z, sigma, views, known.astype(np.uint8))


def photographed(
    height_map: HeightMap, bundles: list[Laid], aside: float = 0.5, blur_m: float = 0.01
) -> HeightMap:
    """The same with an orthophoto, bars lit from above and, `aside` as strongly, from a side.

    What is not floor is smoothed across X, so that the bars don't show in the heights.
    """
    x = height_map.x0_m + height_map.cell_m * np.arange(height_map.z_m.shape[1])
    y = height_map.y0_m + height_map.cell_m * np.arange(height_map.z_m.shape[0])
    gray = np.zeros(height_map.z_m.shape)
    for part in np.linspace(-0.4, 0.4, 5) * height_map.cell_m:
        xx, yy = np.meshgrid(x + part, y)
        top, light = np.full(xx.shape, 0.0), np.full(xx.shape, 0.6)
        for bundle in bundles:
            yaw = np.radians(bundle.yaw_deg)
            across = (xx - bundle.x_m) * np.cos(yaw) + (yy - bundle.y_m) * np.sin(yaw)
            along = -(xx - bundle.x_m) * np.sin(yaw) + (yy - bundle.y_m) * np.cos(yaw)
            for side, up in bundle.axes_m:
                turned = 2 * (across - side) / bundle.diameter_m
                rise = np.sqrt(np.maximum(1 - turned**2, 0))
                height = bundle.z_m + up + rise * bundle.diameter_m / 2
                seen = (np.abs(turned) < 1) & (np.abs(along) < bundle.length_m / 2) & (height > top)
                top = np.where(seen, height, top)
                light = np.where(seen, np.maximum(rise + aside * turned, 0), light)
        gray += light / 5
    noise = np.random.default_rng(5).normal(0, 6, gray.shape)
    steel = height_map.z_m > 0.05
    share = ndimage.gaussian_filter1d(steel.astype(float), blur_m / height_map.cell_m, axis=1)
    total = ndimage.gaussian_filter1d(height_map.z_m * steel, blur_m / height_map.cell_m, axis=1)
    z = np.where(steel, total / np.maximum(share, 1e-9), height_map.z_m).astype(np.float32)
    return replace(height_map, z_m=z, gray=(40 + 100 * gray + noise).clip(1, 255).astype(np.uint8))
