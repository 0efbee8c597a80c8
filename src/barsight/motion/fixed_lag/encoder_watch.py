"""Watch the encoders while the crane travels: jumps and freezes as soon as they show."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E

from barsight.core.arrays import Float64
from barsight.core.stamps import seconds_to_ns
from barsight.core.types import CraneSamples, EncoderJump
from barsight.motion.batch.fault_detection import frozen_stretches, without_frozen
from barsight.motion.crane.encoder_jumps import find_jumps, take_off_jumps
from barsight.motion.crane.known_motion import KnownMotion
from barsight.motion.fixed_lag.sliding_window import Window
from barsight.motion.problem.problem import MarginalPrior, encoder_unknowns_of

NEWEST_S = 2.5
"""Jumps are sought in so much of what came last: one shows more clearly the longer it is past."""


class EncoderWatch:
    """Encoder faults so far. jumps: in time's order; frozen: stamps of the first and last frozen readings."""

    def __init__(self) -> None:
        self.jumps: tuple[EncoderJump, ...] = ()
        self.frozen: list[tuple[int, int]] = []

    def check(self, crane: CraneSamples, known: KnownMotion) -> None:
        """Look for faults in the newest readings. crane: as they came."""
        if not len(crane.stamp_ns):
            return
        stamps, place = crane.stamp_ns, crane.position_m
        parts = [(int(stamps[first]), int(stamps[last])) for first, last in frozen_stretches(crane)]
        if self.frozen:  # one that began before what is left of the readings goes on
            begin, end = self.frozen[-1]
            k = int(np.searchsorted(stamps, end))
            while k + 1 < len(stamps) and stamps[k] >= end and (place[k + 1] == place[k]).all():
                k += 1
            self.frozen[-1] = begin, max(end, int(stamps[min(k, len(stamps) - 1)]))
        seen = {first for first, _ in self.frozen}
        self.frozen += [part for part in parts if part[0] not in seen]
        usable, after = without_frozen(crane, self.frozen)
        told = {jump.stamp_ns for jump in self.jumps}
        self._add(jump for jump in after if jump.stamp_ns not in told)
        newest_ns = int(stamps[-1]) - seconds_to_ns(NEWEST_S)
        self._add(find_jumps(replace(usable, jumps=self.jumps), known, newest_ns))

    def usable(self, crane: CraneSamples) -> CraneSamples:
        """Return readings without the frozen ones, jumps taken off."""
        return take_off_jumps(without_frozen(crane, self.frozen)[0], self.jumps)

    def _add(self, jumps: Iterable[EncoderJump]) -> None:
        self.jumps = tuple(sorted((*self.jumps, *jumps), key=lambda jump: jump.stamp_ns))


def with_jumps(window: Window, jumps: tuple[EncoderJump, ...]) -> Window:
    """Make jumps that were found since unknowns of a window."""
    problem = window.problem
    added = tuple(jump for jump in jumps if jump not in problem.jumps)
    if not added or not problem.has_latency:
        return window
    values, prior, old = gtsam.Values(window.state.values), problem.prior, problem.encoder_unknowns
    known = encoder_unknowns_of(values)
    values.erase(E(0))
    values.insert(E(0), np.append(known, np.zeros(len(added))))
    if prior is not None:
        prior = _widened(prior, old, np.array([jump.sigma_m for jump in added]))
    problem = replace(problem, jumps=(*problem.jumps, *added), prior=prior)
    return replace(window, problem=problem, state=replace(window.state, values=values))


def _widened(prior: MarginalPrior, old: int, sigmas_m: Float64) -> MarginalPrior:
    """Add unknowns of these sigmas to a prior whose border begins with `old` of the encoders."""
    at = len(prior.matrix) - len(prior.border) + old
    where, none = np.full(len(sigmas_m), at), np.zeros(len(sigmas_m))
    matrix = np.insert(np.insert(prior.matrix, where, 0.0, axis=0), where, 0.0, axis=1)
    new = at + np.arange(len(sigmas_m))
    matrix[new, new] = sigmas_m**-2
    border = np.insert(prior.border, np.full(len(sigmas_m), old), none)
    return replace(prior, border=border, matrix=matrix, gradient=np.insert(prior.gradient, where, none))
