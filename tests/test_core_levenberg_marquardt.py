"""Levenberg-Marquardt: known minima, each end, and never uphill."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest

from barsight.core.arrays import Float64
from barsight.core.linalg.levenberg_marquardt import Options, Termination, minimise

OPTIONS = Options(100, 1e-14, 0.0, 1e-6, 1e8)


@dataclass(frozen=True, eq=False)
class Rosenbrock:
    """10 (y - x^2) and 1 - x: the minimum 0 lies at (1, 1) in a bent valley."""

    x: Float64

    @cached_property
    def cost(self) -> float:
        r = self.residual
        return float(r @ r)

    @property
    def residual(self) -> Float64:
        return np.array([10 * (self.x[1] - self.x[0] ** 2), 1 - self.x[0]])

    def step(self, damping: float) -> Rosenbrock:
        jacobian = np.array([[-20 * self.x[0], 10.0], [-1.0, 0.0]])
        normal = jacobian.T @ jacobian
        normal += damping * np.diag(np.diag(normal))
        return Rosenbrock(self.x - np.linalg.solve(normal, jacobian.T @ self.residual))


@dataclass(frozen=True, eq=False)
class Sloped:
    """x with a step that always leads `by` further; `singular`: none at all."""

    x: float
    by: float = 1.0
    singular: bool = False

    @property
    def cost(self) -> float:
        return self.x

    def step(self, damping: float) -> Sloped:
        if self.singular:
            raise np.linalg.LinAlgError
        return Sloped(self.x + self.by, self.by)


def test_a_bent_valley_is_followed_to_its_end() -> None:
    found = minimise(Rosenbrock(np.array([-1.2, 1.0])), OPTIONS)
    assert found.converged
    np.testing.assert_allclose(found.best.x, 1, atol=1e-8)


def test_each_end_is_named() -> None:
    assert minimise(Sloped(100.0, -1.0), OPTIONS).best.x == 0
    uphill, singular = minimise(Sloped(1.0), OPTIONS), minimise(Sloped(1.0, singular=True), OPTIONS)
    assert uphill.termination is Termination.MAX_DAMPING
    assert uphill.best.x == 1
    assert singular.termination is Termination.SINGULAR
    short = minimise(Sloped(100.0, -1.0), Options(7, 1e-14, 0.0, 1e-6, 1e8))
    assert (short.termination, short.steps) == (Termination.MAX_STEPS, 7)
    assert short.best.x == 93


@pytest.mark.parametrize("nan", [np.nan, np.inf])
def test_a_cost_that_is_not_a_number_is_refused(nan: float) -> None:
    assert minimise(Sloped(1.0, nan), OPTIONS).best.x == 1
