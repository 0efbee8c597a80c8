"""Stack the yard: sections of bundles in layers, dunnage between them, straps around them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.yard import BarKind

PACKING = 1.003
"""Distance between the axes of neighbouring bars relative to their diameter."""
END_CLEARANCE_M = 0.004
OVER_EDGE_M = 0.25
"""Largest overhang of a crossed bundle beyond its carriers, m; less than the gap between sections."""
MIN_CROSSED_M = 0.8
OVER_M = 0.02
"""Bundles that overlap by less, seen from above, don't lie on each other."""


@dataclass(frozen=True, eq=False)
class StackedBundle:
    """One bundle. Its axis is level, rotated by yaw_rad from Y towards -X; all lengths in `yard`, metres.

    centre_m: (3,) midpoint of the axis. cross_m: (count, 2) axes of the bars in the bundle's cross-section
    (sideways, up). top_z_m: highest point of its bars. on_top: no bundle lies on it.
    """

    section: int
    layer: int
    column: int
    kind: BarKind
    centre_m: Float64
    yaw_rad: float
    roll_rad: float
    cross_m: Float64
    length_m: float
    ribbed: bool
    on_top: bool = False

    @property
    def radius_m(self) -> float:
        """Return the radius of the circle around its bars, m."""
        return _radius(self.kind)

    @property
    def width_m(self) -> float:
        """Return the width seen from above."""
        return float(np.ptp(self.cross_m[:, 0])) + self.kind.diameter_m

    @property
    def top_z_m(self) -> float:
        """Return the highest point of its bars, m."""
        return float(self.centre_m[2] + self.cross_m[:, 1].max() + self.kind.diameter_m / 2)

    @property
    def axes(self) -> Float64:
        """Return its axes as rows (3, 3) in `yard`: sideways, along, up."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class DunnageBeam:
    """A wooden beam of dunnage: centre_m (3,); half_m (3,) along, across and up; yaw_rad from X."""

    centre_m: Float64
    half_m: Float64
    yaw_rad: float


@dataclass(frozen=True)
class Stock:
    """Everything that lies on the floor."""

    bundles: tuple[StackedBundle, ...]
    beams: tuple[DunnageBeam, ...]


def stack_yard(settings: SimulationSettings, rng: np.random.Generator) -> Stock:
    """Fill `length_m` of the yard with sections of different heights, kinds of bundles and bar lengths."""
    bundles: list[StackedBundle] = []
    beams: list[DunnageBeam] = []
    x, section = 0.0, 0
    while x < settings.length_m - 0.3:
        kinds = settings.kinds
        kind = kinds[(section + int(rng.integers(len(kinds)))) % len(kinds)] if section else kinds[0]
        room = settings.length_m - x
        span = min(room, rng.uniform(2.2, 4.2))
        if room - span < 1.2:
            span = room
        new_bundles, new_beams = _section(settings, rng, section, kind, (x, x + span))
        bundles += new_bundles
        beams += new_beams
        x += span + rng.uniform(0.3, 0.7)
        section += 1
    return Stock(tuple(bundles), tuple(beams))


def hexagonal_packing(kind: BarKind) -> Float64:
    """Compute the bars' axes (count, 2) in a hexagonal packing with level rows, the central bar first."""
    rings, pitch = kind.rings, kind.diameter_m * PACKING
    cells = [
        (q + r / 2, r * np.sqrt(0.75))
        for q in range(-rings, rings + 1)
        for r in range(-rings, rings + 1)
        if abs(q + r) <= rings
    ]
    places = pitch * np.array(sorted(cells, key=lambda cell: round(cell[0] ** 2 + cell[1] ** 2, 9)))
    return places.reshape(-1, 2)


def _radius(kind: BarKind) -> float:
    return kind.diameter_m * (kind.rings * PACKING + 0.5)


