"""Run `barsight accept PLAN RECORDING... -o CERTIFICATE`, `barsight accept --plan OUT -o PLAN` and
`barsight accept --check CERTIFICATE --key PUBLIC`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.acceptance.acceptance import Acceptance, accept
from barsight.acceptance.certificate import (
    CommissioningStep,
    certificate_content,
    certificate_files,
    check_certificate,
    write_certificate,
)
from barsight.acceptance.layout import Area, lay_out
from barsight.acceptance.pdf import headline
from barsight.acceptance.quantities import Decision
from barsight.acceptance.yard_area import measured_area
from barsight.artefacts.plan import plan_text, read_plan
from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError, Failed, InputError, MeasurementError, OutputError
from barsight.core.files import atomic_path, expect_output, translated_os_errors
from barsight.measure_settings import MeasureSettings
from barsight.recording.base import RecordingSettings
from barsight.report.signing import sign_file
from barsight.result_folder import read_heights
from barsight.yard.magnet.description import MagnetOffset, load_magnet

COLOURS = {Decision.PASSED: "green", Decision.FAILED: "red"}


@dataclass(frozen=True)
class CertificateSignature:
    """The signature of a certificate, to be made or to be checked."""

    key: Path | None = None
    """Ed25519 private key (PEM) that signs each file of the certificate; the signature is written next to the
    file as NAME.sig. With --check: the signer's public key.
    """
    signer: str = ""
    """Name of the person responsible for the certificate."""
    check: bool = False
    """Check that a certificate is as it was signed, with --key PUBLIC.pem. The exit code is 0 if all its
    files are, whatever the certificate says, and 5 if one was changed or isn't signed, or if another key
    signed it.
    """


UNSIGNED = CertificateSignature()


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, run the acceptance and print it."""

    def command(
        files: tyro.conf.Positional[tuple[Path, ...]],
        out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None,
        plan: bool = False,
        yard: Path | None = None,
        rig: Path | None = None,
        magnet: Path | None = None,
        preset: Literal["best", "fast"] = "best",
        keep: Path | None = None,
        signature: Annotated[CertificateSignature, tyro.conf.arg(name="")] = UNSIGNED,
    ) -> None:
        """Accept a rig with artefacts in the yard, in the manner of VDI/VDE 2634-3 and ISO 10360-13.

        A quantity passes only if |error| + U is within its limit (ISO 14253-1). The exit code is 5 if one
        does not pass or the crane's travel shows a drifted rig; the certificate is written anyway and
        names the cause.

        Args:
            files: PLAN.toml, then one or more recordings of the artefacts; several show the repeatability.
                With --plan: a folder of results from barsight measure that shows the yard. With --check:
                the certificate, by the name of any of its files.
            out: The certificate: .json, .html and, with the extra `acceptance`, .pdf are written under this
                name. With --plan: the plan to write, PLAN.toml.
            plan: Make a plan for the yard instead, with artefacts on its free floor and limits based on the
                pixel size.
            yard: Yard file from barsight calibrate yard.
            rig: Rig file to use instead of the recordings' own calibration.
            magnet: TOML file of the magnet. Its offset from earlier touch-downs (barsight calibrate magnet)
                is applied to the crane's readings; the touch-downs of this plan verify it.
            preset: Stereo preset, as in barsight measure.
            keep: A new folder in which to keep the results of measuring each recording.
            signature: Who signs it, or whether it is as it was signed.
        """
        if signature.check:
            if len(files) != 1 or signature.key is None or plan or out is not None:
                raise ConfigError("accept --check takes one certificate and --key PUBLIC.pem, nothing else")
            print_checked(*check_certificate(files[0], signature.key))
            return
        if out is None:
            raise ConfigError("accept needs -o: the certificate to write, or with --plan the plan")
        if plan:
            if len(files) != 1:
                raise ConfigError("accept --plan takes one folder that barsight measure wrote")
            make_plan(files[0], out, files[0].name)
            return
        if len(files) < 2:
            raise ConfigError("accept needs PLAN.toml and at least one recording; --plan makes a plan")
        settings = MeasureSettings(preset=preset, yard=yard, recording=RecordingSettings(rig=rig))
        by = signature.key, signature.signer
        found = run_acceptance(files, out, settings, *by, keep, offset=_offset(magnet))
        if not found.is_passed:
            raise MeasurementError(f"{files[0]}: not accepted: {why_refused(found)}")

    call(command, "accept", arguments)


