"""How the magnet's faces lie on what is under them: contact plane, air gaps, pull.

The faces are one rigid plane. Set down, it comes to rest where its middle is lowest: on three points of the
upper envelope around the middle, or on fewer with the suspension holding it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float32, Float64, UInt8, kernel
from barsight.core.types import Source
from barsight.yard.footprint import Placement
from barsight.yard.magnet import Magnet
from barsight.yard.types import HeightMap

SEGMENT_M = 0.45
"""Heights are taken as medians along the bars over this length: bars are straight, noise is not."""
STEP_M = 0.01
CORRELATED_CELLS = 5.0
"""Neighbouring cells share their matching windows: so many count as one."""
NEWTON_PER_KG = 9.81
_COLUMNS = 6
_U, _V, _Z, _SCATTER, _SEEN, _ALL = range(_COLUMNS)
_STEEPEST = 0.35


@dataclass(frozen=True, eq=False)
class PoleContact:
    """One pole's face. gap_m: mean air gap; gap_map_m: (across, along) air gaps, NaN where unknown.

    contact_share: of the face that lies on steel. unknown_share: of the cells under it that were not seen.
    """

    gap_m: float
    gap_map_m: Float64
    contact_share: float
    unknown_share: float


@dataclass(frozen=True, eq=False)
class Contact:
    """How all faces lie. z_m: (P,) height of the faces at the poles' centres; centre_z_m at the magnet's.

    pitch_rad: rise along the beam; roll_rad: rise across. rests_off_m: how far beside the middle the faces
    rest, where the suspension's stop holds them, else 0. sigma_m: of the plane over the points.
    pull_n, pull_low_n: the pull, and its lower bound (95 %).
    """

    centre_z_m: float
    z_m: Float64
    pitch_rad: float
    roll_rad: float
    rests_off_m: float
    sigma_m: float
    poles: tuple[PoleContact, ...]
    pull_n: float
    pull_low_n: float

    @property
    def unknown_share(self) -> float:
        """The worst pole's."""
        return max(pole.unknown_share for pole in self.poles)

    @property
    def contact_share(self) -> float:
        """The worst pole's."""
        return min(pole.contact_share for pole in self.poles)


def touch(heights: HeightMap, place: Placement, magnet: Magnet, contact_gap_m: float) -> Contact | None:
    """Set the magnet down on the map; None where nothing at all is known under it.

    contact_gap_m: a face nearer than this to steel lies on it.
    """
    poles = magnet.pole_table
    points = _profiles(
        heights.z_m, heights.source, heights.x0_m, heights.y0_m, heights.cell_m, poles,
        place.x_m, place.y_m, place.yaw_rad, STEP_M, SEGMENT_M,
    )  # fmt: skip
    flat = np.concatenate(points)
    known = flat[np.isfinite(flat[:, _Z])]
    if len(known) < 3:
        return None
    most = np.tan(np.radians(magnet.limits.roll_deg))
    height, roll, pitch = rest(known[:, _U], known[:, _V], known[:, _Z], most)
    # The highest of many noisy points is too high: the median's noise says by how much.
    cells = np.median(known[:, _SEEN])
    noise = float(1.25 * np.median(known[:, _SCATTER]) / np.sqrt(max(cells / CORRELATED_CELLS, 1.0)))
    height -= noise
    held = abs(roll) > 0.999 * most
    rests_off = 0.0
    if held:
        gap = height + roll * known[:, _U] + pitch * known[:, _V] - known[:, _Z]
        near = known[gap <= gap.min() + noise + 0.0005]
        rests_off = float(np.abs(np.median(near[:, _U])))
    pull = magnet.pull
    found, force, force_low = [], 0.0, 0.0
    for pole, own in zip(magnet.poles, points, strict=True):
        gap = np.maximum(height + roll * own[:, _U] + pitch * own[:, _V] - own[:, _Z], 0.0)
        seen = np.isfinite(gap)
        area = pole.length_m * pole.width_m / len(own)
        force += 1e3 * area * float(np.interp(gap[seen], pull.gap_m, pull.kilopascal, right=0.0).sum())
        low = np.interp(gap[seen] + 1.645 * noise, pull.gap_m, pull.kilopascal, right=0.0)
        force_low += 1e3 * area * float(low.sum())
        columns = len(np.unique(own[:, _U]))
        found.append(
            PoleContact(
                float(gap[seen].mean()) if seen.any() else float("nan"),
                gap.reshape(columns, -1),
                float((gap[seen] <= contact_gap_m).sum() / len(own)),
                float(1 - own[:, _SEEN].sum() / own[:, _ALL].sum()),
            )
        )
    faces = height + roll * poles[:, 1] + pitch * poles[:, 0]
    return Contact(
        height, faces, float(np.arctan(pitch)), float(np.arctan(roll)), rests_off, noise, tuple(found),
        force, force_low,
    )  # fmt: skip


