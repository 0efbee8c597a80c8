"""Jumps of the encoders: a step between two neighbouring readings that no motion of a crane explains.

Around each place between two readings a polynomial with a step is fitted; the step is a weighted sum of the
readings, s = sum_i w_i x_i. Noise gives s the standard deviation |w| sigma. An oscillation of amplitude A at
f Hz gives at most A |sum_i w_i exp(2 pi i f t_i)|, and a kink in the speed at time t, as backlash makes, at
most its size times |sum_i w_i max(t_i - t, 0)|. What exceeds all three, by a robust fit too, is a jump.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.stamps import NS_PER_S
from barsight.core.types import CraneSamples

MIN_JUMP_M = 0.006
"""The robust weights of the estimate deal with smaller steps."""
NOISE_SIGMAS = 7.0
MAX_FREQUENCY_HZ, MAX_AMPLITUDE_M, MAX_ACCELERATION_MPS2 = 3.2, 0.015, 1.0
"""A crane oscillates no faster, no further and with no more acceleration than this."""
MAX_KINK_MPS = 0.05
"""Change of speed between two readings, by backlash or the end of a ramp."""
WINDOWS = tuple((degree, side) for degree in (2, 3) for side in range(5, 13))
"""Degrees and numbers of readings on either side, of which the pair is taken that shows the smallest jump."""
MAX_WILD, MIN_GAIN = 2, 4
"""Readings of a window that may lie elsewhere; where some do, a fit without a step leaves so many more."""
ROBUST_STEPS = 15
_FREQUENCIES_HZ = np.linspace(0.3, MAX_FREQUENCY_HZ, 12)
_AMPLITUDES_M = np.minimum(MAX_AMPLITUDE_M, MAX_ACCELERATION_MPS2 / (2 * np.pi * _FREQUENCIES_HZ) ** 2)
_MAX_GAP = 3.5
"""Steps in time, over the median one, that a window may hold."""


@dataclass(frozen=True, eq=False)
class JumpTest:
    """The test for jumps on one recording's readings.

    degree, side: of the fits. sigma_m: of a reading, on each axis. smallest_m: the size from which on a jump
    is told, the median over the readings; noise hides it in half the cases, one |w| sigma more in 16 %.
    """

    degree: int
    side: int
    sigma_m: float
    smallest_m: float


def find_jumps(crane: CraneSamples) -> list[tuple[int, float]]:
    """Find the jumps: index of the first reading beyond each, and its size in m."""
    test = jump_test(crane)
    if test is None:
        return []
    windows = _windows(_seconds(crane), test)
    size = np.linalg.norm(windows.steps(crane.position_m), axis=1)
    windows = windows.chosen(size > windows.limit_m)
    step, agree = windows.robust_fits(crane.position_m, test.sigma_m)
    _, agree_without = windows.robust_fits(crane.position_m, test.sigma_m, parameters=test.degree + 1)
    wild = 2 * test.side - agree
    sure = (step > windows.limit_m) & (wild <= MAX_WILD) & ((wild == 0) | (agree >= agree_without + MIN_GAIN))
    places = np.flatnonzero(sure)
    groups = np.split(places, np.flatnonzero(np.diff(windows.middle[places]) > 2 * test.side) + 1)
    best = [max(group, key=lambda k: (agree[k], step[k])) for group in groups if group.size]
    return [(int(windows.middle[k]), float(step[k])) for k in best]


def jump_test(crane: CraneSamples) -> JumpTest | None:
    """Choose the window that shows the smallest jump; None where the readings are too few for any."""
    time = _seconds(crane)
    sigma = max(crane.position_std_m, _seen_sigma_m(crane))
    tests = []
    for degree, side in WINDOWS:
        if len(time) > 2 * side:
            regular: Float64 = np.arange(2.0 * side) * float(np.median(np.diff(time)))
            limit = _windows(regular, JumpTest(degree, side, sigma, 0.0)).limit_m[0]
            tests.append(JumpTest(degree, side, sigma, float(limit)))
    return min(tests, key=lambda test: test.smallest_m, default=None)


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of n = 2 side readings. middle: (K,) index of the first reading beyond each step. design:
    (K, n, P) of the polynomial and, last, the step. weights: (K, n) of the least-squares step. limit_m: (K,).
    """

    middle: Int64
    design: Float64
    weights: Float64
    limit_m: Float64

    def steps(self, place_m: Float64) -> Float64:
        """Return (K, 3): steps by least squares."""
        steps: Float64 = np.einsum("kn,knj->kj", self.weights, place_m[self._readings])
        return steps

    def robust_fits(
        self, place_m: Float64, sigma_m: float, parameters: int | None = None
    ) -> tuple[Float64, Int64]:
        """Return (K,): sizes of the last parameter by Cauchy's weights; (K,) how many readings agree with the
        fit.
        """
        places, design = place_m[self._readings], self.design[..., :parameters]
        root = np.ones_like(self.weights)
        for _ in range(ROBUST_STEPS):
            weighted = design * root[..., None]
            fit = np.linalg.solve(weighted.mT @ weighted, weighted.mT @ (places * root[..., None]))
            residual = np.linalg.norm(places - design @ fit, axis=2)
            scale = 3 * np.maximum(np.median(residual, axis=1, keepdims=True), sigma_m)
            root = 1 / np.sqrt(1 + (residual / scale) ** 2)
        agree = (residual < np.maximum(self.limit_m / 2, 5 * sigma_m)[:, None]).sum(axis=1)
        return np.linalg.norm(fit[:, -1], axis=1), agree

    def chosen(self, chosen: Bool) -> Windows:
        """Some of them."""
        return Windows(self.middle[chosen], self.design[chosen], self.weights[chosen], self.limit_m[chosen])

    @property
    def _readings(self) -> Int64:
        side = self.weights.shape[1] // 2
        return self.middle[:, None] + np.arange(-side, side)


