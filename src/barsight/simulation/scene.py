"""Build the stock from primitives (capped cylinders, boxes and spheres with materials) in a grid of cells.

Primitives 0 .. cylinders-1 are cylinders, the rest boxes and spheres. Rows of `shape` (float64, `yard`, m):
cylinder: centre 0:3, axis 3:6 (unit), direction of angle 0 6:9, of angle 90 degrees 9:12, radius 12, half
length 13. Box: centre 0:3, three unit axes 3:12, half sizes 12:15. A sphere has its radius at 12 and zeros at
13 and 14. Rows of `material` (float32): base albedo, gloss, texture offsets (m) around and along, twist
(m/m), texture scale along, rib pitch (m, 0 for none), weight of the texture, dust on upward-facing surfaces
(share) or, for a box, the number, from 1, of the code on the upper face of its third axis (0 for none),
roughness relative to the ordinary.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int32, Int64, kernel
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.stock import DunnageBeam, StackedBundle, Stock

STRAP_WIDTH_M = 0.032
STRAP_THICKNESS_M = 0.0012
LABEL_HALF_M = (0.032, 0.018, 0.0015)
CODE = 8
"""Column of `Primitives.material` that holds the number of a box's code."""


class Primitives(NamedTuple):
    """shape: (P, 15). material: (P, 10). cylinders: number of cylinders among the P primitives."""

    shape: Float64
    material: Float32
    cylinders: int


class Grid(NamedTuple):
    """Cells over the stock. Cell c = (i * ny + j) * nz + k lists `items[first[c]:first[c + 1]]`.

    low: (3,) lowest corner, m; cell: (3,) size, m; counts: (3,) nx, ny, nz. first: (cells + 1,). items: (N,)
    numbers of primitives.
    """

    low: Float64
    cell: Float64
    counts: Int64
    first: Int64
    items: Int32


class Scene(NamedTuple):
    """Geometry that a ray can hit: primitives and, below them, the floor z = 0 (its id is their number)."""

    primitives: Primitives
    grid: Grid


def build_scene(stock: Stock, settings: SimulationSettings, rng: np.random.Generator) -> Scene:
    """Convert the stock to primitives and sort them into the grid."""
    cylinders: list[Float64] = []
    cylinder_materials: list[list[float]] = []
    boxes: list[Float64] = []
    box_materials: list[list[float]] = []
    for number, bundle in enumerate(stock.bundles, start=1):
        shapes, materials = _bars(bundle, settings, rng)
        cylinders += shapes
        cylinder_materials += materials
        straps = _straps(bundle, settings.yard, rng)
        for k, (rounds, facets, label) in enumerate(straps):
            cylinders += rounds
            cylinder_materials += [plain_material(0.13, 0.5, rng) for _ in rounds]
            boxes += facets
            box_materials += [plain_material(0.13, 0.5, rng) for _ in facets]
            paper = plain_material(0.75, 0.0, rng, weight=0.3)
            if max(settings.yard.label_m) > 0:
                paper[CODE] = number
            if k == len(straps) // 2:
                boxes.append(label)
                box_materials.append(paper)
    for beam in stock.beams:
        boxes.append(_beam_shape(beam))
        box_materials.append(plain_material(rng.uniform(0.3, 0.42), 0.0, rng))
    shape = np.array([np.pad(row, (0, 15 - len(row))) for row in cylinders + boxes])
    material = np.array(cylinder_materials + box_materials, dtype=np.float32)
    primitives = Primitives(shape.reshape(-1, 15), material.reshape(-1, 10), len(cylinders))
    thickest = max(kind.diameter_m for kind in settings.kinds)
    return Scene(primitives, build_grid(primitives, (np.clip(thickest, 0.06, 0.12), 0.5)))


def select_primitives(scene: Scene, kept: Bool) -> Scene:
    """Keep only the primitives marked in `kept` (P,)."""
    shape, material, cylinders = scene.primitives
    left = Primitives(shape[kept], material[kept], int(kept[:cylinders].sum()))
    return Scene(left, build_grid(left, (float(scene.grid.cell[0]), float(scene.grid.cell[1]))))


def build_grid(primitives: Primitives, cell_m: tuple[float, float]) -> Grid:
    """Build cells of size cell_m[0] across (X, Z) and cell_m[1] along the bars (Y)."""
    low, high = primitive_bounds(primitives)
    margin = 1e-3
    low_corner = low.min(axis=0) - margin if len(low) else np.zeros(3)
    high_corner = high.max(axis=0) + margin if len(high) else np.ones(3)
    cell = np.array([cell_m[0], cell_m[1], cell_m[0]])
    counts = np.maximum(np.ceil((high_corner - low_corner) / cell).astype(np.int64), 1)
    first = np.zeros(int(counts.prod()) + 1, dtype=np.int64)
    empty = np.empty(0, dtype=np.int32)
    sizes = Grid(low_corner, cell, counts, first, empty)
    _fill(primitives.shape, primitives.cylinders, sizes)
    np.cumsum(first, out=first)
    items = np.empty(int(first[-1]), dtype=np.int32)
    grid = Grid(low_corner, cell, counts, first, items)
    _fill(primitives.shape, primitives.cylinders, grid)
    return grid


