"""Compare gyro and encoders with the pictures' motion to reveal wrong units, axes and clocks.

The pictures of a calibrated pair measure each step's turn in rad and distance in m, independently of the
other sensors. A wrong unit, axis or clock causes errors far beyond any noise, so all thresholds are coarse.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.errors import InputError
from barsight.core.records.sensor_samples import AXES, CraneSamples, ImuSamples
from barsight.core.stamps import interpolate_at, seconds_to_ns
from barsight.motion.batch.fault_detection import (
    CLEARLY_BETTER,
    TURN_SIGMA_RAD,
    WAY_SIGMA_M,
    frozen_stretches,
)
from barsight.motion.crane.known_motion import SeenSteps
from barsight.motion.crane.sway import MAX_GAP_S, turned_angle
from barsight.motion.frontend.seen_steps import seen_steps
from barsight.motion.frontend.sightings import Sighting

MIN_STEPS, MAX_STEPS = 3, 200
MIN_WAY_M = 0.1
"""Steps that are shorter than this by both pictures and encoders show neither scale nor direction."""
MAX_WAY_RATIO, MAX_ANGLE_DEG = 1.15, 5.0
"""Maximum ratio between the encoders' and the pictures' travel, and maximum angle between the two."""
MAX_FAST_S = 0.06
"""Maximum interval, s, of readings five of which a crane travels nearly straight."""
SIGN_SIGMAS = 5.0
"""Significance from which an encoder counts backwards."""
READING_SIGMAS = 2.0
"""Distance, in sigma of a reading, by which the readings may leave a step's direction."""
TURNS_SIGMAS, MAX_TURN_RATIO, MIN_ALIKE = 4.0, 5.0, 0.7
"""Minimum size of a turn, in sigma, for it to be seen; maximum ratio between the gyro's and the pictures'
turns; minimum cosine between them.
"""
MAX_IMU_LATE_S, MAX_CRANE_LATE_S = 0.05, 0.2
"""Maximum offset of each sensor's stamps, s; the encoders' may be larger, since their latency is
estimated.
"""
LATE_S = np.arange(-50, 51) * 0.02
"""Delays that are tried, s."""


def refuse_contradictions(
    path: Path, sightings: Sequence[Sighting], imu: ImuSamples | None, crane: CraneSamples | None,
    rectifier: Rectifier, shift_ns: int,
) -> None:  # fmt: skip
    """Raise InputError where the pictures show that a unit, an axis or a clock is wrong.

    crane: the readings as stated. Steps that are too few or too short show nothing.
    """
    steps = _steps(sightings, rectifier, shift_ns)
    if len(steps.old_ns) < MIN_STEPS:
        return
    if crane is not None and len(crane.stamp_ns) > 1:
        _check_encoders(path, steps, crane)
    if imu is not None and len(imu.stamp_ns) > 1:
        _check_gyro(path, steps, imu)


