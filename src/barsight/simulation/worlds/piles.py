"""Pile up bars: layers on beams, bundles that nest in each other's grooves, heaps of single bars.

A pile's own frame: x across the bars, y along them from its centre, z up from the floor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from barsight.simulation.worlds.packing import hexagon, packed
from barsight.simulation.worlds.settling import BarPack, Rectangle, settle
from barsight.simulation.worlds.solids import Solid, box, cylinder

DIAMETERS_M = (0.016, 0.02, 0.025, 0.032, 0.04, 0.05, 0.06, 0.08, 0.09, 0.1)
SECTION_M2 = (0.006, 0.045)
"""Smallest and largest cross-sectional area of the steel in a bundle, m2."""
BARS = (3, 200)
BEAMS_M = (0.05, 0.09, 0.14)
BOW = 0.002
"""Standard deviation of the bow relative to the length, if there is room for it."""
MIN_LENGTH_RATIO, MIN_ORDERLY_LENGTH_RATIO = 0.8, 0.98
"""Minimum length of a bundle relative to the pile's bar length: in general, and in an orderly pile."""
RINGS = (1, 2, 3, 4)
"""Possible numbers of rings of the full hexagons in an orderly pile."""
GAPS_M = (0.002, 0.006, 0.02, 0.05, 0.12, 0.25)
"""Gaps between neighbours in a layer, m. In an orderly pile all gaps are equal, between the third and the
fifth value.
"""
ROLLED_M = 0.8
"""Largest distance of a bundle from its pile, m; bundles that roll farther are removed."""

Manner = Literal["layered", "nested", "loose", "orderly"]
Upright = Literal["wedges", "stanchions", "walls"]


@dataclass(frozen=True, eq=False)
class Lying:
    """A bundle, or a single bar, as it lies. y: position of its centre along the pile, m.

    yaw: its own, rad. bow: sideways deviation of its centre from its ends, m. uneven: spread of its bars'
    ends, m.
    """

    pack: BarPack
    layer: int
    length: float
    y: float = 0.0
    yaw: float = 0.0
    bow: float = 0.0
    uneven: float = 0.02

    @property
    def strapped(self) -> bool:
        """Tell whether it is a bundle."""
        return len(self.pack.cross) > 1


@dataclass
class Pile:
    """Bars that lie together. others: what is below, beside or on them; crossing: single bars across them."""

    manner: Manner
    upright: Upright
    lying: list[Lying] = field(default_factory=list)
    others: list[Solid] = field(default_factory=list)
    crossing: list[Solid] = field(default_factory=list)

    @property
    def top(self) -> float:
        """Return the highest point of the bars, m."""
        return max(one.pack.top for one in self.lying)


def pile_up(manner: Manner, upright: Upright, span: float, length: float, rng: np.random.Generator) -> Pile:
    """Build a pile `span` m wide of bars up to `length` m long; upright: what holds the pile's sides."""
    pile = Pile(manner, upright)
    sides = _stand_sides(pile, span, length, rng)
    sorts = [float(d) for d in rng.choice(DIAMETERS_M, 2, replace=False)]
    if manner == "loose":
        _heap(pile, span, length, sides, rng)
    elif manner == "nested":
        packs = [_bundle(sorts, rng) for _ in range(int(rng.integers(5, 8 + round(5 * span))))]
        base, boxes = _bear(pile, 0.0, (0.0, span), length, rng) if rng.random() < 0.5 else (0.0, [])
        settled = settle(_over(packs, (0.02, span - 0.02), base + 0.02, rng), boxes=[*sides, *boxes])
        laid = [_laid(pack, 0, length, rng) for pack in _within(settled, span)]
        pile.lying += _slackened(laid, (0.0, span), rng)
    elif manner == "orderly":
        whole = _whole_bundle(rng)
        _layers(pile, span, length, sides, lambda: whole, rng)
    else:
        _layers(pile, span, length, sides, lambda: _bundle(sorts, rng), rng)
    return pile


def _whole_bundle(rng: np.random.Generator) -> BarPack:
    """Create a bundle that is a full hexagon, with a cross-section within SECTION_M2."""
    area = {
        (rings, diameter): (3 * rings * (rings + 1) + 1) * math.pi / 4 * diameter**2
        for rings in RINGS for diameter in DIAMETERS_M
    }  # fmt: skip
    usual = [one for one, section in area.items() if SECTION_M2[0] <= section <= SECTION_M2[1]]
    rings, diameter = usual[int(rng.integers(len(usual)))]
    return BarPack(hexagon(rings, diameter), diameter / 2)


