"""Draw yards from more than any model of them knows: `draw_world(seed)` makes one of KINDS.

Bundles are packed at random (`packing`), stacked on beams, in each other's grooves or leaning; what yards
have besides stands and lies around them. No code of the simulated stock or of the yard's stages is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from barsight.benchmarks.lift_judge.packing import packed, strap, tag
from barsight.benchmarks.lift_judge.solids import NOTHING, Solid, SolidYard, box, cylinder, turn_about_z
from barsight.core.arrays import Float64

KINDS = ("irregular", "beams", "walls", "along-x", "leaning", "askew", "stanchions", "unseen")
BARS = ((0.09, 7), (0.08, 10), (0.06, 7), (0.06, 12), (0.05, 19), (0.04, 23), (0.09, 5), (0.07, 9))
"""Diameter (m) and usual count of a bundle's bars."""


@dataclass(frozen=True, eq=False)
class DrawnWorld:
    """A yard of one of KINDS. size_m: along X and Y. free: bundles on which nothing was laid. hides: whether
    part of it is to lie out of the cameras' sight.
    """

    seed: int
    kind: str
    yard: SolidYard
    size_m: tuple[float, float]
    bar_length_m: float
    yaw_rad: float
    free: tuple[int, ...]

    @property
    def hides(self) -> bool:
        """Tell whether a strip of it should not be seen."""
        return self.kind == "unseen"


@dataclass
class _Laid:
    """A bundle's discs (count, 2) as they lie, x and z; yaw: of its own beside the section's."""

    cross: Float64
    radius: float
    yaw: float
    length: float
    layer: int


@dataclass
class _Section:
    """Bundles side by side and above each other, bars along Y, and what lies between and upon them."""

    laid: list[_Laid] = field(default_factory=list)
    others: list[Solid] = field(default_factory=list)
    covered: set[int] = field(default_factory=set)


def draw_world(seed: int, bar_length_m: float, span_m: float) -> DrawnWorld:
    """Draw the yard of a seed: kind `seed % 8`. span_m: of the stack across its bars."""
    rng = np.random.default_rng((23, seed))
    kind = KINDS[seed % len(KINDS)]
    section = _stack(kind, bar_length_m, span_m, rng)
    solids = [s for number, one in enumerate(section.laid) for s in _bundle(one, number, rng)]
    _lay_upon(section, kind, rng)
    _stand_beside(section, kind, bar_length_m, rng)
    yaw = {"along-x": math.pi / 2, "askew": math.radians(rng.choice([-1, 1]) * rng.uniform(8, 30))}.get(
        kind, math.radians(rng.normal(0, 0.5))
    )
    turned = SolidYard((*solids, *section.others)).seen_from(0.0, 0.0, -yaw).solids
    bounds = np.array([s.bounds for s in turned])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    by = np.array([-low[0], -(low[1] + high[1]) / 2, 0.0])
    free = tuple(k for k in range(len(section.laid)) if k not in section.covered)
    return DrawnWorld(
        seed, kind, SolidYard(tuple(s.moved(by) for s in turned)),
        (float(high[0] - low[0]), float(high[1] - low[1])), bar_length_m, yaw, free,
    )  # fmt: skip


def _stack(kind: str, length: float, span: float, rng: np.random.Generator) -> _Section:
    """Stack bundles over `span`: the lowest side by side, the next in grooves or on beams."""
    section = _Section()
    diameter, count = BARS[int(rng.integers(len(BARS)))]
    layers = int(rng.integers(1, 4)) if kind != "leaning" else int(rng.integers(2, 4))
    nested = kind == "leaning" or rng.random() < 0.3
    base, lean = 0.0, float(rng.uniform(-0.08, 0.08)) if kind == "leaning" else 0.0
    for layer in range(layers):
        on_beams = layer == 0 or not nested
        height = float(rng.choice([0.05, 0.09, 0.14])) if on_beams else 0.0
        x = lean * layer + 0.12 * layer * nested
        end = span - 0.12 * layer * nested - float(rng.uniform(0, 0.5)) * layer
        placed: list[_Laid] = []
        while x < end:
            one = _next(x, end, base + height, section, nested, (diameter, count, layer), length, rng)
            if one is None:
                break
            x = float(one.cross[:, 0].max()) + one.radius + float(rng.choice([0.006, 0.02, 0.05, 0.12, 0.25]))
            if rng.random() > 0.1 or not placed:
                placed.append(one)
        if not placed:
            break
        extents = [_extent(one) for one in placed]
        if on_beams:
            reach = min(low for low, _ in extents), max(high for _, high in extents)
            section.others += _bearers(base, height, reach, length, rng)
        _cover_below(section, extents)
        section.laid += placed
        base = max(float(one.cross[:, 1].max()) + one.radius for one in placed)
    return section


