"""Write a certificate as PDF."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from barsight.core.extras import extra
from barsight.report.page import format_number

HEADS = ("quantity", "error", "U", "k", "limit", "unit", "decision")


def write_pdf(content: dict[str, Any], digest: str, signature: dict[str, str] | None, target: Path) -> None:
    """Write the certificate's pages. Raises ConfigError where the extra isn't installed."""
    with extra("acceptance"):
        from reportlab.lib import colors
        from reportlab.lib.pagesizes import A4
        from reportlab.lib.styles import getSampleStyleSheet
        from reportlab.platypus import Paragraph, SimpleDocTemplate, Spacer, Table, TableStyle
    styles = getSampleStyleSheet()

    def text(words: str, style: str = "BodyText") -> Any:
        return Paragraph(escape(words), styles[style])

    rows = [HEADS, *(_row(one) for one in content["quantities"])]
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
        Table(rows, repeatRows=1, style=TableStyle(look)),
        Spacer(1, 8),
        *(text(line) for line in findings(content)),
        text("Decision rule", "Heading3"),
        text(content["rule"]),
        text("Signature", "Heading3"),
        text(f"Digest of the content (SHA-256): {digest}"),
        text("Not signed." if signature is None else f"{signature['algorithm']} {signature['signature']}, key {signature['public_key']}"),
    ]  # fmt: skip
    SimpleDocTemplate(str(target), pagesize=A4, title="Acceptance certificate", invariant=1).build(parts)


def headline(content: dict[str, Any]) -> str:
    """Say the result in one line."""
    result = "PASSED" if content["passed"] else "FAILED"
    return f"{result}{', of a SIMULATED rig: no certificate of any crane' if content['is_simulated'] else ''}"


def facts(content: dict[str, Any]) -> list[str]:
    """List what was tested, by whom and when."""
    lines = [
        f"Yard: {content['yard'] or 'not named'}. Issued {content['issued_at']} by {content['signer'] or 'nobody named'}, "
        f"{content['software']['name']} {content['software']['version']}.",
        f"Calibration {content['calibration_id']}, yard frame {content['yard_frame_id'] or 'none'}, "
        f"plan {content['plan_sha256'][:12]}.",
    ]
    lines += [f"Recording {one['path']}, map {one['map_id']}." for one in content["recordings"]]
    lines += [f"Step done {s['done_at']}: {s['name']}, {s['result']} ({s['digest'][:12]})." for s in content["steps"]]
    return lines


def findings(content: dict[str, Any]) -> list[str]:
    """List causes and warnings."""
    lines = [
        f"Cause: {one['name']}, {format_number(one['value'], 3)} ± {format_number(one['sigma'], 3)} {one['unit']}."
        for one in content["causes"]
    ]
    lines += [f"Rig against the crane's travel, recording {k}: {one['state']}." for k, one in enumerate(content["rig"], 1)]
    return lines + [f"Warning of the measurement: {code}." for code in content["warnings"]]


def _row(one: dict[str, Any]) -> tuple[str, ...]:
    whole = one["uncertainty"]
    numbers = (one["error"], whole["expanded"], whole["coverage"], one["limit"])
    told = [format_number(value, 2).replace("−", "-").replace("\u202f", " ") for value in numbers]
    return (one["name"], *told, one["unit"], one["decision"])
