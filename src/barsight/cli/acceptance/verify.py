"""Run `barsight verify RECORDING [--record watch.json]`."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import tyro
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.acceptance.acceptance import look_at_rig
from barsight.acceptance.observation import observe
from barsight.acceptance.watch.charts import ALARM, ControlChart, control_charts
from barsight.acceptance.watch.figures import (
    beyond_limits,
    feature_figures,
    picture_figures,
    rig_figures,
    tag_figures,
)
from barsight.acceptance.watch.record import Approval, WatchedSurvey, read_watch, with_survey, write_watch
from barsight.artefacts.plan import AcceptancePlan, ErrorLimits, read_plan
from barsight.cli.arguments import call
from barsight.cli.calibrate.yard_tags import place_in_yard
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError, Failed, MeasurementError
from barsight.core.files import expect_output
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.motion.rig_check.drift_check import RigCheck
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from barsight.registration.surveyed_targets import SurveyedTags, read_tags
from barsight.yard_frame import calibration_id, in_yard, placing_id, recording_id


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, verify the rig and print the result."""

    def command(
        recording: tyro.conf.Positional[Path],
        record: Path = Path("watch.json"),
        plan: Path | None = None,
        tags: Path | None = None,
        yard: Path | None = None,
        rig: Path | None = None,
        approve: str = "",
        why: str = "",
    ) -> None:
        """Verify from an ordinary survey that a rig still measures as it did when it was accepted.

        Control charts (CUSUM) monitor yaw, baseline, pitch, roll, focal ratio, the pictures' sharpness
        and, with a plan or tags, fixed features. The first eight surveys establish what is normal. The
        exit code is 5 if a chart raises an alarm, the rig has drifted, fixed features are beyond their
        limits, a lens is dirty, or the survey shows nothing of the rig; an alarm of a chart persists until a
        calibration is approved.

        Args:
            recording: An ordinary survey with travel.
            record: The record of all surveys; it is created if it does not exist.
            plan: An acceptance plan, whose plates and surveyed spheres serve as fixed features.
            tags: CSV of surveyed AprilTags on columns or floor, as for calibrate yard --tags, which serve
                as fixed features.
            yard: Yard file from barsight calibrate yard.
            rig: Rig file to use instead of the recording's own calibration.
            approve: Name of the person who puts this survey's calibration into service, as after a
                recalibration; the charts start afresh.
            why: Reason for the approval; required with --approve.
        """
        if bool(approve) != bool(why):
            raise ConfigError("verify: --approve and --why go together")
        expect_output(record, ".json")
        known = read_watch(record)
        features = None if plan is None else read_plan(plan)
        settings = MeasureSettings(yard=yard, recording=RecordingSettings(rig=rig))
        listed = None if tags is None else read_tags(tags)
        survey, check, own = _look(recording, settings, features, listed)
        if approve:
            now = datetime.now(UTC).isoformat(timespec="seconds")
            given = Approval(approve, why, now, survey.calibration_id, len(known.surveys))
            known = replace(known, approvals=(*known.approvals, given))
        known = with_survey(known, survey, record)
        write_watch(known, record)
        charts = control_charts(known.since_approval)
        _print(charts, check, len(known.since_approval))
        problems = _problems(charts, check) + own
        if problems:
            raise MeasurementError(f"{recording}: {'; '.join(problems)}")

    call(command, "verify", arguments)


def _look(
    path: Path, settings: MeasureSettings, plan: AcceptancePlan | None, listed: SurveyedTags | None
) -> tuple[WatchedSurvey, RigCheck, list[str]]:
    """Compute a survey's figures; also return the rig's check and messages about dirty lenses and about
    features that lie beyond their limits.
    """
    source = in_yard(open_recording(path, settings.recording), settings.yard)
    check, health = look_at_rig(source, settings.recording.rig)
    figures = rig_figures(check)
    if not figures:
        why = "; ".join(one.reason for one in (check.rows, check.drift) if isinstance(one, Failed))
        raise MeasurementError(f"{path}: shows nothing of the rig ({why}); travel over more of the yard")
    figures += picture_figures(health)
    if plan is not None:
        console = SafeConsole(stderr=True)
        with tempfile.TemporaryDirectory(prefix="barsight.") as scratch, stages(console) as advance:
            measure_into(path, Path(scratch) / "out", settings, advance=advance, report=False)
            seen = observe(Path(scratch) / "out", plan, source.rig, str(path))
        fixed = feature_figures(plan, seen)
        if isinstance(fixed, Failed):
            raise MeasurementError(
                f"{path}: none of the plan's plates, or spheres, was found: {fixed.reason}"
            )
        figures += fixed
    if listed is not None:
        placed = tag_figures(listed, place_in_yard(source, listed, SafeConsole(stderr=True)))
        if isinstance(placed, Failed):
            raise MeasurementError(f"{path}: none of the listed tags was placed: {placed.reason}")
        figures += placed
    limits = ErrorLimits() if plan is None else plan.limits
    spoiled = [] if isinstance(health, Failed) else [one for one in health if one.dirt_pct > limits.dirt_pct]
    ids = recording_id(source.digests()), calibration_id(source.rig)
    survey = WatchedSurvey(str(path), *ids, figures, placing_id(source))
    beyond = beyond_limits(limits, figures)
    return survey, check, [f"dirty lens of {one.camera}" for one in spoiled] + beyond


def _problems(charts: Sequence[ControlChart], check: RigCheck) -> list[str]:
    problems = [
        f"{one.name.partition(' / ')[0]} left its control limits at survey {one.alarmed_at}"
        for one in charts
        if one.alarmed_at is not None
    ]
    if check.is_bad:
        bad = [line.name for line in check.lines if line.state is check.state]
        problems.append(f"{check.state}: {', '.join(bad)}")
    return problems


def _print(charts: Sequence[ControlChart], check: RigCheck, surveys: int) -> None:
    table = Table(box=SIMPLE_HEAD, title=f"Survey {surveys} since the last approval")
    for head in ("figure", "now", "normal", "sigma", f"sum (alarm over {ALARM:g})", ""):
        table.add_column(head, justify="left" if head in ("figure", "") else "right")
    for one in charts:
        state = "learning" if one.mean != one.mean else "not seen" if one.value != one.value else "good"
        state = state if one.alarmed_at is None else "alarm"
        cells = [f"{number:.4g}" for number in (one.value, one.mean, one.sigma, one.cusum)]
        table.add_row(one.name, *(["-" if cell == "nan" else cell for cell in cells]), state)
    console = SafeConsole()
    console.print(table)
    console.print(f"rig: {check.state}", highlight=False)
