"""The pile's sides: how steep they are, which way they lean, and what stands over at each layer.

A pile is all parallel bundles that lie near each other. What its lower layers do is known only where they
show beside the upper ones: a layer that doesn't show is left out.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from barsight.core.arrays import Float64
from barsight.yard.stability import STEP_M, Footing
from barsight.yard.types import Bundle

NEAR_M = 0.3
PARALLEL_RAD = np.radians(5.0)


@dataclass(frozen=True)
class LayerOverhang:
    """By how much the outermost bundle of a layer stands out over that of the next lower layer that shows.

    Negative: it stands back. sigma_m: one standard deviation.
    """

    upper: int
    lower: int
    overhang_m: float
    sigma_m: float


@dataclass(frozen=True)
class PileSide:
    """One side of a pile: -1 towards low x, 1 towards high x (y, where the bars lie along X).

    bundles: the outermost of each layer that shows, from below. drop_m: from the highest's top to the lowest
    place beside it. slope_deg: of the line between (90 is sheer). lean_deg: of the outermost edges, positive
    outwards, NaN where one layer shows only. Sigmas are one standard deviation, NaN where the figure is.
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
    """Both sides of each pile, piles from low to high x. standing: how each bundle stands."""
    footings = {footing.bundle: footing for footing in standing}
    sides = []
    for pile in _piles(bundles):
        yaw = float(np.median([b.yaw_rad for b in pile]))
        across = np.array([np.cos(yaw), np.sin(yaw)])
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
    """Whether two parallel bundles come nearer than NEAR_M sideways and overlap along."""
    turned = (one.yaw_rad - other.yaw_rad + np.pi / 2) % np.pi - np.pi / 2
    if abs(turned) > PARALLEL_RAD:
        return False
    away = other.centre_m[:2] - one.centre_m[:2]
    cos, sin = np.cos(one.yaw_rad), np.sin(one.yaw_rad)
    beside = abs(away @ (cos, sin)) - (one.width_m + other.width_m) / 2
    beyond = abs(away @ (-sin, cos)) - (one.length_m + other.length_m) / 2
    return bool(beside < NEAR_M and beyond < 0)


def _side(pile: list[Bundle], across: Float64, side: int, footings: dict[int, Footing]) -> PileSide:
    def edge(bundle: Bundle) -> float:
        return float(side * (bundle.centre_m[:2] @ across)) + bundle.width_m / 2

    layers = sorted({b.layer for b in pile})
    outer = [max((b for b in pile if b.layer == layer), key=edge) for layer in layers]
    overhangs = tuple(
        LayerOverhang(
            upper.id, lower.id, edge(upper) - edge(lower), math.hypot(_edge_sigma(upper), _edge_sigma(lower))
        )
        for lower, upper in itertools.pairwise(outer)
    )
    lean = sigma = math.nan
    lowest, highest = outer[0], outer[-1]
    rise = float(highest.centre_m[2] - lowest.centre_m[2])
    if rise > 0:
        out = edge(highest) - edge(lowest)
        lean = math.degrees(math.atan2(out, rise))
        spread = math.hypot(_edge_sigma(highest), _edge_sigma(lowest))
        sigma = math.degrees(spread * rise / (rise**2 + out**2))
    beside = footings[highest.id].sides[0 if side < 0 else 1]
    run, drop = beside.run_m, beside.drop_m
    reach = run**2 + drop**2
    slope_sigma = (
        math.degrees(
            math.hypot(run * highest.sigma.top_z_m, drop * math.hypot(STEP_M, _edge_sigma(highest))) / reach
        )
        if reach > 0 else math.nan
    )  # fmt: skip
    return PileSide(
        side, tuple(b.id for b in outer), drop, beside.slope_deg, slope_sigma, lean, sigma, overhangs
    )


def _edge_sigma(bundle: Bundle) -> float:
    """Of the edge's place: the axis's and half the width's."""
    return math.hypot(bundle.sigma.lateral_m, bundle.sigma.width_m / 2)
