"""Model the magnet's contact with the surface under it: contact plane and air gaps.

The faces form one rigid plane. When set down, it comes to rest where its middle is lowest: on three points of
the upper envelope around the middle, or on fewer with the suspension limiting its lean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import grey_opening

from barsight.core.arrays import Float64, frozen, kernel
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.magnet.resting_plane import (
    ALL,
    POLE,
    SEEN,
    SIGMA,
    U,
    V,
    Z,
    profiles,
    rest_faces,
    straighten_heights,
)
from barsight.yard.types import HeightMap

NEWTON_PER_KG = 9.81
HIDING_COLUMNS = 4
"""Minimum number of adjacent unseen columns of `resting_plane.STEP_M` that may hide an obstacle: the strip
between two bars, where no picture shows the steel, hides nothing.
"""
NO_PLATE = frozen(np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class PoleContact:
    """Contact of one pole's face.

    gap_m: mean air gap, min_gap_m: the smallest; gap_map_m: (across, along) air gaps, NaN where unknown.
    contact_share: share of the face that lies on steel. unknown_share: unseen share of the cells under it,
    except for strips along it that are too narrow to hide an obstacle. z_m: height of its centre. pull_n,
    pull_low_n: its part of the pull and its lower bound, 0 until a load is known (`holding.hold_load`).
    pull_across_m, pull_along_m: where the lower bound acts, across and along from its centre.
    """

    gap_m: float
    min_gap_m: float
    contact_share: float
    unknown_share: float
    z_m: float
    gap_map_m: Float64
    pull_n: float = 0.0
    pull_low_n: float = 0.0
    pull_across_m: float = 0.0
    pull_along_m: float = 0.0


@dataclass(frozen=True, eq=False)
class Contact:
    """Contact of all faces. centre_z_m: height of their plane at the magnet's centre, z_m: (P,) at the poles.

    pitch_rad: slope along the beam; roll_rad: slope across. rests_off_m: how far from the middle the faces
    rest where the suspension stops their lean, otherwise 0. sigma_m: of the plane's height, including the
    error that the whole map shares; gap_sigma_m: of the height over the steel. touch_gap_m: maximum gap at
    which a place of a face touches. over_map_m: how much higher than on the map the faces lie on a known
    load, with its sigma; map_z_m: (P,) their height on the map. pull_n, pull_low_n: the pull, and its lower
    bound (95 %).
    widest_gap_m: the largest of the poles' smallest gaps. contact_share: of all faces; unknown_share: the
    worst pole's. plate_m: (N, 2) places, along and across, where the faces touch a plate on the steel
    (`FaceHeights.rest`).
    """

    centre_z_m: float
    z_m: Float64
    pitch_rad: float
    roll_rad: float
    rests_off_m: float
    sigma_m: float
    gap_sigma_m: float
    touch_gap_m: float
    poles: tuple[PoleContact, ...]
    plate_m: Float64 = field(default_factory=lambda: np.empty((0, 2)))
    over_map_m: float = 0.0
    over_map_sigma_m: float = 0.0

    @property
    def map_z_m(self) -> Float64:
        """Return the heights (P,) at the poles as if the faces lay on the map itself."""
        return self.z_m - self.over_map_m

    @property
    def pull_n(self) -> float:
        """Sum the poles' pull."""
        return sum(pole.pull_n for pole in self.poles)

    @property
    def pull_low_n(self) -> float:
        """Sum the lower bounds (95 %) of the poles' pull."""
        return sum(pole.pull_low_n for pole in self.poles)

    @property
    def unknown_share(self) -> float:
        """Return the largest unseen share of a pole."""
        return max(pole.unknown_share for pole in self.poles)

    @property
    def contact_share(self) -> float:
        """Average the contact share over all faces."""
        return sum(pole.contact_share for pole in self.poles) / len(self.poles)

    @property
    def widest_gap_m(self) -> float:
        """Return the largest of the poles' smallest gaps; infinite where a pole has no known gap."""
        return max(pole.min_gap_m for pole in self.poles)


