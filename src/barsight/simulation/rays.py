"""Cast rays against the scene: exact intersections with cylinders, boxes, spheres, by walking the grid."""

from __future__ import annotations

import math

import numba
import numpy as np

from barsight.core.arrays import Float64, Int32, kernel
from barsight.simulation.scene import Grid, Primitives, Scene

FAR = 1e30


@kernel()
def hit_cylinder(
    shape: Float64, p: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, near: float
) -> float:
    """Find the first ray parameter above `near` at which the ray enters the capped cylinder, else FAR.

    shape: (P, 15), see `Primitives`; p: the cylinder's number. Origin o in m, direction d of any length.
    """
    cx, cy, cz = ox - shape[p, 0], oy - shape[p, 1], oz - shape[p, 2]
    da = dx * shape[p, 3] + dy * shape[p, 4] + dz * shape[p, 5]
    ca = cx * shape[p, 3] + cy * shape[p, 4] + cz * shape[p, 5]
    a = dx * dx + dy * dy + dz * dz - da * da
    b = cx * dx + cy * dy + cz * dz - ca * da
    c = cx * cx + cy * cy + cz * cz - ca * ca - shape[p, 12] * shape[p, 12]
    h = shape[p, 13]
    if a > 1e-14:
        root = b * b - a * c
        if root < 0:
            return FAR
        t: float = (-b - math.sqrt(root)) / a
        if t > near and abs(ca + t * da) <= h:
            return t
    if da != 0.0:
        t = (-h - ca) / da if da > 0 else (h - ca) / da
        if t > near and a * t * t + 2 * b * t + c <= 0:
            return t
    return FAR


@kernel()
def _hit_sphere(
    shape: Float64, p: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, near: float
) -> float:
    """Find the first ray parameter above `near` at which the ray enters the sphere, else FAR.

    shape: (P, 15), see `Primitives`; p: its number. Origin o in m, direction d of any length.
    """
    cx, cy, cz = ox - shape[p, 0], oy - shape[p, 1], oz - shape[p, 2]
    a = dx * dx + dy * dy + dz * dz
    b = cx * dx + cy * dy + cz * dz
    root = b * b - a * (cx * cx + cy * cy + cz * cz - shape[p, 12] * shape[p, 12])
    if root < 0:
        return FAR
    t: float = (-b - math.sqrt(root)) / a
    return t if t > near else FAR


@kernel()
def hit_box(
    shape: Float64, p: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, near: float
) -> float:
    """Find the first ray parameter above `near` at which the ray enters the box or sphere, else FAR.

    shape: (P, 15), see `Primitives`; p: its number. Origin o in m, direction d of any length.
    """
    if shape[p, 13] == 0.0:
        return _hit_sphere(shape, p, ox, oy, oz, dx, dy, dz, near)
    cx, cy, cz = ox - shape[p, 0], oy - shape[p, 1], oz - shape[p, 2]
    enter: float = -FAR
    leave: float = FAR
    for k in range(3):
        ex, ey, ez = shape[p, 3 + 3 * k], shape[p, 4 + 3 * k], shape[p, 5 + 3 * k]
        place = cx * ex + cy * ey + cz * ez
        speed = dx * ex + dy * ey + dz * ez
        half = shape[p, 12 + k]
        if abs(speed) < 1e-14:
            if abs(place) > half:
                return FAR
        else:
            t0, t1 = (-half - place) / speed, (half - place) / speed
            enter = max(enter, min(t0, t1))
            leave = min(leave, max(t0, t1))
    return enter if near < enter <= leave else FAR


@kernel()
def _inside(
    grid: Grid, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, near: float, far: float
) -> tuple[float, float]:
    """Clip the interval near .. far to the grid; empty (first > second) if the ray misses the grid."""
    enter, leave = near, far
    for k in range(3):
        o = ox if k == 0 else (oy if k == 1 else oz)
        d = dx if k == 0 else (dy if k == 1 else dz)
        low, top = grid.low[k], grid.low[k] + grid.counts[k] * grid.cell[k]
        if abs(d) < 1e-14:
            if o < low or o > top:
                enter = FAR
        else:
            t0, t1 = (low - o) / d, (top - o) / d
            enter, leave = max(enter, min(t0, t1)), min(leave, max(t0, t1))
    return enter, leave