def _section(
    settings: SimulationSettings, rng: np.random.Generator, section: int, kind: BarKind,
    span_m: tuple[float, float],
) -> tuple[list[StackedBundle], list[DunnageBeam]]:  # fmt: skip
    yard = settings.yard
    length = yard.bar_length_m * (1.0 if section % 3 != 1 else 0.8)
    ribbed = bool(rng.random() < yard.ribbed_ratio)
    columns = _columns(settings, rng, kind, span_m, length)
    heights = _heights(len(columns), yard.max_layers, yard.missing_ratio, rng)
    layers: list[list[StackedBundle]] = []
    beams: list[DunnageBeam] = []
    base = 0.0
    for layer in range(max(heights, default=0)):
        present = [c for c, height in enumerate(heights) if height > layer]
        extent = (columns[present[0]][0] - _radius(kind), columns[present[-1]][0] + _radius(kind))
        beams += _dunnage(yard.dunnage_m, base, extent, length, rng)
        base += yard.dunnage_m
        placed: list[StackedBundle] = []
        for column in present:
            x, yaw = columns[column] if layer == 0 else _above(columns[column], yard.skew_deg, rng)
            x, yaw = _clear(x, yaw, placed, kind, length)
            y = float(np.clip(rng.normal(0, 0.05), -0.12, 0.12))
            placed.append(_bundle((section, layer, column), kind, (x, y, base), yaw, length, ribbed, rng))
        layers.append(placed)
        base = max(bundle.top_z_m for bundle in placed)
    if yard.crossed_ratio > 0 and rng.random() < yard.crossed_ratio:
        layers.append([_crossed(layers[-1], base, rng)])
    placed = [bundle for layer_placed in layers for bundle in layer_placed]
    return [replace(b, on_top=not any(covers(over, b) for over in placed)) for b in placed], beams


def _columns(
    settings: SimulationSettings, rng: np.random.Generator, kind: BarKind, span_m: tuple[float, float],
    length: float,
) -> list[tuple[float, float]]:  # fmt: skip
    """Place the lowest layer's bundles (x, yaw), far enough apart that skewed neighbours don't collide."""
    columns: list[tuple[float, float]] = []
    radius, yard = _radius(kind), settings.yard
    x = span_m[0] + radius
    while x + radius < span_m[1] or not columns:
        yaw = _skew(yard.skew_deg, rng)
        if columns:
            x = columns[-1][0] + _needed(radius, yaw - columns[-1][1], length)
            x += float(rng.gamma(2.0, yard.gap_m / 2)) if yard.gap_m > 0 else 0.0
            if x + radius > span_m[1]:
                break
        columns.append((x, yaw))
        x += 2 * radius
    return columns


def _needed(radius: float, difference_rad: float, length: float) -> float:
    return 2 * radius + END_CLEARANCE_M + abs(difference_rad) * (length / 2 + 0.2)


def _skew(skew_deg: float, rng: np.random.Generator) -> float:
    if skew_deg == 0:
        return 0.0
    limit = _limit(skew_deg)
    return float(np.radians(np.clip(rng.normal(0, skew_deg), -limit, limit)))


def _limit(skew_deg: float) -> float:
    return max(1.0, 2 * skew_deg)


def _above(below: tuple[float, float], skew_deg: float, rng: np.random.Generator) -> tuple[float, float]:
    """Place a bundle on the column below, slightly offset and rotated."""
    limit = np.radians(_limit(skew_deg))
    yaw = np.clip(below[1] + rng.normal(0, 0.3) * np.radians(skew_deg), -limit, limit)
    return below[0] + float(rng.normal(0, 0.006)), float(yaw)


def _clear(
    x: float, yaw: float, placed: list[StackedBundle], kind: BarKind, length: float
) -> tuple[float, float]:
    """Shift the bundle along X until it clears the previous one on its layer."""
    if placed:
        last = placed[-1]
        x = max(x, float(last.centre_m[0]) + _needed(_radius(kind), yaw - last.yaw_rad, length))
    return x, yaw


