"""The live window's algebra against NumPy's."""

import gtsam
import numpy as np

from barsight.motion.fixed_lag.encoder_watch import sum_unknowns
from barsight.motion.fixed_lag.window_equations import (
    SLIDE_SIGMA_RAD,
    SLIDE_WAY_M,
    DenseEquations,
    marginal_prior,
    propagate_slide,
)
from barsight.motion.problem.problem import MarginalPrior


def positive(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n + 3))
    return root @ root.T, rng.normal(size=n)


def test_a_prior_says_the_same_of_what_stays() -> None:
    matrix, gradient = positive(2, 9)
    step = np.linspace(-1, 1, 9)
    left, slope = marginal_prior(DenseEquations(matrix, gradient, ()), step, 4)
    best = -np.linalg.solve(matrix, gradient)
    np.testing.assert_allclose(np.linalg.inv(left), np.linalg.inv(matrix)[4:, 4:])
    np.testing.assert_allclose(-np.linalg.solve(left, slope), (best - step)[4:])


def test_a_slide_is_forgotten() -> None:
    """As a new unknown that the old one, taken out, is bound to; after a long way nothing is left of it."""
    matrix, gradient = positive(3, 7)
    matrix *= SLIDE_SIGMA_RAD**-2
    slide, keeps = 1e-4, np.exp(-1 / SLIDE_WAY_M)
    fresh = 1 / ((1 - keeps**2) * SLIDE_SIGMA_RAD**2)
    whole, right = np.zeros((8, 8)), np.append(gradient, 0)
    whole[:7, :7] = matrix
    by = np.zeros(8)
    by[4], by[7] = -keeps, 1  # (slide + new) - keeps (slide + old)
    whole += fresh * np.outer(by, by)
    right += fresh * (1 - keeps) * slide * by
    covariance = np.linalg.inv(whole)
    order = [0, 1, 2, 3, 7, 5, 6]
    found, slope = propagate_slide(matrix, gradient, slide, 1.0)
    np.testing.assert_allclose(np.linalg.inv(found), covariance[np.ix_(order, order)], rtol=1e-6)
    np.testing.assert_allclose(
        np.linalg.solve(found, slope), np.linalg.solve(whole, right)[order], rtol=1e-6, atol=1e-15
    )
    far, slope = propagate_slide(matrix, gradient, slide, 1e3)
    np.testing.assert_allclose(np.linalg.inv(far)[4, 4], SLIDE_SIGMA_RAD**2)
    np.testing.assert_allclose(np.linalg.solve(far, slope)[4], slide)


def test_a_sum_is_known_as_well_as_its_parts_tell() -> None:
    """As the whole's inverse says of the sum; what else is known stays."""
    matrix, gradient = positive(4, 9)
    at = np.array([1, 3, 4])
    prior = MarginalPrior(np.zeros(0, np.int64), gtsam.Values(), np.arange(6.0), matrix, gradient)
    found = sum_unknowns(prior, at)
    summing = np.delete(np.eye(9), 3 + at[1:], axis=0)
    summing[4, 3 + at] = 1.0
    np.testing.assert_allclose(found.border, [0, 8, 2, 5])
    np.testing.assert_allclose(np.linalg.inv(found.matrix), summing @ np.linalg.inv(matrix) @ summing.T)
    best = np.linalg.solve(matrix, gradient)
    np.testing.assert_allclose(np.linalg.solve(found.matrix, found.gradient), summing @ best)
