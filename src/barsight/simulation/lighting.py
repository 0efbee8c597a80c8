"""Bake the light of the hall's lamps on each surface, once, because nothing in the yard moves.

In each of two rows, lamps hang at every `spacing` along X; the beam of a lamp ends 1.5 spacings away, so at
most three lamps of a row reach a point. Lamp number i of row r has slot (i mod 3) + 3 r there.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from barsight.core.arrays import Float32, Float64, Int32, Int64, UInt8, kernel
from barsight.simulation.effects.settings import LightSettings
from barsight.simulation.rays import FAR, trace
from barsight.simulation.scene import Grid, Primitives, Scene

SLOTS = 6
TEXEL_M = 0.05
AROUND = 16
"""Number of lightmap cells around a bar."""
FLOOR_MARGIN_M = 5.0
SUN_EDGE_M = 0.07
"""Width of a sun patch's soft edge, m: the sun's diameter of half a degree over a distance of 8 m."""
ORDINARY_LIGHT = LightSettings()


class Lamps(NamedTuple):
    """Lamp positions (m): spacing and offset along X, y of the two rows (2,), height z; half length along Y.

    ambient: irradiance from the hall on an open level surface; bounce: share of it that reaches any surface.
    sun: (8,) unit direction towards the sun, patch that it lights on the floor (x from, to, y from, to),
    irradiance of a surface that faces it.
    """

    spacing: float
    offset: float
    rows: Float64
    z: float
    half_length: float
    power: float
    ambient: float
    bounce: float
    sun: Float64


class Lightmap(NamedTuple):
    """Light per texel. Texel t of primitive p: start[p] + s * around[p] + a; the floor is the last primitive.

    start: (P + 2,). along, around: (P + 1,). For a cylinder `a` runs around it; for a box it is the face (2 k
    for -axis k, 2 k + 1 for +axis k), with `along` on its longest axis; the floor's texels run along X, then
    Y. diffuse: (T,) irradiance from lamps and hall. seen: (T, SLOTS) visible share of each lamp, 255 for all
    of it. sun: (T,) irradiance from the sun if its patch covered everything; (0,) without a sun.
    """

    start: Int64
    along: Int32
    around: Int32
    diffuse: Float32
    seen: UInt8
    floor: Float64
    sun: Float32


def hall_lamps(above_floor_m: float, light: LightSettings = ORDINARY_LIGHT) -> Lamps:
    """Create two rows of lamps above a crane with cameras at `above_floor_m`, and optionally a sun."""
    z = above_floor_m + 3.5
    height, turn = np.radians([light.sun_elevation_deg, light.sun_azimuth_deg])
    to_sun = [np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height)]
    sun = np.array([*to_sun, *light.sun_patch_m, light.sun_ratio / np.sin(height)])
    return Lamps(
        5.0, 1.7, np.array([-4.2, 4.6]), z, light.lamp_length_m / 2, light.lamp_ratio * 0.75 * z * z,
        light.ambient, light.bounce_ratio, sun,
    )  # fmt: skip


def bake(scene: Scene, lamps: Lamps, rng: np.random.Generator) -> Lightmap:
    """Bake the scene's lightmap with rays from every texel to the lamps and over the hall's ceiling."""
    shape, _, cylinders = scene.primitives
    count = len(shape)
    along = np.ones(count + 1, dtype=np.int32)
    around = np.full(count + 1, 6, dtype=np.int32)
    around[:cylinders] = AROUND
    along[:cylinders] = np.ceil(2 * shape[:cylinders, 13] / TEXEL_M)
    along[cylinders:count] = np.ceil(2 * shape[cylinders:, 12:15].max(axis=1, initial=0) / TEXEL_M)
    low = shape[:, :2].min(axis=0) - FLOOR_MARGIN_M
    high = shape[:, :2].max(axis=0) + FLOOR_MARGIN_M
    along[count], around[count] = np.ceil((high - low) / TEXEL_M)
    start = np.concatenate([[0], np.cumsum(along.astype(np.int64) * around)])
    floor = np.array([low[0], low[1], TEXEL_M])
    diffuse = np.zeros(int(start[-1]), dtype=np.float32)
    seen = np.zeros((int(start[-1]), SLOTS), dtype=np.uint8)
    sun = np.zeros(int(start[-1]) if lamps.sun[7] > 0 else 0, dtype=np.float32)
    lightmap = Lightmap(start, along, around, diffuse, seen, floor, sun)
    rows = np.repeat(np.arange(count + 1, dtype=np.int32), along)
    places = np.arange(len(rows), dtype=np.int64) - np.repeat(np.cumsum(along) - along, along)
    order = rng.permutation(len(rows))
    _bake(*scene, lamps, lightmap, rows[order], places[order], _ceiling_directions(), diffuse, seen, sun)
    return lightmap


def _ceiling_directions() -> Float64:
    """Compute unit directions (16, 3) into the upper half-space: three rings and the zenith."""
    rings = ((15, 5), (35, 5), (60, 5))
    directions = [(0.0, 0.0, 1.0)]
    for number, (elevation_deg, count) in enumerate(rings):
        elevation = np.radians(elevation_deg)
        for k in range(count):
            azimuth = 2 * np.pi * (k + number / 3 + 0.1) / count
            directions.append(
                (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
            )
    return np.array(directions)


@kernel(parallel=True)
def _bake(
    primitives: Primitives, grid: Grid, lamps: Lamps, lightmap: Lightmap, rows: Int32, places: Int64,
    ceiling: Float64, diffuse: Float32, seen: UInt8, sun: Float32,
) -> None:  # fmt: skip
    """Bake the irradiance of each texel with shadow rays to the lamps and the hall's ceiling.

    rows, places: (R,) primitive of each row of texels and its place along the primitive. ceiling: (16, 3)
    unit directions. Fills diffuse (T,), seen (T, SLOTS), 255 for all of a lamp, and sun (T,) or (0,), see
    `Lightmap`; texels at or below the floor's z = 0 stay 0.
    """
    # Write to plain arrays: Numba 0.68 loses writes of a prange to the fields of a named tuple.
    for r in numba.prange(rows.shape[0]):
        scene, p, s = Scene(primitives, grid), rows[r], places[r]
        for a in range(lightmap.around[p]):
            x, y, z, nx, ny, nz = _texel(primitives, lightmap, p, s, a)
            if z <= 0.0:
                continue
            t = lightmap.start[p] + s * lightmap.around[p] + a
            light = _hall_light(scene, ceiling, x, y, z, nx, ny, nz, lamps.bounce) * lamps.ambient
            if sun.size > 0:
                cosine = lamps.sun[0] * nx + lamps.sun[1] * ny + lamps.sun[2] * nz
                if cosine > 0:
                    _, found = trace(
                        scene, x, y, z, lamps.sun[0], lamps.sun[1], lamps.sun[2], 1e-6, FAR, True
                    )
                    if found < 0:
                        sun[t] = cosine * lamps.sun[7]
            middle = int(np.floor((x - lamps.offset) / lamps.spacing + 0.5))
            for slot in range(6):
                lamp = middle + (slot % 3 - middle + 1) % 3 - 1
                lx, ly = lamp * lamps.spacing + lamps.offset - x, lamps.rows[slot // 3] - y
                lz = lamps.z - z
                square = lx * lx + ly * ly + lz * lz
                distance = np.sqrt(square)
                cosine = (lx * nx + ly * ny + lz * nz) / distance
                if cosine <= -0.2:
                    continue
                share = 0.0
                for end in range(2):
                    ey = ly + (2 * end - 1) * 0.6 * lamps.half_length
                    _, found = trace(scene, x, y, z, lx, ey, lz, 1e-6, 1.0, True)
                    if found < 0:
                        share += 0.5
                seen[t, slot] = int(255 * share)
                if cosine > 0:
                    light += share * cosine * lamp_beam(lamps, lx) * (lz / distance) / square
            diffuse[t] = light


@kernel()
def lamp_beam(lamps: Lamps, along_x: float) -> float:
    """Compute a lamp's power towards a point at distance `along_x` along X; zero from 1.5 spacings on."""
    u = along_x / (1.5 * lamps.spacing)
    return lamps.power * (1 - u * u) ** 2 if u * u < 1 else 0.0