def _windows(time: Float64, test: JumpTest) -> Windows:
    """Lay a window around each place between two readings where none is far from the next."""
    side, degree = test.side, test.degree
    middle = np.arange(side, len(time) - side + 1)
    at = time[middle[:, None] + np.arange(-side, side)]
    whole = np.diff(at, axis=1).max(axis=1) <= _MAX_GAP * np.median(np.diff(time))
    middle, at = middle[whole], at[whole]
    at = at - (at[:, side - 1] + at[:, side])[:, None] / 2
    unit = at / (at[:, -1] - at[:, 0])[:, None]
    beyond = np.broadcast_to(np.arange(2 * side) >= side, unit.shape)
    design = np.stack([*(unit**power for power in range(degree + 1)), beyond], axis=2)
    last = np.broadcast_to(np.eye(degree + 2)[:, -1:], (len(at), degree + 2, 1))
    weights = (design @ np.linalg.solve(design.mT @ design, last))[..., 0]
    wave = np.exp(2j * np.pi * at[..., None] * _FREQUENCIES_HZ)
    alias = (np.abs(np.einsum("kn,knf->kf", weights, wave)) * _AMPLITUDES_M).max(axis=1)
    ramps = np.maximum(at[:, :, None] - at[:, None, :], 0)
    kink = MAX_KINK_MPS * np.abs(np.einsum("kn,knm->km", weights, ramps)).max(axis=1)
    noise = NOISE_SIGMAS * test.sigma_m * np.linalg.norm(weights, axis=1)
    return Windows(middle, design, weights, np.maximum(noise + alias + kink, MIN_JUMP_M))


def _off_neighbours(crane: CraneSamples) -> tuple[Float64, Float64]:
    """Return (N - 4, 3): readings minus the cubic through two on either side; (N - 4,) sigmas over a
    reading's.
    """
    time = _seconds(crane)
    if len(time) < 9:
        return np.empty((0, 3)), np.empty(0)
    around = np.arange(2, len(time) - 2)[:, None] + np.array([-2, -1, 1, 2])
    unit = (time[around] - time[2:-2, None]) / float(np.median(np.diff(time)))
    weights = np.ones_like(unit)  # Lagrange's, at the reading's own time
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[:, i] *= -unit[:, j] / (unit[:, i] - unit[:, j])
    off = crane.position_m[2:-2] - np.einsum("kn,knj->kj", weights, crane.position_m[around])
    return off, np.sqrt(1 + (weights**2).sum(axis=1))


def _seen_sigma_m(crane: CraneSamples) -> float:
    """Noise of a reading on the noisiest axis, by the median distance from its neighbours' cubic."""
    off, scale = _off_neighbours(crane)
    if off.size == 0:
        return 0.0
    return float(1.4826 * np.median(np.abs(off) / scale[:, None], axis=0).max())


def _seconds(crane: CraneSamples) -> Float64:
    return np.asarray((crane.stamp_ns - crane.stamp_ns[:1]) / NS_PER_S, np.float64)
