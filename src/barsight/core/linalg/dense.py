"""Factorise and solve dense positive definite systems with LAPACK through SciPy, on one thread.

Its own threads would wait for each other on a busy machine, and their number changes the last digits.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from typing import Any

import numpy as np
import scipy.linalg
from threadpoolctl import ThreadpoolController

from barsight.core.arrays import Float64


class _Limit:
    """BLAS's thread limit in this process: which thread holds it, and how deeply it is nested."""

    turn = threading.RLock()
    depth = 0


@cache
def _blas() -> Any:
    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread, as a decorator or in a `with`; nesting costs next to nothing.

    The limit belongs to the process, so threads take turns; the old limit is restored on leaving. A limit
    that another thread has set through `threadpoolctl` stays.
    """
    with _Limit.turn, nullcontext() if _Limit.depth else _blas().limit(limits=1):
        _Limit.depth += 1
        try:
            yield
        finally:
            _Limit.depth -= 1


@one_blas_thread()
def cholesky(matrix: Float64) -> Float64:
    """Factorise a symmetric matrix (n, n), of which the lower half counts; the factor is lower, 0 above.

    Raises LinAlgError where the matrix isn't positive definite.
    """
    factor: Float64 = scipy.linalg.cholesky(matrix, lower=True, check_finite=False)
    if not (factor.diagonal() > 0).all():
        raise np.linalg.LinAlgError("the matrix isn't positive definite")
    return factor


@one_blas_thread()
def solve_lower(factor: Float64, right: Float64, transposed: bool = False) -> Float64:
    """Multiply right (n,) or (n, m) by the inverse of a lower factor (n, n), or of its transpose."""
    solved: Float64 = scipy.linalg.solve_triangular(
        factor, right, lower=True, trans="T" if transposed else "N", check_finite=False
    )
    return solved


@one_blas_thread()
def solve_positive(matrix: Float64, right: Float64) -> Float64:
    """Solve a symmetric system (n, n) for right (n,) or (n, m).

    Raises LinAlgError where the matrix isn't positive definite.
    """
    factor = cholesky(matrix)
    return solve_lower(factor, solve_lower(factor, right), transposed=True)
