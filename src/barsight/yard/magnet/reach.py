"""Find what lies within reach of each pole, wherever the crane sets the magnet down within its tolerance."""

from __future__ import annotations

import itertools
import math

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.yard.magnet.description import Magnet, Tolerance
from barsight.yard.magnet.footprint import SURELY, Placement
from barsight.yard.magnet.resting_plane import Z, profiles
from barsight.yard.types import Bundle, HeightMap, known_sigma

DEEPER_M = 0.01
"""Depth (m) below a pole's reach at which steel may still be pulled, due to the errors of both heights."""
PART_M = 0.25
"""Length (m) along the poles of the parts over which median heights are taken."""
ALONG_M = 0.02
"""Spacing (m) of the rows of a part."""
MAX_SKEW = 0.05
"""Maximum sine of the skew to the beam of a bundle beside whose surface is looked at."""
_ROWS = 3
"""Minimum number of rows of a part that lie beside a bundle; with fewer, the bundle lies beyond it."""
LOOK_M = 0.05
"""Distance (m) beside a face over which falling flanks are followed."""
FLANK_M, SHOULDER_M = 0.003, 0.004
"""Minimum fall (m) of a flank from one place across to the next, and maximum decrease (m) of that fall: where
another bundle begins there is a groove or a shoulder.
"""


def reached_strips(
    heights: HeightMap, place: Placement, magnet: Magnet, tolerance: Tolerance, face_z_m: Float64
) -> Float64:
    """Bound what each pole may reach by a rectangle (P, 4): along, across, length, width, in the beam's axes.

    It contains every place under the face, grown by the crane's tolerance, where the map's median along
    PART_M lies less than DEEPER_M below the reach, or nothing was seen; its size is 0 where there is none.
    Flanks that fall from there to below the reach are left out, since they belong to the bundle whose top
    they fall from. face_z_m: (P,) height of each pole's face.
    """
    poles = magnet.pole_table
    more = tolerance.along(place.beam_axes)
    turned = math.radians(tolerance.yaw_deg)
    wide, long = ((np.abs(poles[:, k]) + poles[:, m] / 2).max() for k, m in ((1, 3), (0, 2)))
    grown = poles.copy()
    grown[:, 2] += 2 * (more[0] + turned * wide)
    grown[:, 3] += 2 * (more[1] + turned * long)
    looked = grown.copy()
    looked[:, 3] += 2 * LOOK_M
    count = max(round(float(looked[:, 2].max()) / PART_M), 1)
    cuts = np.repeat(looked, count, axis=0)
    cuts[:, 2] /= count
    cuts[:, 0] += np.tile(np.arange(count) - (count - 1) / 2, len(poles)) * cuts[:, 2]
    shapes, points = profiles(heights, place, cuts)
    first = 0
    for number in range(len(poles)):
        shape = shapes[number * count][0], count
        last = first + shape[0] * count
        z = points[first:last, Z].reshape(count, shape[0]).T
        over_m = z - (face_z_m[number] - magnet.reach_m - DEEPER_M)
        first = last
        beside = (np.arange(shape[0]) + 0.5) / shape[0] * looked[number, 3] - looked[number, 3] / 2
        reached = ~(over_m < 0) & (np.abs(beside) <= grown[number, 3] / 2)[:, None]
        across, along = (0, 0), (0, 0)
        if reached.any():
            along = _ends(reached.any(axis=0))
            # The maximum counts, and so does NaN: a flank that is hidden in one place isn't one.
            level = over_m[:, along[0] : along[1]].max(axis=1)
            low, high = _ends(reached.any(axis=1))
            across = low + _flank(level[:high][::-1], low), high - _flank(level[low:], shape[0] - high)
        for (low, high), cells, middle, size in ((along, shape[1], 0, 2), (across, shape[0], 1, 3)):
            step = looked[number, size] / cells
            grown[number, middle] += step * (low + high - cells) / 2
            grown[number, size] = step * max(high - low, 0)
    return grown


def _ends(flags: Bool) -> tuple[int, int]:
    """Return the first place that is set, and one past the last."""
    (places,) = np.nonzero(flags)
    return int(places[0]), int(places[-1]) + 1


def _flank(level: Float64, beyond: int) -> int:
    """Count the places of a flank that falls from within the reach to below it.

    level: (N,) heights over the reach, outwards, NaN where unknown; the last `beyond` lie outside of what may
    be reached.
    """
    edge = len(level) - beyond
    (deep,) = np.nonzero(level[edge - 1 :] < 0)
    if not deep.size:
        return 0
    falls = -np.diff(level[: edge + deep[0]])
    flank = (falls >= FLANK_M) & np.append(np.diff(falls) >= -SHOULDER_M, True)
    top = len(flank) - (len(flank) if flank.all() else int(np.argmin(flank[::-1])))
    return max(edge - 1 - top, 0)


def parts_beside(bundle: Bundle, place: Placement, pole: Float64) -> list[tuple[float, float, float]]:
    """List the parts, about PART_M long, of a pole's reach (4,) beside which a bundle may lie: from and to
    along the beam, and the place of the bundle's middle across it.
    """
    away = bundle.centre_m[:2] - (place.x_m, place.y_m)
    middle, along = float(away @ place.across), float(away @ place.along)
    ends_m = math.hypot(known_sigma(bundle.sigma.along_m), known_sigma(bundle.sigma.length_m) / 2)
    half_m = math.inf if any(bundle.ends_open) else bundle.length_m / 2 + SURELY * ends_m
    turn = math.tan(bundle.yaw_rad - place.yaw_rad)
    count = max(round(pole[2] / PART_M), 1)
    ends = pole[0] + pole[2] * (np.arange(count + 1) / count - 0.5)
    found = []
    for low, high in itertools.pairwise(ends):
        rows = np.arange(low, high + ALONG_M / 2, ALONG_M)
        rows = rows[np.abs(rows - along) < half_m]
        if rows.size >= _ROWS:
            found.append((float(rows[0]), float(rows[-1]), middle - turn * (float(rows.mean()) - along)))
    return found
