"""Draw yards more varied than any model of them: `draw_yard(seed)` makes one of KINDS or of NAMED_KINDS.

Piles (`piles`) are lined up along X; other objects of a yard stand and lie around them. No code of the
simulated stock or of the yard's stages is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.signal import argrelmin

from barsight.core.arrays import Float64
from barsight.simulation.worlds.packing import strap, tag
from barsight.simulation.worlds.piles import DIAMETERS_M, Lying, Manner, Pile, Upright, pile_up
from barsight.simulation.worlds.settling import BarPack
from barsight.simulation.worlds.solids import Solid, SolidYard, box, cylinder, turn_about_z

KINDS = (
    "layered", "beams", "walls", "along-x", "nested", "askew", "stanchions", "unseen", "loose", "mixed",
)  # fmt: skip
ORDERLY, SPILLED = NAMED_KINDS = ("orderly", "spilled")
"""Kinds of yards that are drawn only if named, not by a seed: layers of identical full-hexagon bundles; the
same with single bars that lie along on the highest ones.
"""
LOOSE = 1000
"""Number of the first bar that belongs to no bundle."""
SEGMENT_M = 1.2
"""Maximum length of the straight pieces that make up a bowed bar, m."""
AISLE_M = (0.3, 1.2)
SPAN_M = (1.6, 3.6)
MAX_SIDE_M = 3.4
"""Maximum width, along Y, of piles whose bars lie along X, m."""
STRAIGHT_M = 0.0005
MIN_BAR_M = 1.5
ON_STRAP_M = 0.0013
SPILLED_RATIO = 0.5
"""Share of the highest bundles on which a single bar lies along in a spilled yard."""
GROOVE_STEP_M = 0.0005


@dataclass(frozen=True, eq=False)
class DrawnBundle:
    """A bundle, or a single bar, of a drawn yard. number: of its solids; section, layer: of its pile.

    centre_m: (3,) centre of its bars. yaw_rad: of its axis, from Y towards -X. cross_m: (count, 2) axes of
    its bars from the centre, sideways and up. bow_m: sideways deviation of its centre from its ends.
    """

    number: int
    section: int
    layer: int
    manner: Manner
    centre_m: Float64
    yaw_rad: float
    cross_m: Float64
    diameter_m: float
    length_m: float
    bow_m: float


@dataclass(frozen=True, eq=False)
class DrawnYard:
    """A yard of one of KINDS or NAMED_KINDS, from x = 0 and centred on y = 0. size_m: along X and Y."""

    seed: int
    kind: str
    yard: SolidYard
    bundles: tuple[DrawnBundle, ...]
    size_m: tuple[float, float]

    @property
    def hides(self) -> bool:
        """Tell whether a strip of it is meant to be out of sight."""
        return self.kind == "unseen"

    @property
    def free(self) -> tuple[int, ...]:
        """Return the bundles in the highest layer of each pile; nested ones may be covered all the same."""
        strapped = [b for b in self.bundles if b.number < LOOSE]
        tops = {b.section: b.layer for b in sorted(strapped, key=lambda b: b.layer)}
        return tuple(b.number for b in strapped if b.layer == tops[b.section])


def kind_of(seed: int) -> str:
    """Return the kind of yard that a seed draws."""
    return KINDS[seed % len(KINDS)]


def draw_yard(
    seed: int, bar_length_m: float, length_m: float, min_length_ratio: float = 0.75, kind: str | None = None
) -> DrawnYard:
    """Draw the yard of a seed, of the seed's own kind (see `kind_of`) unless one is given.

    length_m: approximate extent along X, m. bar_length_m: length of the longest bars, m; min_length_ratio:
    smallest bar length of a pile relative to it.
    """
    rng = np.random.default_rng((23, seed))
    kind = kind or kind_of(seed)
    solids: list[Solid] = []
    bundles: list[DrawnBundle] = []
    x, section = 0.0, 0
    while x < length_m - SPAN_M[0] or not section:
        manner, upright = _sort(kind, section, rng)
        length = float(rng.uniform(min_length_ratio, 1.0)) * bar_length_m
        yaw = _yaw(kind, section, rng)
        if abs(yaw) > 1:
            length = min(length, max(length_m - x, MIN_BAR_M))
        across = float(rng.uniform(*SPAN_M))
        room = length_m - x
        span = min(across, MAX_SIDE_M) if abs(yaw) > 1 else min(across, room)
        pile = pile_up(manner, upright, span, length, rng)
        if kind == SPILLED:
            _spill_upon(pile, rng)
        else:
            _lay_upon(pile, 0.7 if kind == "beams" else 0.12, rng)
        placed, laid = _placed(pile, section, (len(bundles), LOOSE + len(bundles)), yaw, rng)
        bounds = np.array([s.bounds for s in placed])
        low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
        by = np.array([x - low[0], -(low[1] + high[1]) / 2 + rng.normal(0, 0.1), 0.0])
        solids += [s.moved(by) for s in placed]
        bundles += [replace(b, centre_m=b.centre_m + by) for b in laid]
        x += float(high[0] - low[0]) + float(rng.uniform(*AISLE_M))
        section += 1
    solids += _stand_about(x, bar_length_m, rng)
    bounds = np.array([s.bounds for s in solids])
    size = bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)
    return DrawnYard(seed, kind, SolidYard(tuple(solids)), tuple(bundles), (float(size[0]), float(size[1])))


def _sort(kind: str, section: int, rng: np.random.Generator) -> tuple[Manner, Upright]:
    """Choose how a pile is stacked and what holds its sides."""
    manner: Manner = "nested" if rng.random() < 0.3 else "layered"
    upright: Upright = "wedges"
    if kind == "nested":
        manner = "nested"
    if kind in NAMED_KINDS:
        manner = "orderly"
    if kind == "loose" and section % 2 == 0:
        return "loose", "stanchions" if rng.random() < 0.5 else "wedges"
    if kind == "mixed":
        manners: tuple[Manner, ...] = ("layered", "nested", "loose")
        manner = manners[section % 3]
    if kind in ("walls", "stanchions"):
        upright = "walls" if kind == "walls" else "stanchions"
    elif rng.random() < 0.25:
        upright = "stanchions"
    return manner, upright


def _yaw(kind: str, section: int, rng: np.random.Generator) -> float:
    if kind == "along-x" or (kind == "mixed" and section % 4 == 3):
        return math.pi / 2 + math.radians(rng.normal(0, 0.5))
    if kind == "askew":
        return math.radians(rng.choice([-1, 1]) * rng.uniform(8, 30))
    return math.radians(rng.normal(0, 0.5))


def _placed(
    pile: Pile, section: int, first: tuple[int, int], yaw: float, rng: np.random.Generator
) -> tuple[list[Solid], list[DrawnBundle]]:
    """Create a pile's solids, rotated by yaw; first: numbers of its first bundle and first single bar."""
    solids, bundles = list(pile.others), []
    for k, one in enumerate(pile.lying):
        number = first[0 if one.strapped else 1] + k
        made = _bars(one, number, rng)
        solids += made
        bundles.append(_described(pile.manner, one, made, section, yaw))
    layer = max(one.layer for one in pile.lying) + 1
    for k, bar in enumerate(pile.crossing):
        number = first[1] + len(pile.lying) + k
        solids.append(replace(bar, bundle=number))
        turned = bar.turned(yaw)
        along, diameter, length = turned.axes[0], 2 * float(bar.half[1]), 2 * float(bar.half[0])
        bundles.append(DrawnBundle(
            number, section, layer, "loose", turned.centre, math.atan2(-along[0], along[1]), np.zeros((1, 2)),
            diameter, length, 0.0,
        ))  # fmt: skip
    return [s.turned(yaw) for s in solids], bundles


