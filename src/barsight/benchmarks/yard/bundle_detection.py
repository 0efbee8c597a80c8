"""Detect bundles in many degraded maps of drawn yards and score them against the truth."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from barsight.benchmarks.yard.bundle_scores import (
    BundleErrors,
    TrueBundle,
    bars_mass,
    score_bundles,
)
from barsight.benchmarks.yard.degraded_map import Defects, degraded_map
from barsight.simulation.scene import build_scene
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.stock import StackedBundle, stack_yard
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.types import HeightMap

_KINDS = (
    "90mm:7", "40mm:37", "20mm:61", "60mm:19", "90mm:7,40mm:37,20mm:61", "160mm:1", "60mm:7",
    "40mm:19,90mm:7",
)  # fmt: skip
_RENDERED_KINDS = (
    "90mm:7", "40mm:37", "20mm:61", "60mm:19", "40mm:19", "60mm:7", "90mm:7,40mm:37", "20mm:37",
)  # fmt: skip


def score_drawn(settings: SimulationSettings) -> tuple[BundleErrors, float]:
    """Draw a yard, degrade its map, detect its bundles: their scores, and the detection's CPU time, s."""
    height_map, true = drawn_map(settings)
    start = time.process_time()
    found = find_bundles(height_map, BundleSettings())
    return score_bundles(found, true), time.process_time() - start


def drawn_yards(yards: int, seed: int, length_m: float) -> Iterator[SimulationSettings]:
    """Draw varied yards of 1 to 5 layers: kinds of bars, gaps, skew, missing and crossed bundles, dunnage."""
    rng = np.random.default_rng(seed)
    for k in range(yards):
        bars = _KINDS[k % len(_KINDS)]
        yard = YardSettings(
            max_layers=1 + k % 5 if "mm:7" in bars else 1 + k % 4,
            gap_m=float(rng.choice([0, 0.01, 0.03, 0.1])),
            skew_deg=float(rng.choice([0, 0.3, 0.6, 1.5])),
            missing_ratio=float(rng.choice([0, 0.1, 0.3])),
            dunnage_m=float(rng.choice([0.05, 0.09, 0.12])),
            bar_length_m=float(rng.choice([4, 5, 6, 7.5])),
            crossed_ratio=0.5 if k % 3 == 2 else 0.0,
        )
        yield SimulationSettings(length_m=length_m, seed=1000 * seed + k, bars=bars, yard=yard)


def rendered_yards(yards: int, seed: int) -> Iterator[SimulationSettings]:
    """Choose short yards for small images, as varied as the drawn ones; each takes about half a minute.

    The images are cropped to a quarter of their area at the same resolution. Short bars have both ends in
    view, long ones one.
    """
    rng = np.random.default_rng((seed, 1))
    for k in range(yards):
        bars = _RENDERED_KINDS[k % len(_RENDERED_KINDS)]
        mixed = "," in bars
        bar_length = float(rng.choice([2.0, 2.3, 4.0]))
        yard = YardSettings(
            max_layers=1 + k % 5,
            gap_m=float(rng.choice([0, 0.01, 0.03, 0.1])),
            skew_deg=float(rng.choice([0, 0.3, 0.6, 1.5])),
            missing_ratio=float(rng.choice([0, 0.1, 0.3])),
            dunnage_m=float(rng.choice([0.05, 0.09, 0.12])),
            bar_length_m=bar_length,
            crossed_ratio=1.0 if k % 3 == 2 else 0.0,
        )
        camera = CameraSettings(width_px=640, height_px=512, trolley_y_m=-1.0 if bar_length > 3 else 0.0)
        yield SimulationSettings(
            length_m=4.6 if mixed else 2.6, frames=10 if mixed else 7, seed=1000 * seed + k, bars=bars,
            depth_views=0, camera=camera, yard=yard,
        )  # fmt: skip


def drawn_map(settings: SimulationSettings) -> tuple[HeightMap, tuple[TrueBundle, ...]]:
    """Draw the degraded map of a yard, and its true bundles."""
    stock = stack_yard(settings, np.random.default_rng((settings.seed, 0)))
    scene = build_scene(stock, settings, np.random.default_rng((settings.seed, 1)))
    rng = np.random.default_rng((settings.seed, 20))
    height_map = degraded_map(scene, settings.length_m, settings.camera, rng, Defects())
    return height_map, tuple(_true(bundle) for bundle in stock.bundles)


def _true(bundle: StackedBundle) -> TrueBundle:
    return TrueBundle(
        bundle.centre_m, bundle.yaw_rad, bundle.length_m, 2 * bundle.radius_m, bundle.top_z_m,
        bundle.kind.diameter_m, bundle.kind.count, bundle.on_top,
        bars_mass(bundle.kind.count, bundle.kind.diameter_m, bundle.length_m),
    )  # fmt: skip
