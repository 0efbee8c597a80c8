"""Bars along X, or seen in a mirror, give the same lifts as bars along Y, turned or mirrored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from barsight.core.arrays import Float64
from barsight.yard.axes import turn_between
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.targets import plan_lifts
from barsight.yard.magnet.description import Tolerance
from barsight.yard.magnet.footprint import Placement
from barsight.yard.stability.pile_sides import pile_sides
from barsight.yard.stability.stability import footings
from barsight.yard.types import Bundle, HeightMap
from lift_yards import MAGNET, SETTINGS, codes, judged, laid, map_of, record
from yard_maps import Laid

EVEN = replace(MAGNET, tolerance=Tolerance(0.02, 0.02, 0.2))
"""A crane that misses as far along X as along Y."""


@dataclass(frozen=True)
class Motion:
    """A turn or mirror image: matrix (2, 2) of places; what becomes of a map's array [y, x] and of a yaw."""

    matrix: Float64
    array: Callable[[np.ndarray], np.ndarray]
    yaw_deg: Callable[[float], float]

    def place(self, x: float, y: float) -> tuple[float, float]:
        new = self.matrix @ (x, y)
        return float(new[0]), float(new[1])

    def laid(self, one: Laid) -> Laid:
        x, y = self.place(one.x_m, one.y_m)
        yaw = (self.yaw_deg(one.yaw_deg) + 90) % 180 - 90
        return replace(one, x_m=x, y_m=y, yaw_deg=90.0 if yaw == -90 else yaw)

    def map(self, heights: HeightMap) -> HeightMap:
        ends = np.array([[heights.x_m[k], heights.y_m[k]] for k in (0, -1)]) @ self.matrix.T
        low = ends.min(axis=0)
        arrays = {
            name: np.ascontiguousarray(self.array(getattr(heights, name)))
            for name in ("z_m", "sigma_m", "views", "source")
        }
        return replace(heights, x0_m=float(low[0]), y0_m=float(low[1]), **arrays)


TURNED = Motion(np.array([[0.0, -1.0], [1.0, 0.0]]), lambda a: a.T[:, ::-1], lambda yaw: yaw + 90)
TURNED_BACK = Motion(np.array([[0.0, 1.0], [-1.0, 0.0]]), lambda a: a.T[::-1], lambda yaw: yaw - 90)
MIRRORED = Motion(np.diag([-1.0, 1.0]), lambda a: a[:, ::-1], lambda yaw: -yaw)
HEAD_TO_TAIL = Motion(np.diag([-1.0, -1.0]), lambda a: a[::-1, ::-1], lambda yaw: yaw)
MOTIONS = pytest.mark.parametrize(
    "motion", [TURNED, TURNED_BACK, MIRRORED, HEAD_TO_TAIL], ids=["turned", "back", "mirrored", "tail"]
)

STOCK = [
    laid(0.3, yaw_deg=0.4), laid(0.63, yaw_deg=-0.3), laid(0.98), laid(0.37, z=0.56, yaw_deg=0.2),
    laid(2.4, yaw_deg=-1.0), laid(3.4, y_m=0.3, yaw_deg=0.5),
]  # fmt: skip
COVERED = (0,)


def yard() -> HeightMap:
    return map_of(STOCK, x_m=(-1.5, 4.8), y_m=(-4.2, 4.2))


def records(stock: list[Laid]) -> tuple[Bundle, ...]:
    return tuple(
        record(one, k, layer=int(one.z_m > 0.5), on_top=k not in COVERED) for k, one in enumerate(stock)
    )


@MOTIONS
def test_lifts_and_places_to_set_down_turn_with_the_yard(motion: Motion) -> None:
    heights, stock = yard(), [motion.laid(one) for one in STOCK]
    ours = plan_lifts(heights, records(STOCK), EVEN, SETTINGS, ())
    theirs = plan_lifts(motion.map(heights), records(stock), EVEN, SETTINGS, ())
    refused = {lift.bundles: codes(lift) for lift in theirs.refused}
    assert {lift.bundles: codes(lift) for lift in ours.refused} == refused
    assert len(ours.offered) >= 3
    by_id = {lift.bundles: lift for lift in theirs.offered}
    assert set(by_id) == {lift.bundles for lift in ours.offered}
    for lift in ours.offered:
        other = by_id[lift.bundles]
        place = motion.place(lift.place.x_m, lift.place.y_m)
        # Of two places that are as good the first is taken, and that may be the one on the other side.
        assert np.hypot(place[0] - other.place.x_m, place[1] - other.place.y_m) < 0.032
        assert lift.safety == pytest.approx(other.safety, rel=0.15)
        assert (lift.set_down is None) == (other.set_down is None)
        assert lift.set_down is not None and other.set_down is not None
        assert lift.set_down.z_m == pytest.approx(other.set_down.z_m, abs=0.005)
        assert other.set_down.turn_deg == lift.set_down.turn_deg == 0
    assert [each.blockers for each in ours.blocked] == [each.blockers for each in theirs.blocked]