def _bundle(sorts: Sequence[float], rng: np.random.Generator) -> BarPack:
    """Pack a bundle of one of two bar diameters, most often the first, with a random roll."""
    diameter = float(sorts[int(rng.random() < 0.25)])
    count = round(float(rng.uniform(*SECTION_M2)) / (math.pi / 4 * diameter**2))
    cross = packed(int(np.clip(count, *BARS)), diameter, rng)
    turn = float(rng.uniform(0, 2 * math.pi))
    c, s = math.cos(turn), math.sin(turn)
    return BarPack(np.asarray(cross @ np.array([[c, s], [-s, c]]), np.float64), diameter / 2)


def _over(
    packs: Sequence[BarPack], span: tuple[float, float], base: float, rng: np.random.Generator
) -> list[BarPack]:
    """Arrange packs in rows above `span`, from height `base` up, without lateral overlap."""
    out: list[BarPack] = []
    x, z, row = span[0], base, 0.0
    for pack in packs:
        reach = pack.reach + 0.002
        if x + 2 * reach > span[1] and x > span[0]:
            x, z, row = span[0], z + row, 0.0
        slack = max(span[1] - x - 2 * reach, 0.0)
        x += float(rng.uniform(0, 0.3)) * slack
        place = np.array([x + reach, z + reach])
        out.append(BarPack(pack.cross - pack.cross.mean(axis=0) + place, pack.radius))
        x, row = x + 2 * reach, max(row, 2 * reach)
    return out


