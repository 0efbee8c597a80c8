"""Estimate how a crane's body oscillates beside its encoders, on springs or under a girder that swings.

An encoder measures its wheel or drum. The body oscillates by millimetres beside it, at 0.3 to 3 Hz, and half
a period of that looks like a jump of the encoder in comparison with the IMU. On each axis the oscillation is
modelled as a Gaussian process of covariance

    K(t) = sum_k a_k^2 / 2  exp(-|t| / T)  cos(2 pi f_k t)

f_k is the frequency that reduces the chi2 of the windows the most [least-squares spectrum: Lomb 1976], in
addition to the step that reduces it the most, so that a jump isn't taken for an oscillation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.linalg.dense import cholesky, solve_lower
from barsight.core.records.sensor_samples import EncoderJump
from barsight.core.stamps import NS_PER_S
from barsight.motion.crane.jump_window import JumpWindow

SPRINGS_HZ = np.geomspace(0.3, 3.2, 25)
"""Frequencies that are tried, 10 % apart."""
FADE_S = 4.0
"""Correlation time T of an oscillation, s."""
MAX_PER_AXIS = 2
MIN_GAIN = 4.0
"""Minimum reduction of chi2, in the mean of the windows; noise alone reduces it by 2 to 5."""
AMPLITUDE_RATIO = 0.8
"""Share of the windows whose amplitude is below the one taken for all of them."""
EVERY, MAX_WINDOWS = 2, 24
"""Of the windows, which overlap, every second one is used, and no more than this."""
STEP_READINGS = 2
"""Distance between the steps that are tried, in readings."""
Spring = tuple[float, float]
"""Frequency, Hz, and amplitude, m."""
ANY_SPRINGS = ((0.5, 0.01), (1.0, 0.01), (2.0, 0.004))
"""Oscillations allowed for while wild readings are found."""


def find_springs(
    windows: Sequence[JumpWindow], jumps: Sequence[Sequence[EncoderJump]]
) -> tuple[tuple[Spring, ...], ...]:
    """Estimate the oscillations on each of the three axes, from windows in which the IMU measures the travel.

    jumps: of each axis, known already.
    """
    known = [window for window in windows if window.by_imu][::EVERY]
    chosen = np.unique(np.linspace(0, len(known) - 1, min(len(known), MAX_WINDOWS)).round().astype(int))
    return tuple(_find([known[k] for k in chosen], axis, jumps[axis]) for axis in range(3))


def with_springs(window: JumpWindow, springs: Sequence[Sequence[Spring]]) -> JumpWindow:
    """Add the oscillations' covariance to a window's readings; without an IMU it allows for any already."""
    if not window.by_imu or not any(springs):
        return window
    extra = [_covariance(window, found) for found in springs]
    return replace(window, open=window.open + np.stack(extra))


def _find(windows: Sequence[JumpWindow], axis: int, jumps: Sequence[EncoderJump]) -> tuple[Spring, ...]:
    springs: list[Spring] = []
    spreads = [window.open[axis] + window.jumped(jumps) for window in windows]
    noises = [
        window.variance[axis] / window.weights(axis, spread + _covariance(window, ANY_SPRINGS))
        for window, spread in zip(windows, spreads, strict=True)
    ]
    while windows and len(springs) < MAX_PER_AXIS:
        spectra = [
            _spectrum(window, axis, spread + _covariance(window, springs) + np.diag(noise))
            for window, spread, noise in zip(windows, spreads, noises, strict=True)
        ]
        gain = np.mean([gain for gain, _ in spectra], axis=0)
        best = int(gain.argmax())
        power = np.quantile([power[best] for _, power in spectra], AMPLITUDE_RATIO, method="higher")
        if gain[best] < MIN_GAIN or power <= 0:
            break
        springs.append((float(SPRINGS_HZ[best]), float(np.sqrt(power))))
    return tuple(springs)


def _spectrum(window: JumpWindow, axis: int, covariance_m2: Float64) -> tuple[Float64, Float64]:
    """Fit c cos(2 pi f t) + s sin(2 pi f t) for each frequency f, in addition to the best step.

    Return the reduction (F,) of chi2 against the best step alone, and the squared amplitude c^2 + s^2 (F,),
    m2, less the share of noise. covariance_m2: (N + M, N + M) of the window's values.
    """
    values, count = window.values[:, axis], len(window.stamp_ns)
    beyond = np.arange(STEP_READINGS, count, STEP_READINGS)
    angle = 2 * np.pi * _time(window)[:, None] * SPRINGS_HZ
    columns = np.zeros((len(values), 1 + len(beyond) + 2 * len(SPRINGS_HZ)))
    columns[:, 0] = values
    columns[:count, 1:] = np.hstack([np.arange(count)[:, None] >= beyond, np.cos(angle), np.sin(angle)])
    white = solve_lower(cholesky(covariance_m2), columns)
    own, steps, cos, sin = np.split(white, np.cumsum([1, len(beyond), len(SPRINGS_HZ)]), axis=1)
    steps /= np.linalg.norm(steps, axis=0)
    # The normal equations (S, F) of c and s after each step is eliminated.
    by_step, by_cos, by_sin = steps.T @ own, steps.T @ cos, steps.T @ sin
    cc, ss, cs = (cos**2).sum(axis=0) - by_cos**2, (sin**2).sum(axis=0) - by_sin**2, (cos * sin).sum(axis=0)
    cs = cs - by_cos * by_sin
    c, s = (own.T @ cos) - by_step * by_cos, (own.T @ sin) - by_step * by_sin
    det = cc * ss - cs**2
    gain = by_step**2 + (ss * c**2 - 2 * cs * c * s + cc * s**2) / det
    power = ((ss * c - cs * s) ** 2 + (cc * s - cs * c) ** 2) / det**2 - (cc + ss) / det
    best = gain.argmax(axis=0), np.arange(len(SPRINGS_HZ))
    return gain[best] - (by_step**2).max(), power[best]


def _covariance(window: JumpWindow, springs: Sequence[Spring]) -> Float64:
    """Compute the covariance (N + M, N + M), m2, of the oscillations in a window's N readings."""
    count, time = len(window.stamp_ns), _time(window)
    apart = np.abs(time[:, None] - time)
    whole = np.zeros((len(window.values), len(window.values)))
    for hertz, amplitude_m in springs:
        whole[:count, :count] += (
            amplitude_m**2 / 2 * np.exp(-apart / FADE_S) * np.cos(2 * np.pi * hertz * apart)
        )
    return whole


def _time(window: JumpWindow) -> Float64:
    return np.asarray((window.stamp_ns - window.stamp_ns[0]) / NS_PER_S)
