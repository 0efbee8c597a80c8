"""Dense systems against NumPy's, and the limit on BLAS's threads."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from barsight.core.linalg.dense import cholesky, one_blas_thread, solve_lower, solve_positive


def positive(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n + 3))
    return root @ root.T, rng.normal(size=(n, 2))


def threads() -> set[int]:
    return {lib["num_threads"] for lib in ThreadpoolController().select(user_api="blas").info()}


def test_a_dense_system_is_solved() -> None:
    matrix, right = positive(0, 23)
    factor = cholesky(np.tril(matrix))
    np.testing.assert_allclose(factor, np.linalg.cholesky(matrix))
    forward = solve_lower(factor, right)
    np.testing.assert_allclose(factor @ forward, right)
    np.testing.assert_allclose(factor.T @ solve_lower(factor, forward[:, 0], transposed=True), forward[:, 0])
    np.testing.assert_allclose(solve_positive(matrix, right), np.linalg.solve(matrix, right))


@pytest.mark.parametrize("wrong", [-1.0, 0.0, np.nan])
def test_what_is_not_positive_definite_is_refused(wrong: float) -> None:
    matrix, _ = positive(1, 9)
    matrix[5, 5] = wrong
    with pytest.raises(np.linalg.LinAlgError):
        cholesky(matrix)


def test_threads_change_no_digit() -> None:
    matrix, right = positive(2, 700)
    with threadpool_limits(1, user_api="blas"):
        one = solve_positive(matrix, right)
    with threadpool_limits(2, user_api="blas"):
        np.testing.assert_array_equal(solve_positive(matrix, right), one)


def test_the_limit_holds_inside_alone() -> None:
    """Threads that enter by turns, and one block within another."""

    def inside(_: int) -> list[set[int]]:
        with one_blas_thread():
            with one_blas_thread():
                within = threads()
            return [within, threads()]

    before = threads()
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(inside, range(6))) == [[{1}, {1}]] * 6
    assert threads() == before