def _described(manner: Manner, one: Lying, made: list[Solid], section: int, yaw: float) -> DrawnBundle:
    """Describe a bundle by its solids: it ends where its bars do on the average, as a simulated stock's does,
    not where they were to be cut.
    """
    middle = one.pack.cross.mean(axis=0)
    turn = turn_about_z(one.yaw)
    at = np.array([middle[0], one.y, middle[1]])
    pieces = [s for s in made if s.part == "bar"]
    ends = np.array([(s.centre - at) @ turn[:, 1] + (-s.half[0], s.half[0]) for s in pieces])
    ends = ends.reshape(len(one.pack.cross), -1, 2)
    low, high = float(ends[..., 0].min(axis=1).mean()), float(ends[..., 1].max(axis=1).mean())
    centre = turn_about_z(yaw) @ (at + (low + high) / 2 * turn[:, 1])
    return DrawnBundle(
        made[0].bundle, section, one.layer, manner, centre, yaw + one.yaw, one.pack.cross - middle,
        2 * one.pack.radius, high - low, one.bow,
    )  # fmt: skip


def _bars(one: Lying, number: int, rng: np.random.Generator) -> list[Solid]:
    """Create a bundle's bars, its straps and perhaps a tag, or a single bar."""
    turn = turn_about_z(one.yaw)
    axes = np.stack([turn[:, 0], turn[:, 1], np.array([0.0, 0.0, 1.0])])
    centre = one.pack.cross.mean(axis=0)
    middle = np.array([centre[0], one.y, 0.0])
    cross = one.pack.cross - (centre[0], 0.0)
    solids = []
    for x, z in cross:
        # The ends of bars of equal nominal length are uneven.
        short, shift = rng.uniform(0, 1, 2) * one.uneven
        begin, end = -one.length / 2 + shift * 0.3, one.length / 2 - short
        at = middle + x * axes[0] + z * axes[2]
        solids += _bowed(at, axes, (begin, end), one, number)
    if not one.strapped:
        return solids
    straps = max(2, round(one.length / float(rng.uniform(1.1, 1.9))))
    for k in range(straps):
        place = ((k + 0.5) / straps - 0.5) * one.length + float(rng.normal(0, 0.04))
        at = middle + place * axes[1] + _bow_at(one, place) * axes[0]
        solids += strap(cross, one.pack.radius, at, axes, number)
    if rng.random() < 0.5:
        place = float(rng.uniform(-0.3, 0.3)) * one.length
        at = middle + place * axes[1] + _bow_at(one, place) * axes[0]
        solids.append(tag(cross, one.pack.radius, at, axes, number))
    return solids


