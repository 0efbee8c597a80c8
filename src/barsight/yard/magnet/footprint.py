"""Count the bundles under a magnet's poles, with the probability of the count.

Poles and bundles are rectangles in plan view; two overlap where no side of either separates them. Each
overlap has a depth, the depth a sigma (of the bundle's place, yaw, width and ends) and a bound on how much
the crane's tolerance can change it. The probability of the count follows from all depths together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64, kernel
from barsight.yard.axes import axes_of
from barsight.yard.magnet.description import Magnet, Tolerance
from barsight.yard.types import UNKNOWN_SIGMA_M, UNKNOWN_SIGMA_RAD, Bundle

BEYOND_OPEN_END_M = 20.0
"""Maximum length (m) of a bundle beyond an end that wasn't seen."""
MIN_SIGMA_M = 0.001
"""Minimum standard deviation (m) of an overlap."""
HEIGHT_SIGMA_M = 0.005
"""Standard deviation (m), besides its own sigma, of a bundle's top line as its height under a pole."""
SURELY = 3.0
"""Number of sigmas by which a place must lie within a bundle's ends to belong to it with certainty."""
SEEN_EDGE_SIGMA_M = 0.006
"""Standard deviation (m) of the place where a bundle's surface is seen to sink out of a pole's reach: at
999 of 1,000 parts of poles it lies at most 18 mm further out than told.
"""
MAX_TOP_SIGMA_M = 0.008
"""Upper bound (m) of a top's sigma: the faces rest on the same map, so what all places share of that sigma
doesn't affect the heights between them.
"""


@dataclass(frozen=True)
class Placement:
    """The magnet's centre when set down: yard axes; yaw from +Y about Z, as a bundle's."""

    x_m: float
    y_m: float
    yaw_rad: float

    @property
    def yaw_deg(self) -> float:
        """Return the yaw in degrees, for people and plant systems."""
        return math.degrees(self.yaw_rad)

    @property
    def along(self) -> Float64:
        """Return the unit vector (2,) along the beam."""
        return np.asarray(axes_of(self.yaw_rad)[1])

    @property
    def across(self) -> Float64:
        """Return the unit vector (2,) across the beam."""
        return np.asarray(axes_of(self.yaw_rad)[0])

    @property
    def beam_axes(self) -> Float64:
        """Return the rows (2, 2) `along` and `across`."""
        return np.stack([self.along, self.across])

    @property
    def frame(self) -> Float64:
        """Return the rows (3, 2): the place, then `beam_axes`."""
        return np.vstack([(self.x_m, self.y_m), self.beam_axes])


class Rectangles(NamedTuple):
    """Bundles in plan view with their tops, as arrays. Lengths in m.

    centre: (B, 2). along: (B, 2) unit vectors. half: (B, 2) half width, half length. top: (B,) at mid-length,
    slope: (B,) rise per metre along. sigma: (B, 5) of lateral, along, yaw, half width, half length; an
    unknown one is replaced. sigma_top: (B,). open_ends: (B, 2) low-y and high-y end.
    """

    centre: Float64
    along: Float64
    half: Float64
    top: Float64
    slope: Float64
    sigma: Float64
    sigma_top: Float64
    open_ends: Bool


@dataclass(frozen=True, eq=False)
class BundleTable:
    """Bundles, and the same as arrays (B, ...)."""

    bundles: tuple[Bundle, ...]
    rectangles: Rectangles

    @classmethod
    def of(cls, bundles: tuple[Bundle, ...]) -> BundleTable:
        """Build from bundles. An unknown sigma counts as UNKNOWN_SIGMA_M or UNKNOWN_SIGMA_RAD."""
        yaw = np.array([b.yaw_rad for b in bundles])
        sigma = np.array(
            [
                (
                    b.sigma.lateral_m,
                    b.sigma.along_m,
                    b.sigma.yaw_rad,
                    b.sigma.width_m / 2,
                    b.sigma.length_m / 2,
                )
                for b in bundles
            ]
        ).reshape(-1, 5)
        m, rad = UNKNOWN_SIGMA_M, UNKNOWN_SIGMA_RAD
        sigma_top = np.array([b.sigma.top_z_m for b in bundles])
        rectangles = Rectangles(
            np.array([b.centre_m[:2] for b in bundles]).reshape(-1, 2),
            np.stack([-np.sin(yaw), np.cos(yaw)], axis=1).reshape(-1, 2),
            np.array([(b.width_m / 2, b.length_m / 2) for b in bundles]).reshape(-1, 2),
            np.array([b.top_z_m for b in bundles]),
            np.tan([b.pitch_rad for b in bundles]),
            np.where(np.isfinite(sigma), sigma, (m, m, rad, m, m)),
            np.where(np.isfinite(sigma_top), np.minimum(sigma_top, MAX_TOP_SIGMA_M), m),
            np.array([b.ends_open for b in bundles], dtype=np.bool_).reshape(-1, 2),
        )
        return cls(bundles, rectangles)