def _check_encoders(path: Path, steps: SeenSteps, crane: CraneSamples) -> None:
    fast = crane.interval_ns <= seconds_to_ns(MAX_FAST_S)
    place = median_filter(crane.position_m, size=(5 if fast else 3, 1), mode="nearest")  # against outliers
    for first, last, _ in frozen_stretches(crane):  # reported by itself: no wrong unit or axis
        place[first : last + 1] = np.nan
    seen_m = np.linalg.norm(steps.way_m, axis=1)

    def travelled(late_s: float) -> Float64:
        return _between(steps, crane.stamp_ns, place, late_s) @ crane.yard_from_body_nominal

    def compared(late_s: float) -> tuple[float, float] | None:
        """Compute the median ratio and the third quartile of the angle (degrees); None where too few steps
        are long.
        """
        travel = travelled(late_s)
        read_m = np.linalg.norm(travel, axis=1)
        long = np.maximum(read_m, seen_m) > MIN_WAY_M
        if long.sum() < MIN_STEPS:
            return None
        product = np.maximum(read_m * seen_m, 1e-12)[long]
        angle = np.arccos(np.clip((travel * steps.way_m).sum(axis=1)[long] / product, -1, 1))
        angle -= np.arctan2(READING_SIGMAS * crane.position_std_m, read_m[long])
        ratio = float(np.median(read_m[long] / np.maximum(seen_m[long], 1e-6)))
        return ratio, float(np.degrees(np.percentile(angle, 75)))  # diagonal steps hide exchanged axes

    found, late_s = compared(0.0), 0.0
    if found is None:
        return
    unlike = max(found[0], 1 / max(found[0], 1e-9)) > 2
    if not unlike:

        def cost(late_s: float) -> float:
            off = np.linalg.norm(travelled(late_s), axis=1) - seen_m
            return _mean_square(off[:, None])

        late_s = _delay(cost, WAY_SIGMA_M)
        if abs(late_s) > MAX_CRANE_LATE_S:
            raise _wrong_clock(path, "encoders'", late_s)
        found = compared(late_s) or found
        unlike = max(found[0], 1 / found[0]) > MAX_WAY_RATIO
    ratio, angle_deg = found
    if unlike:
        raise InputError(
            path, f"the encoders travel {ratio:.3g} times as far as the pictures show: a wrong unit",
            "give bridge, trolley and hoist in metres, or check the baseline",
        )  # fmt: skip
    if angle_deg > MAX_ANGLE_DEG:
        raise InputError(
            path,
            f"the encoders travel {angle_deg:.0f} degrees off the pictures' way: a wrong mounting",
            "check the encoders' axes and signs, R_yard_body and the cameras' T_BS",
        )
    _check_signs(path, steps, crane, place, late_s)


def _check_signs(path: Path, steps: SeenSteps, crane: CraneSamples, place: Float64, late_s: float) -> None:
    """Raise InputError where an encoder counts backwards, even one that moves in few of the steps."""
    seen, read = steps.way_m @ crane.yard_from_body_nominal.T, _between(steps, crane.stamp_ns, place, late_s)
    read_all = np.isfinite(read).all(axis=1)
    seen, read = seen[read_all], read[read_all]
    if len(read) <= read.shape[1]:
        return
    way = np.nanmax(place, axis=0) - np.nanmin(place, axis=0)
    for axis in np.flatnonzero(way > MIN_WAY_M).tolist():
        gain, sigma = _gain(read, seen[:, axis], axis)
        if gain < -SIGN_SIGMAS * sigma:
            raise InputError(
                path, f"the {AXES[axis]}'s encoder counts against the pictures' way: a wrong mounting",
                "check its sign",
            )  # fmt: skip


def _gain(read: Float64, seen: Float64, axis: int) -> tuple[float, float]:
    """Fit how far the pictures show (K,) travel per metre of one of the encoders (K, 3), besides what the
    others' axes, slightly askew, add; also return its sigma.
    """
    inverse = np.linalg.pinv(read)
    fitted = inverse @ seen
    scatter = np.linalg.norm(seen - read @ fitted) / (len(seen) - len(fitted)) ** 0.5
    return float(fitted[axis]), float(scatter * np.linalg.norm(inverse[axis]))


