"""Simulate yards as the yard's stages would get them, without rendering: a height map and its bundles.

Both are the truth with drawn errors of a stated sigma, or the truth itself (`error=0`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Float32, Float64
from barsight.core.types import HeightSource
from barsight.simulation import stock as truth
from barsight.simulation.scene import build_scene
from barsight.simulation.sensors import heights
from barsight.simulation.settings import SimulationSettings
from barsight.yard.types import Bundle, BundleSigma, HeightMap

CELL_M = 0.01
MARGIN_M = 0.6
CELL_SIGMA_M, CORRELATION_CELLS = 0.005, 2.0
SHARED_SIGMA_M, SHARED_CELLS = 0.004, 100.0
STEEP_M, STEEP_UNKNOWN = 0.08, 0.3
"""Where neighbouring cells differ by more than this, so large a share of them is unknown."""
SIGMA = BundleSigma(
    lateral_m=0.004, along_m=0.02, yaw_rad=0.0008, length_m=0.03, width_m=0.01, top_z_m=0.004,
    bar_diameter_m=0.001,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class KnownYard:
    """A yard's stock with its exact height map and bundles."""

    stock: truth.Stock
    heights: HeightMap
    bundles: tuple[Bundle, ...]


def known_yard(stock: truth.Stock, settings: SimulationSettings, rng: np.random.Generator) -> KnownYard:
    """Build the exact map of all that lies there, straps included, and all bundles, covered ones too."""
    scene = build_scene(stock, settings, rng)
    ends = np.array(
        [b.centre_m[:2] + s * b.length_m / 2 * b.axes[1, :2] for b in stock.bundles for s in (-1, 1)]
    )
    ends = ends.reshape(-1, 2) if len(ends) else np.zeros((1, 2))
    low, high = ends.min(axis=0) - MARGIN_M, ends.max(axis=0) + MARGIN_M
    first, last = np.floor(low / CELL_M).astype(int), np.ceil(high / CELL_M).astype(int)
    x, y = np.arange(first[0], last[0] + 1) * CELL_M, np.arange(first[1], last[1] + 1) * CELL_M
    xx, yy = np.meshgrid(x, y)
    z = heights(scene, xx.ravel(), yy.ravel()).reshape(xx.shape).astype(np.float32)
    exact = HeightMap(
        float(x[0]), float(y[0]), CELL_M, z, np.full_like(z, 1e-4), np.full_like(z, 5.0),
        np.full(z.shape, HeightSource.VISION, np.uint8),
    )  # fmt: skip
    found = tuple(_bundle(number, bundle, stock) for number, bundle in enumerate(stock.bundles))
    return KnownYard(stock, exact, found)


def _bundle(number: int, bundle: truth.StackedBundle, stock: truth.Stock) -> Bundle:
    along = bundle.axes[1]
    nothing = BundleSigma(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    beside = [
        k for k, other in enumerate(stock.bundles)
        if other is not bundle and other.layer == bundle.layer and other.section == bundle.section
        and abs(other.centre_m[0] - bundle.centre_m[0]) < other.radius_m + bundle.radius_m + 0.03
    ]  # fmt: skip
    visible = bundle.kind.rings * 2 + 1
    return Bundle(
        id=number, centre_m=bundle.centre_m.copy(), yaw_rad=bundle.yaw_rad, pitch_rad=0.0,
        length_m=bundle.length_m,
        ends_m=np.stack([bundle.centre_m + s * bundle.length_m / 2 * along for s in (-1, 1)]),
        ends_open=(False, False), width_m=2 * bundle.radius_m, top_z_m=bundle.top_z_m,
        bar_diameter_m=bundle.kind.diameter_m, visible_bars=visible, bars=bundle.kind.count,
        layer=bundle.layer, on_top=bundle.on_top, neighbours=tuple(beside), sigma=nothing,
        known_share=1.0, confidence=1.0, reasons=(),
    )  # fmt: skip


def seen_bundles(yard: KnownYard, rng: np.random.Generator, sigma: BundleSigma = SIGMA) -> tuple[Bundle, ...]:
    """Draw errors from `sigma`, which they state, onto the bundles on which nothing lies."""
    return tuple(_seen(bundle, rng, sigma) for bundle in yard.bundles if bundle.on_top)


def _seen(bundle: Bundle, rng: np.random.Generator, sigma: BundleSigma) -> Bundle:
    side = np.array([np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad), 0.0])
    centre = bundle.centre_m + side * rng.normal(0, sigma.lateral_m)
    centre = centre + bundle.direction * rng.normal(0, sigma.along_m)
    length = bundle.length_m + rng.normal(0, sigma.length_m)
    yaw = bundle.yaw_rad + rng.normal(0, sigma.yaw_rad)
    along = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    changed = {
        "centre_m": centre, "length_m": length, "yaw_rad": yaw, "sigma": sigma,
        "ends_m": np.stack([centre + s * length / 2 * along for s in (-1, 1)]),
        "width_m": bundle.width_m + rng.normal(0, sigma.width_m),
        "top_z_m": bundle.top_z_m + rng.normal(0, sigma.top_z_m),
        "bar_diameter_m": bundle.bar_diameter_m + rng.normal(0, sigma.bar_diameter_m),
    }  # fmt: skip
    return Bundle(**{**vars(bundle), **changed})


def seen_heights(exact: HeightMap, rng: np.random.Generator) -> HeightMap:
    """Add noise that neighbours share, an error that changes slowly along the map, and unknown cells."""
    z, shape = exact.z_m, exact.z_m.shape
    noise = _smooth(rng, shape, CORRELATION_CELLS) * CELL_SIGMA_M
    noise += _smooth(rng, shape, SHARED_CELLS) * SHARED_SIGMA_M
    kernel = np.ones((3, 3), np.uint8)
    steep = cv2.dilate(z, kernel) - cv2.erode(z, kernel) > STEEP_M
    lost = steep & (rng.random(shape) < STEEP_UNKNOWN)
    seen = np.where(lost, np.nan, z + noise).astype(np.float32)
    sigma = np.where(lost, np.nan, np.hypot(CELL_SIGMA_M, SHARED_SIGMA_M)).astype(np.float32)
    source = np.where(lost, HeightSource.UNKNOWN, HeightSource.VISION).astype(np.uint8)
    views = np.where(lost, 0, exact.views).astype(np.float32)
    return HeightMap(exact.x0_m, exact.y0_m, exact.cell_m, seen, sigma, views, source)


def _smooth(rng: np.random.Generator, shape: tuple[int, int], cells: float) -> Float32:
    """Smooth white noise over `cells`, of variance 1."""
    shrink = max(1, int(cells / 4))
    rows, columns = -(-shape[0] // shrink) + 8, -(-shape[1] // shrink) + 8
    smooth: Float64 = cv2.GaussianBlur(rng.normal(0, 1, (rows, columns)), (0, 0), cells / shrink)
    smooth /= smooth.std()
    whole = cv2.resize(smooth, (columns * shrink, rows * shrink), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole[: shape[0], : shape[1]], dtype=np.float32)
