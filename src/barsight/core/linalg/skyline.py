"""Factorise and solve symmetric matrices of which each row begins late: the skyline Cholesky factor.

A factor's rows begin where the matrix's do [Jennings 1966], so nothing before is stored or worked on. Plain
loops: LAPACK is two to six times as fast on one thread, but slower than these on its own threads where the
machine is busy (benchmarks/results/2026-11-23-linear-algebra.md).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float64, Int64, kernel


class Skyline(NamedTuple):
    """The lower half of a symmetric matrix (n, n). first: (n,) each row's first column that may be filled;
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


@kernel(fastmath=True)
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


@kernel(fastmath=True)
def solve_forward(factor: Skyline, x: Float64) -> None:
    """Replace x (n, m), right sides beside each other so that the factor is read once for all of them, by the
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


@kernel(fastmath=True)
def solve_back_dense(factor: Skyline, x: Float64) -> None:
    """Replace x (n, m) by the inverse of the factor's transpose times it."""
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


@kernel(fastmath=True)
def gram_matrix(x: Float64, result: Float64) -> None:
    """Multiply x^T x (m, m) of x (n, m). BLAS's threads wait for each other where the machine is busy."""
    result[:] = 0
    for i in range(x.shape[0]):
        for a in range(x.shape[1]):
            share = x[i, a]
            for b in range(x.shape[1]):
                result[a, b] += share * x[i, b]
