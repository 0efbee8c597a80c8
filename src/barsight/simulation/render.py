"""Render a camera's view of the yard as linear radiance: four rays per pixel, textured and lightmapped."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from barsight.core.arrays import Float32, Float64, UInt8, kernel
from barsight.core.pose import Pose
from barsight.simulation.lighting import Lamps, Lightmap, lamp_beam, longest_axis, sun_patch
from barsight.simulation.rays import FAR, trace
from barsight.simulation.scene import CODE, Grid, Primitives, Scene
from barsight.simulation.textures import ALONG_M, AROUND_M, TILE

FLOOR_ALBEDO = 0.22
SPREAD_ALONG = 0.38
"""Roughness along the bar, by which highlights are stretched along it [Ward 1992]."""
SPREAD_AROUND = 0.17
HIGHLIGHT = 0.28
"""Radiance at the centre of a highlight under a lamp, relative to that of white paper."""
DUST_ALBEDO = 0.6
MASK = TILE - 1


NO_CODES: UInt8 = np.zeros((0, 1, 1), np.uint8)
INK = 0.12
"""Albedo of a code's dark modules relative to that of the paper."""


class Shading(NamedTuple):
    """Shading inputs besides the geometry. tile: (TILE, TILE, 4), see `surface_tile`. codes: (N, S, S)
    uint8, one cell per module, 0 dark; `Primitives.material` refers to them by numbers from 1.
    """

    lamps: Lamps
    lightmap: Lightmap
    tile: Float32
    codes: UInt8 = NO_CODES


