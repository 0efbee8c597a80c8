"""Run `barsight calibrate yard TARGETS.csv|RECORDING -o yard.yaml`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape

from barsight.calibration.geometry.rectification import Rectifier
from barsight.cli.arguments import call
from barsight.cli.calibrate.yard_tags import calibrate_by_tags, print_bend
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
from barsight.recording.open import open_recording
from barsight.registration.bending import CraneBend, straight
from barsight.registration.surveyed_targets import read_targets
from barsight.registration.yard import YardCalibration, calibrate_yard
from barsight.registration.yard_file import MAX_SPAN_M, MIN_SPAN_M, write_yard_file
from barsight.report.calibration.yard_page import write_yard_report
from barsight.yard_frame import MAX_PLACE_M as MAX_UNSURE_M
from barsight.yard_frame import MAX_TURN_DEG as MAX_UNSURE_DEG
from barsight.yard_frame import calibration_id, measured_owners, recording_id

MAX_TURN_DEG = 0.05
MAX_PLACE_M = 0.01
ALONE = "--tags takes a recording, and says the frame: leave out --frame and --measured"
MAX_SCALE_OFF = 0.02
"""Maximum deviation of the scale from 1; a larger one is no error of the baseline, but of units or
mixed-up points.
"""


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and calibrate."""

    def command(
        source: tyro.conf.Positional[Path],
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        frame: Literal["world", "encoders", "body"] = "world",
        measured: Path | None = None,
        tags: Path | None = None,
        picks: Path | None = None,
        girder_y_m: tuple[float, float] | None = None,
        rails_x_m: tuple[float, float] | None = None,
        sigma_m: float = 0.005,
        reading: Annotated[RecordingSettings, tyro.conf.arg(name="recording")] = RecordingSettings(),  # noqa: B008
    ) -> None:
        """Register the measurement's frame in the yard, from surveyed targets or tags, or from crane moves.

        The exit code is 5, and nothing is written, where targets contradict their sigmas; the mistaken ones
        are named.

        Args:
            source: A .csv of targets (name,yard_x,yard_y,yard_z,x,y,z in m; optionally sigma_m, and check = 1
                for targets set apart), a recording that shows tags, or one in which bridge and trolley move.
            out: The .yaml file to write; its report goes next to it (.html and .json).
            frame: Frame of the targets' x, y, z: a measurement's world, the yard according to the encoders,
                or the body, which gives the mounting of the rig.
            measured: The folder of results in whose map the targets were measured; it determines the frame,
                and the file is then bound to its rig and crane.
            tags: A .csv of surveyed AprilTags 36h11 (tag,yard_x,yard_y,yard_z of the centre in m; optionally
                sigma_m and check), which are searched for in the recording's pictures. The frame is the one
                in which measure maps this recording, and the file is bound to its rig and crane.
            picks: A .csv of hand-picked targets of any kind: name,stamp_ns,u,v, the pixel in cam0's picture
                of that stamp, in at least two pictures each; the spot is matched in cam1's picture. --tags
                then lists the surveyed targets, by name instead of tag.
            girder_y_m: With --tags: the trolley's readings at the girder's ends, the lower first. The bending
                of the crane is calibrated too; bridge and trolley must travel in the recording.
            rails_x_m: With --girder-y-m: the bridge's readings at the ends of rails that may bend.
            sigma_m: Standard deviation of one coordinate of a target, survey and measurement together, or of
                a tag's survey alone, unless a sigma_m column gives it.
            reading: How to read the recording.
        """
        expect_output(out, ".yaml", ".yml")
        if not 0 < sigma_m < 10:
            raise ConfigError(f"--sigma-m {sigma_m:g} can't be; give metres")
        if picks is not None and tags is None:
            raise ConfigError("--picks needs --tags, the list of what was picked, as surveyed")
        bend = _begun_bend(girder_y_m, rails_x_m, has_tags=tags is not None)
        console = SafeConsole(stderr=True)
        yard_source = _YardSource(source, frame, measured, sigma_m, reading)
        found, owners, hangs, bend = yard_source.calibrated(tags, picks, bend, console)
        _expect_usable(found, source if tags is None else tags)
        verdict = "good" if _is_good(found) else "usable with care"
        with atomic_paths(out, out.with_suffix(".html"), out.with_suffix(".json")) as (path, html, data):
            write_yard_file(path, found, hangs, owners, bend)
            write_yard_report(found, verdict, str(source), html, data)
        _print(found, verdict, out, console)
        print_bend(bend, console)

    call(command, "calibrate yard", arguments)


