"""Pack round bars as they lie when strapped: pulled together at random, without forming a full hexagon."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import ConvexHull

from barsight.core.arrays import Float64, kernel
from barsight.simulation.worlds.solids import Part, Solid, cylinder

STRAP_M = (0.032, 0.0012)
"""Width and thickness of a strap, m."""


def packed(count: int, diameter_m: float, rng: np.random.Generator) -> Float64:
    """Pack discs (count, 2), m: attracted to their centre, more so vertically, and pushed off each other.

    They are shaken with decreasing amplitude, some long enough to form a lattice, most not, and end up 0.1 %
    of their diameter apart.
    """
    places = rng.uniform(-1, 1, (count, 2)) * diameter_m * math.sqrt(count)
    flat = float(rng.uniform(0.6, 1.0))
    steps = int(rng.choice([40, 80, 400]))
    for step in range(steps):
        left = 1 - step / steps
        places -= places * (0.1, 0.1 / flat) * left
        places += rng.normal(0, 0.03 * diameter_m * left, places.shape)
        _push_apart(places, 1.001 * diameter_m, 3)
    for _ in range(2000):
        if _push_apart(places, 1.001 * diameter_m, 1) < 1e-5 * diameter_m:
            break
    return np.asarray(places - places.mean(axis=0), np.float64)


def hexagon(rings: int, diameter_m: float) -> Float64:
    """Arrange discs (3 rings (rings + 1) + 1, 2), m, in a full hexagon around the origin, a side down."""
    cells = np.arange(-rings, rings + 1)
    row, place = (index.ravel() for index in np.meshgrid(cells, cells, indexing="ij"))
    within = np.abs(row + place) <= rings
    x, z = place[within] + row[within] / 2, row[within] * math.sqrt(3) / 2
    return np.asarray(1.001 * diameter_m * np.stack([x, z], axis=1), np.float64)


@kernel()
def _push_apart(places: Float64, min_apart: float, times: int) -> float:
    """Push overlapping discs off each other in place; returns the deepest overlap of the last iteration, m.

    places: (N, 2) centres, m. min_apart: distance at which two discs touch, m.
    """
    deepest = 0.0
    for _ in range(times):
        deepest = 0.0
        for i in range(len(places)):
            for j in range(i):
                x, z = places[i, 0] - places[j, 0], places[i, 1] - places[j, 1]
                distance = math.sqrt(x * x + z * z) + 1e-12
                overlap = min_apart - distance
                if overlap > 0:
                    deepest = max(deepest, overlap)
                    x, z = 0.5 * overlap * x / distance, 0.5 * overlap * z / distance
                    places[i, 0] += x
                    places[i, 1] += z
                    places[j, 0] -= x
                    places[j, 1] -= z
    return deepest


def strap(cross: Float64, radius_m: float, centre: Float64, axes: Float64, bundle: int) -> list[Solid]:
    """Build a strap around the discs (count, 2) of a bundle: arcs on the outermost, flat runs between them.

    centre: (3,) of the strap; axes: (3, 3) sideways, along and up, in `yard`.
    """
    sideways, along, up = axes
    width, thick = STRAP_M
    hull = cross[ConvexHull(cross).vertices]
    parts: list[Solid] = []
    for k, corner in enumerate(hull):
        after = hull[(k + 1) % len(hull)]
        edge = after - corner
        length = float(np.hypot(*edge))
        tangent, normal = edge / length, np.array([edge[1], -edge[0]]) / length
        place = centre + corner[0] * sideways + corner[1] * up
        parts.append(cylinder("strap", place, along, radius_m + thick, width, bundle))
        middle = (corner + after) / 2 + (radius_m + thick / 2) * normal
        turned = np.stack([
            tangent[0] * sideways + tangent[1] * up, along, normal[0] * sideways + normal[1] * up,
        ])  # fmt: skip
        half = np.array([length, width, thick]) / 2
        place = centre + middle[0] * sideways + middle[1] * up
        parts.append(_plate("strap", place, turned, half, bundle))
    return parts


def tag(cross: Float64, radius_m: float, centre: Float64, axes: Float64, bundle: int) -> Solid:
    """Place a tag of 64 x 36 x 3 mm on the topmost bar."""
    sideways, _, up = axes
    top = cross[int(np.argmax(cross[:, 1]))]
    place = centre + top[0] * sideways + (top[1] + radius_m + STRAP_M[1] + 0.0015) * up
    return _plate("tag", place, axes, np.array([0.018, 0.032, 0.0015]), bundle)


def _plate(part: Part, centre: Float64, axes: Float64, half: Float64, bundle: int) -> Solid:
    return Solid(part, False, centre, axes, half, bundle)
