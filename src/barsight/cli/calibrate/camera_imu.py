"""Run `barsight calibrate camera-imu RECORDING --rig rig.yaml --imu imu.yaml --board BOARD -o
rig_imu.yaml`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape

from barsight.calibration.boards.board import Board, parse_board
from barsight.calibration.boards.board_views import BoardView, Corners
from barsight.calibration.boards.detection import detect
from barsight.calibration.boards.detection_files import NAMES, has_detections, read_detections
from barsight.calibration.camera_imu.calibration import CameraImuCalibration, calibrate_camera_imu
from barsight.calibration.camera_imu.result_files import write_camera_imu
from barsight.calibration.camera_imu.verdict import CameraImuAssessment, assess_camera_imu, cross_halves
from barsight.calibration.files.kalibr import read_imu_file
from barsight.calibration.files.rig_file import read_board, read_covariance
from barsight.calibration.files.rig_formats import read_rig_file
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.stereo.verdict import Verdict, expect_usable, summary_sentence
from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError, InputError
from barsight.core.files import atomic_paths, expect_output
from barsight.core.parallel import ordered_map
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import ImuSamples
from barsight.recording.base import RecordingSettings
from barsight.recording.formats.imu_log import AccelUnit, GyroUnit, read_imu_log
from barsight.recording.open import open_recording
from barsight.report.calibration.camera_imu_page import write_camera_imu_report

COLOURS = {Verdict.GOOD: "green", Verdict.USABLE: "yellow", Verdict.REDO: "red"}
Recorded = tuple[list[BoardView], ImuSamples, ImuNoise | None]


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and calibrate."""

    def command(
        recording: tyro.conf.Positional[Path],
        rig: Path,
        board: str,
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        imu: Path | None = None,
        imu_scales: bool = False,
        imu_topic: str | None = None,
        gyro_unit: tyro.conf.EnumChoicesFromValues[GyroUnit] = GyroUnit.AUTO,
        accel_unit: tyro.conf.EnumChoicesFromValues[AccelUnit] = AccelUnit.AUTO,
        max_views: int = 2000,
    ) -> None:
        """Calibrate the mounting of the cameras on the IMU and the offset between their clocks.

        The exit code is 5 if the verdict is redo; the files are written all the same.

        Args:
            recording: An EuRoC folder or bag taken while the rig was waved in front of the board, or a folder
                of detections (cam0_detections.npz, cam1_detections.npz) with imu0.csv.
            rig: Stereo rig, in any format, from which the lenses are taken. If it is from `calibrate stereo`
                with the same board, the board's shape is taken too.
            board: checkerboard:9x6:0.025, charuco:11x8:0.03:0.022[:DICTIONARY] or aprilgrid:6x6:0.088:0.3.
            out: The rig file to write (.yaml); the report (.html, .json) and Kalibr's camchain go next to it.
            imu: The IMU's noise: imu.yaml from `calibrate imu-noise` or Kalibr, or EuRoC's sensor.yaml. By
                default the recording's own.
            imu_scales: Estimate the IMU's scales and misalignments too; needs brisk turns about all axes.
            imu_topic: A bag's topic of the IMU, if its calibration does not state it.
            gyro_unit: Unit of the gyroscope in imu0.csv; auto assumes degrees if the header says so.
            accel_unit: Unit of the accelerometer in imu0.csv; auto decides by gravity.
            max_views: Maximum number of pictures; a longer recording is thinned evenly.
        """
        _expect(out, max_views)
        console = SafeConsole(stderr=True)
        lenses = read_rig_file(rig)
        own_file = rig.is_file() and rig.suffix in (".yaml", ".yml")
        target = read_board(rig, parse_board(board)) if own_file else parse_board(board)
        with stages(console) as advance:
            if any((recording / name).is_file() for name in NAMES):
                views, samples, stated = _from_detections(recording, target, max_views, gyro_unit, accel_unit)
            else:
                settings = RecordingSettings(rig=rig, imu_topic=imu_topic)
                views, samples, stated = _from_pictures(recording, settings, target, max_views, advance)
            noise = _noise(imu or recording, read_imu_file(imu).noise if imu else stated)
            advance("solve", 0, 3)
            calibration = calibrate_camera_imu(
                views, samples, lenses, target, noise, recording, scales=imu_scales
            )
            advance("solve", 1, 3)
            halves = cross_halves(calibration, views, samples, lenses, target, noise, recording)
            advance("solve", 3, 3)
        if own_file and (known := read_covariance(rig)) is not None:
            calibration = calibration.with_lenses(*known)
        assessment = assess_camera_imu(calibration, halves)
        _write(calibration, assessment, out)
        _print(console, calibration, assessment, out)

    call(command, "calibrate camera-imu", arguments)


