"""Write and read certificates: sealed JSON, an HTML page and a PDF, signed where a key is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import barsight
from barsight.acceptance.acceptance import Acceptance
from barsight.acceptance.pdf import write_pdf
from barsight.core.errors import Failed, InputError, MeasurementError
from barsight.core.files import atomic_paths
from barsight.core.json_values import json_digest, json_value
from barsight.core.reading.bounded_reading import read_bytes
from barsight.core.reading.sealed_json import SEAL, read_sealed, write_sealed
from barsight.report.page import environment, resource
from barsight.report.signing import MAX_SIGNED_BYTES, is_signed, sign_file, signature_of

SCHEMA_VERSION = 1
REMEDY = "take the certificate that barsight accept wrote"
RULE = (
    "ISO 14253-1: passed only where |error| + U is within the limit. Errors are the worst of all "
    "recordings. U is the test value uncertainty (ISO/TS 23165) with a coverage of 95.45 % (k = 2 for "
    "many degrees of freedom): what the artefacts and the survey leave open, not the scatter of the rig "
    "under test."
)


@dataclass(frozen=True)
class CommissioningStep:
    """A step completed on the way to acceptance: its name, its result, the digest of its output, and the
    time.
    """

    name: str
    result: str
    digest: str
    done_at: str


def certificate_content(
    found: Acceptance, signer: str, steps: Sequence[CommissioningStep] = ()
) -> dict[str, Any]:
    """Collect the content of a certificate as JSON values. signer: the person responsible for it."""
    rows = [asdict(one) | {"decision": str(one.decision)} for one in found.quantities]
    content = {
        "schema_version": SCHEMA_VERSION,
        "software": {"name": "barsight", "version": barsight.__version__},
        "issued_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "signer": signer,
        "yard": found.plan.yard,
        "passed": found.is_passed,
        "is_simulated": any(view.is_simulated for view in found.observations),
        "calibration_id": found.observations[0].calibration_id,
        "yard_frame_id": found.observations[0].yard_frame_id,
        "magnet_offset": None if found.offset is None else asdict(found.offset),
        "rule": RULE,
        "plan": asdict(found.plan),
        "plan_sha256": json_digest(json_value(found.plan)),
        "recordings": [
            {"path": view.recording, "map_id": view.map_id, "inputs": found.inputs[view.recording]}
            for view in found.observations
        ],
        "quantities": rows,
        "rig": [
            {"state": str(one.state), "lines": [asdict(line) for line in one.lines]} for one in found.rig
        ],
        "pictures": [
            {"reason": str(row)} if isinstance(row, Failed) else {"cameras": [asdict(one) for one in row]}
            for row in found.pictures
        ],
        "warnings": sorted({code for view in found.observations for code in view.warnings}),
        "causes": [asdict(one) for one in found.causes],
        "steps": [asdict(one) for one in steps],
    }
    plain: dict[str, Any] = json_value(content, 9)
    return plain


def certificate_files(out: Path) -> tuple[Path, ...]:
    """Return the paths of a certificate's JSON, page and PDF; a suffix of `out` is dropped."""
    stem = out.with_suffix("") if out.suffix in (".json", ".html", ".pdf") else out
    return tuple(stem.with_name(stem.name + suffix) for suffix in (".json", ".html", ".pdf"))


def write_certificate(content: dict[str, Any], out: Path, key: Path | None, pdf: bool) -> str:
    """Write JSON, page and, where `pdf` is set, the PDF, all or none; return the content's digest. An earlier
    certificate's PDF and signatures don't stay beside them.

    key: Ed25519 private key (PEM) that signs each file; the signature is written next to it as NAME.sig.
    """
    files = certificate_files(out)
    written = files if pdf else files[:2]
    signatures = tuple(signature_of(file) for file in files)
    made = written if key is None else (*written, *signatures[: len(written)])
    digest = json_digest(content)
    page = environment().get_template("certificate_page.html.jinja").render(
        c=content, digest=digest, signed=key is not None, css=resource("page.css"), bar=error_bar
    )  # fmt: skip
    with atomic_paths(*made) as paths:
        write_sealed(content, paths[0])
        paths[1].write_text(page, encoding="utf-8", errors="replace")
        if pdf:
            write_pdf(content, digest, key is not None, paths[2])
        if key is not None:
            for path in paths[: len(written)]:
                sign_file(path, key)
        for stale in {*files, *signatures} - {*made}:
            stale.unlink(missing_ok=True)
    return digest


def read_certificate(path: Path) -> dict[str, Any]:
    """Read a certificate. Raises InputError where it is missing, damaged or altered."""
    content = read_sealed(certificate_files(path)[0], SCHEMA_VERSION, REMEDY)
    if "quantities" not in content or "plan" not in content:
        raise InputError(path, "is not a certificate", REMEDY)
    return content


def check_certificate(path: Path, key: Path) -> tuple[tuple[Path, ...], dict[str, Any] | None]:
    """Check that the files of a certificate are what was signed with a key, and belong together.

    key: the signer's public key. Returns the files, and the JSON's content if the JSON is there. Raises
    MeasurementError where one was changed, isn't signed, or was signed with another key; InputError where
    there is no certificate.
    """
    files = tuple(file for file in certificate_files(path) if file.exists())
    if not files or (path.suffix in (".json", ".html", ".pdf") and not path.exists()):
        raise InputError(path, "is missing", REMEDY)
    signed = {file: is_signed(file, key) for file in files}
    content = None
    if files[0].suffix == ".json":
        try:
            content = read_certificate(files[0])
        except InputError as error:
            raise MeasurementError(f"changed: {error}") from error
    bad = [file.name for file, is_good in signed.items() if is_good is False]
    if bad and True in signed.values():
        raise MeasurementError(f"{path}: changed: {', '.join(bad)} isn't what was signed with {key}")
    if bad:
        raise MeasurementError(f"{path}: unknown key: no signature is by {key}, or all files were changed")
    if None in signed.values():
        unsigned = ", ".join(file.name for file, is_good in signed.items() if is_good is None)
        raise MeasurementError(f"{path}: not signed: {unsigned} has no signature beside it (.sig)")
    digest = b"" if content is None else str(content[SEAL]).encode()
    for page in (file for file in files if file.suffix != ".json"):
        if digest not in read_bytes(page, MAX_SIGNED_BYTES):
            raise MeasurementError(f"{path}: changed: {page.name} was signed for another certificate")
    return files, content


def error_bar(row: dict[str, Any]) -> str:
    """Draw an error with U against its limits as SVG; empty where the error wasn't measured."""
    if row["error"] is None:
        return ""
    reach = 1.6 * row["limit"]
    middle, half = (
        110 + 100 * max(min(value / reach, 1.0), -1.0)
        for value in (row["error"], row["uncertainty"]["expanded"])
    )
    half = max(half - 110, 0.5)
    edge = 100 / 1.6
    colour = {"passed": "#2a7d46", "failed": "#b3261e"}.get(row["decision"], "#a86a00")
    return (
        '<svg width="220" height="16" role="img" aria-label="error against limit">'
        f'<rect x="{110 - edge:.1f}" y="1" width="{2 * edge:.1f}" height="14" fill="none" '
        'stroke="currentColor" stroke-opacity=".5"/>'
        f'<rect x="{middle - half:.1f}" y="5" width="{2 * half:.1f}" height="6" '
        f'fill="{colour}" opacity=".4"/>'
        f'<rect x="{middle - 1:.1f}" y="2" width="2" height="12" fill="{colour}"/></svg>'
    )
