"""Lower the faces, one rigid plane hung at the magnet's centre, until they rest.

A plane that hangs at its centre comes to rest where its centre is lowest and it still clears every point:
minimise h over h + v pitch + u roll >= z, a linear programme in three unknowns. Where the centre lies within
the triangle of three contacts they carry it; else the suspension's stop does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from barsight.core.arrays import Float64, Int64, kernel

STEEPEST_PITCH = 0.6
"""Slope along the beam at which the lowering ends: far beyond what any magnet allows."""
EXACT_M = 1e-6
CONTACT_M = 1e-4


@dataclass(frozen=True, eq=False)
class Rest:
    """The faces at rest: z = height + v pitch + u roll, v along the beam and u across. contacts: (C,) numbers
    of the points that carry them.
    """

    height: float
    pitch: float
    roll: float
    contacts: Int64

    def at(self, v: Float64, u: Float64) -> Float64:
        """Compute the faces' plane, m."""
        return self.height + v * self.pitch + u * self.roll


def lower(v: Float64, u: Float64, z: Float64, cell: Int64, max_roll: float) -> Rest:
    """Lower the plane onto points (N,); one at -inf isn't there. max_roll: slope across that stops it.

    Points are added to the programme as the plane is found to cut into them, the deepest of each cell (N,
    numbers from 0) at a time; it ends when none is cut by more than EXACT_M.
    """
    chosen = [int(k) for k in _highest(v, u, z, cell, 0.0, 0.0, 0.0) if k >= 0]
    if not chosen:
        raise ValueError("the faces have nothing to rest on")
    for _ in range(60):
        rows = np.array(chosen)
        found = linprog(
            [1.0, 0.0, 0.0],
            A_ub=-np.column_stack([np.ones(len(rows)), v[rows], u[rows]]), b_ub=-z[rows],
            bounds=[(None, None), (-STEEPEST_PITCH, STEEPEST_PITCH), (-max_roll, max_roll)],
            method="highs",
        )  # fmt: skip
        height, pitch, roll = (float(x) for x in np.asarray(found.x, np.float64))
        cut = [int(k) for k in _highest(v, u, z, cell, height, pitch, roll) if k >= 0]
        deeper = [k for k in cut if z[k] - height - v[k] * pitch - u[k] * roll > EXACT_M]
        if not deeper:
            break
        chosen += deeper
    carry = z[rows] - height - v[rows] * pitch - u[rows] * roll > -CONTACT_M
    return Rest(height, pitch, roll, np.unique(rows[carry]))


@kernel()
def _highest(
    v: Float64, u: Float64, z: Float64, cell: Int64, height: float, pitch: float, roll: float
) -> Int64:
    """Find the point of each cell that is highest over a plane, -1 where a cell has none."""
    best, found = np.full(cell.max() + 1, -np.inf), np.full(cell.max() + 1, -1)
    for k in range(len(z)):
        over = z[k] - height - v[k] * pitch - u[k] * roll
        if over > best[cell[k]]:
            best[cell[k]], found[cell[k]] = over, k
    return found