def _write(calibration: CameraImuCalibration, assessment: CameraImuAssessment, out: Path) -> None:
    """Write the rig file, Kalibr's camchain and the report, or nothing at all."""
    camchain = out.with_name(f"{out.stem}-camchain-imucam.yaml")
    with atomic_paths(out, camchain, out.with_suffix(".html"), out.with_suffix(".json")) as paths:
        path, chain, *report = paths
        write_camera_imu(calibration, path, chain)
        write_camera_imu_report(calibration, assessment, *report)


def _expect(out: Path, max_views: int) -> None:
    expect_output(out, ".yaml", ".yml")
    if max_views < 60:
        raise ConfigError(f"--max-views {max_views} is too few; give 60 or more")


def _noise(path: Path, noise: ImuNoise | None) -> ImuNoise:
    """Refuse unknown noise, and densities that no IMU has, which suggest another unit."""
    if noise is None:
        raise ConfigError("the IMU's noise isn't known; give --imu (see barsight calibrate imu-noise)")
    if not (1e-6 < noise.gyro_density < 0.05 and 1e-5 < noise.accel_density < 1.0):
        raise InputError(
            path, f"noise densities of {noise.gyro_density:g} rad/s/sqrt(Hz) and {noise.accel_density:g} "
            "m/s^2/sqrt(Hz) are impossible", "give them in these units",
        )  # fmt: skip
    return noise


def _from_detections(
    folder: Path, board: Board, max_views: int, gyro_unit: GyroUnit, accel_unit: AccelUnit
) -> Recorded:
    if not has_detections(folder):
        raise InputError(folder, f"lacks one of {' and '.join(NAMES)}", "detect both cameras' corners")
    views = read_detections(folder, board)
    step = -(-len(views) // max_views)
    return views[::step], read_imu_log(folder, gyro_unit, accel_unit).samples, None


def _from_pictures(
    path: Path, settings: RecordingSettings, board: Board, max_views: int,
    advance: Callable[[str, int, int], None],
) -> Recorded:  # fmt: skip
    opened = open_recording(path, settings)
    samples = opened.imu()
    if samples is None:
        raise InputError(path, "has no IMU", "record the IMU too; name a bag's topic with --imu-topic")
    total = len(opened.index.stamps_ns)
    step = max(-(-total // max_views), 1)
    chosen = (
        frame
        for number, frame in enumerate(opened.frames())
        if number % step == 0 and not isinstance(frame, RefusedFrame)
    )
    views = []
    for done, view in enumerate(ordered_map(lambda frame: _detected(board, frame), chosen), 1):
        advance("corners", done, -(-total // step))
        if view.cam0 is not None or view.cam1 is not None:
            views.append(view)
    return views, samples, opened.imu_noise()


def _detected(board: Board, frame: StereoFrame) -> BoardView:
    found = [detect(board, image) for image in (frame.left, frame.right)]
    seen = [own if isinstance(own, Corners) else None for own in found]
    return BoardView(str(frame.stamp_ns), seen[0], seen[1])


def _print(
    console: Console,
    calibration: CameraImuCalibration,
    assessment: CameraImuAssessment,
    out: Path,
) -> None:
    """Print the result and the verdict. Raises MeasurementError where it is to be redone."""
    sigma = calibration.sigma
    for camera, mount in enumerate(calibration.solution.state.mounts):
        own = sigma[7 * camera : 7 * camera + 7]
        place = ", ".join(
            f"{1e3 * v:.2f} ± {1e3 * s:.2f}" for v, s in zip(mount.place_m, own[3:6], strict=True)
        )
        console.print(
            f"body_from_cam{camera}: {place} mm, rotation ± {np.degrees(own[:3].max()):.3f} deg, time shift "
            f"{1e3 * mount.shift_s:.3f} ± {1e3 * own[6]:.3f} ms",
            soft_wrap=True, highlight=False,
        )  # fmt: skip
    console.print(
        f"{escape(str(out))}: baseline {calibration.rig.baseline_m * 1e3:.2f} ± "
        f"{calibration.baseline_sigma_m * 1e3:.2f} mm; report {escape(str(out.with_suffix('.html')))}",
        soft_wrap=True, highlight=False,
    )  # fmt: skip
    colour = COLOURS[assessment.verdict]
    sentence = escape(summary_sentence(assessment.lines))
    console.print(f"[{colour}]{assessment.verdict}[/{colour}]: {sentence}", highlight=False)
    for advice in (*calibration.notes, *assessment.advice):
        console.print(f"  {escape(advice)}", highlight=False)
    expect_usable(assessment.lines, out)
