"""Settle packs of bars by 2D physics in their cross-section, the plane (x, z) across the bars."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from barsight.core.arrays import Float64
from barsight.core.extras import extra

with extra("bench"):
    import pymunk

GRAVITY_MPS2 = 9.81
STEP_S = 1 / 500
SKIN_M = 0.0003
"""Collision margin around each pack while it falls, m; contacts penetrate by less."""
FRICTION = 0.45
REST_MPS = 0.002
MAX_SETTLING_S = 20.0
CHECKED_STEPS = 50
FLOOR = (-200.0, -1.0, 200.0, 0.0)

Rectangle = tuple[float, float, float, float]
"""Fixed box: x and z of its lower corner, then of its upper corner, m."""


@dataclass(frozen=True, eq=False)
class BarPack:
    """Bars strapped together, or a single bar: discs (count, 2), x and z in m, with a common radius."""

    cross: Float64
    radius: float

    @property
    def extent(self) -> tuple[float, float]:
        """Return the smallest and the largest x, m."""
        x = self.cross[:, 0]
        return float(x.min()) - self.radius, float(x.max()) + self.radius

    @property
    def top(self) -> float:
        """Return the largest z, m."""
        return float(self.cross[:, 1].max()) + self.radius

    @property
    def reach(self) -> float:
        """Return the radius of the circle around the centre that contains the discs, m."""
        return float(np.hypot(*(self.cross - self.cross.mean(axis=0)).T).max()) + self.radius

    @property
    def corners(self) -> Float64:
        """Return the discs (M, 2) on the pack's convex hull, over which a strap bends, in order."""
        if len(self.cross) < 3:
            return self.cross
        try:
            return np.asarray(self.cross[ConvexHull(self.cross).vertices], np.float64)
        except QhullError:  # all discs are collinear
            order = np.lexsort((self.cross[:, 1], self.cross[:, 0]))
            return np.asarray(self.cross[order[[0, -1]]], np.float64)


def settle(
    falling: Sequence[BarPack], lying: Sequence[BarPack] = (), boxes: Sequence[Rectangle] = ()
) -> list[BarPack]:
    """Let packs fall until they rest: each is the rigid hull of its discs, with friction.

    lying: packs that stay where they are. boxes: beams, posts and walls; the floor z = 0 is always there.
    Falling packs must not overlap anything initially. Those that still roll after MAX_SETTLING_S are stopped
    there.
    """
    space = pymunk.Space()
    space.gravity, space.damping = (0.0, -GRAVITY_MPS2), 0.05
    space.iterations, space.collision_slop = 30, SKIN_M / 2
    for x0, z0, x1, z1 in (FLOOR, *boxes):
        corners = [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]
        _add(space, pymunk.Poly(space.static_body, corners))
    for pack in lying:
        _add(space, _hull(space.static_body, pack, pack.corners))
    bodies = []
    for pack in falling:
        middle = pack.cross.mean(axis=0)
        kg = len(pack.cross) * (pack.radius / 0.02) ** 2
        inertia = kg * (float(((pack.cross - middle) ** 2).sum(axis=1).mean()) + pack.radius**2 / 2)
        body = pymunk.Body(kg, inertia)
        body.position = (float(middle[0]), float(middle[1]))
        space.add(body)
        _add(space, _hull(body, pack, pack.corners - middle))
        bodies.append(body)
    for step in range(round(MAX_SETTLING_S / STEP_S)):
        space.step(STEP_S)
        if step % CHECKED_STEPS == 0 and step * STEP_S > 0.5 and _rest(bodies, falling):
            break
    return [_moved(pack, body) for pack, body in zip(falling, bodies, strict=True)]


def _add(space: pymunk.Space, shape: pymunk.Shape) -> None:
    shape.friction = FRICTION
    space.add(shape)


def _hull(body: pymunk.Body, pack: BarPack, corners: Float64) -> pymunk.Shape:
    radius = pack.radius + SKIN_M
    points = [(float(x), float(z)) for x, z in corners]
    if len(points) == 1:
        return pymunk.Circle(body, radius, points[0])
    if len(points) == 2:
        return pymunk.Segment(body, points[0], points[1], radius)
    return pymunk.Poly(body, points, radius=radius)


def _rest(bodies: Sequence[pymunk.Body], packs: Sequence[BarPack]) -> bool:
    return all(
        body.velocity.length < REST_MPS and abs(body.angular_velocity) * pack.reach < REST_MPS
        for body, pack in zip(bodies, packs, strict=True)
    )


def _moved(pack: BarPack, body: pymunk.Body) -> BarPack:
    c, s = math.cos(body.angle), math.sin(body.angle)
    middle = pack.cross.mean(axis=0)
    turned = (pack.cross - middle) @ np.array([[c, s], [-s, c]])
    return BarPack(turned + np.array([body.position.x, body.position.y]), pack.radius)
