"""Exact geometry of a drawn yard, and a judge of set-downs and ways that knows nothing of the package's own.

Bars are cylinders, dunnage is boxes. A load is lowered as a rigid body by its own statics: a linear program
finds how it rests, again with its centre of mass moved to each side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

Array = NDArray[np.float64]
CELL_M = 0.01
MAX_ROLL_DEG, MAX_PITCH_DEG = 10.0, 3.0
SHIFT_ALONG_RATIO, SHIFT_ACROSS_RATIO = 0.1, 0.1
"""How far, of length and width, the centre of mass may be off before the load must still not tip."""
MAX_ABOVE_M = 0.06
"""A load that rests this much over the height it was told has met something."""


@dataclass(frozen=True)
class Bars:
    """A bundle: middle of its axis, yaw from +Y, the bars' axes (N, 2) sideways and up, diameter, length."""

    number: int
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    cross_m: Array
    diameter_m: float
    length_m: float

    @property
    def width_m(self) -> float:
        return float(np.ptp(self.cross_m[:, 0])) + self.diameter_m

    @property
    def top_z_m(self) -> float:
        return self.z_m + float(self.cross_m[:, 1].max()) + self.diameter_m / 2

    @property
    def bottom_z_m(self) -> float:
        return self.z_m + float(self.cross_m[:, 1].min()) - self.diameter_m / 2

    def local(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Places across and along."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return (x - self.x_m) * cos + (y - self.y_m) * sin, (y - self.y_m) * cos - (x - self.x_m) * sin

    def surface(self, across: Array, sign: int) -> Array:
        """Upper (1) or lower (-1) side over the axis at places across; -inf or inf beside the bars."""
        inside = (self.diameter_m / 2) ** 2 - (across[..., None] - self.cross_m[:, 0]) ** 2
        side = self.cross_m[:, 1] + sign * np.sqrt(np.maximum(inside, 0))
        side = np.where(inside >= 0, side, -sign * np.inf)
        return np.asarray(side.max(axis=-1) if sign > 0 else side.min(axis=-1))


@dataclass(frozen=True)
class Beam:
    """A box of dunnage: centre, half sizes along itself, across, up; yaw from +X."""

    centre_m: Array
    half_m: Array
    yaw_rad: float


@dataclass(frozen=True)
class World:
    """All that stands on the floor z = 0 of a rectangle, x and y from low_m to high_m."""

    bundles: tuple[Bars, ...]
    beams: tuple[Beam, ...]
    low_m: Array
    high_m: Array
    heights: dict[int, Array] = field(default_factory=dict)

    def raster(self, without: int = -1) -> Array:
        """Exact heights [y, x] at the cells' centres, without one bundle."""
        if without not in self.heights:
            x, y = (np.arange(a, b, CELL_M) for a, b in zip(self.low_m, self.high_m, strict=True))
            z = np.zeros((y.size, x.size))
            for beam in self.beams:
                cos, sin = math.cos(beam.yaw_rad), math.sin(beam.yaw_rad)
                part, xx, yy = _part(x, y, beam.centre_m, float(np.hypot(*beam.half_m[:2])))
                away = xx - beam.centre_m[0], yy - beam.centre_m[1]
                on = np.abs(away[0] * cos + away[1] * sin) < beam.half_m[0]
                on &= np.abs(away[1] * cos - away[0] * sin) < beam.half_m[1]
                z[part] = np.where(on, np.maximum(z[part], beam.centre_m[2] + beam.half_m[2]), z[part])
            for bars in self.bundles:
                if bars.number == without:
                    continue
                part, xx, yy = _part(x, y, np.array([bars.x_m, bars.y_m]), bars.length_m / 2 + bars.width_m)
                across, along = bars.local(xx, yy)
                near = (np.abs(along) < bars.length_m / 2) & (np.abs(across) < bars.width_m / 2)
                top = np.full(xx.shape, -np.inf)
                top[near] = bars.z_m + bars.surface(across[near], 1)
                z[part] = np.maximum(z[part], top)
            self.heights[without] = z
        return self.heights[without]

    def at(self, x: Array, y: Array, without: int) -> Array:
        """Exact heights at places; inf beyond the rectangle, where nobody knows."""
        z = self.raster(without)
        column = np.rint((x - self.low_m[0]) / CELL_M).astype(int)
        row = np.rint((y - self.low_m[1]) / CELL_M).astype(int)
        held = (row >= 0) & (column >= 0) & (row < z.shape[0]) & (column < z.shape[1])
        return np.where(held, z[np.where(held, row, 0), np.where(held, column, 0)], np.inf)

    def changed(self, moved: Bars | None, number: int, beams: tuple[Beam, ...] = ()) -> World:
        """The world with a bundle moved (or taken), and with dunnage on which nothing lies cleared away."""
        others = tuple(b for b in self.bundles if b.number != number)
        bundles = (*others, moved) if moved is not None else others
        kept = tuple(beam for beam in self.beams if any(_carries(beam, b) for b in bundles))
        return replace(self, bundles=bundles, beams=(*kept, *beams), heights={})


def _part(x: Array, y: Array, centre: Array, reach: float) -> tuple[tuple[slice, slice], Array, Array]:
    columns = slice(*np.searchsorted(x, (centre[0] - reach, centre[0] + reach)).tolist())
    rows = slice(*np.searchsorted(y, (centre[1] - reach, centre[1] + reach)).tolist())
    xx, yy = np.meshgrid(x[columns], y[rows])
    return (rows, columns), xx, yy


def _carries(beam: Beam, bars: Bars) -> bool:
    if abs(beam.centre_m[2] + beam.half_m[2] - bars.bottom_z_m) > 0.05:
        return False
    along = np.linspace(-1, 1, 200)[:, None] * beam.half_m[0]
    x = beam.centre_m[0] + along * math.cos(beam.yaw_rad)
    y = beam.centre_m[1] + along * math.sin(beam.yaw_rad)
    across, lengthwise = bars.local(x, y)
    return bool(((np.abs(across) < bars.width_m / 2) & (np.abs(lengthwise) < bars.length_m / 2)).any())


def undermined(world: World, number: int) -> list[int]:
    """Bundles that lie over a part of this one: it would be drawn from under them."""
    (own,) = (b for b in world.bundles if b.number == number)
    along, across = np.meshgrid(
        np.linspace(-0.5, 0.5, 300) * own.length_m, np.linspace(-0.4, 0.4, 9) * own.width_m
    )
    x = own.x_m - along * math.sin(own.yaw_rad) + across * math.cos(own.yaw_rad)
    y = own.y_m + along * math.cos(own.yaw_rad) + across * math.sin(own.yaw_rad)
    found = []
    for other in world.bundles:
        if other.number != number and other.z_m > own.z_m + 0.25 * own.width_m:
            to_side, to_end = other.local(x, y)
            if ((np.abs(to_side) < 0.4 * other.width_m) & (np.abs(to_end) < other.length_m / 2)).any():
                found.append(other.number)
    return found


def settled(cross_m: Array) -> Array:
    """The bars' axes turned so that a row lies level, as a bundle comes to rest on level ground."""
    if len(cross_m) == 1:
        return cross_m
    apart = np.linalg.norm(cross_m - cross_m[0], axis=1)
    nearest = cross_m[int(np.argsort(apart)[1])] - cross_m[0]
    turn = -math.atan2(nearest[1], nearest[0])
    cos, sin = math.cos(turn), math.sin(turn)
    return np.asarray(cross_m @ np.array([[cos, sin], [-sin, cos]]))


def rest(
    world: World, load: Bars, x_m: float, y_m: float, yaw_rad: float, dunnage_m: float
) -> tuple[Bars, tuple[Beam, ...], list[str]]:
    """Lower the load: how it lies, what dunnage was laid, and what is wrong with that."""
    placed = replace(load, x_m=x_m, y_m=y_m, z_m=0.0, yaw_rad=yaw_rad, cross_m=settled(load.cross_m))
    u = np.arange(-placed.width_m / 2 + 0.002, placed.width_m / 2, 0.005)
    v = np.arange(-placed.length_m / 2, placed.length_m / 2, 0.02)
    vv, uu = np.meshgrid(v, u, indexing="ij")
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    h = world.at(x_m + uu * cos - vv * sin, y_m + uu * sin + vv * cos, load.number)
    if not np.isfinite(h).all():
        return placed, (), ["it reaches beyond the known floor"]
    beams = []
    if dunnage_m > 0:
        for share in (-0.3, 0.0, 0.3):
            on = np.abs(v - share * placed.length_m) < 0.05
            top = float(h[on].max()) + dunnage_m
            h[on] = top
            centre = [
                x_m - share * placed.length_m * sin,
                y_m + share * placed.length_m * cos,
                top - dunnage_m / 2,
            ]
            half = np.array([placed.width_m / 2 + 0.1, 0.05, dunnage_m / 2])
            beams.append(Beam(np.array(centre), half, yaw_rad))
    p = h - placed.surface(u, -1)
    table = np.stack([p, uu, vv], axis=-1)
    count = v.size // 10
    blocks = table[: count * 10].reshape(count, 10, u.size, 3)
    best = blocks[..., 0].argmax(axis=1)
    points = np.take_along_axis(blocks, best[:, None, :, None], axis=1)[:, 0].reshape(-1, 3)
    wrong = []
    z = math.nan
    for du, dv in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        at = du * SHIFT_ACROSS_RATIO * placed.width_m, dv * SHIFT_ALONG_RATIO * placed.length_m
        found = linprog(
            [1, *at], -np.column_stack([np.ones(len(points)), points[:, 1:]]), -points[:, 0],
            bounds=[(None, None), (-0.3, 0.3), (-0.1, 0.1)],
        )  # fmt: skip
        height, roll, pitch = found.x
        z = height if du == dv == 0 else z
        name = "it tips" if du == dv == 0 else "it would tip if its mass lay a tenth off"
        if abs(math.degrees(roll)) > MAX_ROLL_DEG:
            wrong.append(f"{name}: rolls {math.degrees(roll):.1f} deg")
        if abs(math.degrees(pitch)) > MAX_PITCH_DEG:
            wrong.append(f"{name}: pitches {math.degrees(pitch):.1f} deg")
    return replace(placed, z_m=float(z)), tuple(beams), wrong


def judge_set_down(
    world: World, load: Bars, place: dict[str, float], error: tuple[float, float, float], dunnage_m: float,
    beam: tuple[float, float, float],
) -> tuple[Bars, tuple[Beam, ...], list[str], list[str]]:  # fmt: skip
    """Set a load down, the crane off by error (m, m, rad): how it lies, what is unsupported, what collides.

    place: x_m, y_m, z_m, yaw_deg as lifts.json has them. beam: length, width, height over the load's top.
    """
    yaw = math.radians(place["yaw_deg"]) + error[2]
    x, y = place["x_m"] + error[0], place["y_m"] + error[1]
    lies, beams, unsupported = rest(world, load, x, y, yaw, dunnage_m)
    collides = []
    if lies.bottom_z_m > place["z_m"] + MAX_ABOVE_M:
        above = 1e3 * (lies.bottom_z_m - place["z_m"])
        collides.append(f"it rests {above:.0f} mm above the height it was told")
    if lies.bottom_z_m < place["z_m"] - MAX_ABOVE_M:
        below = 1e3 * (place["z_m"] - lies.bottom_z_m)
        unsupported.append(f"it rests {below:.0f} mm below the height it was told")
    vv, uu = np.meshgrid(
        np.arange(-beam[0] / 2, beam[0] / 2, 0.02), np.arange(-beam[1] / 2, beam[1] / 2, 0.02)
    )
    h = world.at(
        x + uu * math.cos(yaw) - vv * math.sin(yaw), y + uu * math.sin(yaw) + vv * math.cos(yaw), load.number
    )
    if (h > lies.top_z_m + beam[2]).any():
        collides.append("something stands under the magnet's beam")
    return lies, beams, unsupported, collides


def judge_way(world: World, load: Bars, to: Bars, travel_z_m: float, swing_m: float) -> list[str]:
    """Carry a load, swung out by swing_m to each side, along three ways: what it meets."""
    along, across = np.meshgrid(
        np.arange(-load.length_m / 2, load.length_m / 2, 0.05), np.linspace(-0.5, 0.5, 7) * load.width_m
    )
    turn = (to.yaw_rad - load.yaw_rad + math.pi / 2) % math.pi - math.pi / 2
    start, end = np.array([load.x_m, load.y_m]), np.array([to.x_m, to.y_m])
    steps = np.linspace(0, 1, 25)
    first, second = np.clip(2 * steps, 0, 1), np.clip(2 * steps - 1, 0, 1)
    for ways in ((steps, steps), (first, second), (second, first)):
        for share, x_share, y_share in zip(steps, *ways, strict=True):
            yaw = load.yaw_rad + share * turn
            cos, sin = math.cos(yaw), math.sin(yaw)
            for out in ((0, 0), (swing_m, 0), (-swing_m, 0), (0, swing_m), (0, -swing_m)):
                x = start[0] + x_share * (end - start)[0] + out[0] + across * cos - along * sin
                y = start[1] + y_share * (end - start)[1] + out[1] + across * sin + along * cos
                highest = float(world.at(x, y, load.number).max())
                if highest >= travel_z_m:
                    return [f"something {highest:.2f} m high stands in a way at {travel_z_m:.2f} m"]
    return []
