"""Write the page of a yard calibration: each point's residual, in plan view and in list order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import barsight
from barsight.registration.yard import YardCalibration
from barsight.report.page import KeyFigure, format_number, write_summary_page
from barsight.report.plots import SERIES, Plot, json_numbers

ARROW_RATIO = 0.15
"""Length of the longest arrow as a share of the plan."""
MAX_ROWS = 200


def write_yard_report(found: YardCalibration, verdict: str, source: str, html: Path, data: Path) -> None:
    """Write the page to `html` and its numbers to `data`, each completely or not at all."""
    summary: dict[str, Any] = {
        "schema": 1,
        "software": {"name": "barsight", "version": barsight.__version__},
        "source": source,
        "verdict": verdict,
        "points": int((~found.checks).sum()),
        "checks": int(found.checks.sum()),
        "turn_sigma_deg": found.turn_sigma_deg,
        "place_sigma_mm": 1e3 * found.place_sigma_m,
        "rms_mm": 1e3 * found.rms_m,
        "scale": found.alignment.scale,
        "scale_sigma": found.alignment.scale_sigma,
        "doubts": list(found.doubts),
        "table": [
            {"name": name, "kind": "check" if check else "target", "off_mm": (1e3 * off).tolist(),
             "sigma_mm": float(1e3 * sigma)}
            for name, check, off, sigma in zip(
                found.names, found.checks.tolist(), found.off_m, found.sigma_m, strict=True
            )
        ][:MAX_ROWS],
    }  # fmt: skip
    figures = [
        KeyFigure("Verdict", verdict),
        KeyFigure("Turned to", f"± {format_number(found.turn_sigma_deg, 4, 'deg')}", "one sigma, worst axis"),
        KeyFigure(
            "Placed to", f"± {format_number(1e3 * found.place_sigma_m, 1, 'mm')}", "one sigma, worst axis"
        ),
        KeyFigure("Points off", format_number(1e3 * found.rms_m, 1, "mm"), "RMS of their distances"),
        KeyFigure(
            "Scale",
            format_number(found.alignment.scale, 5),
            f"± {format_number(found.alignment.scale_sigma, 5)}, not applied",
        ),
    ]
    plots = [_plan(found), _axes(found)]
    write_summary_page("yard_calibration_page.html.jinja", summary, figures, plots, html, data)


def _plan(found: YardCalibration) -> Plot:
    yard_m = found.yard_m
    longest = max(float(np.linalg.norm(found.off_m[:, :2], axis=1).max()), 1e-9)
    gain = float(f"{ARROW_RATIO * float(np.ptp(yard_m[:, :2], axis=0).max()) / longest:.1g}")
    ends = yard_m + gain * found.off_m
    gap = np.full(len(yard_m), np.nan)
    x, y = (np.column_stack([yard_m[:, k], ends[:, k], gap]).ravel() for k in (0, 1))
    traces: list[dict[str, Any]] = [
        {"type": "scatter", "mode": "lines", "x": json_numbers(x, 4), "y": json_numbers(y, 4), "name": "off",
         "line": {"color": "--series-1", "width": 1.2}, "hoverinfo": "skip"}
    ]  # fmt: skip
    for kind, chosen, symbol in (("target", ~found.checks, "circle"), ("check", found.checks, "diamond")):
        if chosen.any():
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": kind,
                    "x": json_numbers(yard_m[chosen, 0], 4),
                    "y": json_numbers(yard_m[chosen, 1], 4),
                    "text": [found.names[k] for k in np.flatnonzero(chosen)],
                    "marker": {"color": "--series-0", "size": 6, "symbol": symbol},
                }
            )
    layout = {
        "xaxis": {"title": {"text": "yard x / m"}, "constrain": "domain"},
        "yaxis": {"title": {"text": "yard y / m"}, "scaleanchor": "x"},
    }
    return Plot(
        "plan", traces, layout, 420, f"From above; what the points are off is drawn {gain:g} times as long."
    )


def _axes(found: YardCalibration) -> Plot:
    order, off_mm = list(range(len(found.names))), 1e3 * found.off_m
    traces: list[dict[str, Any]] = [
        {"type": "scatter", "mode": "markers", "name": axis, "x": order, "y": json_numbers(off_mm[:, k], 2),
         "marker": {"color": SERIES[k], "size": 5}}
        for k, axis in enumerate("xyz")
    ]  # fmt: skip
    layout = {"xaxis": {"title": {"text": "point"}}, "yaxis": {"title": {"text": "off / mm"}}}
    return Plot("axes", traces, layout, 420, "Per axis, in the order of the list (of moves: of time).")
