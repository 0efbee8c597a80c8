"""Symmetric band matrices: Cholesky's factor, its solutions, and the inverse within the band.

A matrix (n, n) of half-width w lies in rows (n, w): `rows[i, w - 1 - (i - j)]` is its element (i, j), j <= i.
Plain loops: the bands are a few hundred wide, where BLAS's threads cost more than they bring.
"""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64, Int64, kernel


@kernel(fastmath=True)
def factorise(rows: Float64) -> bool:
    """Replaces the matrix by its lower factor; false where it isn't positive definite."""
    n, width = rows.shape
    for i in range(n):
        first = max(0, i - width + 1)
        for j in range(first, i + 1):
            begin = max(first, j - width + 1)
            mine = rows[i, begin - i + width - 1 : j - i + width - 1]
            other = rows[j, begin - j + width - 1 : width - 1]
            total = 0.0
            for k in range(len(mine)):
                total += mine[k] * other[k]
            left = rows[i, j - i + width - 1] - total
            if j < i:
                rows[i, j - i + width - 1] = left / rows[j, width - 1]
            elif left <= 0:
                return False
            else:
                rows[i, width - 1] = np.sqrt(left)
    return True


@kernel(fastmath=True)
def solve_forward(factor: Float64, x: Float64) -> None:
    """Replaces x (n, m), right sides beside each other so that the factor is read once for all of them, by
    the factor's inverse times these. Four rows at a time, so that the sums stay in the registers.
    """
    n, width = factor.shape
    sides = x.shape[1]
    for i in range(n):
        first = max(0, i - width + 1)
        own = i - width + 1
        fours = first + (i - first) // 4 * 4
        for k in range(first, fours, 4):
            p, q = factor[i, k - own], factor[i, k + 1 - own]
            r, s = factor[i, k + 2 - own], factor[i, k + 3 - own]
            for c in range(sides):
                x[i, c] -= p * x[k, c] + q * x[k + 1, c] + r * x[k + 2, c] + s * x[k + 3, c]
        for k in range(fours, i):
            p = factor[i, k - own]
            for c in range(sides):
                x[i, c] -= p * x[k, c]
        p = 1 / factor[i, width - 1]
        for c in range(sides):
            x[i, c] *= p


@kernel(fastmath=True)
def solve_back(factor: Float64, x: Float64) -> None:
    """Replaces x (n, m) by the inverse of the factor's transpose times it."""
    n, width = factor.shape
    sides = x.shape[1]
    for i in range(n - 1, -1, -1):
        p = 1 / factor[i, width - 1]
        for c in range(sides):
            x[i, c] *= p
        for k in range(max(0, i - width + 1), i):
            share = factor[i, k - i + width - 1]
            for c in range(sides):
                x[k, c] -= share * x[i, c]


@kernel(fastmath=True)
def products(x: Float64, result: Float64) -> None:
    """result (m, m): x^T x of x (n, m). BLAS's threads wait for each other where the machine is busy."""
    result[:] = 0
    for i in range(x.shape[0]):
        for a in range(x.shape[1]):
            share = x[i, a]
            for b in range(x.shape[1]):
                result[a, b] += share * x[i, b]


@kernel(fastmath=True)
def inverse_blocks(factor: Float64, size: int, blocks: Float64, pairs: Int64, cross: Float64) -> None:
    """blocks: (n / size, size, size) those on the inverse's diagonal, from the last column back [Takahashi
    1973]: only the inverse's elements within the band are needed. cross: (P, size, size) those in the rows of
    block pairs[:, 0] and the columns of the later pairs[:, 1]; NaN beyond the band.
    """
    n, width = factor.shape
    inverse = np.zeros((n, 2 * width - 1))  # element (i, j) at [i, j - i + width - 1], both halves
    column, sums = np.empty(width), np.empty(width)
    for j in range(n - 1, -1, -1):
        own = factor[j, width - 1]
        count = min(width - 1, n - 1 - j)
        for k in range(count):
            column[k] = factor[j + 1 + k, width - 2 - k] / own
        for i in range(count):
            row = inverse[j + 1 + i, width - 1 - i : width - 1 - i + count]
            total = 0.0
            for k in range(count):
                total += column[k] * row[k]
            sums[i] = -total
        diagonal = 1 / own**2
        for i in range(count):
            inverse[j + 1 + i, width - 2 - i] = inverse[j, width + i] = sums[i]
            diagonal -= column[i] * sums[i]
        inverse[j, width - 1] = diagonal
    for b in range(len(blocks)):
        for i in range(size):
            for j in range(size):
                blocks[b, i, j] = inverse[b * size + i, j - i + width - 1]
    for p in range(len(pairs)):
        apart = (pairs[p, 1] - pairs[p, 0]) * size
        for i in range(size):
            for j in range(size):
                within = apart + j - i < width
                row = pairs[p, 0] * size + i
                cross[p, i, j] = inverse[row, apart + j - i + width - 1] if within else np.nan


@kernel(fastmath=True)
def add_products(
    first: Int64, at: Int64, values: Float64, right: Float64, rows: Float64, gradient: Float64,
    side: Float64, corner: Float64, corner_gradient: Float64,
) -> None:  # fmt: skip
    """Adds the normal equations of sparse rows: row r has values[k] at unknown at[k], first[r] <= k <
    first[r + 1], and `right`. Unknown n, one after the band's, is the border's first.
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
def add_blocks(blocks: Float64, size: int, rows: Float64) -> None:
    """Adds blocks (M, b, R b): of node k's first b unknowns with those of the nodes k - R + 1...k; a node has
    `size` unknowns. Of its own block the lower half counts.
    """
    width, own = rows.shape[1], blocks.shape[1]
    reach = blocks.shape[2] // own
    for k in range(blocks.shape[0]):
        for s in range(min(reach, k + 1)):
            for i in range(own):
                row, begin = k * size + i, (reach - 1 - s) * own
                column = row - i - s * size
                for j in range(i + 1 if s == 0 else own):
                    rows[row, column + j - row + width - 1] += blocks[k, i, begin + j]


@kernel(fastmath=True)
def add_dense(matrix: Float64, count: int, rows: Float64) -> None:
    """Adds a symmetric matrix's first `count` unknowns to the band's first ones."""
    width = rows.shape[1]
    for i in range(count):
        for j in range(i + 1):
            rows[i, j - i + width - 1] += matrix[i, j]


@kernel()
def whole(rows: Float64, result: Float64) -> None:
    """The matrix (n, n), both halves, zero beyond the band."""
    n, width = rows.shape
    result[:] = 0
    for i in range(n):
        for j in range(max(0, i - width + 1), i + 1):
            result[i, j] = result[j, i] = rows[i, j - i + width - 1]