@MOTIONS
def test_footings_and_piles_turn_with_the_yard(motion: Motion) -> None:
    heights, stock = yard(), [motion.laid(one) for one in STOCK]
    ours = footings(heights, records(STOCK), SETTINGS)
    theirs = footings(motion.map(heights), records(stock), SETTINGS)
    for one, other in zip(ours, theirs, strict=True):
        assert one.overhang_m == pytest.approx(other.overhang_m, abs=0.011, nan_ok=True)
        assert sorted(side.drop_m for side in one.sides) == pytest.approx(
            sorted(side.drop_m for side in other.sides), abs=0.01
        )
    found = [
        sorted(
            (side.bundles, round(side.drop_m, 2))
            for side in pile_sides(bundles, standing)
        )
        for bundles, standing in ((records(STOCK), ours), (records(stock), theirs))
    ]  # fmt: skip
    for side, other in zip(*found, strict=True):
        assert side[0] == other[0] and side[1] == pytest.approx(other[1], abs=0.021)


@MOTIONS
@pytest.mark.parametrize("yaw_deg", [0.0, 0.4, -0.4])
def test_a_neighbour_that_leans_over_forbids_whichever_way_the_bars_run(
    motion: Motion, yaw_deg: float
) -> None:
    stock = [laid(0.0), laid(0.09, z=0.56, yaw_deg=yaw_deg), laid(0.5)]
    heights, moved = motion.map(map_of(stock)), [motion.laid(one) for one in stock]
    bundles = (record(moved[1], 1, layer=1), record(moved[2], 2))
    place = Placement(moved[2].x_m, moved[2].y_m, float(np.radians(moved[2].yaw_deg)))
    lift = judged(moved, bundles, place, magnet=EVEN, heights=heights)
    assert "unstable-side" in codes(lift)
    away = replace(stock[2], x_m=-0.5)
    bundles = (record(moved[1], 1, layer=1), record(motion.laid(away), 2))
    heights = motion.map(map_of([*stock[:2], away]))
    place = Placement(*motion.place(-0.5, 0.0), place.yaw_rad)
    lift = judged(moved, bundles, place, magnet=EVEN, heights=heights)
    assert not any("bundle 1" in veto.reason for veto in lift.vetoes)


@MOTIONS
@pytest.mark.parametrize("yaw_deg", [0.0, 0.3])
def test_groups_of_two_are_found_whichever_way_the_bars_run(motion: Motion, yaw_deg: float) -> None:
    stock = [
        laid(0.1 + 0.19 * k, diameter_m=0.06, yaw_deg=yaw_deg * (1 - 2 * k), y_m=0.1 * k) for k in range(2)
    ]
    wide = replace(
        EVEN, poles=tuple(replace(p, width_m=0.3) for p in MAGNET.poles),
        limits=replace(MAGNET.limits, roll_deg=8.0),
    )  # fmt: skip
    moved = [motion.laid(one) for one in stock]
    plan = plan_lifts(motion.map(map_of(stock)), records_of(moved), wide, LiftSettings(bundles=2), ())
    lifts = [*plan.offered, *plan.refused]
    assert [set(lift.bundles) for lift in lifts] == [{0, 1}]
    assert "straddles-neighbour" not in codes(lifts[0])
    if yaw_deg == 0:
        assert len(plan.offered) == 1


def records_of(stock: list[Laid]) -> tuple[Bundle, ...]:
    return tuple(record(one, k) for k, one in enumerate(stock))


@MOTIONS
def test_bundles_are_found_whichever_way_the_bars_run(motion: Motion) -> None:
    stock = [replace(one, length_m=3.0) for one in STOCK]
    heights = map_of(stock, x_m=(-0.6, 4.2), y_m=(-2.2, 2.2))
    ours = find_bundles(heights, BundleSettings())
    theirs = find_bundles(motion.map(heights), BundleSettings())
    assert len(ours) == len(theirs) >= 5
    left = list(theirs)
    for bundle in ours:
        place = motion.place(*bundle.centre_m[:2].tolist())
        apart = [np.hypot(*(other.centre_m[:2] - place)) for other in left]
        other = left.pop(int(np.argmin(apart)))
        assert min(apart) < 0.02
        yaw = np.radians(motion.yaw_deg(float(np.degrees(bundle.yaw_rad))))
        assert abs(turn_between(yaw, other.yaw_rad)) < 0.002
        assert bundle.layer == other.layer and bundle.on_top == other.on_top
        assert bundle.top_z_m == pytest.approx(other.top_z_m, abs=0.004)
        assert bundle.width_m == pytest.approx(other.width_m, abs=0.008)
