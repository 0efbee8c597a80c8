"""Draw bundles of round bars, hexagons and irregular packs, and the maps that would be measured of them.

Nothing of the package is used but the record of a map: what judges shares no code with what is judged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from barsight.yard.types import HeightMap

Array = NDArray[np.float64]
CELL_M, FINE_M = 0.01, 0.0025
HEXAGONS = {7: 1, 19: 2, 37: 3, 61: 4}
STEEL_KG_PER_M3 = 7850.0


@dataclass(frozen=True, eq=False)
class Pack:
    """A bundle along Y. axes_m: (bars, 2) x and z at y = 0; bow_m: (bars,) of each bar, upwards or down;
    straps: (S, 3) y, half width and thickness, round the whole bundle."""

    axes_m: Array
    diameter_m: float
    length_m: float
    bow_m: Array
    straps: Array

    @property
    def mass_kg(self) -> float:
        """Weigh the bars."""
        section = len(self.axes_m) * np.pi / 4 * self.diameter_m**2
        return float(section * self.length_m * STEEL_KG_PER_M3)

    def heights(self, x: Array, y: Array) -> Array:
        """Compute the highest surface (Y, X) over each y and x; -inf beside the bars."""
        radius = self.diameter_m / 2
        shape = np.cos(np.pi * y / self.length_m)[:, None]
        z = np.full((len(y), len(x)), -np.inf)
        for (side, up), bow in zip(self.axes_m, self.bow_m, strict=True):
            own = np.flatnonzero(np.abs(x - side) < radius)
            top = up + np.sqrt(radius**2 - (x[own] - side) ** 2)
            z[:, own] = np.maximum(z[:, own], top + bow * shape)
        for at, half, thick in self.straps:
            z[np.abs(y - at) < half] += thick
        return np.where(np.abs(y)[:, None] <= self.length_m / 2, z, -np.inf)


def edges(pack: Pack) -> Array:
    """Return where a pack begins and ends across."""
    at = pack.axes_m[:, 0]
    return np.array([at.min() - pack.diameter_m / 2, at.max() + pack.diameter_m / 2])


def hexagon(bars: int, rng: np.random.Generator) -> Array:
    """Lay a full hexagon of bars of diameter 1, rolled at random, about the origin."""
    rings = HEXAGONS[bars]
    span = range(-rings, rings + 1)
    cells = np.array([(q + r / 2, r * 0.75**0.5) for q in span for r in span if abs(q + r) <= rings])
    angle = rng.uniform(0, np.pi / 3)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return 1.003 * cells @ turn.T


def settled(bars: int, rng: np.random.Generator) -> Array:
    """Settle bars of diameter 1 on a level floor, one after the other, each held by two that lie, or by one
    and the floor, in one of the three places that are lowest and nearest to the middle."""
    at = np.array([[0.0, 0.5]])
    wide, up = rng.uniform(0.0, 0.5), rng.uniform(0.2, 0.55) * bars**0.5
    for _ in range(bars - 1):
        loose = rng.uniform(1.001, 1.02)
        held = [_floor_places(at, loose)]
        i, j = np.triu_indices(len(at), 1)
        apart = at[j] - at[i]
        far = np.linalg.norm(apart, axis=1)
        near = (far < 2 * loose) & (far > 0.1)
        half, across = apart[near] / 2, np.column_stack([-apart[near, 1], apart[near, 0]]) / far[near, None]
        reach = np.sqrt(loose**2 - (far[near, None] / 2) ** 2)
        held += [at[i[near]] + half + side * reach * across for side in (-1, 1)]
        places = np.concatenate(held)
        free = np.linalg.norm(places[:, None] - at[None], axis=2).min(axis=1) > loose - 1e-6
        places = places[free & (places[:, 1] >= 0.5)]
        cost = wide * places[:, 1] + np.hypot(places[:, 0], places[:, 1] - up)
        best = np.argsort(cost)[:3]
        at = np.vstack([at, places[rng.choice(best)]])
    return at - [at[:, 0].mean(), 0]


def _floor_places(at: Array, loose: float) -> Array:
    """Find where a bar touches another and the floor."""
    low = at[at[:, 1] < 0.5 + loose]
    reach = np.sqrt(loose**2 - (low[:, 1] - 0.5) ** 2)
    return np.concatenate([
        np.column_stack([low[:, 0] + side * reach, np.full(len(low), 0.5)]) for side in (-1, 1)
    ])  # fmt: skip


def draw_pack(rng: np.random.Generator, *, irregular: bool, x_m: float = 0.0, length_m: float = 7.0) -> Pack:
    """Draw a bundle that stands on z = 0 with its middle at x_m."""
    if irregular:
        bars = int(rng.integers(5, 41))
        axes = settled(bars, rng)
    else:
        bars = int(rng.choice(list(HEXAGONS)))
        axes = hexagon(bars, rng)
    width = np.ptp(axes[:, 0]) + 1
    thickest = min(0.12, 0.5 / width)
    diameter = float(rng.uniform(max(0.02, 0.1 / width), max(thickest, 0.021)))
    axes = axes * diameter + rng.normal(0, 0.0005, axes.shape)
    axes[:, 0] += x_m
    axes[:, 1] += diameter / 2 - axes[:, 1].min()
    straps = np.array([(y + rng.normal(0, 0.05), 0.016, 0.0012) for y in np.arange(-2.6, 2.7, 1.7)])
    bow = rng.normal(0, 0.001) + rng.normal(0, 0.0005, len(axes))
    return Pack(axes, diameter, length_m, bow, straps if rng.random() < 0.7 else np.empty((0, 3)))


def seen_map(
    packs: list[Pack], x_m: tuple[float, float], y_m: tuple[float, float], rng: np.random.Generator
) -> HeightMap:
    """Draw the map that would be measured: smoothed, with errors alike along the bars, between neighbours and
    over all, and a standard deviation that states them."""
    x, y = np.arange(x_m[0], x_m[1], FINE_M), np.arange(y_m[0], y_m[1], CELL_M)
    z = np.max([pack.heights(x, y) for pack in packs], axis=0)
    z = np.maximum(z, 0.0)
    z = ndimage.gaussian_filter1d(z, rng.uniform(0.005, 0.016) / FINE_M, axis=1)
    z = ndimage.gaussian_filter1d(z, rng.uniform(0.5, 2.0), axis=0)[:, :: round(CELL_M / FINE_M)]
    own, along, slow, common = rng.uniform([0.002, 0.001, 0.001, 0.001], [0.005, 0.003, 0.003, 0.004])
    z = z + own * field(rng, z.shape, (1.5, 1.5)) + along * field(rng, z.shape, (40, 3))
    z = z + slow * field(rng, z.shape, (150, 100)) + common * rng.normal()
    sigma = np.full(z.shape, np.sqrt(own**2 + along**2 + slow**2 + common**2), np.float32)
    ones = np.ones(z.shape, np.float32)
    return HeightMap(
        float(x[0]), float(y[0]), CELL_M, z.astype(np.float32), sigma, 5 * ones, ones.astype(np.uint8)
    )


def field(rng: np.random.Generator, shape: tuple[int, int], cells: tuple[float, float]) -> Array:
    """Draw a field of variance 1 that is alike over so many cells."""
    skip = [max(int(c / 4), 1) for c in cells]
    small = [n // s + 12 for n, s in zip(shape, skip, strict=True)]
    spread = [c / s for c, s in zip(cells, skip, strict=True)]
    drawn = ndimage.gaussian_filter(rng.normal(0, 1, small), spread, mode="wrap")
    drawn = ndimage.zoom(drawn / drawn.std(), skip, order=1)
    return np.asarray(drawn[: shape[0], : shape[1]])


def rest_on(packs: list[Pack], place: tuple[float, float, float], poles: Array, max_roll: float) -> Array:
    """Lower the rigid faces onto the bars: height at the middle, slopes along and across.

    poles: (P, 4) along, across, length, width. Of all planes on or above the steel the lowest at its middle.
    """
    points = np.concatenate([_under(packs, place, pole)[0].reshape(-1, 3) for pole in poles])
    # What lies this far under the highest can't carry, as little as the faces may slope.
    points = points[points[:, 2] > points[:, 2].max() - 0.03]
    points = points[ConvexHull(points, qhull_options="QJ").vertices]
    rule = -np.column_stack([np.ones(len(points)), points[:, 0], points[:, 1]])
    found = linprog(
        [1, 0, 0], rule, -points[:, 2], bounds=[(None, None), (-0.35, 0.35), (-max_roll, max_roll)]
    )
    return np.asarray(found.x)


def gaps(packs: list[Pack], place: tuple[float, float, float], pole: Array, rest: Array) -> Array:
    """Compute the air gaps (V, U) under a face, inf where there is no steel."""
    points, _ = _under(packs, place, pole)
    z = points[..., 2]
    above = rest[0] + rest[1] * points[..., 0] + rest[2] * points[..., 1]
    return np.where(np.isfinite(z), np.maximum(above - z, 0), np.inf)


def _under(packs: list[Pack], place: tuple[float, float, float], pole: Array) -> tuple[Array, Array]:
    """Sample the steel under a face every 20 mm along and 1 mm across: (V, U, 3) along, across, height."""
    x0, y0, yaw = place
    v = pole[0] + np.arange(-pole[2] / 2 + 0.01, pole[2] / 2, 0.02)
    u = pole[1] + np.arange(-pole[3] / 2 + 0.0005, pole[3] / 2, 0.001)
    out = np.empty((len(v), len(u), 3))
    for k, along in enumerate(v):
        x = x0 - along * np.sin(yaw) + u * np.cos(yaw)
        y = np.array([y0 + along * np.cos(yaw)])
        z = np.max([pack.heights(x, y)[0] for pack in packs], axis=0)
        out[k] = np.column_stack([np.full(len(u), along), u, z])
    return out, v