@dataclass(frozen=True, eq=False)
class FaceHeights:
    """Heights under all faces, by which they rest. shape: (P, 2) columns and parts of each pole; points:
    (N, COLUMNS) of `profiles`, straightened. noise_m: that remains in them. unknown: (P,) `unknown_share`.
    """

    shape: list[tuple[int, int]]
    points: Float64
    noise_m: float
    unknown: tuple[float, ...]

    @classmethod
    def of(cls, heights: HeightMap, place: Placement, magnet: Magnet) -> FaceHeights | None:
        """Sample a map; None where nothing at all is known under the magnet."""
        shape, points = profiles(heights, place, magnet.pole_table)
        if np.isfinite(points[:, Z]).sum() < 3:
            return None
        noise, unknown, first = straighten_heights(points), [], 0
        for columns, parts in shape:
            own = points[first : first + columns * parts]
            unseen = (1 - own[:, SEEN] / own[:, ALL]).reshape(columns, parts)
            hiding = unseen.any() and grey_opening(unseen, (HIDING_COLUMNS, 1), mode="nearest").mean()
            unknown.append(float(hiding))
            first += columns * parts
        return cls(shape, points, noise, tuple(unknown))

    def rest(self, magnet: Magnet, contact_gap_m: float, plate: Float64 = NO_PLATE) -> Contact:
        """Set the magnet down. contact_gap_m: maximum gap between a face and steel on which it lies. plate:
        (N, 3) corners of a plate under a face that the map doesn't show: along, across and height, m.
        """
        points, noise, poles = self.points, self.noise_m, magnet.pole_table
        seen = np.isfinite(points[:, Z])
        most = np.tan(np.radians(magnet.limits.roll_deg))
        v, u, z = (np.append(points[seen, k], plate[:, n]) for n, k in enumerate((V, U, Z)))
        height, roll, pitch, rests_off = rest_faces(u, v, z, noise, most)
        touch_gap = contact_gap_m + noise
        table, gaps = _gaps(points, height, roll, pitch, touch_gap, poles)
        touches, sigma = height + roll * u + pitch * v - z <= touch_gap, points[seen, SIGMA]
        on_map, on_plate = np.split(touches, [sigma.size])
        # Faces that rest on a plate alone may touch none of the map.
        touched = sigma[on_map] if on_map.any() else sigma
        faces = height + roll * poles[:, 1] + pitch * poles[:, 0]
        ends = np.cumsum([columns * parts for columns, parts in self.shape])
        found = tuple(
            PoleContact(float(mean), float(least), float(share), unknown, float(face), own.reshape(form))
            for (mean, least, share), unknown, face, own, form in zip(
                table, self.unknown, faces, np.split(gaps, ends[:-1]), self.shape, strict=True
            )
        )
        return Contact(
            height,
            faces,
            math.atan(pitch),
            math.atan(roll),
            rests_off,
            math.hypot(noise, float(np.median(touched))),
            noise,
            touch_gap,
            found,
            plate[on_plate, :2],
        )


def rest_magnet(heights: HeightMap, place: Placement, magnet: Magnet, contact_gap_m: float) -> Contact | None:
    """Set the magnet down on the map (`FaceHeights.rest`); None where nothing at all is known under it."""
    faces = FaceHeights.of(heights, place, magnet)
    return None if faces is None else faces.rest(magnet, contact_gap_m)


@kernel()
def _gaps(
    points: Float64, height: float, roll: float, pitch: float, near: float, poles: Float64
) -> tuple[Float64, Float64]:
    """Compute mean gap, smallest gap and contact share of each pole (P, 3), and all gaps (N,)."""
    table, gaps = np.zeros((len(poles), 3)), np.empty(len(points))
    counts = np.zeros((len(poles), 2))
    table[:, 1] = np.inf
    for k in range(len(points)):
        own = points[k]
        p = int(own[POLE])
        gaps[k] = max(height + roll * own[U] + pitch * own[V] - own[Z], 0.0)
        counts[p, 0] += 1
        if np.isnan(own[Z]):
            gaps[k] = np.nan
            continue
        counts[p, 1] += 1
        table[p, 0] += gaps[k]
        table[p, 1] = min(table[p, 1], gaps[k])
        table[p, 2] += gaps[k] <= near
    for p in range(len(poles)):
        table[p, 0] = table[p, 0] / counts[p, 1] if counts[p, 1] else np.nan
        table[p, 2] /= counts[p, 0]
    return table, gaps
