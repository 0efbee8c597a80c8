"""Run `barsight calibrate yard TARGETS.csv|RECORDING -o yard.yaml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape

from barsight.calibration.files.yaml_document import write_document
from barsight.calibration.geometry.rectification import Rectifier
from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.arrays import Float64
from barsight.core.errors import ConfigError, Failed, MeasurementError
from barsight.core.files import atomic_paths, expect_output
from barsight.core.timing import count_frames
from barsight.motion.batch.fusion import BatchFusion, FusionSettings
from barsight.motion.crane.crane_moves import MovedYard, yard_from_moves
from barsight.motion.crane.encoder_trajectory import CraneSettings
from barsight.recording.base import RecordingSettings
from barsight.recording.formats.surveyed_targets import read_targets
from barsight.recording.open import open_recording
from barsight.registration.yard import YardCalibration, calibrate_yard
from barsight.report.calibration.yard_page import write_yard_report

MAX_TURN_DEG = 0.05
MAX_PLACE_M = 0.01


def run(arguments: Sequence[str]) -> None:
    """Parse and calibrate."""

    def command(
        source: tyro.conf.Positional[Path],
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        frame: Literal["world", "body"] = "world",
        sigma_m: float = 0.005,
        reading: Annotated[RecordingSettings, tyro.conf.arg(name="recording")] = RecordingSettings(),  # noqa: B008
    ) -> None:
        """Register the measurement's world in the yard, from surveyed targets or from crane moves.

        Args:
            source: A .csv of targets (name,yard_x,yard_y,yard_z,x,y,z in m; optionally sigma_m, and check = 1
                for targets set apart), or a recording in which bridge and trolley move.
            out: The .yaml file to write; its report goes beside it (.html and .json).
            frame: What x, y, z of the targets are measured in; body gives how the rig is mounted.
            sigma_m: One coordinate's error of a target, survey and measurement together, where no sigma_m
                column says it.
            reading: How to read the recording.
        """
        expect_output(out, ".yaml", ".yml")
        if not 0 < sigma_m < 10:
            raise ConfigError(f"--sigma-m {sigma_m:g} can't be; give metres")
        console = SafeConsole(stderr=True)
        hangs = None
        if source.suffix.lower() == ".csv":
            found = _from_targets(source, frame, sigma_m)
        else:
            moved = _from_moves(source, reading, console)
            found, hangs = moved.calibration, moved.yard_from_body
        verdict = "good" if _is_good(found) else "usable with care"
        with atomic_paths(out, out.with_suffix(".html"), out.with_suffix(".json")) as (path, html, data):
            write_document(path, _content(found, hangs))
            write_yard_report(found, verdict, str(source), html, data)
        _print(found, verdict, out, console)

    call(command, "calibrate yard", arguments)


def _from_targets(path: Path, frame: str, sigma_m: float) -> YardCalibration:
    targets = read_targets(path)
    sigma = np.where(np.isnan(targets.sigma_m), sigma_m, targets.sigma_m)
    covariance = sigma[:, None, None] ** 2 * np.eye(3)
    found = calibrate_yard(
        targets.names, targets.measured_m, targets.yard_m, covariance, targets.checks, frame
    )
    if isinstance(found, Failed):
        raise MeasurementError(f"{path}: {found.reason}; survey three targets or more, well apart")
    return found


def _from_moves(path: Path, reading: RecordingSettings, console: Console) -> MovedYard:
    recording = open_recording(path, reading)
    crane = recording.crane()
    if crane is None:
        raise MeasurementError(f"{path}: no crane encoders; give surveyed targets (.csv) instead")
    with stages(console) as advance:
        count = count_frames("travel", len(recording.index.stamps_ns), advance)
        estimator = BatchFusion(FusionSettings(use="stereo,imu"), CraneSettings())
        trajectory = estimator(recording, Rectifier(recording.rig), count)
    moved = yard_from_moves(trajectory, crane, recording.rig.timeshift_cam_imu_ns)
    if isinstance(moved, Failed):
        raise MeasurementError(f"{path}: {moved.reason}")
    return moved


def _content(found: YardCalibration, hangs: Float64 | None) -> dict[str, Any]:
    pose = found.alignment.target_from_source
    content: dict[str, Any] = {
        "barsight_yard": 1,
        f"yard_from_{pose.source}": pose.matrix.tolist(),
        "covariance": found.alignment.covariance.tolist(),
        "scale": found.alignment.scale,
        "scale_sigma": found.alignment.scale_sigma,
        "points": int((~found.checks).sum()),
        "rms_m": float(np.sqrt((found.off_m[~found.checks] ** 2).sum(axis=1).mean())),
        "doubts": list(found.doubts),
    }
    if hangs is not None:
        content["R_yard_body"] = hangs.tolist()
    return content


def _is_good(found: YardCalibration) -> bool:
    return found.turn_sigma_deg <= MAX_TURN_DEG and found.place_sigma_m <= MAX_PLACE_M and not found.doubts


def _print(found: YardCalibration, verdict: str, out: Path, console: Console) -> None:
    for k, name in enumerate(found.names if len(found.names) <= 30 else ()):
        off = " ".join(f"{1e3 * value:+7.1f}" for value in found.off_m[k])
        kind = "check " if found.checks[k] else "target"
        console.print(
            escape(f"{kind} {name}: off {off} mm, sigma {1e3 * found.sigma_m[k]:.1f}"), highlight=False
        )
    console.print(
        f"{escape(str(out))}: turned to ± {found.turn_sigma_deg:.4f} deg, placed to ± "
        f"{1e3 * found.place_sigma_m:.1f} mm (worst axes), scale {found.alignment.scale:.5f} ± "
        f"{found.alignment.scale_sigma:.5f}",
        soft_wrap=True, highlight=False,
    )  # fmt: skip
    for doubt in found.doubts:
        console.print(f"[yellow]{escape(doubt)}[/yellow]", soft_wrap=True, highlight=False)
    if verdict == "good":
        console.print("[green]good[/green]")
    else:
        limits = f"{MAX_TURN_DEG:g} deg and {1e3 * MAX_PLACE_M:g} mm without doubts are good"
        console.print(f"[yellow]{verdict}[/yellow]: {limits}; more points, further apart, help")