def _profiles(
    z: Float32, source: UInt8, x0: float, y0: float, cell: float, poles: Float64, x: float, y: float,
    yaw: float, step: float, segment: float,
) -> list[Float64]:  # fmt: skip
    """For each pole (N, _COLUMNS): place across and along, median height, scatter, cells seen and in all."""
    found = []
    for along, across, length, width in poles:
        columns, parts = max(round(width / step), 2), max(round(length / segment), 1)
        own = np.empty((columns * parts, _COLUMNS))
        _profile(
            z, source, x0, y0, cell, x, y, np.cos(yaw), np.sin(yaw), along, across, length, width, parts,
            step, own,
        )  # fmt: skip
        found.append(own)
    return found


@kernel()
def _profile(
    z: Float32, source: UInt8, x0: float, y0: float, cell: float, x: float, y: float, cos: float, sin: float,
    along: float, across: float, length: float, width: float, parts: int, step: float, out: Float64,
) -> None:  # fmt: skip
    columns = out.shape[0] // parts
    samples = max(int(length / parts / step), 1)
    values = np.empty(samples)
    for i in range(columns):
        u = across + width * ((i + 0.5) / columns - 0.5)
        for k in range(parts):
            count = 0
            for m in range(samples):
                v = along + length * ((k + (m + 0.5) / samples) / parts - 0.5)
                column = int(np.floor((x + u * cos - v * sin - x0) / cell + 0.5))
                row = int(np.floor((y + u * sin + v * cos - y0) / cell + 0.5))
                if row < 0 or column < 0 or row >= z.shape[0] or column >= z.shape[1]:
                    continue
                if source[row, column] == 0 or source[row, column] == 3 or np.isnan(z[row, column]):
                    continue
                values[count] = z[row, column]
                count += 1
            own = out[i * parts + k]
            own[_U], own[_V] = u, along + length * ((k + 0.5) / parts - 0.5)
            own[_SEEN], own[_ALL] = count, samples
            own[_Z] = own[_SCATTER] = np.nan
            if 2 * count >= samples:
                middle = np.median(values[:count])
                own[_Z] = middle
                own[_SCATTER] = 1.4826 * np.median(np.abs(values[:count] - middle))


assert Source.FILLED == 3 and Source.UNKNOWN == 0


@kernel()
def rest(u: Float64, v: Float64, z: Float64, most_roll: float) -> tuple[float, float, float]:
    """Height at the origin, slope along u and along v of the plane that rests on the points.

    Of all planes on or above the points it has the lowest origin; its slope along u is held within
    `most_roll`. The height is convex in the slopes: two nested searches find the one lowest place.
    """
    best = (0.0, 0.0, 0.0)
    low, high = -most_roll, most_roll
    for _ in range(36):
        a, b = low + (high - low) * 0.382, low + (high - low) * 0.618
        at_a, at_b = _rest_along(u, v, z, a), _rest_along(u, v, z, b)
        if at_a[0] <= at_b[0]:
            high = b
        else:
            low = a
    roll = (low + high) / 2
    if most_roll - abs(roll) < 1e-3 * most_roll:
        roll = most_roll if roll > 0 else -most_roll
    height, pitch = _rest_along(u, v, z, roll)
    best = (height, roll, pitch)
    return best


@kernel()
def _rest_along(u: Float64, v: Float64, z: Float64, roll: float) -> tuple[float, float]:
    low, high = -_STEEPEST, _STEEPEST
    for _ in range(36):
        a, b = low + (high - low) * 0.382, low + (high - low) * 0.618
        at_a = at_b = -np.inf
        for i in range(u.size):
            left = z[i] - roll * u[i]
            at_a = max(at_a, left - a * v[i])
            at_b = max(at_b, left - b * v[i])
        if at_a <= at_b:
            high = b
        else:
            low = a
    slope = (low + high) / 2
    height = -np.inf
    for i in range(u.size):
        height = max(height, z[i] - roll * u[i] - slope * v[i])
    return height, slope