def _heights(columns: int, max_layers: int, missing_ratio: float, rng: np.random.Generator) -> list[int]:
    """Draw the number of layers per column: runs of random height, with single columns lower or empty."""
    heights: list[int] = []
    while len(heights) < columns:
        run = int(rng.integers(1, max_layers + 1))
        heights += [run] * int(rng.integers(1, 4))
    heights = heights[:columns]
    for column in range(columns):
        if rng.random() < missing_ratio:
            heights[column] = 0
        elif rng.random() < 0.15:
            heights[column] = max(1, heights[column] - 1)
    if not any(heights):
        heights[0] = 1
    return heights


def _bundle(
    number: tuple[int, int, int], kind: BarKind, place: tuple[float, float, float], yaw: float, length: float,
    ribbed: bool, rng: np.random.Generator,
) -> StackedBundle:  # fmt: skip
    """Create a bundle. place: x and y of its centre, and z of the surface that it lies on, m."""
    roll = rng.uniform(0, np.pi / 3) if kind.count <= 7 else np.radians(rng.normal(0, 1.5))
    c, s = np.cos(roll), np.sin(roll)
    cross = hexagonal_packing(kind) @ np.array([[c, s], [-s, c]])
    lowest = cross[:, 1].min() - kind.diameter_m / 2
    centre = np.array([place[0], place[1], place[2] - lowest])
    return StackedBundle(*number, kind, centre, yaw, float(roll), cross, length, ribbed)


def _crossed(carriers: list[StackedBundle], base: float, rng: np.random.Generator) -> StackedBundle:
    """Create a bundle of the same bars on the highest layer, across it or rotated by 6 to 20 degrees."""
    first = carriers[0]
    low, high = (float(b.centre_m[0]) + s * b.radius_m for b, s in ((first, -1), (carriers[-1], 1)))
    reach = (high - low) / 2 + OVER_EDGE_M
    yaw = float(rng.choice([-1, 1]) * np.radians(rng.uniform(6, 20)))
    length = min(rng.uniform(0.5, 0.9) * first.length_m, 2 * (reach - first.radius_m) / np.sin(abs(yaw)))
    if rng.random() < 0.5 or length < MIN_CROSSED_M:
        yaw = float(np.pi / 2 - abs(rng.normal(0, np.radians(3))))
        length = min(max(2 * reach - rng.uniform(0, OVER_EDGE_M), MIN_CROSSED_M), first.length_m)
    y = float(rng.uniform(-0.2, 0.2)) * first.length_m
    number = (first.section, first.layer + 1, -1)
    place = ((low + high) / 2, y, base)
    return _bundle(number, first.kind, place, yaw, length, first.ribbed, rng)


def covers(over: StackedBundle, under: StackedBundle) -> bool:
    """Check whether one bundle of a section covers another as seen from above.

    It does if they overlap in plan view by more than OVER_M on every axis of either (separating axes).
    """
    if over.section != under.section or over.layer <= under.layer:
        return False
    away = over.centre_m - under.centre_m
    for axis in (*over.axes[:2], *under.axes[:2]):
        reach = sum(
            abs(axis @ b.axes[0]) * b.width_m / 2 + abs(axis @ b.axes[1]) * b.length_m / 2
            for b in (over, under)
        )
        if abs(away @ axis) > reach - OVER_M:
            return False
    return True


def _dunnage(
    size: float, base: float, extent: tuple[float, float], length: float, rng: np.random.Generator
) -> list[DunnageBeam]:
    """Place three beams along X under a layer."""
    beams = []
    for share in (-0.36, 0.0, 0.36):
        begin, end = extent[0] - rng.uniform(0.05, 0.3), extent[1] + rng.uniform(0.05, 0.3)
        centre = np.array([(begin + end) / 2, share * length + rng.normal(0, 0.06), base + size / 2])
        half = np.array([(end - begin) / 2, size / 2, size / 2])
        beams.append(DunnageBeam(centre, half, float(np.radians(rng.normal(0, 0.3)))))
    return beams