@dataclass(frozen=True)
class _YardSource:
    """Input of a yard calibration and its options."""

    source: Path
    frame: str
    measured: Path | None
    sigma_m: float
    reading: RecordingSettings

    def calibrated(
        self, listed: Path | None, picks: Path | None, bend: CraneBend | None, console: Console
    ) -> tuple[YardCalibration, dict[str, str | None], Float64 | None, CraneBend | None]:
        """Calibrate from listed tags or picks, from targets, or from crane moves. Returns the calibration,
        the ids of its rig and crane, the rig's mounting where moves showed it, and the bending of the crane.
        """
        is_list = self.source.suffix.lower() == ".csv"
        if listed is not None:
            if is_list or self.measured is not None or self.frame != "world":
                raise ConfigError(ALONE)
            found, owners, bend = calibrate_by_tags(
                self.source, listed, picks, self.sigma_m, self.reading, bend, console
            )
            return found, owners, None, bend
        if not is_list:
            moved, owners = _from_moves(self.source, self.reading, console)
            return moved.calibration, owners, moved.yard_from_body, bend
        owners, frame = dict[str, str | None](), self.frame
        if self.measured is not None:
            owners = measured_owners(self.measured)
        if owners:
            frame = "world" if owners["mounting_id"] is None else "encoders"
        return _from_targets(self.source, frame, self.sigma_m), owners, None, bend


def _begun_bend(
    girder_y_m: tuple[float, float] | None, rails_x_m: tuple[float, float] | None, *, has_tags: bool
) -> CraneBend | None:
    """Make a straight crane as start value. Raises ConfigError for invalid ends."""
    if girder_y_m is None:
        if rails_x_m is not None:
            raise ConfigError("--rails-x-m needs --girder-y-m")
        return None
    if not has_tags:
        raise ConfigError(
            "--girder-y-m needs --tags: places measured by hand don't say where the trolley was"
        )
    for name, ends in (("--girder-y-m", girder_y_m), ("--rails-x-m", rails_x_m)):
        if ends is not None and not MIN_SPAN_M <= ends[1] - ends[0] <= MAX_SPAN_M:
            given = f"{name} {ends[0]:g} {ends[1]:g}"
            raise ConfigError(f"{given}: give the lower reading first, {MIN_SPAN_M:g} m or more apart")
    return straight(girder_y_m, rails_x_m)


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


def _from_moves(
    path: Path, reading: RecordingSettings, console: Console
) -> tuple[MovedYard, dict[str, str | None]]:
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
    owners = {
        "calibration_id": calibration_id(recording.rig), "mounting_id": None,
        "recording_id": recording_id(recording.digests()),
    }  # fmt: skip
    return moved, owners


def _expect_usable(found: YardCalibration, source: Path) -> None:
    """Raise MeasurementError where units or points are mixed up, or the frame would place nothing."""
    scale, off_m = found.alignment.scale, np.linalg.norm(found.off_m[~found.checks], axis=1)
    if abs(scale - 1) > MAX_SCALE_OFF:
        size = f"{scale:.4g} times as large as" if scale > 1 else f"only {scale:.4g} of"
        remedy = "give both in metres and each name its own place"
        raise MeasurementError(f"{source}: the yard's places are {size} the measured ones: {remedy}")
    pose = found.alignment.target_from_source
    if pose.source != "body" and pose.rotation[2, 2] <= 0:
        remedy = "names are mixed up; z points up in both"
        raise MeasurementError(f"{source}: the points fit only if the map is turned upside down: {remedy}")
    if found.contradictions:
        remedy = "survey and measure again or leave out, or give the sigma that is true (--sigma-m, sigma_m)"
        raise MeasurementError(f"{source}: {'; '.join(found.contradictions)}: {remedy}")
    if found.turn_sigma_deg > MAX_UNSURE_DEG or found.place_sigma_m > MAX_UNSURE_M:
        raise MeasurementError(
            f"{source}: the points disagree by up to {off_m.max():.3g} m and tell the turn to "
            f"± {found.turn_sigma_deg:.3g} deg, the place to ± {found.place_sigma_m:.3g} m only: names are "
            "mixed up, or the points lie too close together"
        )


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
