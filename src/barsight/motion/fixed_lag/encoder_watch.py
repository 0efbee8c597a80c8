"""Watch the encoders while the crane travels, to find jumps and freezes as soon as they show.

Once all readings held come after several jumps of one encoder, only the sum of these jumps can be observed.
It then replaces them, so that neither the number of unknowns nor the time grows with what is past.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E

from barsight.core.arrays import Float64, Int64
from barsight.core.linalg import dense
from barsight.core.records.sensor_samples import CraneSamples, EncoderJump
from barsight.core.stamps import BEFORE_ALL_NS, seconds_to_ns
from barsight.motion.batch.fault_detection import Stretch, frozen_stretches, merge_stretches, without_frozen
from barsight.motion.crane.encoder_jumps import find_jumps, take_off_jumps
from barsight.motion.crane.known_motion import KnownMotion
from barsight.motion.fixed_lag.sliding_window import Window
from barsight.motion.problem.problem import MarginalPrior, encoder_unknowns_of

NEWEST_S = 2.5
"""Duration, s, of the readings in which jumps are sought again: a jump shows more clearly as readings follow.
"""
MAX_SEARCHED_S = 600.0
"""Maximum duration, s, of the readings in which jumps are sought at once, which takes 10 ms a second."""


class EncoderWatch:
    """Encoder faults so far. jumps: those that the readings held need, in order of time; told: every jump
    that was found; frozen: stamps of the first and last reading of each freeze, which lasts as long as the
    encoders that froze, whatever the others do.
    """

    def __init__(self) -> None:
        self.jumps: tuple[EncoderJump, ...] = ()
        self.told: list[EncoderJump] = []
        self._frozen: list[Stretch] = []
        self._searched_ns = BEFORE_ALL_NS

    @property
    def frozen(self) -> list[tuple[int, int]]:
        """Return the stamps of the first and last reading of each freeze."""
        return [(first, last) for first, last, _ in self._frozen]

    @property
    def off_m(self) -> Float64:
        """Return by how much each encoder is off since the beginning, (3,): the sum of its jumps."""
        return np.array([sum(jump.size_m for jump in self.told if jump.axis == axis) for axis in range(3)])

    def check(self, crane: CraneSamples, known: KnownMotion) -> None:
        """Look for faults in the readings since the last look, however long ago that was, and in those of
        `NEWEST_S` before it. crane: the readings as they came.
        """
        if not len(crane.stamp_ns):
            return
        stamps, place = crane.stamp_ns, crane.position_m
        if self._frozen and self._frozen[-1][1] >= stamps[0]:  # a freeze from before may go on
            begin, end, axes = self._frozen[-1]
            k = int(np.searchsorted(stamps, end))
            while k + 1 < len(stamps) and (place[k + 1] == place[k])[list(axes)].all():
                k += 1
            self._frozen[-1] = begin, max(end, int(stamps[min(k, len(stamps) - 1)])), axes
        parts = frozen_stretches(crane)
        new = ((int(stamps[first]), int(stamps[last]), axes) for first, last, axes in parts)
        self._frozen = merge_stretches((*self._frozen, *new))
        usable, after = without_frozen(crane, self._frozen_since(int(stamps[0])))
        reported = {jump.stamp_ns for jump in self.jumps}
        self._add([jump for jump in after if jump.stamp_ns not in reported])
        since_ns = min(self._searched_ns, int(stamps[-1])) - seconds_to_ns(NEWEST_S)
        self._searched_ns = int(stamps[-1])
        since_ns = max(since_ns, int(stamps[-1]) - seconds_to_ns(MAX_SEARCHED_S))
        self._add(find_jumps(replace(usable, jumps=self.jumps), known, since_ns))

    def put_together(self, begin_ns: int) -> dict[EncoderJump, tuple[EncoderJump, ...]]:
        """Replace the jumps of each encoder that lie before all readings held, from `begin_ns` on, by their
        sum; return the replaced jumps by their sum.
        """
        found: dict[EncoderJump, tuple[EncoderJump, ...]] = {}
        for axis in range(3):
            past = tuple(jump for jump in self.jumps if jump.axis == axis and jump.stamp_ns <= begin_ns)
            if len(past) > 1:
                size, sigma = sum(jump.size_m for jump in past), math.hypot(*(jump.sigma_m for jump in past))
                known = math.hypot(*(jump.known_sigma_m for jump in past))
                found[EncoderJump(past[-1].stamp_ns, axis, size, sigma, found_sigma_m=known)] = past
        gone = {jump for past in found.values() for jump in past}
        left = (*found, *(jump for jump in self.jumps if jump not in gone))
        self.jumps = tuple(sorted(left, key=lambda jump: jump.stamp_ns))
        return found

    def settle(self, begin_ns: int) -> None:
        """Take the jumps before a stamp as known as they were found, as a window that begins then has no
        readings from before them.
        """
        self.jumps = tuple(
            replace(jump, sigma_m=jump.known_sigma_m) if jump.stamp_ns <= begin_ns else jump
            for jump in self.jumps
        )

    def usable(self, crane: CraneSamples) -> CraneSamples:
        """Return the readings without the frozen ones and with the jumps subtracted."""
        since = int(crane.stamp_ns[0]) if len(crane.stamp_ns) else 0
        return take_off_jumps(without_frozen(crane, self._frozen_since(since))[0], self.jumps)

    def _frozen_since(self, begin_ns: int) -> list[tuple[int, int]]:
        return [part for part in self.frozen if part[1] >= begin_ns]

    def _add(self, jumps: Sequence[EncoderJump]) -> None:
        self.told += jumps
        self.jumps = tuple(sorted((*self.jumps, *jumps), key=lambda jump: jump.stamp_ns))


def with_jumps(window: Window, jumps: tuple[EncoderJump, ...]) -> Window:
    """Add newly found jumps to a window as unknowns."""
    problem = window.problem
    added = tuple(jump for jump in jumps if jump not in problem.jumps)
    if not added or not problem.has_latency:
        return window
    values, prior, old = gtsam.Values(window.state.values), problem.prior, 1 + len(problem.jumps)
    known = encoder_unknowns_of(values)
    values.erase(E(0))
    values.insert(E(0), np.insert(known, old, np.zeros(len(added))))
    if prior is not None:
        prior = _widened(prior, old, np.array([jump.sigma_m for jump in added]))
    problem = replace(problem, jumps=(*problem.jumps, *added), prior=prior)
    return replace(window, problem=problem, state=replace(window.state, values=values))


def with_sums(window: Window, sums: dict[EncoderJump, tuple[EncoderJump, ...]]) -> Window:
    """Replace jumps that lie before all present and future nodes of a window by one unknown: their sum.

    The window knows as much of the sum as before, since no residual depends on the single jumps otherwise.
    """
    problem, values = window.problem, gtsam.Values(window.state.values)
    if not problem.has_latency:
        return window
    for whole, past in sums.items():
        at = [problem.jumps.index(jump) for jump in past]
        kept = np.delete(np.arange(len(problem.jumps)), at[1:])
        known = encoder_unknowns_of(values)
        known[1 + at[0]] = known[1:][at].sum()
        values.erase(E(0))
        values.insert(E(0), known[np.r_[0, 1 + kept, 1 + len(problem.jumps) : len(known)]])
        prior = problem.prior
        if prior is not None:
            prior = sum_unknowns(prior, 1 + np.array(at))
        jumps = [whole if k == at[0] else problem.jumps[k] for k in kept.tolist()]
        problem = replace(problem, jumps=tuple(jumps), prior=prior)
    return replace(window, problem=problem, state=replace(window.state, values=values))


def sum_unknowns(prior: MarginalPrior, at: Int64) -> MarginalPrior:
    """Replace the first of some unknowns by their sum and marginalise the others. at: (J,) their indices in
    the border.
    """
    first = len(prior.matrix) - len(prior.border)
    others = first + at[1:]
    kept = np.delete(np.arange(len(prior.matrix)), others)
    # The first unknown is the sum minus the others.
    matrix, gradient, border = prior.matrix.copy(), prior.gradient.copy(), prior.border.copy()
    gradient[others] -= gradient[first + at[0]]
    matrix[others] -= matrix[first + at[0]]
    matrix[:, others] -= matrix[:, [first + at[0]]]
    border[at[0]] = border[at].sum()
    gain = dense.solve_positive(matrix[np.ix_(others, others)], matrix[np.ix_(others, kept)]).T
    own = matrix[np.ix_(kept, kept)] - gain @ matrix[np.ix_(others, kept)]
    return replace(
        prior, border=np.delete(border, at[1:]), matrix=(own + own.T) / 2,
        gradient=gradient[kept] - gain @ gradient[others],
    )  # fmt: skip


def _widened(prior: MarginalPrior, old: int, sigmas_m: Float64) -> MarginalPrior:
    """Add unknowns with these sigmas to a prior, after the first `old` unknowns in its border."""
    at = len(prior.matrix) - len(prior.border) + old
    where, none = np.full(len(sigmas_m), at), np.zeros(len(sigmas_m))
    matrix = np.insert(np.insert(prior.matrix, where, 0.0, axis=0), where, 0.0, axis=1)
    new = at + np.arange(len(sigmas_m))
    matrix[new, new] = sigmas_m**-2
    border = np.insert(prior.border, np.full(len(sigmas_m), old), none)
    return replace(prior, border=border, matrix=matrix, gradient=np.insert(prior.gradient, where, none))
