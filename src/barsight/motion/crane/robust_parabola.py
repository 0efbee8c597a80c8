"""Fit a robust parabola to readings, compiled: the live estimate fits several per frame."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64, kernel

ROUNDS = 10


@kernel()
def fit_parabola(time: Float64, values: Float64, length: float, result: Float64) -> None:
    """Fit by least squares with robust Cauchy weights, which fall off for residuals beyond `length`.

    time: (N,), about -1...1; values (N, 3). result: (P, 4) the P coefficients, lowest power first, and the
    first column of their covariance for a reading's variance of 1.
    """
    size = len(result)
    weight, normal, power = np.ones(len(time)), np.empty((size, size)), np.empty(size)
    for _ in range(ROUNDS):
        normal[:], result[:], result[0, 3] = 0.0, 0.0, 1.0
        for n in range(len(time)):
            for a in range(size):
                power[a] = weight[n] if a == 0 else power[a - 1] * time[n]
                for c in range(3):
                    result[a, c] += power[a] * values[n, c]
                for b in range(a + 1):
                    normal[a, b] += power[a] * power[b] / weight[n]
        for i in range(size):
            for j in range(i + 1):
                for k in range(j):
                    normal[i, j] -= normal[i, k] * normal[j, k]
                normal[i, j] = np.sqrt(normal[i, i]) if i == j else normal[i, j] / normal[j, j]
            for c in range(4):
                for k in range(i):
                    result[i, c] -= normal[i, k] * result[k, c]
                result[i, c] /= normal[i, i]
        for i in range(size - 1, -1, -1):
            for c in range(4):
                for k in range(i + 1, size):
                    result[i, c] -= normal[k, i] * result[k, c]
                result[i, c] /= normal[i, i]
        for n in range(len(time)):
            square = 0.0
            for c in range(3):
                off = result[size - 1, c]
                for a in range(size - 2, -1, -1):
                    off = off * time[n] + result[a, c]
                square += (values[n, c] - off) ** 2
            weight[n] = 1 / (1 + square / length**2)
    scale = (weight**2).sum() / weight.sum()
    for a in range(size):
        result[a, 3] *= scale
