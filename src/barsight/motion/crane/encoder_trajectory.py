"""Estimate the trajectory by dead reckoning: encoders, nominal attitude, and the gyro's sway about it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64, Int64
from barsight.core.errors import Failed, MeasurementError
from barsight.core.linalg.robust import mad_sigma
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import MAX_REACH_NS, READINGS_PER_SIDE, CraneSamples
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.core.settings.values import NOT_NEGATIVE, POSITIVE, expect_ranges
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.inertial.model import ImuBias
from barsight.motion.crane.known_motion import ImuWay, way_around
from barsight.motion.crane.robust_parabola import fit_parabola
from barsight.motion.crane.sway import sway_at
from barsight.motion.estimator import FrameInput, ImmediatePoses, TrajectoryEstimator
from barsight.recording.base import Recording
from barsight.recording.sensor_samples import expect_usable

CAUCHY_SIGMAS = 3.0
MIN_FOR_NOISE = 100
NINE_TENTHS = 0.623
"""Mean square of the smallest nine tenths of normally distributed residuals, relative to that of all."""

MOUNTING_RATIO = 2 / 3
"""Ratio of the sigma of the mounting's and girder's own error to `CraneSettings.attitude_std_deg`."""
MIN_ALIKE_RATIO = 0.9
"""Smallest share of equal readings on an axis that stands; the rest may be outliers."""


@dataclass(frozen=True)
class CraneSettings:
    """Encoders and nominal attitude."""

    window_s: float = 0.35
    """Half-width, in seconds, of the window around a frame whose readings are fitted with a parabola."""
    attitude_std_deg: float = 0.15
    """Standard deviation of the body's sway about its nominal attitude (degrees, each axis), where no IMU
    measures it.
    """
    sway_window_s: float = 8.0
    """Half-width, in seconds, of the window around a frame over which the gyro's mean and trend are removed;
    the rest is sway.
    """
    sway_std_deg: float = 0.02
    """Standard deviation of the attitude (degrees, each axis) where the gyro measures the sway."""

    @property
    def mounting_sigma_rad(self) -> float:
        """Return the standard deviation of the part of the attitude's error that doesn't change."""
        return float(np.deg2rad(MOUNTING_RATIO * self.attitude_std_deg))

    def __post_init__(self) -> None:
        expect_ranges(
            self, "motion.crane.", window_s=POSITIVE, sway_window_s=POSITIVE, attitude_std_deg=NOT_NEGATIVE,
            sway_std_deg=NOT_NEGATIVE,
        )  # fmt: skip


@dataclass(frozen=True)
class EncoderOdometry(TrajectoryEstimator):
    """Estimates recordings with encoders; the reference is `yard`. No image is read."""

    settings: CraneSettings

    def begin(self, recording: Recording, rectifier: Rectifier) -> EncoderPoses:
        """Begin. Raises MeasurementError where the recording has no encoders."""
        crane = recording.crane()
        if crane is None:
            raise MeasurementError(f"{recording.path}: no crane encoders; measure without them (use: stereo)")
        expect_usable(recording.path, crane, recording.imu())
        return EncoderPoses(self.settings, recording)


class EncoderPoses(ImmediatePoses):
    """`PoseEstimator` that uses the encoder readings on both sides of a frame."""

    reads_pictures = False

    def __init__(self, settings: CraneSettings, recording: Recording) -> None:
        super().__init__()
        self._settings, self._recording = settings, recording
        self.delay_ns = seconds_to_ns(settings.window_s)
        self._without_sway = 0

    def place(self, seen: FrameInput) -> PosedFrame | Failed:
        """Place the frame by the readings around it."""
        settings, stamp = self._settings, seen.stamp_ns
        crane, imu = self._recording.crane(), self._recording.imu()
        assert crane is not None
        at_ns = stamp + self._recording.rig.timeshift_cam_imu_ns
        attitude, attitude_std_deg = crane.yard_from_body_nominal, settings.attitude_std_deg
        half, way = crane.reach_ns(seconds_to_ns(settings.window_s)), None
        if imu is not None:
            way = way_around(imu, at_ns, half, attitude, ImuBias.none(), 2)
        fit = fit_position(crane, at_ns, half, way)
        if isinstance(fit, Failed):
            return fit
        if imu is not None:
            sway = sway_at(imu, at_ns, settings.sway_window_s)
            if isinstance(sway, Failed):
                self._without_sway += 1
            else:
                attitude = attitude @ Rotation.from_rotvec(sway).as_matrix()
                attitude_std_deg = settings.sway_std_deg
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = np.eye(3) * np.deg2rad(attitude_std_deg) ** 2
        covariance[3:, 3:] = fit.covariance
        pose = Pose("yard", "body", attitude, fit.position_m + crane.crane_to_body_m)
        return PosedFrame(stamp, pose, covariance)

    def finish(self) -> Trajectory:
        """Return all poses."""
        missed, placed = self._without_sway, tuple(self.placed)
        sensors = ("crane",) if self._recording.imu() is None or missed == len(placed) else ("crane", "imu")
        warnings = (f"the IMU doesn't cover {missed} frames: nominal attitude",) if missed else ()
        return Trajectory("yard", placed, tuple(self.refused), sensors, warnings)


@dataclass(frozen=True, eq=False)
class FittedPosition:
    """Position of the crane point near a stamp: position_m, velocity_mps, acceleration_mps2 (3,) in `yard`;
    covariance (3, 3) of the position.
    """

    position_m: Float64
    velocity_mps: Float64
    acceleration_mps2: Float64
    covariance: Float64


def fit_position(
    crane: CraneSamples, stamp_ns: int, window_ns: int, way: ImuWay | None = None, late_ns: int = 0
) -> FittedPosition | Failed:
    """Fit the crane point at `stamp_ns` to the readings around it.

    Fits a parabola to the readings within the window (a line to fewer than six), which is wider where they
    are slow, by least squares with Cauchy weights, so that isolated outliers have no pull however far off
    they are. A crane that oscillates follows no parabola. So the travel measured by the IMU, where known, is
    subtracted from the readings, which are `late_ns` late, before the fit and added again after it, and only
    what the IMU leaves open is fitted (a line where the acceleration is known too: its middle has 4/9 of a
    parabola's variance). Failed `no-encoder` where the readings don't enclose the stamp; readings beyond a
    jump don't count.
    """
    window_ns = crane.reach_ns(window_ns)
    begin_ns, end_ns = stamp_ns - window_ns, stamp_ns + window_ns
    for jump in crane.jumps:
        if jump.stamp_ns <= stamp_ns:
            begin_ns = max(begin_ns, jump.stamp_ns)
        else:
            end_ns = min(end_ns, jump.stamp_ns)
    first, last = np.searchsorted(crane.stamp_ns, (begin_ns, end_ns))
    stamps: Int64 = crane.stamp_ns[first:last]
    if stamps.size < 4 or stamps[0] > stamp_ns or stamps[-1] < stamp_ns:
        where = "on one side of" if stamps.size >= 4 else "around"
        reason = f"{stamps.size} encoder readings {where} the frame"
        if len(crane.stamp_ns):
            reason += f" (the nearest {np.abs(crane.stamp_ns - stamp_ns).min() / NS_PER_S:.2f} s away)"
        if READINGS_PER_SIDE * crane.interval_ns > MAX_REACH_NS:
            apart_s = crane.interval_ns / NS_PER_S
            reason += f"; they come {apart_s:.2f} s apart: give at least four a second"
        return Failed("no-encoder", reason)
    time = (stamps - stamp_ns) / window_ns
    window_s = window_ns / NS_PER_S
    degree = min(2 if stamps.size >= 6 else 1, 2 if way is None else way.open_degree)
    places, stamp = crane.position_m[first:last], np.array([stamp_ns - late_ns])
    if way is not None:
        places = places - way.place_at(stamps - late_ns)
    fitted = np.empty((degree + 1, 4))
    length = CAUCHY_SIGMAS * 3**0.5 * crane.position_std_m
    fit_parabola(time, places, length, fitted)
    coefficients, variance = fitted[:, :3], fitted[0, 3] * crane.position_std_m**2
    place, velocity = coefficients[0], coefficients[1] / window_s
    bend = 2 * coefficients[2] / window_s**2 if degree == 2 else np.zeros(3)
    if way is None:
        # What the parabola can't follow is a common error of the window: it doesn't average out.
        off = places - np.polynomial.polynomial.polyval(time, coefficients).T
        variance += _misfit_m2(off, degree + 1, crane.position_std_m)
    else:
        place, velocity = place + way.place_at(stamp)[0], velocity + way.speed_at(stamp)[0]
        bend = bend + way.acceleration_at(stamp)[0]
    hidden = _hidden_m2(crane.position_m[first:last], crane.position_std_m)
    return FittedPosition(place, velocity, bend, np.diag(variance + hidden))


def _misfit_m2(off_m: Float64, fitted: int, sigma_m: float) -> float:
    """Estimate the variance of residuals (N, 3) in excess of a reading's own, 0 unless it is clearly larger.
    Uses the smallest nine tenths of them, since the rest may be outliers.
    """
    free, squares = 3 * (len(off_m) - fitted), np.sort(off_m**2, axis=None)
    seen = float(squares[: int(0.9 * squares.size)].mean()) / NINE_TENTHS * squares.size / free
    return float(max(0.0, seen - (1 + 2 * (2 / free) ** 0.5) * sigma_m**2))


def _hidden_m2(position_m: Float64, sigma_m: float) -> Float64:
    """Return the variance (3,) that readings (N, 3) hide where they are alike: an encoder that stands rounds
    each of them by the same amount, which doesn't average out.
    """
    alike = (position_m == np.median(position_m, axis=0)).mean(axis=0)
    return np.where(alike >= MIN_ALIKE_RATIO, sigma_m**2, 0.0)


def reestimate_noise(crane: CraneSamples) -> CraneSamples:
    """Re-estimate the readings' sigma from themselves, within a factor of two of the stated one, but no finer
    than their resolution.

    Uses fourth differences, which suppress any smooth motion, and their median, which is robust to outliers.
    (Each outlier is in five of them, so the largest ones are removed before the median.) A median of zero
    shows rounding, not noise.
    """
    rounding = crane.resolution_m / 12**0.5
    crane = replace(crane, position_std_m=max(crane.position_std_m, rounding))
    if len(crane.stamp_ns) < MIN_FOR_NOISE:
        return crane
    fourth = np.abs(np.diff(crane.position_m, n=4, axis=0))
    kept = fourth
    for _ in range(3):
        spread = mad_sigma(kept)
        kept = fourth[fourth <= 4 * spread]
    if spread == 0:
        return crane
    seen = spread / 70**0.5
    stated = crane.position_std_m
    return replace(crane, position_std_m=max(rounding, float(np.clip(seen, stated / 2, stated * 2))))
