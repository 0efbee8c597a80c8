"""Find the stanchions of the settings that stand under the magnet, whether the map shows them or not."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.magnet.footprint import Placement
from barsight.yard.vetoes import Check, check_max


def stanchion_checks(
    place: Placement, parts: Float64, planes: Float64, stanchions: Iterable[tuple[float, float, float]]
) -> list[Check]:
    """Check that no stanchion rises into the magnet; none to check where none stands under it.

    parts: (N, 5) poles and beam: middle along and across, reach to either side, allowed rise over the faces,
    m. planes: (K, 3) heights of the faces at the place, slopes along and across. stanchions: x, y, height, m.
    """
    checks = []
    for x, y, z in stanchions:
        v, u = place.beam_axes @ (x - place.x_m, y - place.y_m)
        over = z - float((planes @ (1, v, u)).min())
        under = (np.abs(parts[:, 0] - v) <= parts[:, 2]) & (np.abs(parts[:, 1] - u) <= parts[:, 3])
        if under.any():
            reason = f"the stanchion at {x:g}, {y:g} m rises {1e3 * over:.0f} mm over the plane of the faces"
            what = "height of a stanchion under the magnet above the plane of the faces"
            allowed = float(parts[under, 4].min())
            checks.append(check_max("obstructed", what, 1e3 * over, 1e3 * allowed, "mm", reason))
    return checks