def render_view(scene: Scene, look: Shading, rays: Float32, side: int, yard_from_cam: Pose) -> Float32:
    """Render the radiance (H, W) float32, about 1 for white paper under the lamps.

    rays: (side H, side W, 2) float32, x and y of each sample's direction with z = 1: side^2 samples per
    pixel, of which only the diagonal ones are traced if they all hit the same primitive.
    """
    image = np.empty((rays.shape[0] // side, rays.shape[1] // side), dtype=np.float32)
    pose = np.column_stack([yard_from_cam.rotation, yard_from_cam.translation])
    _render(*scene, look.lamps, look.lightmap, look.tile, look.codes, rays, side, pose, image)
    return image


@kernel(parallel=True)
def _render(
    primitives: Primitives, grid: Grid, lamps: Lamps, lightmap: Lightmap, tile: Float32, codes: UInt8,
    rays: Float32, side: int, pose: Float64, image: Float32,
) -> None:  # fmt: skip
    """Render the radiance image (H, W) by ray casting, about 1 for white paper under the lamps.

    codes: see `Shading`. rays: (side H, side W, 2) directions with z = 1. pose: (3, 4), rotation and
    translation (m) of yard_from_cam. Fills image; a ray that hits nothing adds 0.
    """
    R = pose[:, :3]
    ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
    for v in numba.prange(image.shape[0]):
        scene, look = Scene(primitives, grid), Shading(lamps, lightmap, tile, codes)
        for u in range(image.shape[1]):
            total, taken, first, same = 0.0, 0, -2, True
            for n in range(side * side):
                # The diagonal first: if it hits a single primitive, the other samples aren't needed.
                row = n % side
                column = (row + n // side) % side
                x, y = rays[v * side + row, u * side + column, 0], rays[v * side + row, u * side + column, 1]
                dx = R[0, 0] * x + R[0, 1] * y + R[0, 2]
                dy = R[1, 0] * x + R[1, 1] * y + R[1, 2]
                dz = R[2, 0] * x + R[2, 1] * y + R[2, 2]
                t, p = trace(scene, ox, oy, oz, dx, dy, dz, 1e-6, FAR, False)
                if p >= 0:
                    total += shade(primitives, look, p, ox, oy, oz, dx * t, dy * t, dz * t)
                taken += 1
                same = same and (first == -2 or first == p)
                first = p
                if same and taken == side and side > 1:
                    break
            image[v, u] = total / taken


@kernel()
def shade(
    primitives: Primitives, look: Shading, p: int, ox: float, oy: float, oz: float,
    rx: float, ry: float, rz: float,
) -> float:  # fmt: skip
    """Compute the radiance towards the eye at (ox, oy, oz) from primitive `p` at eye + (rx, ry, rz), m."""
    lamps, lightmap, tile, _ = look
    x, y, z = ox + rx, oy + ry, oz + rz
    if p == primitives.shape.shape[0]:
        return _shade_floor(lamps, lightmap, tile, p, x, y)
    if p >= primitives.cylinders:
        return _shade_box(primitives, look, p, x, y, z)
    shape, material = primitives.shape, primitives.material
    cx, cy, cz = x - shape[p, 0], y - shape[p, 1], z - shape[p, 2]
    s = cx * shape[p, 3] + cy * shape[p, 4] + cz * shape[p, 5]
    e = cx * shape[p, 6] + cy * shape[p, 7] + cz * shape[p, 8]
    f = cx * shape[p, 9] + cy * shape[p, 10] + cz * shape[p, 11]
    radius, half = shape[p, 12], shape[p, 13]
    if e * e + f * f < radius * radius * (1 - 1e-6):
        factor, _, _, _ = _texels(tile, e / AROUND_M + 37.0 * p, f / ALONG_M)
        t = lightmap.start[p] + (lightmap.along[p] - 1 if s > 0 else 0) * lightmap.around[p]
        end_face: float = 0.7 * material[p, 0] * factor * lightmap.diffuse[t]
        return end_face
    angle = math.atan2(f, e)
    albedo, gloss, slope, _ = _texels(
        tile,
        (radius * angle + material[p, 4] * s + material[p, 2]) / AROUND_M,
        (s * material[p, 5] + material[p, 3]) / ALONG_M,
    )
    weight = material[p, 7]
    albedo = material[p, 0] * (1 + weight * (albedo - 1))
    slope *= weight
    if material[p, 6] > 0:
        phase = 2 * math.pi * s / material[p, 6] + 2 * angle
        albedo *= 1 + 0.22 * math.sin(phase)
        gloss *= 1 + 0.35 * math.sin(phase + 0.6)
    c, d = math.cos(angle + slope), math.sin(angle + slope)
    if material[p, 8] > 0:
        up = (c * shape[p, 8] + d * shape[p, 11] - 0.3) / 0.5
        cover = material[p, 8] * min(max(up, 0.0), 1.0)
        albedo += cover * (DUST_ALBEDO - albedo)
        gloss *= 1 - cover
    t00, t01, t10, t11, ws, wa = _lightmap_place(lightmap, p, (s / half + 1) / 2, angle + slope)
    diffuse = _between(lightmap.diffuse, (t00, t01, t10, t11, ws, wa))
    place = (t00, t01, t10, t11, ws, wa)
    sun = 0.0
    if lightmap.sun.size > 0:
        sun = _between(lightmap.sun, place) * sun_patch(lamps.sun, x, y, z)
        diffuse += sun
    shine = 0.0
    if material[p, 1] > 0:
        away = -1 / math.sqrt(rx * rx + ry * ry + rz * rz)
        eye = (rx * away, ry * away, rz * away)
        turn = (c, d, material[p, 9])
        shine = _shine(shape, p, lamps, lightmap.seen, place, (x, y, z), eye, turn)
        if sun > 0:
            to_sun = lamps.sun[:3]
            half = (to_sun[0] + eye[0], to_sun[1] + eye[1], to_sun[2] + eye[2])
            shine += sun * _mirrored(shape, p, turn, half)
    radiance: float = albedo * diffuse + HIGHLIGHT * material[p, 1] * gloss * shine
    return radiance


@kernel()
def _shine(
    shape: Float64, p: int, lamps: Lamps, seen: UInt8, place: tuple[int, int, int, int, float, float],
    point: tuple[float, float, float], eye: tuple[float, float, float], turn: tuple[float, float, float],
) -> float:  # fmt: skip
    """Compute the lamps' highlight that bar `p` reflects to the eye; `turn`: see `_mirrored`.

    shape: (P, 15), see `Primitives`; seen: (T, SLOTS), see `Lightmap`. place: result of `_lightmap_place`.
    point: m; eye: unit vector towards it.
    """
    t00, t01, t10, t11, ws, wa = place
    x, y, z = point
    shine = 0.0
    middle = math.floor((x - lamps.offset) / lamps.spacing + 0.5)
    for slot in range(6):
        lamp = middle + (slot % 3 - middle + 1) % 3 - 1
        lx, ly, lz = lamp * lamps.spacing + lamps.offset - x, lamps.rows[slot // 3] - y, lamps.z - z
        near = 1 / math.sqrt(lx * lx + ly * ly + lz * lz)
        half = (lx * near + eye[0], ly * near + eye[1], lz * near + eye[2])
        lobe = _mirrored(shape, p, turn, half)
        if lobe == 0.0:
            continue
        lit = (seen[t00, slot] * (1 - wa) + seen[t01, slot] * wa) * (1 - ws)
        lit += (seen[t10, slot] * (1 - wa) + seen[t11, slot] * wa) * ws
        shine += lit / 255 * lobe * lamp_beam(lamps, lx) * lz * near * near * near
    return shine


@kernel()
def _mirrored(
    shape: Float64, p: int, turn: tuple[float, float, float], half: tuple[float, float, float]
) -> float:
    """Compute the specular reflection of bar `p`, at most 1, for the half vector `half` [Ward 1992].

    shape: (P, 15), see `Primitives`. turn: cosine and sine of the normal's angle around the bar, and its
    roughness relative to the ordinary.
    """
    c, d, rough = turn
    hx, hy, hz = half
    nx, tx = c * shape[p, 6] + d * shape[p, 9], c * shape[p, 9] - d * shape[p, 6]
    ny, ty = c * shape[p, 7] + d * shape[p, 10], c * shape[p, 10] - d * shape[p, 7]
    nz, tz = c * shape[p, 8] + d * shape[p, 11], c * shape[p, 11] - d * shape[p, 8]
    hn = hx * nx + hy * ny + hz * nz
    if hn <= 0.1:
        return 0.0
    ha = (hx * shape[p, 3] + hy * shape[p, 4] + hz * shape[p, 5]) / (hn * SPREAD_ALONG * rough)
    ht = (hx * tx + hy * ty + hz * tz) / (hn * SPREAD_AROUND * rough)
    exponent = ha * ha + ht * ht
    return math.exp(-exponent) if exponent <= 9 else 0.0


@kernel()
def _between(light: Float32, place: tuple[int, int, int, int, float, float]) -> float:
    """Interpolate the light (T,) between the four texels of `_lightmap_place`."""
    t00, t01, t10, t11, ws, wa = place
    first, second = light[t00] * (1 - wa) + light[t01] * wa, light[t10] * (1 - wa) + light[t11] * wa
    between: float = first * (1 - ws) + second * ws
    return between


@kernel()
def _shade_floor(lamps: Lamps, lightmap: Lightmap, tile: Float32, p: int, x: float, y: float) -> float:
    """Compute the floor's diffuse radiance at (x, y), m, with lightmap and texture interpolated.

    p: the floor's id, the number of primitives. tile: (TILE, TILE, 4).
    """
    _, _, _, fine = _texels(tile, x / ALONG_M, y / ALONG_M)
    _, _, _, coarse = _texels(tile, (x + 0.31 * y) / (7.3 * ALONG_M), (y - 0.31 * x) / (7.3 * ALONG_M))
    floor = lightmap.floor
    i, j = (x - floor[0]) / floor[2] - 0.5, (y - floor[1]) / floor[2] - 0.5
    i = min(max(i, 0.0), lightmap.along[p] - 1.001)
    j = min(max(j, 0.0), lightmap.around[p] - 1.001)
    i0, j0 = int(i), int(j)
    wi, wj = i - i0, j - j0
    t = lightmap.start[p] + i0 * lightmap.around[p] + j0
    n, light = lightmap.around[p], lightmap.diffuse
    diffuse = (light[t] * (1 - wj) + light[t + 1] * wj) * (1 - wi)
    diffuse += (light[t + n] * (1 - wj) + light[t + n + 1] * wj) * wi
    if lightmap.sun.size > 0:
        sun = _between(lightmap.sun, (t, t + 1, t + n, t + n + 1, wi, wj))
        diffuse += sun * sun_patch(lamps.sun, x, y, 0.0)
    radiance: float = FLOOR_ALBEDO * fine * coarse * diffuse
    return radiance


@kernel()
def _shade_box(primitives: Primitives, look: Shading, p: int, x: float, y: float, z: float) -> float:
    """Compute box `p`'s diffuse radiance at (x, y, z), m, in `yard`, lit per face along its longest axis.

    The face is the one nearest to the point, relative to the box's half sizes.
    """
    lamps, lightmap, tile, codes = look
    shape, material = primitives.shape, primitives.material
    if shape[p, 13] == 0.0:
        return _shade_sphere(primitives, look, p, x, y, z)
    cx, cy, cz = x - shape[p, 0], y - shape[p, 1], z - shape[p, 2]
    longest = longest_axis(shape, p)
    face, sign, deepest, along, across = 0, 0, -1.0, 0.0, 0.0
    for k in range(3):
        place = cx * shape[p, 3 + 3 * k] + cy * shape[p, 4 + 3 * k] + cz * shape[p, 5 + 3 * k]
        if k == longest:
            along = place
        else:
            across += place
        if abs(place) / shape[p, 12 + k] > deepest:
            face, sign, deepest = k, 1 if place > 0 else 0, abs(place) / shape[p, 12 + k]
    pattern, _, _, _ = _texels(tile, (across + material[p, 2]) / AROUND_M, (along + material[p, 3]) / ALONG_M)
    n = lightmap.along[p]
    i = min(max((along / shape[p, 12 + longest] + 1) / 2 * n - 0.5, 0.0), n - 1.0)
    i0 = min(int(i), n - 1)
    i1 = min(i0 + 1, n - 1)
    t = lightmap.start[p] + 2 * face + sign
    light = lightmap.diffuse
    diffuse = light[t + 6 * i0] * (1 - i + i0) + light[t + 6 * i1] * (i - i0)
    if lightmap.sun.size > 0:
        sun = lightmap.sun[t + 6 * i0] * (1 - i + i0) + lightmap.sun[t + 6 * i1] * (i - i0)
        diffuse += sun * sun_patch(lamps.sun, x, y, z)
    radiance: float = material[p, 0] * (1 + material[p, 7] * (pattern - 1)) * diffuse
    if material[p, CODE] > 0 and face == 2 and sign == 1:
        half, count = min(shape[p, 12], shape[p, 13]), codes.shape[1]
        u = (cx * shape[p, 3] + cy * shape[p, 4] + cz * shape[p, 5]) / half
        v = (cx * shape[p, 6] + cy * shape[p, 7] + cz * shape[p, 8]) / half
        row, column = math.floor((1 - v) / 2 * count), math.floor((1 + u) / 2 * count)
        if 0 <= row < count and 0 <= column < count and codes[int(material[p, CODE]) - 1, row, column] == 0:
            radiance *= INK
    return radiance


@kernel()
def _shade_sphere(primitives: Primitives, look: Shading, p: int, x: float, y: float, z: float) -> float:
    """Compute sphere `p`'s diffuse radiance at (x, y, z), m, in `yard`, from the six ends of its axes.

    An end is weighted with the square of the normal's component along it. The texture runs around the first
    axis. tile: (TILE, TILE, 4).
    """
    lamps, lightmap, tile, _ = look
    shape, material = primitives.shape, primitives.material
    radius = shape[p, 12]
    nx, ny, nz = (x - shape[p, 0]) / radius, (y - shape[p, 1]) / radius, (z - shape[p, 2]) / radius
    diffuse, sun = 0.0, 0.0
    n0, n1, n2 = 0.0, 0.0, 0.0
    for k in range(3):
        n = nx * shape[p, 3 + 3 * k] + ny * shape[p, 4 + 3 * k] + nz * shape[p, 5 + 3 * k]
        n0, n1, n2 = n1, n2, n
        t = lightmap.start[p] + 2 * k + (1 if n > 0 else 0)
        diffuse += n * n * lightmap.diffuse[t]
        if lightmap.sun.size > 0:
            sun += n * n * lightmap.sun[t]
    if sun > 0:
        diffuse += sun * sun_patch(lamps.sun, x, y, z)
    around, along = math.atan2(n2, n1) * radius, math.asin(min(max(n0, -1.0), 1.0)) * radius
    _, _, _, pattern = _texels(tile, (around + material[p, 2]) / ALONG_M, (along + material[p, 3]) / ALONG_M)
    radiance: float = material[p, 0] * max(1 + material[p, 7] * (pattern - 1), 0.1) * diffuse
    return radiance


@kernel()
def _lightmap_place(
    lightmap: Lightmap, p: int, share: float, angle: float
) -> tuple[int, int, int, int, float, float]:
    """Find the four texels around a point on a bar, and the weights of the second ones."""
    n, m = lightmap.along[p], lightmap.around[p]
    i = min(max(share * n - 0.5, 0.0), n - 1.0)
    i0 = min(int(i), n - 1)
    i1 = min(i0 + 1, n - 1)
    a = angle / (2 * math.pi) * m - 0.5
    low = math.floor(a)
    a0, a1 = low % m, (low + 1) % m
    t = lightmap.start[p]
    return t + i0 * m + a0, t + i0 * m + a1, t + i1 * m + a0, t + i1 * m + a1, i - i0, a - low


@kernel()
def _texels(tile: Float32, a: float, b: float) -> tuple[float, float, float, float]:
    """Interpolate the tile's four channels at texel (a, b) bilinearly, with periodic repetition.

    tile: (TILE, TILE, 4).
    """
    fa, fb = math.floor(a), math.floor(b)
    wa, wb = a - fa, b - fb
    i, j = int(fa) & MASK, int(fb) & MASK
    i1, j1 = (i + 1) & MASK, (j + 1) & MASK
    w00, w01, w10, w11 = (1 - wa) * (1 - wb), (1 - wa) * wb, wa * (1 - wb), wa * wb
    return (
        tile[i, j, 0] * w00 + tile[i, j1, 0] * w01 + tile[i1, j, 0] * w10 + tile[i1, j1, 0] * w11,
        tile[i, j, 1] * w00 + tile[i, j1, 1] * w01 + tile[i1, j, 1] * w10 + tile[i1, j1, 1] * w11,
        tile[i, j, 2] * w00 + tile[i, j1, 2] * w01 + tile[i1, j, 2] * w10 + tile[i1, j1, 2] * w11,
        tile[i, j, 3] * w00 + tile[i, j1, 3] * w01 + tile[i1, j, 3] * w10 + tile[i1, j1, 3] * w11,
    )
