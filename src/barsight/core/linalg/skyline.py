"""Factorise and solve symmetric matrices whose rows begin at different columns: the skyline Cholesky factor.

The factor's rows begin where the matrix's do [Jennings 1966], so nothing before is stored or computed. Plain
loops are used, because rows of poses are long and those of velocities and biases short, which costs LAPACK's
band and block routines more than they gain (benchmarks/results/2026-11-23-linear-algebra.md).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float64, Int64, kernel


class Skyline(NamedTuple):
    """The lower half of a symmetric matrix (N, N). first: (N,) each row's first column that may be filled;
    element (i, j), first[i] <= j <= i, is `values[offset[i] + j]`.
    """

    values: Float64
    first: Int64
    offset: Int64


def empty_skyline(first: Int64) -> Skyline:
    """Allocate zeros."""
    index = np.arange(len(first))
    end = np.cumsum(index - first + 1)
    return Skyline(np.zeros(end[-1] if len(end) else 0), first, end - index - 1)


def uniform_band(rows: Float64) -> Skyline:
    """View a matrix of one half-width w as a skyline, the same memory: rows (n, w), `rows[i, w - 1 - (i -
    j)]` is its element (i, j).
    """
    return Skyline(rows.reshape(-1), *_even(*rows.shape))


def full(matrix: Float64) -> Skyline:
    """Wrap the lower half of a whole symmetric matrix (n, n), the same memory."""
    at = np.arange(len(matrix))
    return Skyline(matrix.reshape(-1), np.zeros_like(at), at * len(matrix))


@lru_cache(maxsize=256)
def _even(n: int, width: int) -> tuple[Int64, Int64]:
    index = np.arange(n)
    return np.maximum(index - width + 1, 0), (index + 1) * (width - 1)


@kernel()
def factorise_skyline(band: Skyline) -> bool:
    """Replace the matrix by its lower Cholesky factor; false where it isn't positive definite."""
    values, first, offset = band
    for i in range(len(first)):
        for j in range(first[i], i + 1):
            begin = max(first[i], first[j])
            mine = values[offset[i] + begin : offset[i] + j]
            other = values[offset[j] + begin : offset[j] + j]
            total = 0.0
            for k in range(len(mine)):
                total += mine[k] * other[k]
            left = values[offset[i] + j] - total
            if j < i:
                values[offset[i] + j] = left / values[offset[j] + j]
            elif left <= 0:
                return False
            else:
                values[offset[i] + i] = np.sqrt(left)
    return True


@kernel()
def solve_forward(factor: Skyline, x: Float64) -> None:
    """Replace x (N, M), right sides beside each other so that the factor is read once for all of them, by the
    factor's inverse times these. Four rows at a time, so that the sums stay in the registers.
    """
    values, first, offset = factor
    sides = x.shape[1]
    for i in range(len(first)):
        own, begin = offset[i], first[i]
        fours = begin + (i - begin) // 4 * 4
        for k in range(begin, fours, 4):
            p, q, r, s = values[own + k], values[own + k + 1], values[own + k + 2], values[own + k + 3]
            for c in range(sides):
                x[i, c] -= p * x[k, c] + q * x[k + 1, c] + r * x[k + 2, c] + s * x[k + 3, c]
        for k in range(fours, i):
            p = values[own + k]
            for c in range(sides):
                x[i, c] -= p * x[k, c]
        p = 1 / values[own + i]
        for c in range(sides):
            x[i, c] *= p


@kernel()
def solve_back_dense(factor: Skyline, x: Float64) -> None:
    """Replace x (N, M) by the inverse of the factor's transpose times it."""
    values, first, offset = factor
    sides = x.shape[1]
    for i in range(len(first) - 1, -1, -1):
        p = 1 / values[offset[i] + i]
        for c in range(sides):
            x[i, c] *= p
        for k in range(first[i], i):
            share = values[offset[i] + k]
            for c in range(sides):
                x[k, c] -= share * x[i, c]


@kernel()
def inverse_blocks(
    factor: Skyline, at: Int64, diagonal: Float64, blocks: Float64, pairs: Int64, cross: Float64
) -> None:
    """Compute blocks of the inverse, from the last column back [Takahashi 1973]: only its elements within the
    band are needed, and of these only those of the rows that a column reaches. diagonal: (N,). blocks: (K, B,
    B) of the unknowns from at[k] on, at (K,) ascending; cross: (P, B, B) those in the rows of block pairs[:,
    0], ascending, and the columns of the later pairs[:, 1], pairs (P, 2); NaN beyond the band.
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
