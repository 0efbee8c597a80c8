"""Fit an IMU's noise model to a log at rest by Allan deviation.

The overlapping Allan variance of a rate with white noise N, flicker B and random walk K is
N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 [IEEE Std 952]. All three are fitted together over all octaves of
tau, each weighted by its degrees of freedom.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.arrays import Float64, Int64
from barsight.core.errors import Failed
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import NS_PER_S

FLICKER = 2 * np.log(2) / np.pi
GAP_STEPS = 1.5
FEWEST_SAMPLES = 2000
FIT_ROUNDS = 12
MAX_GYRO_CHANGE, MAX_ACCEL_CHANGE = 0.05, 0.5


@dataclass(frozen=True, eq=False)
class AxisNoise:
    """Noise of one sensor axis. tau_s, deviation, freedom: (T,) Allan deviation and its degrees of freedom.

    density, walk, instability: N (unit / sqrt(Hz)), K (unit / s / sqrt(Hz)) and B (unit), 0 where the log
    shows none. *_sigma: standard deviation of each; where the value is 0, the smallest value that would show.
    """

    name: str
    tau_s: Float64
    deviation: Float64
    freedom: Float64
    density: float
    density_sigma: float
    walk: float
    walk_sigma: float
    instability: float
    instability_sigma: float

    def model(self, tau_s: Float64) -> Float64:
        """Evaluate the fitted Allan deviation (T,) at averaging times tau_s (T,)."""
        curve: Float64 = np.sqrt(_terms(tau_s) @ np.square([self.density, self.instability, self.walk]))
        return curve


@dataclass(frozen=True, eq=False)
class ImuNoiseFit:
    """Noise fitted to a log.

    axes: gyro x, y, z (rad/s), then accelerometer x, y, z (m/s^2). duration_s: length of the log without its
    gaps. gaps: number of gaps.
    """

    axes: tuple[AxisNoise, ...]
    rate_hz: float
    duration_s: float
    gaps: int

    @property
    def noise(self) -> ImuNoise:
        """Return Kalibr's four numbers, each from the noisiest axis, so that no axis is trusted too much.

        A random walk that does not show in the log is set to its sigma, the smallest value that would show,
        not to 0.
        """
        gyro, accel = self.axes[:3], self.axes[3:]
        return ImuNoise(
            max(a.density for a in gyro), max(max(a.walk, a.walk_sigma) for a in gyro),
            max(a.density for a in accel), max(max(a.walk, a.walk_sigma) for a in accel), self.rate_hz,
        )  # fmt: skip


def fit_imu_noise(samples: ImuSamples) -> ImuNoiseFit | Failed:
    """Fit the noise model of an IMU at rest.

    Stamps may jitter. Where samples are missing, the stretches between the gaps are evaluated together.
    Failed `too-short` below 2000 samples, `moving` where the mean over a second changes more than that of a
    resting IMU.
    """
    step = float(np.median(np.diff(samples.stamp_ns))) / NS_PER_S
    bounds = _stretches(samples.stamp_ns, step)
    lengths = np.diff(bounds)
    if lengths.max() < FEWEST_SAMPLES:
        return Failed(
            "too-short",
            f"the longest stretch without a gap has {lengths.max()} samples, {FEWEST_SAMPLES} are needed",
        )
    kept = [slice(a, b) for a, b in itertools.pairwise(bounds) if b - a >= FEWEST_SAMPLES // 4]
    moving = _moving(samples, kept, step)
    if moving is not None:
        return moving
    seconds = sum((samples.stamp_ns[s.stop - 1] - samples.stamp_ns[s.start]) / NS_PER_S for s in kept)
    rate = sum(s.stop - s.start - 1 for s in kept) / seconds
    values = np.column_stack([samples.gyro_radps, samples.accel_mps2])
    names = [f"{sensor} {axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
    axes = tuple(_fit_axis(name, [values[s, k] for s in kept], rate) for k, name in enumerate(names))
    return ImuNoiseFit(axes, float(rate), float(seconds), len(bounds) - 2)


def _stretches(stamp_ns: Int64, step_s: float) -> Int64:
    """Find the indices at which the log begins, resumes after a gap, and ends."""
    gaps = np.flatnonzero(np.diff(stamp_ns) > GAP_STEPS * step_s * NS_PER_S) + 1
    return np.concatenate([[0], gaps, [stamp_ns.size]]).astype(np.int64)


def _moving(samples: ImuSamples, kept: list[slice], step_s: float) -> Failed | None:
    window = max(round(1 / step_s), 1)
    for name, values, most, unit in (
        ("gyroscope", samples.gyro_radps, MAX_GYRO_CHANGE, "rad/s"),
        ("accelerometer", samples.accel_mps2, MAX_ACCEL_CHANGE, "m/s^2"),
    ):
        for stretch in kept:
            part = values[stretch]
            whole = part[: len(part) // window * window].reshape(-1, window, 3).mean(axis=1)
            change = float(np.abs(whole - np.median(whole, axis=0)).max())
            if change > most:
                return Failed("moving", f"the {name}'s mean of one second changes by {change:.2g} {unit}")
    return None


def _fit_axis(name: str, stretches: list[Float64], rate: float) -> AxisNoise:
    taus, variances, counts = _allan(stretches, rate)
    terms = _terms(taus)
    unknown = np.array([variances[0] * taus[0], 0.0, 0.0])
    freedom = counts
    for _ in range(FIT_ROUNDS):
        model = terms @ unknown
        walking = terms[:, 2] * unknown[2] > 0.5 * model
        freedom = _freedom(counts, np.round(taus * rate), walking)
        weight = np.sqrt(freedom / 2) / np.maximum(model, 1e-300)
        scale = 1 / np.linalg.norm(terms * weight[:, None], axis=0)
        unknown = scale * nnls(terms * weight[:, None] * scale, variances * weight)[0]
    model = terms @ unknown
    rows = terms * (np.sqrt(freedom / 2) / model)[:, None]
    scale = 1 / np.linalg.norm(rows, axis=0)
    spread = np.diag(np.linalg.pinv((rows * scale).T @ (rows * scale))) * scale**2
    roots = np.sqrt(unknown)
    sigmas = np.where(unknown**2 > spread, np.sqrt(spread) / np.maximum(2 * roots, 1e-300), spread**0.25)
    n, b, k = (float(value) for value in roots)
    n_sigma, b_sigma, k_sigma = (float(value) for value in sigmas)
    return AxisNoise(name, taus, np.sqrt(variances), freedom, n, n_sigma, k, k_sigma, b, b_sigma)


def _allan(stretches: list[Float64], rate: float) -> tuple[Float64, Float64, Float64]:
    """Compute tau (s), Allan variance and sample count for each octave over all stretches."""
    total: dict[int, list[float]] = {}
    for values in stretches:
        octaves = 2 ** np.arange(int(np.log2(values.size / 5)) + 1)
        for m, one in zip(octaves, overlapping_allan_variance(values, octaves), strict=True):
            entry = total.setdefault(int(m), [0.0, 0.0])
            entry[0] += one * values.size
            entry[1] += values.size
    steps = np.array(sorted(total))
    sums = np.array([total[int(m)] for m in steps])
    return steps / rate, sums[:, 0] / sums[:, 1], sums[:, 1]


def overlapping_allan_variance(values: Float64, steps: Int64) -> Float64:
    """Compute the overlapping Allan variance (T,) of evenly sampled values at averaging times of `steps`
    samples.

    It is half the mean square of the difference between adjacent averages [NIST SP 1065]. steps: (T,), each
    at most half the number of samples.
    """
    phase = np.concatenate([[0.0], np.cumsum(values - values.mean())])
    variances = np.empty(len(steps))
    for k, m in enumerate(steps):
        variances[k] = np.mean(np.square(phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m])) / (2 * m**2)
    return variances


def _terms(tau_s: Float64) -> Float64:
    """Compute the design matrix (T, 3): Allan variance per unit of N^2, B^2 and K^2."""
    return np.column_stack([1 / tau_s, np.full(tau_s.size, FLICKER), tau_s / 3])


def _freedom(count: Float64, steps: Float64, walking: Float64 | np.typing.NDArray[np.bool_]) -> Float64:
    """Compute the degrees of freedom of the overlapping estimate for white noise and random walk [NIST SP
    1065].
    """
    white = (3 * (count - 1) / (2 * steps) - 2 * (count - 2) / count) * 4 * steps**2 / (4 * steps**2 + 5)
    walk = (
        (count - 2) / steps * ((count - 1) ** 2 - 3 * steps * (count - 1) + 4 * steps**2) / (count - 3) ** 2
    )
    freedom: Float64 = np.maximum(np.where(walking, walk, white), 1.0)
    return freedom
