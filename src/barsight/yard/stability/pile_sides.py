"""Measure the pile's sides: how steep they are, which way they lean, and what overhangs at each layer.

A pile consists of all parallel bundles that lie near each other. From above, a lower layer's side shows only
where it projects beyond the upper ones; overhangs are inferred from the other side (`stability.Footing`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from barsight.core.arrays import Float64
from barsight.yard.axes import high_side, turn_between
from barsight.yard.stability.stability import (
    MIN_LEDGE_M,
    STEP_M,
    Footing,
    gaps_between,
)
from barsight.yard.types import Bundle

NEAR_M, PARALLEL_RAD = 0.3, np.radians(5.0)
"""Maximum gap (m) and angle between two bundles of one pile."""


@dataclass(frozen=True)
class LayerOverhang:
    """Overhang of a side's bundle over the edge of what carries it; negative where the next lower layer
    projects beyond it. NaN where it isn't known. sigma_m: one standard deviation.
    """

    bundle: int
    overhang_m: float
    sigma_m: float


@dataclass(frozen=True)
class PileSide:
    """One side of a pile: -1 towards low x, 1 towards high x (y, where the bars run along X).

    bundles: the outermost one of each layer that shows there, from the bottom up. drop_m: from the top of the
    highest to the lowest place beside it. slope_deg: of the line between (90 is vertical). lean_deg: of the
    line from the lowest edge to the highest, positive outwards, NaN where it isn't known. Sigmas are one
    standard deviation.
    """

    side: int
    bundles: tuple[int, ...]
    drop_m: float
    slope_deg: float
    slope_sigma_deg: float
    lean_deg: float
    lean_sigma_deg: float
    overhangs: tuple[LayerOverhang, ...]


def pile_sides(bundles: tuple[Bundle, ...], standing: tuple[Footing, ...]) -> tuple[PileSide, ...]:
    """Measure both sides of each pile; piles run from low to high x. standing: how each bundle stands."""
    footings = {footing.bundle: footing for footing in standing}
    sides = []
    for pile in _piles(bundles):
        turned = [turn_between(pile[0].yaw_rad, b.yaw_rad) for b in pile]
        across = high_side(pile[0].yaw_rad + float(np.median(turned)))
        sides += [_side(pile, across, side, footings) for side in (-1, 1)]
    return tuple(sides)


def _piles(bundles: tuple[Bundle, ...]) -> list[list[Bundle]]:
    pairs = [(i, j) for i, one in enumerate(bundles) for j, other in enumerate(bundles) if _near(one, other)]
    row, column = np.array(pairs, np.int64).reshape(-1, 2).T
    graph = coo_matrix((np.ones(row.size), (row, column)), shape=(len(bundles), len(bundles)))
    label = connected_components(graph, directed=False)[1] if bundles else np.empty(0, np.int64)
    piles = [[b for b, own in zip(bundles, label, strict=True) if own == k] for k in np.unique(label)]
    return sorted(piles, key=lambda pile: min(float(b.centre_m[0]) for b in pile))


def _near(one: Bundle, other: Bundle) -> bool:
    """Check whether two parallel bundles are within NEAR_M of each other sideways and overlap along."""
    if abs(turn_between(one.yaw_rad, other.yaw_rad)) > PARALLEL_RAD:
        return False
    beside, beyond = gaps_between(one, other)
    return beside < NEAR_M and beyond < 0


def _side(pile: list[Bundle], across: Float64, side: int, footings: dict[int, Footing]) -> PileSide:
    def edge(bundle: Bundle) -> float:
        return float(side * (bundle.centre_m[:2] @ across)) + bundle.width_m / 2

    def own_side(bundle: Bundle) -> int:
        """Return this side as the bundle's footing numbers it."""
        return side if high_side(bundle.yaw_rad) @ across > 0 else -side

    outer: list[Bundle] = []
    for layer in sorted({b.layer for b in pile}, reverse=True):
        widest = max((b for b in pile if b.layer == layer), key=edge)
        # A layer that ends behind an upper layer's edge doesn't show on this side.
        if not outer or edge(widest) > edge(outer[0]) + MIN_LEDGE_M:
            outer.insert(0, widest)
    lowest, highest = outer[0], outer[-1]
    overhangs = []
    for place, bundle in enumerate(outer):
        footing, own = footings[bundle.id], _edge_sigma(bundle)
        if footing.overhang_side == own_side(bundle):
            overhangs.append(LayerOverhang(bundle.id, footing.overhang_m, math.hypot(own, STEP_M)))
        elif place:
            lower = outer[place - 1]
            spread = math.hypot(own, _edge_sigma(lower))
            overhangs.append(LayerOverhang(bundle.id, edge(bundle) - edge(lower), spread))
        else:
            overhangs.append(LayerOverhang(bundle.id, math.nan, math.nan))
    lean, sigma = _lean(lowest, highest, edge(highest) - edge(lowest))
    if footings[highest.id].overhang_side == own_side(highest):
        lean = footings[highest.id].lean_deg
        sigma = math.degrees(overhangs[-1].sigma_m / highest.width_m)
    beside = footings[highest.id].sides[0 if own_side(highest) < 0 else 1]
    run, drop = beside.run_m, beside.drop_m
    reach = run**2 + drop**2
    slope_sigma = (
        math.degrees(
            math.hypot(run * highest.sigma.top_z_m, drop * math.hypot(STEP_M, _edge_sigma(highest))) / reach
        )
        if reach > 0 else math.nan
    )  # fmt: skip
    return PileSide(
        side,
        tuple(b.id for b in outer),
        drop,
        beside.slope_deg,
        slope_sigma,
        lean,
        sigma,
        tuple(overhangs),
    )


def _lean(lowest: Bundle, highest: Bundle, out_m: float) -> tuple[float, float]:
    """Compute the lean of the line between two edges and its sigma, degrees; NaN for a single layer."""
    rise = float(highest.centre_m[2] - lowest.centre_m[2])
    if not rise > 0:
        return math.nan, math.nan
    spread = math.hypot(_edge_sigma(highest), _edge_sigma(lowest))
    sigma = math.degrees(spread * rise / (rise**2 + out_m**2))
    return math.degrees(math.atan2(out_m, rise)), sigma


def _edge_sigma(bundle: Bundle) -> float:
    """Compute the sigma (m) of the edge's place, from those of the axis and of half the width."""
    return math.hypot(bundle.sigma.lateral_m, bundle.sigma.width_m / 2)
