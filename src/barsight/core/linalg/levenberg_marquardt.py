"""Minimise a cost by damped Gauss-Newton steps [Levenberg 1944, Marquardt 1963]."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Generic, Protocol, TypeVar

import numpy as np

from barsight.core.linalg.dense import one_blas_thread

_TINY = 1e-18
_FACTOR = 10.0


class Iterate(Protocol):
    """A state with its cost, and the step from there.

    What costs memory or time should be computed on use: a rejected trial is only asked for its cost.
    """

    @property
    def cost(self) -> float:
        """Return the sum to be minimised. May raise LinAlgError."""

    def step(self: I, damping: float) -> I:
        """Solve the normal equations with their diagonal raised by the factor `damping`, and take the step.

        Raises LinAlgError if they have no solution.
        """


I = TypeVar("I", bound=Iterate)  # noqa: E741


@dataclass(frozen=True)
class Options:
    """Options of the search.

    max_steps: maximum number of trials, including rejected ones. min_gain_ratio: relative change of the cost
    below which the search ends. Damping starts at `first_damping` and falls to `min_damping`, or to 0 if it
    started there; above `max_damping` the search ends.
    """

    max_steps: int
    min_gain_ratio: float
    first_damping: float
    min_damping: float
    max_damping: float

    @property
    def floor(self) -> float:
        """Return the smallest damping."""
        return min(self.first_damping, self.min_damping)


class Termination(Enum):
    """The condition that ended the search."""

    CONVERGED = "converged"
    MAX_STEPS = "max-steps"
    MAX_DAMPING = "max-damping"
    SINGULAR = "singular"


@dataclass(frozen=True, eq=False)
class Minimum(Generic[I]):
    """The best iterate, the number of steps tried, and the reason why the search ended."""

    best: I
    steps: int
    termination: Termination

    @property
    def converged(self) -> bool:
        """Return whether further steps would gain next to nothing."""
        return self.termination is Termination.CONVERGED


@one_blas_thread()
def minimise(best: I, options: Options) -> Minimum[I]:
    """Find a minimum, starting from `best`; the cost never increases."""
    damping = options.first_damping
    for steps in range(1, options.max_steps + 1):
        try:
            trial = best.step(damping)
            loss, failure = trial.cost - best.cost, Termination.MAX_DAMPING
        except np.linalg.LinAlgError:
            loss, failure = np.inf, Termination.SINGULAR
        converged = abs(loss) <= options.min_gain_ratio * best.cost + _TINY
        if loss <= 0:
            best = trial
            damping = damping / _FACTOR if damping > options.min_damping else options.floor
        elif damping > options.max_damping:
            return Minimum(best, steps, failure)
        else:
            damping = max(options.min_damping, _FACTOR * damping)
        if converged:
            return Minimum(best, steps, Termination.CONVERGED)
    return Minimum(best, options.max_steps, Termination.MAX_STEPS)
