"""Judge a camera-IMU calibration property by property and advise on the next recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barsight.calibration.boards.board import Board
from barsight.calibration.boards.board_views import BoardView
from barsight.calibration.camera_imu.calibration import (
    CameraImuCalibration,
    calibrate_camera_imu,
    subtract_mounts,
)
from barsight.calibration.camera_imu.problem import MOUNT
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.calibration.stereo.verdict import Line, Verdict, judge
from barsight.core.arrays import Float64
from barsight.core.errors import CalibrationError, Failed
from barsight.core.records.sensor_samples import ImuSamples

MIN_HALF_S = 6.0
MIN_RATE_RADPS, MIN_FORCE_MPS2 = 0.3, 1.0


@dataclass(frozen=True, eq=False)
class Halves:
    """Comparison of two halves of the recording, solved separately.

    difference: (14,) mountings and time shifts, second half minus first. predicted: (14,) their sigmas.
    """

    difference: Float64
    predicted: Float64

    @property
    def ratio(self) -> float:
        """Return the RMS of difference over predicted sigma; 1 where the halves differ as their sigmas
        predict.
        """
        return float(np.sqrt(((self.difference / self.predicted) ** 2).mean()))


@dataclass(frozen=True, eq=False)
class CameraImuAssessment:
    """Verdict on a calibration. lines: judged properties. advice: how to improve the next recording. halves:
    the cross-validation.
    """

    lines: tuple[Line, ...]
    advice: tuple[str, ...]
    halves: Halves | Failed

    @property
    def verdict(self) -> Verdict:
        """Return the worst of the lines."""
        return max((line.verdict for line in self.lines), key=list(Verdict).index)


def cross_halves(
    calibration: CameraImuCalibration, views: Sequence[BoardView], imu: ImuSamples, rig: StereoRig,
    board: Board, noise: ImuNoise, source: Path,
) -> Halves | Failed:  # fmt: skip
    """Solve two halves of the recording separately. Failed `short` where a half would last less than six
    seconds, `half` where one can't be calibrated.
    """
    spline = calibration.solution.state.spline
    if spline.segments * spline.step_s < 2 * MIN_HALF_S:
        return Failed("short", f"halves need {2 * MIN_HALF_S:g} s together")
    ordered = sorted(views, key=lambda view: int(view.name))
    middle = len(ordered) // 2
    solved = []
    for half in (ordered[:middle], ordered[middle:]):
        try:
            scales = calibration.problem.scales
            solved.append(calibrate_camera_imu(half, imu, rig, board, noise, source, scales=scales))
        except CalibrationError as error:
            return Failed("half", f"a half can't be calibrated alone: {error.problem}")
    own = slice(0, 2 * MOUNT)
    predicted = np.hypot(solved[0].sigma[own], solved[1].sigma[own])
    return Halves(subtract_mounts(solved[1].solution.state, solved[0].solution.state), predicted)


def assess_camera_imu(calibration: CameraImuCalibration, halves: Halves | Failed) -> CameraImuAssessment:
    """Judge a calibration by the accuracy that a yard needs."""
    sigma = calibration.sigma[: 2 * MOUNT].reshape(2, MOUNT)
    gyro, accel = calibration.spreads[1:]
    stated, found = calibration.stated, calibration.problem.sigmas
    root = np.sqrt(1 / np.median(np.diff(calibration.problem.imu.time_s)))
    lines = [
        judge("rotation", float(np.degrees(sigma[:, :3].max())), "degrees (one sigma)", 0.1, 0.3,
              "0.1 degrees tilt a 10 m stack by 17 mm"),
        judge("translation", 1e3 * float(sigma[:, 3:6].max()), "mm (one sigma)", 3, 10,
              "lever arms turn sway into apparent travel"),
        judge("time shift", 1e3 * float(sigma[:, 6].max()), "ms (one sigma)", 0.2, 1.0,
              "1 ms at 1 m/s is 1 mm"),
        judge("corners", calibration.corner_px, "px (one coordinate)", 0.5, 1.0,
              "larger means blur, a bent board or wrong lenses"),
        judge("pictures", found.corner_px / calibration.corner_px, "times their corners' noise", 3, 6,
              "corners of one picture err together where board or lens aren't as stated"),
        judge("gyro noise", found.gyro_radps / (stated.gyro_density * root), "times the stated", 1.5, 4,
              "larger means a wrong imu file, or vibration"),
        judge("accelerometer noise", found.accel_mps2 / (stated.accel_density * root), "times the stated",
              2, 6, "larger means a wrong imu file, or vibration"),
        judge("gyro whiteness", float(np.abs(gyro.after - gyro.after_expected).max()),
              "largest autocorrelation beyond white noise's", 0.25, 0.6, "a pattern that the model lacks"),
        judge("accelerometer whiteness", float(np.abs(accel.after - accel.after_expected).max()),
              "largest autocorrelation beyond white noise's", 0.4, 0.8, "a pattern that the model lacks"),
    ]  # fmt: skip
    lines += [
        Line("what was held fixed", group.name, Verdict.USABLE,
             "residuals would fall clearly if it were free; what that would move is in the sigmas")
        for group in calibration.uncertainty.fixed if group.matters
    ]  # fmt: skip
    lines += [
        Line("not determined", name, Verdict.REDO, "the recording's motion doesn't show it")
        for name in calibration.uncertainty.undetermined
    ]
    if isinstance(halves, Failed):
        lines.append(Line("two halves", "not possible", Verdict.USABLE, halves.reason))
    else:
        lines.append(judge("two halves", halves.ratio, "sigma", 2, 3,
                           "halves that differ by more than their sigmas hide an error"))  # fmt: skip
    return CameraImuAssessment(tuple(lines), _advice(calibration), halves)


def _advice(calibration: CameraImuCalibration) -> tuple[str, ...]:
    advice = []
    track = calibration.problem.imu
    spread = np.linalg.eigh(np.cov(track.gyro_radps.T))
    weak, axis = float(np.sqrt(max(spread[0][0], 0))), spread[1][:, 0]
    if weak < MIN_RATE_RADPS:
        name = "xyz"[int(np.abs(axis).argmax())]
        advice.append(
            f"turn faster about the IMU's {name} axis: {weak:.2f} rad/s were seen, {MIN_RATE_RADPS:g} help"
        )
    shake = float(np.sqrt(np.linalg.eigvalsh(np.cov(track.accel_mps2.T))[0]))
    if shake < MIN_FORCE_MPS2:
        advice.append(
            f"move more briskly along all three axes: the weakest shows {shake:.2f} m/s^2, "
            f"{MIN_FORCE_MPS2:g} help"
        )
    for group in calibration.uncertainty.fixed:
        if group.matters and group.name == "lenses":
            parts = ", ".join(f"{name} by {change:+.3g}" for name, change in group.changes)
            advice.append(
                f"the corners would rather have other lenses ({parts}): check that the board is flat and "
                "of the stated size, or calibrate the cameras again"
            )
        elif group.matters:
            advice.append("the IMU's scales don't look ideal: compare with imu_scales")
    return tuple(advice)