def _next(
    x: float, end: float, base: float, section: _Section, nested: bool, bars: tuple[float, int, int],
    length: float, rng: np.random.Generator,
) -> _Laid | None:  # fmt: skip
    """Pack a bundle and lay it down with its side at x; None where it doesn't fit before `end`."""
    diameter, usual, layer = bars
    radius = diameter / 2
    count = max(usual + int(rng.integers(-1, 3)), 3)
    cross = packed(count, diameter, rng)
    turn = turn_about_z(float(rng.uniform(0, 2 * math.pi)))[:2, :2]
    cross = cross @ turn.T
    own = float(rng.uniform(0.85, 1.0)) * length
    yaw = 0.0 if nested else float(np.clip(rng.normal(0, 0.004), -0.01, 0.01))
    slack = abs(yaw) * own / 2
    cross[:, 0] += x + slack + radius - cross[:, 0].min()
    if cross[:, 0].max() + radius + slack > end + 0.25:
        return None
    if nested and layer > 0:
        tries = cross[:, 0].max() - cross[:, 0].min() + diameter
        shifts = np.arange(0.0, tries, 0.01)
        rests = [_rest(cross + np.array([s, 0.0]), radius, section) for s in shifts]
        best = int(np.argmin(rests))
        cross += (shifts[best], rests[best])
    else:
        cross[:, 1] += base + radius - cross[:, 1].min()
    return _Laid(cross, radius, yaw, own, layer)


def _rest(cross: Float64, radius: float, section: _Section) -> float:
    """Compute how far discs must be shifted in z to lie on the floor or what lies below them."""
    lift = radius - float(cross[:, 1].min())
    for below in section.laid:
        away = np.abs(cross[:, None, 0] - below.cross[None, :, 0])
        reach = radius + below.radius
        over = np.sqrt(np.maximum(reach**2 - away**2, 0.0)) + below.cross[None, :, 1] - cross[:, None, 1]
        lift = max(lift, float(np.where(away < reach, over, -np.inf).max()))
    return lift


def _cover_below(section: _Section, extents: list[tuple[float, float]]) -> None:
    """Mark the bundles that a new layer lies over."""
    for number, one in enumerate(section.laid):
        low, high = _extent(one)
        if any(min(high, last) > max(low, first) for first, last in extents):
            section.covered.add(number)


def _extent(one: _Laid) -> tuple[float, float]:
    slack = abs(one.yaw) * one.length / 2
    return (
        float(one.cross[:, 0].min()) - one.radius - slack, float(one.cross[:, 0].max()) + one.radius + slack
    )  # fmt: skip


def _bearers(
    base: float, height: float, reach: tuple[float, float], length: float, rng: np.random.Generator
) -> list[Solid]:
    """Place three beams across the bars, under a layer that reaches from x to x."""
    beams = []
    for share in (-0.35, 0.0, 0.35):
        low, high = reach[0] - rng.uniform(0.02, 0.25), reach[1] + rng.uniform(0.02, 0.25)
        centre = np.array([(low + high) / 2, share * length + rng.normal(0, 0.05), base + height / 2])
        size = np.array([high - low, height, height])
        beams.append(box("beam", centre, size, float(rng.normal(0, 0.006))))
    return beams