def primitive_bounds(primitives: Primitives) -> tuple[Float64, Float64]:
    """Compute lower and upper corners (P, 3) of the primitives' bounding boxes."""
    shape, n = primitives.shape, primitives.cylinders
    reach = np.empty((len(shape), 3))
    axis = np.abs(shape[:n, 3:6])
    reach[:n] = axis * shape[:n, 13:14] + shape[:n, 12:13] * np.sqrt(np.maximum(1 - axis**2, 0))
    turned = np.abs(shape[n:, 3:12].reshape(-1, 3, 3))
    reach[n:] = np.einsum("pij,pi->pj", turned, shape[n:, 12:15])
    spheres = n + np.flatnonzero(shape[n:, 13] == 0)
    reach[spheres] = shape[spheres, 12:13]
    return shape[:, :3] - reach, shape[:, :3] + reach


@kernel()
def _fill(shape: Float64, cylinders: int, grid: Grid) -> None:
    """Count each cell's primitives into first[c + 1] if items is empty; otherwise fill items with them.

    The numbers of cell c are written in order from items[first[c]]. shape: (P, 15), cylinders first, see
    `Primitives`.
    """
    low, cell, counts = grid.low, grid.cell, grid.counts
    writing = grid.items.size > 0
    cursor = grid.first.copy()
    for p in range(shape.shape[0]):
        s = shape[p]
        if p < cylinders:
            y_reach = abs(s[4]) * s[13] + s[12] * np.sqrt(max(1 - s[4] * s[4], 0.0))
        elif s[13] == 0:
            y_reach = s[12]
        else:
            y_reach = abs(s[4]) * s[12] + abs(s[7]) * s[13] + abs(s[10]) * s[14]
        j0 = max(int(np.floor((s[1] - y_reach - 1e-6 - low[1]) / cell[1])), 0)
        j1 = min(int(np.floor((s[1] + y_reach + 1e-6 - low[1]) / cell[1])), counts[1] - 1)
        for j in range(j0, j1 + 1):
            x0, x1, z0, z1 = _slab_extent(s, p < cylinders, low[1] + j * cell[1], low[1] + (j + 1) * cell[1])
            i0 = max(int(np.floor((x0 - low[0]) / cell[0])), 0)
            i1 = min(int(np.floor((x1 - low[0]) / cell[0])), counts[0] - 1)
            k0 = max(int(np.floor((z0 - low[2]) / cell[2])), 0)
            k1 = min(int(np.floor((z1 - low[2]) / cell[2])), counts[2] - 1)
            for i in range(i0, i1 + 1):
                for k in range(k0, k1 + 1):
                    c = (i * counts[1] + j) * counts[2] + k
                    if writing:
                        grid.items[cursor[c]] = p
                        cursor[c] += 1
                    else:
                        grid.first[c + 1] += 1


@kernel()
def _slab_extent(s: Float64, round_bar: bool, y0: float, y1: float) -> tuple[float, float, float, float]:
    """Compute bounds in x and z of the part of a primitive that can lie between y0 and y1.

    s: (15,), a row of `Primitives.shape`. Returns smallest and largest x, then z, m.
    """
    if not round_bar and s[13] == 0:
        reach = s[12] + 1e-6
        return s[0] - reach, s[0] + reach, s[2] - reach, s[2] + reach
    if not round_bar:
        rx = abs(s[3]) * s[12] + abs(s[6]) * s[13] + abs(s[9]) * s[14]
        rz = abs(s[5]) * s[12] + abs(s[8]) * s[13] + abs(s[11]) * s[14]
        return s[0] - rx - 1e-6, s[0] + rx + 1e-6, s[2] - rz - 1e-6, s[2] + rz + 1e-6
    h, r = s[13], s[12]
    lo, hi = -h, h
    if abs(s[4]) > 0.5:
        slack = r * np.sqrt(max(1 - s[4] * s[4], 0.0))
        a, b = (y0 - slack - s[1]) / s[4], (y1 + slack - s[1]) / s[4]
        lo, hi = max(min(a, b), -h), min(max(a, b), h)
    xa, xb = s[0] + lo * s[3], s[0] + hi * s[3]
    za, zb = s[2] + lo * s[5], s[2] + hi * s[5]
    r += 1e-6
    return min(xa, xb) - r, max(xa, xb) + r, min(za, zb) - r, max(za, zb) + r


