"""Write a certificate as a PDF."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any
from unicodedata import normalize

from barsight.core.extras import extra
from barsight.report.page import format_number

HEADS = ("quantity", "error", "U", "k", "limit", "unit", "decision")


PLAIN = str.maketrans("ŁłĐđŦŧĦħı−\u202f", "LlDdTtHhi- ")
"""Letters that no accent can be taken off, and signs, and what the PDF shows of them."""
SPELLED = (
    "Letters that this PDF lacks are shown without their accents or as ?; the page and the JSON have them."
)


def write_pdf(content: dict[str, Any], digest: str, signed: bool, target: Path) -> None:
    """Write the certificate's pages. Raises ConfigError where the extra isn't installed."""
    with extra("acceptance"):
        from reportlab.lib import colors
        from reportlab.lib.pagesizes import A4
        from reportlab.lib.styles import getSampleStyleSheet
        from reportlab.platypus import Paragraph, SimpleDocTemplate, Spacer, Table, TableStyle
    styles = getSampleStyleSheet()

    def text(words: str, style: str = "BodyText") -> Any:
        return Paragraph(escape(_spelled(words)), styles[style])

    rows = [HEADS, *(_row(one) for one in content["quantities"])]
    said = [headline(content), *facts(content), *findings(content), *(cell for row in rows for cell in row)]
    lacks = any(_spelled(words) != words for words in said)
    look = [
        ("FONTSIZE", (0, 0), (-1, -1), 8), ("GRID", (0, 0), (-1, -1), 0.25, colors.grey),
        ("BACKGROUND", (0, 0), (-1, 0), colors.whitesmoke), ("ALIGN", (1, 0), (4, -1), "RIGHT"),
    ]  # fmt: skip
    look += [
        ("TEXTCOLOR", (6, k), (6, k), colors.darkgreen if row[6] == "passed" else colors.firebrick)
        for k, row in enumerate(rows[1:], 1)
    ]
    parts = [
        text("Acceptance certificate", "Title"),
        text(headline(content), "Heading2"),
        *(text(line) for line in facts(content)),
        Spacer(1, 8),
        Table([[*map(_spelled, row)] for row in rows], repeatRows=1, style=TableStyle(look)),
        Spacer(1, 8),
        *(text(line) for line in findings(content)),
        text("Decision rule", "Heading3"),
        text(content["rule"]),
        text("Signature", "Heading3"),
        text(f"Digest of the content (SHA-256): {digest}"),
        text("Signed with Ed25519: the signature lies beside as .sig." if signed else "Not signed."),
        *([text(SPELLED)] if lacks else []),
    ]  # fmt: skip
    page = {"pagesize": A4, "title": "Acceptance certificate", "subject": digest, "invariant": 1}
    SimpleDocTemplate(str(target), **page).build(parts)


def headline(content: dict[str, Any]) -> str:
    """State the result in one line."""
    result = "PASSED" if content["passed"] else "FAILED"
    return f"{result}{', of a SIMULATED rig: no certificate of any crane' if content['is_simulated'] else ''}"


def facts(content: dict[str, Any]) -> list[str]:
    """List what was tested, by whom and when."""
    software = content["software"]
    lines = [
        f"Yard: {content['yard'] or 'not named'}. Issued {content['issued_at']} by "
        f"{content['signer'] or 'nobody named'}, {software['name']} {software['version']}.",
        f"Calibration {content['calibration_id']}, yard frame {content['yard_frame_id'] or 'none'}, "
        f"plan {content['plan_sha256'][:12]}.",
    ]
    lines += [f"Recording {one['path']}, map {one['map_id']}." for one in content["recordings"]]
    lines += [
        f"Step done {step['done_at']}: {step['name']}, {step['result']} ({step['digest'][:12]})."
        for step in content["steps"]
    ]
    return lines


def findings(content: dict[str, Any]) -> list[str]:
    """List causes and warnings."""
    lines = []
    for one in content["causes"]:
        value, sigma = (_plain(one[name], 3) for name in ("value", "sigma"))
        words = " or ".join([one["name"], *one["alike"]])
        lines.append(f"Cause: {words}, {value} ± {sigma} {one['unit']}.")
    for number, one in enumerate(content["rig"], 1):
        lines.append(f"Rig against the crane's travel, recording {number}: {one['state']}.")
    return lines + [f"Warning of the measurement: {code}." for code in content["warnings"]]


def _row(one: dict[str, Any]) -> tuple[str, ...]:
    whole = one["uncertainty"]
    numbers = (one["error"], whole["expanded"], whole["coverage"], one["limit"])
    return (one["name"], *(_plain(value, 2) for value in numbers), one["unit"], one["decision"])


def _plain(value: Any, decimals: int) -> str:
    """Format a value with characters that the PDF's built-in fonts have."""
    return format_number(value, decimals).translate(PLAIN)


def _spelled(words: str) -> str:
    """Spell a text with characters that the PDF's built-in fonts have; others become ?."""
    shown = []
    for letter in words.translate(PLAIN):
        plain = letter if letter.encode("cp1252", "ignore") else normalize("NFKD", letter)[:1]
        shown.append(plain.encode("cp1252", "replace").decode("cp1252"))
    return "".join(shown)
