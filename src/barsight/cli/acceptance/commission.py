"""Run `barsight commission FOLDER`."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
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
from barsight.calibration.stereo.verdict import Verdict
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
from barsight.yard.magnet.description import load_magnet

REMEDY = "do this step again"
CERTIFICATE = ("certificate.json", "certificate.html", "certificate.pdf")


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and continue the commissioning."""

    def command(folder: tyro.conf.Positional[Path]) -> None:
        """Commission a rig step by step, from its board pictures to the certificate, all in one folder.

        Each run completes the steps that it can and says what to supply next. Steps whose inputs or
        settings have changed are repeated, with all that depend on them. The exit code is 0 only if the
        certificate is passed.

        Args:
            folder: A new folder, or one that commission made; commission.toml in it holds the settings.
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
    """List the steps in order."""
    way = _Way(folder, settings)
    rig = ("rig.yaml",)
    steps = [
        GuidedStep(
            "cameras", ("board",), rig, "pictures of the board into board/", way.cameras,
            (settings.board, settings.range_m),
        ),
        GuidedStep(
            "travel", (*rig, "survey"), ("check.json",), "a recording of travel into survey/", way.travel
        ),
        GuidedStep("empty yard", (*rig, "survey", *way.placed), ("measured",), "", way.empty_yard),
        GuidedStep("plan", ("measured",), ("plan_drawn.toml",), "", way.plan, (settings.yard,)),
        GuidedStep(
            "acceptance", ("plan.toml", "artefacts", *rig, *way.framed, *way.magnet), CERTIFICATE,
            "plan_drawn.toml with the measured values as plan.toml, recordings of the artefacts into "
            "artefacts/, each in a folder of its own", way.acceptance, (settings.signer, settings.key),
        ),
    ]  # fmt: skip
    if settings.use_tags:
        bring = "the AprilTags that survey/ shows, as surveyed, as tags.csv"
        takes, given = ("tags.csv", *rig, "survey"), (settings.girder_y_m, settings.rails_x_m)
        steps.insert(2, GuidedStep("yard frame", takes, way.framed, bring, way.tags, given))
    elif settings.use_targets:
        bring = "targets as surveyed and as measured in measured/, as targets.csv"
        steps.insert(3, GuidedStep("yard frame", ("targets.csv", "measured"), way.framed, bring, way.targets))
    if (folder / "rig.yaml").exists() and not (folder / "board").exists():
        steps[0] = GuidedStep("cameras", rig, (), "", way.brought)
    return tuple(steps)


@dataclass(frozen=True)
class _Way:
    """The steps as they are run in the folder; each returns its result in words."""

    folder: Path
    settings: CommissionSettings

    @property
    def framed(self) -> tuple[str, ...]:
        """Return the name of the yard file, empty where the settings use none."""
        return ("yard.yaml",) if self.settings.use_targets or self.settings.use_tags else ()

    @property
    def placed(self) -> tuple[str, ...]:
        """Return the name of the yard file where the empty yard is measured with it, otherwise empty."""
        return ("yard.yaml",) if self.settings.use_tags else ()

    @property
    def magnet(self) -> tuple[str, ...]:
        """Return the name of the magnet's file, empty where there is none."""
        return () if self.settings.magnet is None else (self.settings.magnet,)

    def cameras(self) -> str:
        words = ["--board", self.settings.board, "--range-m", str(self.settings.range_m)]
        stereo.run([self._at("board"), *words, "-o", self._at("rig.yaml")])
        return str(read_json(self.folder / "rig.json", REMEDY)["verdict"])

    def brought(self) -> str:
        """Take a rig file from elsewhere, unless the report beside it says redo."""
        report = self.folder / "rig.json"
        told = read_json(report, REMEDY) if report.exists() else None
        if isinstance(told, dict) and told.get("verdict") == Verdict.REDO:
            remedy = "bring new pictures into board/, or another rig.yaml with its own rig.json"
            raise MeasurementError(f"{report}: says redo of rig.yaml; {remedy}")
        return "rig.yaml was brought along"

    def travel(self) -> str:
        check.run([self._at("survey"), *self._rig, "-o", self._at("check.json")])
        return str(read_json(self.folder / "check.json", REMEDY)["state"])

    def empty_yard(self) -> str:
        shutil.rmtree(self.folder / "measured", ignore_errors=True)
        yard = ["--yard", self._at("yard.yaml")] if self.placed else []
        measure.run([self._at("survey"), "-o", self._at("measured"), *self._rig, *yard])
        return "measured"

    def tags(self) -> str:
        words = ["--tags", self._at("tags.csv"), *self._rig, "-o", self._at("yard.yaml")]
        for name, ends in (("girder", self.settings.girder_y_m), ("rails", self.settings.rails_x_m)):
            axis = "y" if name == "girder" else "x"
            words += [] if ends is None else [f"--{name}-{axis}-m", *map(str, ends)]
        calibrate_yard.run([self._at("survey"), *words])
        return str(read_json(self.folder / "yard.json", REMEDY)["verdict"])

    def targets(self) -> str:
        words = ["--measured", self._at("measured"), "-o", self._at("yard.yaml")]
        calibrate_yard.run([self._at("targets.csv"), *words])
        return str(read_json(self.folder / "yard.json", REMEDY)["verdict"])

    def plan(self) -> str:
        yard = self.settings.yard or self.folder.resolve().name
        accept.make_plan(self.folder / "measured", self.folder / "plan_drawn.toml", yard)
        return "plan_drawn.toml: build the artefacts and have them measured"

    def acceptance(self) -> str:
        folder, settings = self.folder, self.settings
        recordings = sorted(path for path in (folder / "artefacts").iterdir() if path.is_dir())
        if not recordings:
            raise MeasurementError(f"{folder / 'artefacts'}: holds no recordings; put one or more there")
        key = None if settings.key is None else folder / settings.key
        chosen = MeasureSettings(
            yard=folder / "yard.yaml" if self.framed else None,
            recording=RecordingSettings(rig=folder / "rig.yaml"),
        )
        steps = [one.told() for one in read_done(folder)]
        offset = load_magnet(folder / settings.magnet).offset if settings.magnet else None
        files = (folder / "plan.toml", *recordings)
        found = accept.run_acceptance(
            files, folder / "certificate", chosen, key, settings.signer, None, steps, offset
        )
        return "passed" if found.is_passed else "failed"

    def _at(self, name: str) -> str:
        return str(self.folder / name)

    @property
    def _rig(self) -> list[str]:
        return ["--recording.rig", self._at("rig.yaml")]
