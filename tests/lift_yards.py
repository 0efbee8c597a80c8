"""Small yards for the tests of lifts: bundles drawn from geometry, with records that state small sigmas."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from barsight.yard.identity import MapIdentity
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.assessment import assess_placement
from barsight.yard.lifting.lift import Lift, LiftScene
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.description import Magnet, load_magnet
from barsight.yard.magnet.footprint import BundleTable, Placement
from barsight.yard.stability.stability import footings
from barsight.yard.types import Bundle, BundleSigma, HeightMap
from yard_maps import Laid, draw

MAGNET = load_magnet(None)
SETTINGS = LiftSettings()
SIGMA = BundleSigma(0.003, 0.02, 0.0006, 0.03, 0.006, 0.003, 0.001)
LENGTH_M = 7.0
GIVEN = MapIdentity("given", False, None, None, "given", None, "")
"""Of a map that nobody measured."""


def laid(x: float, z: float = 0.2, **changes: Any) -> Laid:
    """A bundle of 7 bars of 90 mm, two of them level on top."""
    return replace(Laid(x, 0.0, z, 0.0, length_m=LENGTH_M, roll_deg=0.0), **changes)


def record(one: Laid, number: int = 0, **changes: Any) -> Bundle:
    """The bundle as it would be found."""
    yaw = np.radians(one.yaw_deg)
    along = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    centre = np.array([one.x_m, one.y_m, one.z_m])
    whole = Bundle(
        id=number, centre_m=centre, yaw_rad=float(yaw), pitch_rad=0.0, length_m=one.length_m,
        ends_m=np.stack([centre + s * one.length_m / 2 * along for s in (-1, 1)]), ends_open=(False, False),
        width_m=one.width_m, top_z_m=one.top_z_m, bar_diameter_m=one.diameter_m, visible_bars=3,
        bars=one.bars, layer=0, on_top=True, neighbours=(), sigma=SIGMA, known_share=1.0, confidence=0.99,
        reasons=(),
    )  # fmt: skip
    return replace(whole, **changes)


def map_of(bundles: list[Laid], **changes: Any) -> HeightMap:
    """A map that sees all of them from end to end."""
    width = max((b.x_m for b in bundles), default=1.0) + 1.5
    return draw(bundles, **({"x_m": (-1.5, width), "y_m": (-4.0, 4.0), "sigma_m": 0.002} | changes))


def bare(heights: HeightMap) -> HeightMap:
    """The same with a photo on which nothing shows."""
    return replace(heights, tops=np.full(heights.shape, 90, np.uint8))


def yard_of(heights: HeightMap, bundles: tuple[Bundle, ...], settings: LiftSettings = SETTINGS) -> LiftScene:
    return LiftScene(heights, BundleTable.of(bundles), footings(heights, bundles, settings))


def judged(
    stock: list[Laid], bundles: tuple[Bundle, ...] | None = None, place: Placement | None = None,
    magnet: Magnet = MAGNET, settings: LiftSettings = SETTINGS, heights: HeightMap | None = None,
) -> Lift:  # fmt: skip
    """The lift at a place, else over the first bundle's middle."""
    if bundles is None:
        bundles = tuple(record(one, k) for k, one in enumerate(stock))
    place = place or Placement(stock[0].x_m, 0.0, 0.0)
    heights = heights if heights is not None else map_of(stock)
    return assess_placement(place, yard_of(heights, bundles, settings), magnet, settings)


def codes(lift: Lift) -> set[str]:
    return {veto.code for veto in lift.vetoes}


def sure_travel(place_m: np.ndarray, stamp_ns: np.ndarray) -> Travel:
    """Travel of measured frames at places (N, 2), each known to 1 mm and as its encoders say."""
    count = len(place_m)
    return Travel(
        place_m, np.full((count, 3), 0.001), np.zeros(count), np.empty((0, 2)), 5.0, stamp_ns,
        np.ones(len(stamp_ns), bool), 3.0, 8.0, 0.0008,
    )  # fmt: skip
