"""Run `barsight odometry RECORDING -o OUT`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.markup import escape

from barsight.calibration.geometry.rectification import Rectifier
from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import MeasurementError, OutputError
from barsight.core.files import atomic_directory, lies_within
from barsight.core.records.trajectory import Trajectory
from barsight.evaluation.board_poses import board_poses, gyro_only_rmse_deg
from barsight.evaluation.trajectory_error import Drift, frame_errors, trajectory_drift
from barsight.mapping.recording_probe import probe_recording
from barsight.motion.frontend.matching_example import matching_example
from barsight.motion.settings import MotionSettings, make_estimator
from barsight.recording.base import Recording, RecordingSettings
from barsight.recording.formats.board_corners import CornerRecording
from barsight.recording.formats.ground_truth import truth_of
from barsight.recording.open import open_recording
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.recording.sensor_selection import SelectedSensors
from barsight.report.files.tables import write_relative, write_trajectory
from barsight.report.odometry_page import OdometryResult, write_odometry_page
from barsight.yard_frame import frame_name


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, estimate the trajectory, write it and compare it with the truth."""

    def command(
        recording: tyro.conf.Positional[Path],
        out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None,
        use: tuple[Literal["stereo", "imu", "crane"], ...] | None = None,
        reading: RecordingSettings = RecordingSettings(),  # noqa: B008
        settings: Annotated[MotionSettings, tyro.conf.arg(name="")] = MotionSettings(),  # noqa: B008
    ) -> None:
        """Estimate the trajectory from cameras, IMU and encoders, and compare it with any known truth.

        Args:
            recording: The recording.
            out: Folder for trajectory.tum, relative.csv (each frame relative to the previous one, with
                covariance), report.html and odometry.json; nothing is written by default.
            use: Sensors that may be used if the recording has them; stereo,imu,crane by default.
            reading: How to read the recording.
            settings: Settings of the estimate.
        """
        if out is not None:
            _expect_own_folder(out, recording)
        console = SafeConsole()
        source: Recording = open_recording(recording, reading)
        rectifier = Rectifier(source.rig)
        if use is not None:
            settings = replace(settings, fusion=replace(settings.fusion, use=",".join(use)))
            if settings.estimator == "paper":  # it has no `use` setting
                source = SelectedSensors(source, use)
        truth = truth_of(source)  # an unreadable one is told before the work
        _refuse_swapped(source, rectifier, settings)
        trajectory = make_estimator(settings)(source, rectifier, lambda: None)
        if not trajectory.frames:
            why = trajectory.refused[0].reason if trajectory.refused else "it has no frames"
            raise MeasurementError(f"{recording}: no frame could be placed: {why}")
        drift = (
            None if truth is None else trajectory_drift(trajectory, truth, source.rig.timeshift_cam_imu_ns)
        )
        if out is not None:
            front_end, with_crane = settings.fusion.front_end, "crane" in trajectory.sensors
            example = matching_example(source, rectifier, trajectory.stamp_ns, front_end, with_crane)
            errors = None
            if truth is not None:
                errors = frame_errors(trajectory, truth, source.rig.timeshift_cam_imu_ns)
            frames = len(source.index.stamps_ns)
            result = OdometryResult(recording.resolve().name, frames, trajectory, example, drift, errors)
            with atomic_directory(out, replace=True) as folder:
                frame_id = frame_name(source, trajectory, source.digests())
                write_trajectory(trajectory, folder / "trajectory.tum", frame_id)
                write_relative(trajectory, folder / "relative.csv")
                write_odometry_page(result, folder / "report.html", folder / "odometry.json")
        lines = [] if truth is None else _drift_lines(drift)
        if isinstance(source, CornerRecording):
            lines += _board_lines(source, trajectory)
        for line in _summary(trajectory) + lines:
            console.print(escape(line), soft_wrap=True, highlight=False)

    call(command, "odometry", arguments)


def _expect_own_folder(out: Path, recording: Path) -> None:
    """Raise OutputError for a folder inside the recording, a measured one, or a file."""
    if lies_within(out, recording):
        raise OutputError(f"{out}: lies in the recording itself; name a folder elsewhere")
    if (out / "result.json").exists():
        raise OutputError(f"{out}: holds what barsight measure wrote; name another folder")
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file; name a folder")


def _refuse_swapped(source: Recording, rectifier: Rectifier, settings: MotionSettings) -> None:
    """Raise InputError where left and right are swapped; other faults of pictures are the estimate's."""
    if settings.estimator == "crane" or "stereo" not in settings.fusion.sensors:
        return
    if source.index.stamps_ns and not isinstance(source, CornerRecording):
        with suppress(MeasurementError):
            probe_recording(RectifiedPairs(source, rectifier))


def _summary(trajectory: Trajectory) -> list[str]:
    sigma = np.sqrt(np.mean([np.diag(frame.covariance) for frame in trajectory.frames], axis=0))
    lines = [
        f"{len(trajectory.frames)} frames placed in {trajectory.reference} over {trajectory.length_m:.2f} m "
        f"from {', '.join(trajectory.sensors)}",
        f"stated sigma: {1e3 * np.linalg.norm(sigma[3:]):.2f} mm, "
        f"{np.degrees(np.linalg.norm(sigma[:3])):.4f} deg",
    ]
    told = (*trajectory.rig_moved, *trajectory.doubts, *trajectory.warnings)
    lines += [f"warning: {warning}" for warning in told]
    lines += [f"refused {frame.stamp_ns}: {frame.reason}" for frame in trajectory.refused]
    return lines


def _board_lines(source: CornerRecording, trajectory: Trajectory) -> list[str]:
    poses, imu, shift = board_poses(source), source.imu(), source.rig.timeshift_cam_imu_ns
    drift = None if poses is None else trajectory_drift(trajectory, poses, 0)
    if poses is None or drift is None:
        return ["too few corners for a PnP of the board"]
    lines = [
        f"against a PnP of the board by cam0: {drift.aligned_rmse_mm:.2f} mm, "
        f"{drift.aligned_rmse_deg:.3f} deg RMSE, aligned"
    ]
    gyro_deg = float("nan") if imu is None else gyro_only_rmse_deg(imu, poses, shift)
    if not math.isnan(gyro_deg):
        lines.append(f"the gyro alone, one bias fitted to those poses, is {gyro_deg:.3f} deg off them")
    return lines


def _drift_lines(drift: Drift | None) -> list[str]:
    if drift is None:
        return ["truth overlaps fewer than 3 frames"]
    lines = [f"aligned to truth: {drift.aligned_rmse_mm:.2f} mm, {drift.aligned_rmse_deg:.4f} deg RMSE"]
    if not math.isnan(drift.reference_rmse_mm):
        lines.append(
            f"in the yard: {drift.reference_rmse_mm:.2f} mm, {drift.reference_rmse_deg:.4f} deg RMSE; NEES "
            f"{drift.nees_position:.2f} position, {drift.nees_attitude:.2f} attitude"
        )
    if not math.isnan(drift.drift_percent):
        lines.append(f"drift over {drift.min_length_m:.0f} m and more: {drift.drift_percent:.3f} %")
    return lines
