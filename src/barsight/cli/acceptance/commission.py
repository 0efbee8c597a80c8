"""Run `barsight commission FOLDER`."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import tyro

from barsight.acceptance.certificate import read_certificate
from barsight.acceptance.commissioning import (
    CommissionSettings,
    GuidedStep,
    begin,
    read_done,
    walk,
)
from barsight.cli import measure
from barsight.cli.acceptance import accept
from barsight.cli.arguments import call
from barsight.cli.calibrate import check, stereo
from barsight.cli.calibrate import yard as calibrate_yard
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import MeasurementError
from barsight.core.reading.bounded_reading import read_json
from barsight.measure_settings import MeasureSettings
from barsight.recording.base import RecordingSettings

REMEDY = "do this step again"


def run(arguments: Sequence[str]) -> None:
    """Parse and walk on."""

    def command(folder: tyro.conf.Positional[Path]) -> None:
        """Commission a rig step by step, from its board pictures to the certificate, all in one folder.

        Each run does what can be done and says what to bring next. What was changed since is done again,
        with all that follows from it. The exit code is 0 only where the certificate is passed.

        Args:
            folder: A new folder, or one that commission made; commission.toml in it says what it needs to
                know.
        """
        settings = begin(folder)
        done, next_step = walk(folder, guided_steps(folder, settings))
        console = SafeConsole()
        for one in done:
            console.print(f"done  {one.name}: {one.result}", highlight=False, markup=False)
        if next_step is not None:
            console.print(f"next  {next_step.name}: {next_step.bring}", highlight=False, markup=False)
            raise MeasurementError(f"{folder}: not commissioned yet; next: {next_step.bring}")
        if not read_certificate(folder / "certificate.json")["passed"]:
            raise MeasurementError(f"{folder}: not accepted; certificate.html says why")

    call(command, "commission", arguments)


def guided_steps(folder: Path, settings: CommissionSettings) -> tuple[GuidedStep, ...]:
    """List the steps in their order."""
    rig, survey = folder / "rig.yaml", folder / "survey"
    with_yard = ("yard.yaml",) if settings.use_targets else ()
    recording = RecordingSettings(rig=rig)
    yard_file = folder / "yard.yaml" if settings.use_targets else None

    def cameras() -> str:
        words = ["--board", settings.board, "--range-m", str(settings.range_m)]
        stereo.run([str(folder / "board"), *words, "-o", str(rig)])
        return _verdict(folder / "rig.json")

    def travel() -> str:
        check.run([str(survey), "--recording.rig", str(rig), "-o", str(folder / "check.json")])
        return str(read_json(folder / "check.json", REMEDY)["state"])

    def empty_yard() -> str:
        shutil.rmtree(folder / "measured", ignore_errors=True)
        measure.run([str(survey), "-o", str(folder / "measured"), "--recording.rig", str(rig)])
        return "measured"

    def targets() -> str:
        words = ["--measured", str(folder / "measured"), "-o", str(folder / "yard.yaml")]
        calibrate_yard.run([str(folder / "targets.csv"), *words])
        return str(read_json(folder / "yard.json", REMEDY)["verdict"])

    def plan() -> str:
        accept.run(["--plan", str(folder / "measured"), "-o", str(folder / "plan_drawn.toml")])
        return "plan_drawn.toml: build the artefacts and have them measured"

    def acceptance() -> str:
        recordings = sorted(path for path in (folder / "artefacts").iterdir() if path.is_dir())
        if not recordings:
            raise MeasurementError(f"{folder / 'artefacts'}: holds no recordings; put one or more there")
        key = None if settings.key is None else folder / settings.key
        chosen = MeasureSettings(yard=yard_file, recording=recording)
        told = [one.told() for one in read_done(folder)]
        files = (folder / "plan.toml", *recordings)
        found = accept.run_acceptance(files, folder / "certificate", chosen, key, settings.signer, None, told)
        return "passed" if found.is_passed else "failed"

    made: list[tuple[str, tuple[str, ...], tuple[str, ...], str, Callable[[], str]]] = [
        ("cameras", ("board",), ("rig.yaml",), "pictures of the board into board/", cameras),
        ("travel", ("rig.yaml", "survey"), ("check.json",), "a recording of travel into survey/", travel),
    ]
    made.append(("empty yard", ("rig.yaml", "survey"), ("measured",), "", empty_yard))
    if settings.use_targets:
        bring = "targets as surveyed and as measured in measured/, as targets.csv"
        made.append(("yard frame", ("targets.csv", "measured"), with_yard, bring, targets))
    made += [
        ("plan", ("measured",), ("plan_drawn.toml",), "", plan),
        (
            "acceptance", ("plan.toml", "artefacts", "rig.yaml", *with_yard), ("certificate.json",),
            "plan_drawn.toml with the measured values as plan.toml, recordings of the artefacts into "
            "artefacts/, each in a folder of its own", acceptance,
        ),
    ]  # fmt: skip
    if rig.exists() and not (folder / "board").exists():
        made[0] = ("cameras", ("rig.yaml",), (), "", lambda: "rig.yaml was brought along")
    return tuple(GuidedStep(*one) for one in made)


def _verdict(path: Path) -> str:
    """Return the verdict of a calibration's report. Raises MeasurementError where it asks to redo it."""
    verdict = str(read_json(path, REMEDY)["verdict"])
    if verdict == "redo":
        raise MeasurementError(f"{path}: the calibration is to be redone; rig.html says why")
    return verdict
