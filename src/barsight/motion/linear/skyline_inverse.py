"""Invert a skyline matrix within its band, and fill it from sparse rows and chains of nodes."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64, Int64, kernel
from barsight.core.linalg.skyline import Skyline


@kernel(fastmath=True)
def inverse_blocks(
    factor: Skyline, at: Int64, diagonal: Float64, blocks: Float64, pairs: Int64, cross: Float64
) -> None:
    """Compute blocks of the inverse, from the last column back [Takahashi 1973]: only its elements within the
    band are needed, and of these only those of the rows that a column reaches. diagonal: (n,). blocks: (K, b,
    b) of the unknowns from at[k] on, at ascending; cross: (P, b, b) those in the rows of block pairs[:, 0],
    ascending, and the columns of the later pairs[:, 1]; NaN beyond the band.
    """
    values, first, offset = factor
    n, size = len(first), blocks.shape[1]
    reach = 1
    for i in range(n):
        reach = max(reach, i - first[i] + 1)
    held = reach + size
    near = np.zeros((held, held))  # element (i, j) at [i % held, j % held]
    column, below, sums = np.zeros(held), np.empty(held, np.int64), np.empty(held)
    block, pair = len(blocks) - 1, len(pairs) - 1
    for j in range(n - 1, -1, -1):
        own, count = values[offset[j] + j], 0
        column[:] = 0.0
        for i in range(j + 1, min(n, j + reach)):
            if first[i] <= j:
                below[count] = i % held
                column[below[count]] = values[offset[i] + j] / own
                count += 1
        here, spread = j % held, 1 / own**2
        for a in range(count):
            row, total = near[below[a]], 0.0
            for k in range(held):
                total += column[k] * row[k]
            sums[a] = total
        for a in range(count):
            near[below[a], here] = near[here, below[a]] = -sums[a]
            spread += column[below[a]] * sums[a]
        near[here, here] = diagonal[j] = spread
        if block < 0 or at[block] != j:
            continue
        for i in range(size):
            for k in range(size):
                blocks[block, i, k] = near[(j + i) % held, (j + k) % held]
        while pair >= 0 and pairs[pair, 0] == block:
            for k in range(size):
                later = at[pairs[pair, 1]] + k
                for i in range(size):
                    within = first[later] <= j + i
                    cross[pair, i, k] = near[(j + i) % held, later % held] if within else np.nan
            pair -= 1
        block -= 1


@kernel(fastmath=True)
def add_products(
    first: Int64, at: Int64, values: Float64, right: Float64, rows: Float64, gradient: Float64,
    side: Float64, corner: Float64, corner_gradient: Float64,
) -> None:  # fmt: skip
    """Add the normal equations of sparse rows to those of one half-width (`even`): row r has values[k] at
    unknown at[k], first[r] <= k < first[r + 1], and `right`. Unknown n, after the band's, is the border's.
    """
    n, width = rows.shape
    for r in range(len(right)):
        for a in range(first[r], first[r + 1]):
            i = at[a]
            if i == n:
                corner_gradient[0] -= values[a] * right[r]
            else:
                gradient[i] -= values[a] * right[r]
            for b in range(first[r], first[r + 1]):
                j, product = at[b], values[a] * values[b]
                if i == n and j == n:
                    corner[0, 0] += product
                elif i == n:
                    side[0, j] += product
                elif j <= i:
                    rows[i, j - i + width - 1] += product


@kernel(fastmath=True)
def add_chain(rows: Float64, at: Int64, band: Skyline) -> None:
    """Add a chain (M n, 2 n) of nodes that bind their neighbours, each node's unknowns from at[k] on."""
    size = rows.shape[1] // 2
    for k in range(len(at)):
        for i in range(size):
            row, line = at[k] + i, rows[k * size + i]
            for j in range(i + 1):
                band.values[band.offset[row] + at[k] + j] += line[2 * size - 1 - i + j]
            if k > 0:
                for j in range(size):
                    band.values[band.offset[row] + at[k - 1] + j] += line[size - 1 - i + j]