def _bars(
    bundle: StackedBundle, settings: SimulationSettings, rng: np.random.Generator
) -> tuple[list[Float64], list[list[float]]]:
    sideways, along, up = bundle.axes
    radius = bundle.kind.diameter_m / 2
    bundle_shade = float(np.exp(rng.normal(0, 0.09)))
    shapes, materials = [], []
    for x, z in bundle.cross_m:
        shift = rng.uniform(-1, 1) * settings.yard.uneven_ends_m
        half = (bundle.length_m + rng.uniform(-0.5, 0.5) * settings.yard.uneven_ends_m) / 2
        centre = bundle.centre_m + x * sideways + z * up + shift * along
        shapes.append(np.concatenate([centre, along, up, sideways, [radius, half]]))
        albedo = 0.27 * bundle_shade * float(np.exp(rng.normal(0, 0.12)))
        gloss = settings.yard.gloss * float(np.exp(rng.normal(0, 0.25)))
        twist = float(rng.choice([-1, 1]) * rng.uniform(0.04, 0.08))
        offsets = rng.uniform(0, 10, 2)
        pitch = 0.7 * bundle.kind.diameter_m if bundle.ribbed else 0.0
        materials.append([albedo, gloss, *offsets, twist, rng.uniform(0.85, 1.15), pitch, 1.0, 0.0, 1.0])
    return shapes, materials


def plain_material(albedo: float, gloss: float, rng: np.random.Generator, weight: float = 0.8) -> list[float]:
    return [
        albedo * float(np.exp(rng.normal(0, 0.08))),
        gloss,
        *rng.uniform(0, 10, 2),
        0.0,
        1.0,
        0.0,
        weight,
        0.0,
        1.0,
    ]


def _beam_shape(beam: DunnageBeam) -> Float64:
    c, s = np.cos(beam.yaw_rad), np.sin(beam.yaw_rad)
    axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.concatenate([beam.centre_m, axes.ravel(), beam.half_m])


def _straps(
    bundle: StackedBundle, yard: YardSettings, rng: np.random.Generator
) -> list[tuple[list[Float64], list[Float64], Float64]]:
    """Build each strap: arcs on the corner bars (cylinders), flat runs between them (boxes), one label."""
    spacing = yard.strap_spacing_m
    half_m = LABEL_HALF_M
    if max(yard.label_m) > 0:
        half_m = (yard.label_m[0] / 2, yard.label_m[1] / 2, LABEL_HALF_M[2])
    if spacing == 0 or bundle.kind.rings == 0:
        return []
    count = max(2, round(bundle.length_m / spacing))
    places = (np.arange(count) + 0.5) / count - 0.5
    return [_strap(bundle, float(s) * bundle.length_m + rng.normal(0, 0.05), half_m, rng) for s in places]


def _strap(
    bundle: StackedBundle, place: float, label_half_m: tuple[float, ...], rng: np.random.Generator
) -> tuple[list[Float64], list[Float64], Float64]:
    sideways, along, up = bundle.axes
    radius, half_width, thick = bundle.kind.diameter_m / 2, STRAP_WIDTH_M / 2, STRAP_THICKNESS_M
    ring = np.linalg.norm(bundle.cross_m, axis=1).max()
    angles = bundle.roll_rad + np.arange(7) * np.pi / 3
    corners = ring * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    middle = bundle.centre_m + place * along
    rounds, facets = [], []
    for corner in corners[:6]:
        centre = middle + corner[0] * sideways + corner[1] * up
        rounds.append(np.concatenate([centre, along, up, sideways, [radius + thick, half_width]]))
    best, label = -2.0, np.zeros(15)
    for k in range(6):
        normal_angle = angles[k] + np.pi / 6
        normal = np.cos(normal_angle) * sideways + np.sin(normal_angle) * up
        if normal[2] < -0.6:
            continue
        tangent = np.cross(along, normal)
        flat = (corners[k] + corners[k + 1]) / 2
        centre = middle + flat[0] * sideways + flat[1] * up + (radius + thick / 2) * normal
        axes = np.concatenate([tangent, along, normal])
        half_edge = np.linalg.norm(corners[k + 1] - corners[k]) / 2
        facets.append(np.concatenate([centre, axes, [half_edge, half_width, thick / 2]]))
        if normal[2] > best:
            best = float(normal[2])
            spot = centre + rng.uniform(-0.5, 0.5) * half_edge * tangent + label_half_m[2] * normal
            label = np.concatenate([spot, axes, label_half_m])
    return rounds, facets, label