def bow_at(bow_m: float, length_m: float, along_m: Float64) -> Float64:
    """Compute the sideways deviation of points along a bowed bar, m; its mean over the length is zero."""
    return np.asarray(bow_m * (1 / 3 - (2 * along_m / length_m) ** 2), np.float64)


def _bow_at(one: Lying, along: float) -> float:
    return float(bow_at(one.bow, one.length, np.array(along)))


def _bowed(at: Float64, axes: Float64, ends: tuple[float, float], one: Lying, number: int) -> list[Solid]:
    """Create one bar from straight pieces that follow the bow."""
    pieces = 1 if abs(one.bow) < STRAIGHT_M else max(2, math.ceil(one.length / SEGMENT_M))
    along = np.linspace(*ends, pieces + 1)
    points = np.array([at + a * axes[1] + _bow_at(one, a) * axes[0] for a in along])
    return [
        cylinder("bar", (p + q) / 2, q - p, one.pack.radius, float(np.linalg.norm(q - p)), number)
        for p, q in pairwise(points)
    ]


def _lay_upon(pile: Pile, share: float, rng: np.random.Generator) -> None:
    """Lay beams, single bars and blocks across bundles of the highest layer."""
    top = max(one.layer for one in pile.lying)
    free = [one for one in pile.lying if one.layer == top and one.strapped]
    taken: set[int] = set()
    for one in free:
        if rng.random() > share or id(one) in taken:
            continue
        what = str(rng.choice(["beam", "bar", "block"]))
        low, high = one.pack.extent
        y = float(rng.uniform(-0.4, 0.4)) * one.length
        thick = (
            float(rng.choice([0.02, 0.045, 0.08, 0.1])) if what != "bar" else float(rng.choice(DIAMETERS_M))
        )
        reach = float({"beam": rng.uniform(0.5, 1.5), "bar": rng.uniform(0.8, 2.0), "block": 0.15}[what])
        x = (low + high) / 2 + float(rng.uniform(-0.3, 0.3)) * reach * (what != "block")
        yaw = float(rng.normal(0, 0.15))
        across = reach / 2 * math.cos(yaw) + 0.1
        near = [o for o in pile.lying if o.pack.extent[0] < x + across and o.pack.extent[1] > x - across]
        at = np.array([x, y, max(o.pack.top for o in near) + ON_STRAP_M + thick / 2])
        if what == "bar":
            pile.crossing.append(cylinder("bar", at, turn_about_z(yaw)[:, 0], thick / 2, reach))
        else:
            size = np.array([reach, float(rng.uniform(0.05, 0.12)), thick])
            pile.others.append(box("beam", at, size, yaw))
        taken |= {id(o) for o in near}


def _spill_upon(pile: Pile, rng: np.random.Generator) -> None:
    """Lay single bars along on bundles of the highest layer, each in a groove between two bars below it."""
    top = max(one.layer for one in pile.lying)
    for one in [one for one in pile.lying if one.layer == top]:
        if rng.random() > SPILLED_RATIO:
            continue
        radius = float(rng.choice(DIAMETERS_M)) / 2
        aside, up = one.pack.cross.T
        x = np.arange(aside.min(), aside.max(), GROOVE_STEP_M)
        room = (one.pack.radius + radius) ** 2 - (x[:, None] - aside) ** 2
        z = np.where(room > 0, up + np.sqrt(np.maximum(room, 0)), -np.inf).max(axis=1)
        (grooves,) = argrelmin(z)
        if not grooves.size:
            continue
        groove = int(rng.choice(grooves))
        length = float(rng.choice([rng.uniform(0.9, 1.0), rng.uniform(0.3, 0.9)], p=[0.7, 0.3])) * one.length
        turn, along = turn_about_z(one.yaw), float(rng.uniform(-0.5, 0.5)) * (one.length - length)
        at = turn[:, 0] * (x[groove] - aside.mean()) + turn[:, 1] * along
        cross = np.array([[aside.mean() + at[0], z[groove] + ON_STRAP_M]])
        pile.lying.append(Lying(BarPack(cross, radius), top + 1, length, one.y + float(at[1]), one.yaw))


def _stand_about(end_x: float, bar_length: float, rng: np.random.Generator) -> list[Solid]:
    """Place carts and people beside the piles, beyond the ends of the bars."""
    solids = []
    for _ in range(int(rng.integers(0, 3))):
        x, side = float(rng.uniform(0, end_x)), float(rng.choice([-1, 1]))
        y = side * (bar_length / 2 + float(rng.uniform(0.5, 1.0)))
        if rng.random() < 0.5:
            solids.append(cylinder("person", np.array([x, y, 0.85]), np.eye(3)[2], 0.22, 1.7))
        else:
            size = np.array([float(rng.uniform(0.8, 1.6)), 0.7, float(rng.uniform(0.5, 1.0))])
            solids.append(
                box("cart", np.array([x, y + side * 0.35, size[2] / 2]), size, float(rng.normal(0, 0.2)))
            )
    return solids
