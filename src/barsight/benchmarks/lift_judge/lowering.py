"""Lower the faces, one rigid plane suspended at the magnet's centre, until they rest.

Such a plane comes to rest where its centre is lowest while it still clears every point: minimise h subject to
h + v pitch + u roll >= z, a linear programme in three unknowns. If the centre lies within the triangle of
three contacts, these carry the plane; otherwise the suspension's stop limits the slope.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from barsight.core.arrays import Float64, Int64, kernel

STEEPEST_PITCH = 0.6
"""Largest slope along the beam that the lowering allows: far more than any magnet permits."""
EXACT_M = 1e-6
CONTACT_M = 1e-4


@dataclass(frozen=True, eq=False)
class Rest:
    """The faces at rest: z = height + v pitch + u roll, v along the beam and u across. contacts: (C,)
    indices of the points that carry them.
    """

    height: float
    pitch: float
    roll: float
    contacts: Int64

    def at(self, v: Float64, u: Float64) -> Float64:
        """Compute the height of the face plane, m."""
        return self.height + v * self.pitch + u * self.roll


def lower(v: Float64, u: Float64, z: Float64, cell: Int64, max_roll: float) -> Rest:
    """Lower the plane onto points (N,), ignoring those at -inf. max_roll: limit of the slope across.

    Points are added to the programme as the plane turns out to cut into them, the deepest of each cell (N,
    numbered from 0) at a time; it ends when none is cut by more than EXACT_M.
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
    """Find the point of each cell that is highest above a plane, -1 for a cell without points.

    v, u, z: (N,) m; cell: (N,) numbers from 0. The plane is z = height + v pitch + u roll. Returns (cells,)
    indices of the points.
    """
    best, found = np.full(cell.max() + 1, -np.inf), np.full(cell.max() + 1, -1)
    for k in range(len(z)):
        over = z[k] - height - v[k] * pitch - u[k] * roll
        if over > best[cell[k]]:
            best[cell[k]], found[cell[k]] = over, k
    return found