@dataclass(frozen=True, eq=False)
class Grip:
    """Bundles that the magnet would take at a placement.

    gripped: indices in the table of the bundles under a pole and within reach. probability: that it is
    exactly these. flips: (B,) probability for each bundle that it is wrongly counted in or out.
    """

    gripped: tuple[int, ...]
    probability: float
    flips: Float64


def count_gripped(
    place: Placement, magnet: Magnet, tolerance: Tolerance, table: BundleTable, face_z_m: Float64,
    reached: Float64, clear_m: Float64 | None = None,
) -> Grip:  # fmt: skip
    """Count the bundles under the poles whose tops are within the magnet's reach.

    face_z_m: (P,) height of each pole's face. tolerance: of the crane's set-down; a hard bound. reached: (P,
    4) of `reach.reached_strips`: a bundle that lies entirely beside it isn't taken, even if its outline
    extends under a face. clear_m: (B, P) of `seen_edges.seen_clearances`, where these were looked for.
    """
    if not table.bundles:
        return Grip((), 1.0, np.empty(0))
    slack = np.array([tolerance.x_m, tolerance.y_m, np.radians(tolerance.yaw_deg)])
    clear = np.full((len(table.bundles), len(reached)), -np.inf) if clear_m is None else clear_m
    flips, taken = _grip(
        place.x_m, place.y_m, place.yaw_rad, magnet.pole_table, reached, face_z_m - magnet.reach_m, slack,
        clear, table.rectangles,
    )  # fmt: skip
    return Grip(tuple(np.flatnonzero(taken).tolist()), float(np.prod(1 - flips)), flips)


@kernel()
def _grip(
    x: float, y: float, yaw: float, poles: Float64, reached: Float64, reach_z: Float64, slack: Float64,
    clear: Float64, bundles: Rectangles,
) -> tuple[Float64, Bool]:  # fmt: skip
    """Compute the probability (B,) of a wrong count, and whether each bundle is taken.

    x, y, yaw: the magnet's place, m and rad. poles: (P, 4) along, across, length, width, m; reached: (P, 4)
    the same of what they may reach. reach_z: (P,) the lowest top that a pole takes, m. slack: (3,) bounds on
    the crane's x, y (m) and yaw (rad). clear: (B, P) as in `count_gripped`.
    """
    centre, along, half, top, slope, sigma, sigma_top, open_ends = bundles
    count = len(centre)
    flips, taken = np.zeros(count), np.zeros(count, np.bool_)
    cos, sin = np.cos(yaw), np.sin(yaw)
    none = np.zeros(3)
    held, holder = _held(x, y, cos, sin, reached, reach_z, bundles)
    for b in range(count):
        kept = 1.0
        # Poles on one side of the middle share their errors; on the other side the yaw's sign is opposite.
        added = np.zeros(2)
        for p in range(len(poles)):
            part, give = reached[p], none
            dx, dy = _away(x, y, cos, sin, part, centre[b])
            far = dx * along[b, 0] + dy * along[b, 1]
            depth, spread, loose = overlap(dx, dy, cos, sin, part, along[b], half[b], sigma[b], give, far)
            if depth > 0:
                part, give = poles[p], slack
                dx, dy = _away(x, y, cos, sin, part, centre[b])
                far = dx * along[b, 0] + dy * along[b, 1]
                depth, spread, loose = overlap(dx, dy, cos, sin, part, along[b], half[b], sigma[b], give, far)
            miss = _below(-max(abs(depth) - loose, 0.0) / spread)
            if depth <= 0 and (open_ends[b, 0] or open_ends[b, 1]):
                # An open end may lie anywhere under the pole.
                longer = (open_ends[b, 0] + open_ends[b, 1]) * BEYOND_OPEN_END_M / 2
                shift = (1.0 * open_ends[b, 1] - 1.0 * open_ends[b, 0]) * BEYOND_OPEN_END_M / 2
                whole = np.array([half[b, 0], half[b, 1] + longer])
                most, unsure, astray = overlap(
                    dx - shift * along[b, 0], dy - shift * along[b, 1], cos, sin, part, along[b], whole,
                    sigma[b], give, far,
                )  # fmt: skip
                miss = max(miss, 0.5 * _below((most + astray) / unsure))
            if depth <= 0 and holder[p] >= 0 and abs(far) < half[b, 1]:
                # A strip that belongs to one bundle doesn't belong to another one beside it.
                miss = min(miss, _below(-held[p, 0 if dx * cos + dy * sin > 0 else 1]))
            over = top[b] + far * slope[b] - reach_z[p]
            if depth <= 0 or over > 0:
                miss = min(miss, _below(-clear[b, p] / SEEN_EDGE_SIGMA_M))
            low = _below(-abs(over) / np.hypot(sigma_top[b], HEIGHT_SIGMA_M))
            under = (1 - miss if depth > 0 else miss) * (1 - low if over > 0 else low)
            if depth > 0 and over > 0:
                taken[b] = True
                kept = min(kept, 1 - under)
            side = 1 if far > 0 else 0
            added[side] = max(added[side], under)
        flips[b] = kept if taken[b] else min(added.sum(), 1.0)
    return flips, taken