@kernel()
def _first_cell(grid: Grid, axis: int, o: float, d: float, enter: float) -> tuple[int, int, float, float]:
    """Find the cell along one axis in which the ray o + t d enters the grid at t = enter, and its step to
    the next cell, 1 or -1; t at the next cell boundary and between boundaries, FAR if the ray is
    perpendicular to the axis.
    """
    low, cell = grid.low[axis], grid.cell[axis]
    place = min(max(math.floor((o + enter * d - low) / cell), 0), grid.counts[axis] - 1)
    step = 1 if d > 0 else -1
    if abs(d) <= 1e-14:
        return place, step, FAR, FAR
    return place, step, (low + (place + (step > 0)) * cell - o) / d, cell / abs(d)


@kernel()
def trace(
    scene: Scene, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, near: float, far: float,
    any_hit: bool,
) -> tuple[float, int]:  # fmt: skip
    """Find the first hit between `near` and `far`: (ray parameter, primitive), or (FAR, -1).

    For the floor z = 0 the id is the number of primitives. With `any_hit` the search ends at any hit, not
    necessarily the first one (shadow rays). [Amanatides 1987]
    """
    shape, _, cylinders = scene.primitives
    grid = scene.grid
    best, found = far, -1
    if dz < 0.0:
        t = -oz / dz
        if near < t < best:
            best, found = t, shape.shape[0]
            if any_hit:
                return best, found
    enter, leave = _inside(grid, ox, oy, oz, dx, dy, dz, near, best)
    if enter > leave:
        return (best, found) if found >= 0 else (FAR, -1)
    n = grid.counts
    i, si, tx, ux = _first_cell(grid, 0, ox, dx, enter)
    j, sj, ty, uy = _first_cell(grid, 1, oy, dy, enter)
    k, sk, tz, uz = _first_cell(grid, 2, oz, dz, enter)
    while True:
        c = (i * n[1] + j) * n[2] + k
        for m in range(grid.first[c], grid.first[c + 1]):
            p = grid.items[m]
            if p < cylinders:
                t = hit_cylinder(shape, p, ox, oy, oz, dx, dy, dz, near)
            else:
                t = hit_box(shape, p, ox, oy, oz, dx, dy, dz, near)
            if t < best:
                best, found = t, p
                if any_hit:
                    return best, found
        step = min(tx, ty, tz)
        if best <= step or step > leave:
            break
        if step == tz:
            k += sk
            tz += uz
            if k < 0 or k >= n[2]:
                break
        elif step == tx:
            i += si
            tx += ux
            if i < 0 or i >= n[0]:
                break
        else:
            j += sj
            ty += uy
            if j < 0 or j >= n[1]:
                break
    return (best, found) if found >= 0 else (FAR, -1)


@kernel(parallel=True)
def _cast(
    primitives: Primitives, grid: Grid, origins: Float64, directions: Float64, distance: Float64,
    primitive: Int32,
) -> None:  # fmt: skip
    """Trace each ray to its first hit.

    origins: (N, 3) or (1, 3) m, directions: (N, 3), both in `yard`. Fills distance (N,), the ray parameter,
    inf without a hit, and primitive (N,), -1 without a hit and the number of primitives for the floor.
    """
    step = 0 if origins.shape[0] == 1 else 1
    for r in numba.prange(directions.shape[0]):
        o, d = origins[r * step], directions[r]
        t, p = trace(Scene(primitives, grid), o[0], o[1], o[2], d[0], d[1], d[2], 1e-6, FAR, False)
        distance[r] = t if p >= 0 else np.inf
        primitive[r] = p


def cast_rays(scene: Scene, origins: Float64, directions: Float64) -> tuple[Float64, Int32]:
    """Find the first hit of each ray.

    origins: (N, 3) or (1, 3) in `yard`. directions: (N, 3), any length. Returns the ray parameter (N,), inf
    without a hit, and the primitive (N,), -1 without a hit and the number of primitives for the floor.
    """
    distance = np.empty(len(directions))
    primitive = np.empty(len(directions), dtype=np.int32)
    _cast(*scene, np.ascontiguousarray(origins), np.ascontiguousarray(directions), distance, primitive)
    return distance, primitive