def _check_gyro(path: Path, steps: SeenSteps, imu: ImuSamples) -> None:
    angle = turned_angle(imu)
    seconds = (steps.new_ns - steps.old_ns)[:, None] / 1e9

    def varying(turns: Float64) -> Float64:
        """Subtract the constant rate, which is the gyro's bias."""
        known = np.isfinite(turns).all(axis=1)
        time = seconds[known]
        rate = (time * turns[known]).sum(axis=0) / max(float((time**2).sum()), 1e-12)
        return np.asarray(turns - seconds * rate)

    def turned(late_s: float) -> tuple[Float64, Float64]:
        """Compute the turns (K, 3) by gyro and by pictures over the steps that both know."""
        gyro = _between(steps, imu.stamp_ns, angle, late_s)
        gyro[_over_gap(steps, imu.stamp_ns, late_s)] = np.nan
        known = np.asarray(np.isfinite(gyro).all(axis=1))
        return varying(gyro)[known], varying(np.where(known[:, None], steps.turn, np.nan))[known]

    gyro, seen = turned(0.0)
    if len(gyro) < MIN_STEPS:
        return
    by_gyro, by_pictures = (float(np.sqrt((turns**2).sum(axis=1).mean())) for turns in (gyro, seen))
    least = TURNS_SIGMAS * TURN_SIGMA_RAD
    if by_gyro > MAX_TURN_RATIO * max(by_pictures, least) or (
        by_pictures > max(MAX_TURN_RATIO * by_gyro, least)
    ):
        raise InputError(
            path,
            f"the gyro turns {by_gyro / max(by_pictures, 1e-9):.3g} times as far as the pictures: "
            "a wrong unit",
            "give it in rad/s (degrees/s times pi / 180)",
        )

    def cost(late_s: float) -> float:
        gyro, seen = turned(late_s)
        return _mean_square(gyro - seen)

    alike = float((gyro * seen).sum()) / max(float(np.linalg.norm(gyro) * np.linalg.norm(seen)), 1e-12)
    late_s = _delay(cost, TURN_SIGMA_RAD)
    # A delay of half a sway period looks like a wrong sign, which is the more common mistake.
    if abs(late_s) > MAX_IMU_LATE_S and alike > -MIN_ALIKE:
        raise _wrong_clock(path, "gyro's", late_s)
    if min(by_gyro, by_pictures) > least and alike < MIN_ALIKE:
        raise InputError(
            path,
            f"the gyro turns about other axes than the pictures (cosine {alike:.2f}): a wrong mounting",
            "check T_BS of IMU and cameras and the gyro's axes and signs, or the IMU's clock",
        )


def _delay(cost: Callable[[float], float], sigma: float) -> float:
    """Estimate the delay (s) of a sensor's stamps if it explains the steps clearly better than none; else
    0.
    """
    at_none = cost(0.0)
    if not at_none > sigma**2 / CLEARLY_BETTER:
        return 0.0
    costs = [cost(float(late_s)) for late_s in LATE_S]
    best = int(np.nanargmin(costs))
    return float(LATE_S[best]) if costs[best] < CLEARLY_BETTER * at_none else 0.0


def _mean_square(off: Float64) -> float:
    """Compute the mean square over the known steps and their axes; NaN where too few are known."""
    known = off[np.isfinite(off).all(axis=1)]
    return float((known**2).mean()) if len(known) >= MIN_STEPS else float("nan")


def _wrong_clock(path: Path, sensor: str, late_s: float) -> InputError:
    return InputError(
        path,
        f"the {sensor} stamps are {abs(late_s):.2f} s {'late' if late_s > 0 else 'early'} against the "
        "pictures: a wrong clock",
        "put all sensors on one clock, and check timeshift_cam_imu (seconds)",
    )


def _steps(sightings: Sequence[Sighting], rectifier: Rectifier, shift_ns: int) -> SeenSteps:
    """Gather the steps that the pictures measured: at most `MAX_STEPS`, evenly spaced."""
    known = [k for k in range(1, len(sightings)) if sightings[k].motion is not None]
    return seen_steps(sightings, known[:: -(-len(known) // MAX_STEPS) or 1], rectifier, shift_ns)


def _over_gap(steps: SeenSteps, stamp_ns: Int64, late_s: float) -> Bool:
    """Select the steps (K,) that reach over a gap of the IMU, so that it doesn't know their turn. Its stamps
    are `late_s` late.
    """
    late_ns, after = seconds_to_ns(late_s), np.flatnonzero(np.diff(stamp_ns) > seconds_to_ns(MAX_GAP_S)) + 1
    begun = np.searchsorted(stamp_ns[after - 1], steps.new_ns + late_ns)
    over: Bool = begun > np.searchsorted(stamp_ns[after], steps.old_ns + late_ns, side="right")
    return over


def _between(steps: SeenSteps, stamp_ns: Int64, values: Float64, late_s: float) -> Float64:
    """Compute the differences (K, 3) of a sensor's values over the steps, with its stamps taken as `late_s`
    late; NaN outside its readings.
    """
    late_ns = seconds_to_ns(late_s)
    old, new = (interpolate_at(at + late_ns, stamp_ns, values) for at in (steps.old_ns, steps.new_ns))
    return np.asarray(new - old)