@kernel()
def _held(
    x: float, y: float, cos: float, sin: float, reached: Float64, reach_z: Float64, bundles: Rectangles
) -> tuple[Float64, Int64]:
    """Find for each pole the bundle (P,) that certainly contains the middle of all that the pole reaches, -1
    where none does, and by how many sigmas the reached strip lies within its sides (P, 2), towards low and
    high across the beam.

    x, y: the magnet's place, m; cos, sin: of its yaw. reached, reach_z: as in `_grip`.
    """
    centre, along, half, top, slope, sigma, _, _ = bundles
    held, holder = np.zeros((len(reached), 2)), np.full(len(reached), -1)
    for p in range(len(reached)):
        part = reached[p]
        for b in range(len(centre)):
            dx, dy = _away(x, y, cos, sin, part, centre[b])
            away = dx * along[b, 0] + dy * along[b, 1]
            ends = math.sqrt(sigma[b, 1] ** 2 + sigma[b, 4] ** 2)
            if top[b] + away * slope[b] < reach_z[p] or half[b, 1] - abs(away) < SURELY * ends:
                continue
            # The bundle's axis may point the opposite way to the beam's.
            same = 1.0 if along[b, 1] * cos - along[b, 0] * sin > 0 else -1.0
            beside = same * (dx * along[b, 1] - dy * along[b, 0])
            turn = abs(along[b, 0] * cos + along[b, 1] * sin)
            level = abs(along[b, 1] * cos - along[b, 0] * sin)
            reaches = level * part[3] / 2 + turn * part[2] / 2
            far = abs(away) + part[2] / 2
            variance = sigma[b, 0] ** 2 + (far * sigma[b, 2]) ** 2 + sigma[b, 3] ** 2 + MIN_SIGMA_M**2
            low = (half[b, 0] + beside - reaches) / math.sqrt(variance)
            high = (half[b, 0] - beside - reaches) / math.sqrt(variance)
            if min(low, high) > max(min(held[p, 0], held[p, 1]), 0.0):
                held[p, 0], held[p, 1], holder[p] = low, high, b
    return held, holder


@kernel()
def _away(x: float, y: float, cos: float, sin: float, part: Float64, centre: Float64) -> tuple[float, float]:
    """Compute the vector (m, yard axes) from a bundle's centre (2,) to that of a magnet's rectangle (4,)."""
    return x - part[0] * sin + part[1] * cos - centre[0], y + part[0] * cos + part[1] * sin - centre[1]


@kernel()
def _below(z: float) -> float:
    """Evaluate the cumulative normal distribution at z."""
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


@kernel()
def overlap(
    dx: float, dy: float, cos: float, sin: float, pole: Float64, along: Float64, half: Float64,
    sigma: Float64, slack: Float64, far: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Compute a pole's overlap with a bundle (negative is a distance), its sigma and the crane's slack, m.

    dx, dy: pole's centre minus bundle's. cos, sin: of the magnet's yaw. pole: (4,) along, across, length,
    width, m. along: (2,) the bundle's unit vector; half (2,), sigma (5,): its own, see `Rectangles`. slack:
    (3,) on x, y (m) and yaw (rad). far: distance (m) along the bundle over which its yaw's error acts. Of the
    four axes perpendicular to the rectangles' sides, the one with the smallest overlap counts (separating
    axes).
    """
    best = (np.inf, 1.0, 0.0)
    for axis in range(4):
        if axis == 0:
            nx, ny = along[1], -along[0]
        elif axis == 1:
            nx, ny = along[0], along[1]
        elif axis == 2:
            nx, ny = cos, sin
        else:
            nx, ny = -sin, cos
        side, end = abs(nx * along[1] - ny * along[0]), abs(nx * along[0] + ny * along[1])
        across, lengthwise = abs(nx * cos + ny * sin), abs(ny * cos - nx * sin)
        depth = (
            side * half[0] + end * half[1] + across * pole[3] / 2 + lengthwise * pole[2] / 2
            - abs(dx * nx + dy * ny)
        )  # fmt: skip
        if depth < best[0]:
            variance = side**2 * (sigma[0] ** 2 + (far * sigma[2]) ** 2 + sigma[3] ** 2)
            variance += end**2 * (sigma[1] ** 2 + sigma[4] ** 2) + MIN_SIGMA_M**2
            loose = slack[0] * abs(nx) + slack[1] * abs(ny)
            loose += slack[2] * across * (abs(pole[0]) + pole[2] / 2)
            loose += slack[2] * lengthwise * (abs(pole[1]) + pole[3] / 2)
            best = (depth, math.sqrt(variance), loose)
    return best
