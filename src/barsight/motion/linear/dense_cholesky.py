"""Fill dense symmetric matrices of a hundred or two unknowns."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64, kernel


@kernel(fastmath=True)
def multiply(matrix: Float64, vector: Float64) -> Float64:
    """Multiply a matrix (m, n) by a vector (n,).

    BLAS's threads wait for each other where the machine is busy.
    """
    result = np.empty(len(matrix))
    for i in range(len(matrix)):
        total = 0.0
        for k in range(len(vector)):
            total += matrix[i, k] * vector[k]
        result[i] = total
    return result


@kernel()
def add_band(rows: Float64, begin: int, matrix: Float64) -> None:
    """Add a symmetric band (`band`) to the unknowns from `begin` on."""
    n, width = rows.shape
    for i in range(n):
        for j in range(max(0, i - width + 1), i + 1):
            value = rows[i, j - i + width - 1]
            matrix[begin + i, begin + j] += value
            if j < i:
                matrix[begin + j, begin + i] += value


@kernel()
def add_blocks(blocks: Float64, size: int, matrix: Float64) -> None:
    """Add blocks (M, 6, 6 M) as `eliminate` gives them: of node k with nodes 0...k at the right end."""
    nodes = blocks.shape[0]
    for k in range(nodes):
        for s in range(k + 1):
            for i in range(6):
                row, column, begin = k * size + i, (k - s) * size, (nodes - 1 - s) * 6
                for j in range(i + 1 if s == 0 else 6):
                    value = blocks[k, i, begin + j]
                    matrix[row, column + j] += value
                    if column + j < row:
                        matrix[column + j, row] += value
