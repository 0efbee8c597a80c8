"""Run `barsight calibrate check RECORDING [-o check.json]`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import MeasurementError
from barsight.core.files import expect_output
from barsight.core.timing import count_frames
from barsight.motion.batch.fusion import FusionSettings
from barsight.motion.rig_check.drift_check import BAD_STATES, CheckSettings, DriftState, RigCheck, check_rig
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from barsight.report.calibration.rig_check_page import write_rig_check_report

COLOURS = {
    DriftState.GOOD: "green",
    DriftState.RECALIBRATE: "red",
    DriftState.CONTRADICTION: "red",
    DriftState.NOT_SEEN: "yellow",
}


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and check the rig."""

    def command(
        recording: tyro.conf.Positional[Path],
        out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None,
        settings: Annotated[CheckSettings, tyro.conf.arg(name="")] = CheckSettings(),  # noqa: B008
        reading: Annotated[RecordingSettings, tyro.conf.arg(name="recording")] = RecordingSettings(),  # noqa: B008
        fusion: FusionSettings = FusionSettings(),  # noqa: B008
    ) -> None:
        """Check if the rig has drifted since its calibration; ordinary crane travel over any scene is enough.

        Rows of matches show pitch, roll and focal ratio between the cameras; the encoders' travel shows the
        yaw, which affects depth most, and the baseline. The exit code is 5 if the rig drifted or readings
        contradict each other.

        Args:
            recording: The recording, with encoders for yaw and baseline.
            out: A .json file for the figures; the report (.html) goes next to it. Nothing is written by
                default.
            settings: Limits of an acceptable drift.
            reading: How to read the recording; --recording.rig checks another calibration.
            fusion: Settings of the trajectory estimate.
        """
        if out is not None:
            expect_output(out, ".json")
        source = open_recording(recording, reading)
        with stages(SafeConsole(stderr=True)) as advance:
            count = count_frames("travel", len(source.index.stamps_ns), advance)
            check = check_rig(source, fusion, settings, count, reading.rig)
        if out is not None:
            write_rig_check_report(check, str(recording), out.with_suffix(".html"), out)
        _print(check, SafeConsole())
        if check.is_bad:
            raise MeasurementError(f"{recording}: {check.state}: " + "; ".join(bad_lines(check)))

    call(command, "calibrate check", arguments)


def bad_lines(check: RigCheck) -> list[str]:
    """List the properties that are not good, each with its reason."""
    return [f"{line.name}: {line.reason}" for line in check.lines if line.state in BAD_STATES]


def _print(check: RigCheck, console: Console) -> None:
    table = Table("drift", "value", "costs", "", title=None if math.isnan(check.range_m) else (
        f"Drift since calibration; costs at {check.range_m:.1f} m"
    ))  # fmt: skip
    for line in check.lines:
        digits = 3 if line.unit == "%" else 4
        value = "-" if math.isnan(line.value) else (
            f"{line.value:+.{digits}f} ± {line.sigma:.{digits}f} {line.unit}"
        )  # fmt: skip
        cost = "" if math.isnan(line.cost_mm) else f"{line.cost_mm:+.1f} mm"
        state = f"[{COLOURS[line.state]}]{line.state}[/{COLOURS[line.state]}]: {line.reason}"
        table.add_row(line.name, value, cost, state)
    console.print(table)
    console.print(f"[{COLOURS[check.state]}]{check.state}[/{COLOURS[check.state]}]")
