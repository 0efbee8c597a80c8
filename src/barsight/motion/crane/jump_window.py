"""Detect jumps of the encoders: steps between two neighbouring readings that no motion of the crane explains.

The readings of four seconds are modelled as the sum of the travel known from the IMU, the travel that it
leaves unknown, noise with isolated outliers, and a step s h, where h is 0 before a reading and 1 from it on.
The unknown travel is a Gaussian process of covariance K: a parabola and the accelerometer's noise, twice
integrated; without an IMU all that a crane may do: oscillations of 0.3 to 3.2 Hz and changes of its
acceleration. The travel that the pictures show between two frames adds rows to the same system. So

    s = h' K^-1 y / h' K^-1 h,    sigma_s^2 = 1 / h' K^-1 h

[generalised least squares: Aitken 1936], with Cauchy weights on the noise. A step's significance, in sigma,
follows from how much lower the total cost is with it than without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from barsight.core.arrays import Float64, Int64
from barsight.core.linalg.dense import cholesky, solve_lower
from barsight.core.records.sensor_samples import CraneSamples, EncoderJump
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.motion.crane.known_motion import KnownMotion, SeenSteps

HALF_S, STRIDE_S = 2.0, 0.5
"""Half the length of a window, and the distance between the middles of neighbouring windows, s."""
MAX_RATE_HZ = 25.0
"""Maximum rate of the readings; those that come faster are combined by their median."""
MIN_SIDE = 4
"""Minimum number of readings on either side of a step."""
SURE_SIGMAS, MAYBE_SIGMAS = 4.7, 4.0
"""Significance from which a step is a jump, and from which it may be one; a possible jump only loosens the
tie between the readings on its two sides.
"""
BLIND_RATIO = 1.7
"""Factor on both thresholds and on a jump's sigma where no IMU measures the travel: what a crane may do isn't
quite normally distributed, and three outliers in a row look like a step.
"""
MIN_JUMP_M = 0.004
WIDE_M = 10.0
CAUCHY_SIGMAS = 3.0
ROUNDS, MIN_CHANGE = 12, 0.01
PLAY_M, PLAY_S = 0.0006, 0.4
"""Standard deviation of an encoder's lag or skew behind its crane, m, and its correlation time, s."""
LATENCY_SIGMA_S = 0.1
FREQUENCIES_HZ = np.linspace(0.3, 3.2, 12)
AMPLITUDES_M = np.minimum(0.015, 1.0 / (2 * np.pi * FREQUENCIES_HZ) ** 2)
"""Amplitudes of a crane's oscillations at `FREQUENCIES_HZ`: limited to 15 mm and to 1 m/s^2."""
CHANGE_MPS2 = 0.35
"""Standard deviation of the change of the crane's acceleration within a second."""
ACCEL_DENSITY = 2.5e-3
"""Noise density of the accelerometer, m/s^2/sqrt(Hz), including the effects of sway and of its
misalignment.
"""
JERK_MPS3 = 3e-3
"""Standard deviation of the rate at which gravity leaks into the acceleration, left by the gyro's trend."""
SCALE, ASKEW_RAD = 2e-3, 2.6e-3
"""Standard deviations of the scale and of the angle that all of the pictures' steps have in common."""


@dataclass(frozen=True, eq=False)
class FoundStep:
    """Step found on an axis. reading: the first of the series' readings beyond it; sigmas: its significance
    (without an IMU reduced by `BLIND_RATIO`); size_m, sigma_m: the step itself; way_m: (n,) the travel less
    the values that the step was fitted to, at the window's readings, which begin at `first`.
    """

    axis: int
    reading: int
    sigmas: float
    size_m: float
    sigma_m: float
    first: int
    way_m: Float64