def run_acceptance(
    files: tuple[Path, ...], out: Path, settings: MeasureSettings, key: Path | None, signer: str,
    keep: Path | None, steps: Sequence[CommissioningStep] = (), offset: MagnetOffset | None = None,
) -> Acceptance:  # fmt: skip
    """Accept a rig by a plan and its recordings, write the certificate and print the result. steps: those
    completed in a commissioning; offset: of the magnet.
    """
    console = SafeConsole(stderr=True)
    wanted = read_plan(files[0])
    page = certificate_files(out)[1]
    expect_output(page, ".html")
    if keep is not None and keep.exists() and (not keep.is_dir() or any(keep.iterdir())):
        raise OutputError(f"{keep}: exists and is not an empty folder; name a new one (--keep)")
    has_pdf = find_spec("reportlab") is not None
    with tempfile.TemporaryDirectory(prefix="barsight.") as scratch:
        if key is not None:  # report a wrong key before measuring, not after
            probe = Path(scratch) / "probe"
            probe.touch()
            sign_file(probe, key)
        work = Path(scratch) if keep is None else keep
        with translated_os_errors(work):
            work.mkdir(parents=True, exist_ok=True)
        with stages(console) as advance:
            found = accept(wanted, files[1:], settings, work, advance, offset)
    write_certificate(certificate_content(found, signer, steps), out, key, has_pdf)
    print_acceptance(found)
    console.print_line(f"certificate: {page}")
    if not has_pdf:
        console.print("no PDF: run pip install 'barsight[acceptance]'", highlight=False, markup=False)
    return found


def _offset(magnet: Path | None) -> MagnetOffset | None:
    if magnet is None:
        return None
    offset = load_magnet(magnet).offset
    if offset is None:
        raise InputError(magnet, "has no [offset]", "make one: barsight calibrate magnet, or leave it out")
    return offset


def why_refused(found: Acceptance) -> str:
    """Explain a refusal in one line: by its causes, or else by the quantities that did not pass."""
    if found.causes:
        return ", ".join(f"{one.words} ({one.value:+.3g} {one.unit})" for one in found.causes)
    bad = [q for q in found.quantities if q.decision is not Decision.PASSED]
    reasons = [f"{q.name} {q.decision}" for q in bad[:3]] + ([f"{len(bad) - 3} more"] if len(bad) > 3 else [])
    return ", ".join(reasons) or "the crane's travel contradicts the rig"


def print_acceptance(found: Acceptance) -> None:
    """Print every quantity with its decision, and the causes."""
    table = Table(box=SIMPLE_HEAD, title="Acceptance: passed" if found.is_passed else "Acceptance: failed")
    for head in ("quantity", "error", "U", "limit", "", "decision"):
        table.add_column(head, justify="left" if head in ("quantity", "decision") else "right", no_wrap=True)
    for q in found.quantities:
        colour = COLOURS.get(q.decision, "yellow")
        error = "-" if q.decision is Decision.NOT_MEASURED else f"{q.error:+.2f}"
        decision = f"[{colour}]{q.decision}[/{colour}]"
        table.add_row(q.name, error, f"{q.uncertainty.expanded:.2f}", f"{q.limit:.2f}", q.unit, decision)
    console = SafeConsole()
    console.print(table)
    for one in found.causes:
        console.print(f"cause: {one.words}, {one.value:+.3g} ± {one.sigma:.2g} {one.unit}", highlight=False)


def print_checked(files: tuple[Path, ...], content: dict[str, Any] | None) -> None:
    """Print that the files of a certificate are valid, and what the certificate says."""
    console, names = SafeConsole(), ", ".join(file.name for file in files)
    console.print(f"valid: {names}: as signed with this key", highlight=False, markup=False)
    if content is None:
        console.print("the JSON isn't there: whether these belong together isn't known", markup=False)
    else:
        by = content["signer"] or "nobody named"
        console.print_line(f"it says: {headline(content)}, issued {content['issued_at']} by {by}")


def make_plan(measured: Path, out: Path, yard: str) -> None:
    """Lay out artefacts on the free floor of a measured yard, and write the plan."""
    expect_output(out, ".toml")
    area: Area = measured_area(measured)
    made = lay_out(area, yard, read_heights(measured))
    if isinstance(made, Failed):
        raise MeasurementError(f"{measured}: {made.reason}; clear more floor, or write the plan by hand")
    with atomic_path(out) as path:
        path.write_text(plan_text(made), encoding="utf-8")
    SafeConsole(stderr=True).print_line(f"plan: {out}")