@kernel()
def sun_patch(sun: Float64, x: float, y: float, z: float) -> float:
    """Compute the share of the sun's patch at (x, y, z), m: 1 inside, with soft edges.

    sun: (8,), see `Lamps`.
    """
    px, py = x - z * sun[0] / sun[2], y - z * sun[1] / sun[2]
    inside = min(px - sun[3], sun[4] - px, py - sun[5], sun[6] - py)
    share: float = min(max(inside / SUN_EDGE_M + 0.5, 0.0), 1.0)
    return share


@kernel()
def _hall_light(
    scene: Scene, ceiling: Float64, x: float, y: float, z: float, nx: float, ny: float, nz: float,
    bounce: float,
) -> float:  # fmt: skip
    """Compute the hall's irradiance, 1 on an open level surface; its share `bounce` is never occluded.

    ceiling: (16, 3) unit directions. x, y, z: point, m; nx, ny, nz: its normal.
    """
    total, norm = 0.0, 0.0
    for k in range(ceiling.shape[0]):
        cx, cy, cz = ceiling[k, 0], ceiling[k, 1], ceiling[k, 2]
        norm += cz
        cosine = cx * nx + cy * ny + cz * nz
        if cosine <= 0:
            continue
        _, found = trace(scene, x, y, z, cx, cy, cz, 1e-6, FAR, True)
        if found < 0:
            total += cosine
    return bounce + (1 - bounce) * total / norm