@dataclass(frozen=True, eq=False)
class JumpWindow:
    """N readings and then M steps of the pictures as rows.

    values: (N + M, 3) m; variance: (3, N + M) of the rows' noise per axis; open: (3, N + M, N + M) covariance
    of everything else. steps: (N + M, S) columns of the steps that are tested; beyond: (S,) the first reading
    beyond each. stamp_ns: (N,), whose first reading is the series' `first`; by_imu: whether the IMU measures
    the travel.
    """

    values: Float64
    variance: Float64
    open: Float64
    steps: Float64
    beyond: Int64
    stamp_ns: Int64
    first: int
    by_imu: bool

    @classmethod
    def around(
        cls,
        series: CraneSamples,
        sigma_m: Float64,
        middle_ns: int,
        known: KnownMotion,
        half_s: float = HALF_S,
        reach_s: float = STRIDE_S / 2,
    ) -> JumpWindow | None:
        """Gather the measurements around a stamp; None where they are too few for any step.

        sigma_m: (n, 3) of the series' readings; reach_s: maximum distance of the steps from the stamp, s.
        """
        first, end = np.searchsorted(series.stamp_ns, known.span(middle_ns, seconds_to_ns(half_s)))
        stamps, place = series.stamp_ns[first:end], series.position_m[first:end]
        count = len(stamps)
        beyond = np.flatnonzero(np.abs(stamps - middle_ns) <= seconds_to_ns(reach_s))
        beyond = beyond[(beyond >= MIN_SIDE) & (beyond <= count - MIN_SIDE)]
        if count < 2 * MIN_SIDE:
            return None
        begin_ns, last_ns = int(stamps[0]), int(stamps[-1])
        imu = known.by_imu(series, begin_ns, last_ns)
        seen = None if known.steps is None else known.steps.chosen(begin_ns, last_ns)
        values, speed, variance = place - place[:1], np.zeros_like(place), sigma_m[first:end].T ** 2
        way, ends = np.empty((0, 3)), np.empty(0, np.int64)
        if seen is not None and len(seen.old_ns):
            way = seen.way_m @ series.yard_from_body_nominal.T
            ends, speed = np.concatenate([seen.old_ns, seen.new_ns]), _seen_speed(seen, way, stamps)
            askew = (ASKEW_RAD * np.linalg.norm(way, axis=1)) ** 2
            variance = np.hstack([variance, np.tile(seen.sigma_m**2 + askew, (3, 1))])
        time = (np.concatenate([stamps, ends]) - begin_ns) / NS_PER_S
        rows = block_diag(np.eye(count), _differences(len(way)))
        if imu is not None:
            values, speed = values - imu.place_at(stamps), imu.speed_at(stamps)
            values -= values[:1]
        by_imu = 0 if imu is None else _differences(len(way)) @ imu.place_at(ends)
        open_m2 = rows @ _unknown_way(time, imu is not None) @ rows.T
        near = np.abs(time[:count, None] - time[:count])
        open_m2[:count, :count] += PLAY_M**2 * np.exp(-near / PLAY_S)
        columns = [_columns(speed[:, axis], way, axis) for axis in range(3)]
        steps = np.zeros((count + len(way), len(beyond)))
        steps[:count] = np.arange(count)[:, None] >= beyond
        return cls(
            np.vstack([values, way - by_imu]), variance, np.stack([open_m2 + c @ c.T for c in columns]),
            steps, beyond, stamps, int(first), imu is not None,
        )  # fmt: skip

    def largest_step(self, axis: int, jumps: Sequence[EncoderJump]) -> FoundStep | None:
        """Find the most significant step on one axis besides the given jumps; None where there is none."""
        values, open_m2 = self.values[:, axis], self.open[axis]
        if jumps:
            open_m2 = open_m2 + self.jumped(jumps)
        none = np.zeros(len(values))
        plain = self._weighted(axis, open_m2, none, np.ones(len(none)))
        if np.abs(plain.sigmas).max() < MAYBE_SIGMAS and plain.worst < CAUCHY_SIGMAS + 1:
            return None
        without = self._robust(axis, open_m2, none)
        tried = {int(np.abs(fit.sigmas).argmax()) for fit in (plain, without)}
        fits = [(self._robust(axis, open_m2, self.steps[:, k]), k) for k in tried]
        fit, k = min(fits, key=lambda one: one[0].cost)
        wider = 1 if self.by_imu else BLIND_RATIO
        sigmas = float(np.sqrt(max(0.0, 2 * (without.cost - fit.cost)))) / wider
        if sigmas < MAYBE_SIGMAS or abs(fit.size_m) < MIN_JUMP_M:
            return None
        way = (fit.way_m - values)[: len(self.stamp_ns)]
        reading = self.first + int(self.beyond[k])
        return FoundStep(axis, reading, sigmas, fit.size_m, wider * fit.sigma_m, self.first, way)

    def step_at(self, axis: int, stamp_ns: int) -> tuple[float, float]:
        """Fit a step at a stamp; return its size and sigma, m."""
        step = np.zeros(len(self.values))
        step[: len(self.stamp_ns)] = self.stamp_ns >= stamp_ns
        fit = self._robust(axis, self.open[axis], step)
        return fit.size_m, fit.sigma_m

    def weights(self, axis: int, open_m2: Float64) -> Float64:
        """Compute the Cauchy weights (N + M,) of the rows, without a step, under the covariance `open_m2`."""
        off = self._robust(axis, open_m2, np.zeros(len(self.values))).off
        return 1 / (1 + off**2 / CAUCHY_SIGMAS**2)

    def jumped(self, jumps: Sequence[EncoderJump]) -> Float64:
        """Compute the covariance (N + M, N + M) of the jumps' unknown sizes and of readings next to them."""
        stamps, near = self.stamp_ns, seconds_to_ns(1.3 / MAX_RATE_HZ)
        columns, unsure = np.zeros((len(self.values), len(jumps))), np.zeros(len(self.values))
        for k, jump in enumerate(jumps):
            columns[: len(stamps), k] = jump.sigma_m * jump.share(stamps)
            # It isn't always known on which side of the jump the nearest readings are.
            unsure[: len(stamps)][np.abs(stamps - jump.stamp_ns) < near] = WIDE_M**2
        return np.asarray(columns @ columns.T + np.diag(unsure))

    def _robust(self, axis: int, open_m2: Float64, step: Float64) -> _Fit:
        weight = np.ones(len(step))
        for _ in range(ROUNDS):
            fit, before = self._weighted(axis, open_m2, step, weight), weight
            weight = 1 / (1 + fit.off**2 / CAUCHY_SIGMAS**2)
            if np.abs(weight - before).max() < MIN_CHANGE:
                break
        return fit

    def _weighted(self, axis: int, open_m2: Float64, step: Float64, weight: Float64) -> _Fit:
        """Fit with given weights; if step (N + M,) is all zeros, no step is fitted."""
        values, variance = self.values[:, axis], self.variance[axis]
        noise = variance / weight
        factor = cholesky(open_m2 + np.diag(noise))
        right = solve_lower(factor, np.column_stack([values, step, self.steps]))
        own, mine = right[:, 0], right[:, 1]
        size = sigma = 0.0
        if step.any():
            power = float(mine @ mine)
            size, sigma = float(mine @ own) / power, power**-0.5
            own = own - size * mine
        each = (right[:, 2:] * own[:, None]).sum(axis=0) / np.sqrt((right[:, 2:] ** 2).sum(axis=0))
        pull = solve_lower(factor, own, transposed=True)
        off = noise * pull / np.sqrt(variance)
        cost = CAUCHY_SIGMAS**2 / 2 * float(np.log1p((off / CAUCHY_SIGMAS) ** 2).sum())
        cost += float(pull @ open_m2 @ pull) / 2
        way = values - size * step - noise * pull
        return _Fit(size, sigma, cost, each, off, way)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fit of a window. size_m, sigma_m: of the step. cost: negative log-likelihood. sigmas: (S,) of each
    tested step in addition to the fitted one. off: (N + M,) residuals in sigma; way_m: (N + M,) the travel
    without the step.
    """

    size_m: float
    sigma_m: float
    cost: float
    sigmas: Float64
    off: Float64
    way_m: Float64

    @property
    def worst(self) -> float:
        """Return the largest residual in sigma."""
        return float(np.abs(self.off).max())


def _unknown_way(time: Float64, by_imu: bool) -> Float64:
    """Compute the covariance (n, n) m2 of the unknown travel at times (n,) s, given the IMU's if there is
    one.
    """
    middle = time - (time[0] + time[-1]) / 2
    near = np.minimum(time[:, None], time)
    apart = np.abs(time[:, None] - time)
    if by_imu:
        sigmas = np.array([WIDE_M, WIDE_M, 1.0, JERK_MPS3 / 6])
        drawn = ACCEL_DENSITY**2 * (near**3 / 3 + apart * near**2 / 2)
    else:
        sigmas = np.array([WIDE_M, WIDE_M, 1.0, 0.0])
        drawn = CHANGE_MPS2**2 * (near**5 / 20 + apart * near**4 / 8 + apart**2 * near**3 / 12)
        waves = np.cos(2 * np.pi * apart[..., None] * FREQUENCIES_HZ)
        drawn += waves @ (AMPLITUDES_M**2 / 2)
    powers = middle[:, None] ** np.arange(4) * sigmas
    return np.asarray(powers @ powers.T + drawn)


def _differences(steps: int) -> Float64:
    """Make the matrix (M, 2 M) that subtracts the first half of the positions from the second."""
    return np.hstack([-np.eye(steps), np.eye(steps)])


def _seen_speed(seen: SeenSteps, way: Float64, stamps: Int64) -> Float64:
    """Interpolate the speed (n, 3) m/s at the stamps from the displacements (M, 3) that the pictures show."""
    middle, seconds = (seen.old_ns + seen.new_ns) // 2, (seen.new_ns - seen.old_ns) / NS_PER_S
    return np.column_stack([np.interp(stamps, middle, part) for part in (way / seconds[:, None]).T])


def _columns(speed: Float64, way: Float64, axis: int) -> Float64:
    """Make columns (n + M, 3) of one axis's unknowns besides its travel, each scaled by its sigma: the
    latency, and scale and angle of the pictures' steps.
    """
    across = np.linalg.norm(np.delete(way, axis, axis=1), axis=1)
    return block_diag(
        -LATENCY_SIGMA_S * speed[:, None], np.column_stack([SCALE * way[:, axis], ASKEW_RAD * across])
    )