def _layers(
    pile: Pile, span: float, length: float, sides: list[Rectangle], bundle: Callable[[], BarPack],
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Lay one to three layers on beams, each settled on the layers below."""
    is_orderly = pile.manner == "orderly"
    gaps = (float(rng.uniform(GAPS_M[2], GAPS_M[4])),) if is_orderly else GAPS_M
    reach = (0.0, span)
    for layer in range(int(rng.integers(1, 4))):
        base = pile.top if pile.lying else 0.0
        level, boxes = _bear(pile, base, reach, length, rng)
        hanging: list[BarPack] = []
        x = reach[0] + 0.02
        while True:
            pack = bundle()
            if x + 2 * pack.reach > reach[1] - 0.02:
                break
            place = np.array([x + pack.reach, level + pack.reach + 0.003])
            if rng.random() > 0.1 or not hanging:
                hanging.append(BarPack(pack.cross - pack.cross.mean(axis=0) + place, pack.radius))
            x += 2 * pack.reach + float(rng.choice(gaps))
        if not hanging:
            return
        settled = settle(hanging, [one.pack for one in pile.lying], [*sides, *boxes])
        shortest = MIN_ORDERLY_LENGTH_RATIO if is_orderly else MIN_LENGTH_RATIO
        laid = [_laid(pack, layer, length, rng, shortest) for pack in settled]
        pile.lying += _slackened(laid, reach, rng)
        extents = np.array([pack.extent for pack in settled])
        reach = (float(extents[:, 0].min()), float(extents[:, 1].max()) - float(rng.uniform(0, 0.6)))


def _laid(
    pack: BarPack, layer: int, length: float, rng: np.random.Generator, shortest: float = MIN_LENGTH_RATIO
) -> Lying:
    own = float(rng.uniform(shortest, 1.0)) * length
    uneven = float(rng.choice([0.005, 0.02, 0.2], p=[0.3, 0.55, 0.15]))
    return Lying(pack, layer, own, float(rng.normal(0, 0.03)), uneven=uneven)


def _slackened(laid: list[Lying], reach: tuple[float, float], rng: np.random.Generator) -> list[Lying]:
    """Rotate and bow each bundle or bar within the gaps to its neighbours, seen from above."""
    out = []
    for one in laid:
        low, high = one.pack.extent
        others = [other.pack.extent for other in laid if other is not one]
        gaps = [low - b for a, b in others if a < low] + [a - high for a, _ in others if a >= low]
        free = 0.45 * max(min([low - reach[0], reach[1] - high, *gaps]), 0.0)
        limit = 2 * free / one.length
        yaw = float(np.clip(rng.normal(0, 0.004), -limit, limit))
        left = free - abs(yaw) * one.length / 2
        bow = float(np.clip(rng.normal(0, BOW * one.length), -left, left))
        out.append(replace(one, yaw=yaw, bow=bow))
    return out


def _heap(pile: Pile, span: float, length: float, sides: list[Rectangle], rng: np.random.Generator) -> None:
    """Heap up single bars of several diameters, most of them of the same one."""
    usual = float(rng.choice(DIAMETERS_M[2:]))
    bars = []
    for _ in range(int(rng.integers(15, 110))):
        diameter = usual if rng.random() < 0.6 else float(rng.choice(DIAMETERS_M))
        bars.append(BarPack(np.zeros((1, 2)), diameter / 2))
    settled = settle(_over(bars, (0.02, span - 0.02), 0.02, rng), boxes=sides)
    laid = [
        Lying(pack, 0, float(rng.uniform(0.5, 1.0)) * length, float(rng.normal(0, 0.15)), uneven=0.0)
        for pack in _within(settled, span)
    ]
    pile.lying += _slackened(laid, (0.0, span), rng)


def _within(packs: Sequence[BarPack], span: float) -> list[BarPack]:
    """Remove the packs that fell or rolled far out of the pile."""
    return [p for p in packs if p.extent[0] > -ROLLED_M and p.extent[1] < span + ROLLED_M]


def _bear(
    pile: Pile, base: float, reach: tuple[float, float], length: float, rng: np.random.Generator
) -> tuple[float, list[Rectangle]]:
    """Place beams across the bars at z = base. Returns the height of their tops and their collision boxes.

    Wedges at their ends stop bars from rolling off if there are no stanchions or walls.
    """
    height = float(rng.choice(BEAMS_M))
    low, high = reach[0] - 0.09, reach[1] + 0.09
    wedge = (0.06, max(0.05, 0.6 * height))
    for share in np.linspace(-0.35, 0.35, int(rng.choice([2, 3, 4]))):
        y = float(share) * length * MIN_LENGTH_RATIO + float(rng.normal(0, 0.04))
        over = float(rng.uniform(0, 0.2)) if pile.upright == "wedges" else -0.09
        ends = (low - over, high + over)
        wide = float(rng.uniform(0.8, 1.4)) * height
        size = np.array([ends[1] - ends[0], wide, height])
        pile.others.append(box("beam", np.array([sum(ends) / 2, y, base + height / 2]), size))
        if pile.upright == "wedges":
            for x in (low + 0.03, high - 0.03):
                place = np.array([x, y, base + height + wedge[1] / 2])
                pile.others.append(box("beam", place, np.array([wedge[0], 0.8 * wide, wedge[1]])))
    level = base + height
    boxes: list[Rectangle] = [(low, base, high, level)]
    if pile.upright == "wedges":
        boxes += [(x - 0.03, level, x + 0.03, level + wedge[1]) for x in (low + 0.03, high - 0.03)]
    return level, boxes


def _stand_sides(pile: Pile, span: float, length: float, rng: np.random.Generator) -> list[Rectangle]:
    """Place posts, walls or blocks on both sides of the pile, and return their collision boxes."""
    sides: list[Rectangle] = []
    for sign, edge in ((-1, 0.0), (1, span)):
        gap = float(rng.choice([0.005, 0.03, 0.08])) if pile.upright != "wedges" else 0.0
        if pile.upright == "stanchions":
            radius, high = float(rng.uniform(0.03, 0.06)), float(rng.uniform(0.8, 1.9))
            for y in rng.uniform(0.15, 0.4, 2) * length * (-1, 1):
                centre = np.array([edge + sign * (gap + radius), y, high / 2])
                pile.others.append(cylinder("stanchion", centre, np.eye(3)[2], radius, high))
            sides.append(_beside(edge + sign * gap, sign, 2 * radius, high))
        elif pile.upright == "walls":
            thick, high = float(rng.uniform(0.06, 0.25)), float(rng.uniform(0.6, 1.9))
            long, y = float(rng.uniform(0.7, 1.1)) * length, float(rng.uniform(-0.1, 0.1)) * length
            centre = np.array([edge + sign * (gap + thick / 2), y, high / 2])
            pile.others.append(box("wall", centre, np.array([thick, long, high])))
            sides.append(_beside(edge + sign * gap, sign, thick, high))
        elif pile.manner not in ("layered", "orderly"):
            for y in (-0.3, 0.3):
                centre = np.array([edge + sign * 0.06, y * length, 0.06])
                pile.others.append(box("beam", centre, np.array([0.12, 0.25, 0.12])))
            sides.append(_beside(edge, sign, 0.12, 0.12))
    return sides


def _beside(edge: float, sign: int, thick: float, high: float) -> Rectangle:
    return min(edge, edge + sign * thick), 0.0, max(edge, edge + sign * thick), high