def _bundle(one: _Laid, number: int, rng: np.random.Generator) -> list[Solid]:
    """Make a bundle's bars, straps and perhaps a tag."""
    turn = turn_about_z(one.yaw)
    axes = np.stack([turn[:, 0], turn[:, 1], np.array([0.0, 0.0, 1.0])])
    middle = np.array([one.cross[:, 0].mean(), rng.normal(0, 0.03), 0.0])
    cross = one.cross - (middle[0], 0.0)
    solids = []
    for x, z in cross:
        uneven = rng.uniform(-0.02, 0.02)
        centre = middle + x * axes[0] + z * axes[2] + uneven * axes[1]
        solids.append(cylinder("bar", centre, axes[1], one.radius, one.length - rng.uniform(0, 0.02), number))
    straps = max(2, round(one.length / 1.4))
    for k in range(straps):
        place = middle + ((k + 0.5) / straps - 0.5) * one.length * axes[1]
        solids += strap(cross, one.radius, place, axes, number)
    if rng.random() < 0.4:
        place = middle + rng.uniform(-0.3, 0.3) * one.length * axes[1]
        solids.append(tag(cross, one.radius, place, axes, number))
    return solids


def _lay_upon(section: _Section, kind: str, rng: np.random.Generator) -> None:
    """Lay beams, single bars and blocks on some of the free bundles."""
    free = [k for k in range(len(section.laid)) if k not in section.covered]
    share = 0.6 if kind == "beams" else 0.12
    for number in free:
        if rng.random() > share or number in section.covered:
            continue
        what = rng.choice(["beam", "bar", "block"])
        one = section.laid[number]
        low, high = _extent(one)
        y = float(rng.uniform(-0.42, 0.42)) * one.length
        thick = float(rng.choice([0.02, 0.045, 0.08, 0.1]))
        wide = {"beam": rng.uniform(0.5, 1.5), "bar": rng.uniform(0.8, 2.0), "block": rng.uniform(0.08, 0.2)}
        reach = float(wide[str(what)])
        x = (low + high) / 2 + float(rng.uniform(-0.3, 0.3)) * reach * (what != "block")
        yaw = float(rng.normal(0, 0.15))
        across = reach / 2 * math.cos(yaw)
        under = [k for k in free if _extent(section.laid[k])[0] < x + across
                 and _extent(section.laid[k])[1] > x - across
                 and abs(y) < section.laid[k].length / 2 - 0.15]  # fmt: skip
        tops = [float(section.laid[k].cross[:, 1].max()) + section.laid[k].radius for k in under]
        if not tops:
            continue
        z = max(tops) + 0.0013
        if what == "bar":
            centre = np.array([x, y, z + thick / 2])
            along = turn_about_z(yaw)[:, 0]
            section.others.append(cylinder("bar", centre, along, thick / 2, reach, _loose(section)))
        else:
            centre = np.array([x, y, z + thick / 2])
            section.others.append(box("beam", centre, np.array([reach, rng.uniform(0.05, 0.12), thick]), yaw))
        section.covered |= set(under)


def _loose(section: _Section) -> int:
    """Number a single bar as a bundle of its own, after those that were stacked."""
    return 1000 + sum(s.bundle != NOTHING for s in section.others)


def _stand_beside(section: _Section, kind: str, length: float, rng: np.random.Generator) -> None:
    """Stand walls or stanchions beside the stack."""
    if kind not in ("walls", "stanchions", "unseen"):
        return
    extents = np.array([_extent(one) for one in section.laid])
    top = max(float(one.cross[:, 1].max()) + one.radius for one in section.laid)
    for sign in (-1, 1):
        edge = extents[:, 0].min() if sign < 0 else extents[:, 1].max()
        gap = float(rng.choice([0.005, 0.03, 0.08]))
        if kind == "stanchions":
            for y in rng.uniform(-0.4, 0.4, 2) * length:
                radius, high = float(rng.uniform(0.03, 0.06)), top + float(rng.uniform(-0.1, 0.6))
                centre = np.array([edge + sign * (gap + radius), y, high / 2])
                up = np.array([0.0, 0.0, 1.0])
                section.others.append(cylinder("stanchion", centre, up, radius, high))
        elif rng.random() < 0.8:
            thick, high = float(rng.uniform(0.06, 0.25)), top + float(rng.uniform(-0.2, 0.8))
            long = float(rng.uniform(0.4, 1.1)) * length
            y = float(rng.uniform(-0.3, 0.3)) * length
            centre = np.array([edge + sign * (gap + thick / 2), y, high / 2])
            section.others.append(box("wall", centre, np.array([thick, long, high])))