@kernel()
def _texel(
    primitives: Primitives, lightmap: Lightmap, p: int, s: int, a: int
) -> tuple[float, float, float, float, float, float]:
    """Compute the centre of a texel, lifted 1 mm off the surface, and its normal."""
    shape, lift = primitives.shape, 1e-3
    if p == shape.shape[0]:
        step = lightmap.floor[2]
        return lightmap.floor[0] + (s + 0.5) * step, lightmap.floor[1] + (a + 0.5) * step, lift, 0.0, 0.0, 1.0
    share = (s + 0.5) / lightmap.along[p] * 2 - 1
    if p < primitives.cylinders:
        angle = 2 * np.pi * (a + 0.5) / lightmap.around[p]
        c, d, length = np.cos(angle), np.sin(angle), share * shape[p, 13]
        nx = c * shape[p, 6] + d * shape[p, 9]
        ny = c * shape[p, 7] + d * shape[p, 10]
        nz = c * shape[p, 8] + d * shape[p, 11]
        out = shape[p, 12] + lift
        return (
            shape[p, 0] + length * shape[p, 3] + out * nx,
            shape[p, 1] + length * shape[p, 4] + out * ny,
            shape[p, 2] + length * shape[p, 5] + out * nz,
            nx, ny, nz,
        )  # fmt: skip
    face, sign = a // 2, 2.0 * (a % 2) - 1.0
    longest = longest_axis(shape, p)
    is_sphere = shape[p, 13] == 0.0
    out = sign * (shape[p, 12 if is_sphere else 12 + face] + lift)
    length = share * shape[p, 12 + longest] if longest != face and not is_sphere else 0.0
    i, j = 3 + 3 * face, 3 + 3 * longest
    return (
        shape[p, 0] + out * shape[p, i] + length * shape[p, j],
        shape[p, 1] + out * shape[p, i + 1] + length * shape[p, j + 1],
        shape[p, 2] + out * shape[p, i + 2] + length * shape[p, j + 2],
        sign * shape[p, i], sign * shape[p, i + 1], sign * shape[p, i + 2],
    )  # fmt: skip


@kernel()
def longest_axis(shape: Float64, p: int) -> int:
    """Find the axis, 0 to 2, along which box `p` is longest. shape: (P, 15), see `Primitives`."""
    k = 0
    for axis in (1, 2):
        if shape[p, 12 + axis] > shape[p, 12 + k]:
            k = axis
    return k
