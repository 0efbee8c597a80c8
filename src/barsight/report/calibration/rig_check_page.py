"""Write the page of a drift check: each result with its cost, row errors over the picture, depth by range."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import barsight
from barsight.core.errors import Failed
from barsight.core.json_values import json_value
from barsight.core.linalg.robust import SIGMAS_95
from barsight.core.records.trajectory import RigDrift
from barsight.motion.rig_check.drift_check import RigCheck
from barsight.motion.rig_check.epipolar_error import COLUMNS, ROWS, RowDrift
from barsight.report.page import KeyFigure, format_number, write_summary_page
from barsight.report.plots import Plot, json_numbers

FARTHEST = 2.0
"""Largest range in the depth plot, as a multiple of the working range."""


def rig_check_summary(check: RigCheck, source: str) -> dict[str, Any]:
    """Collect all data of the report as JSON values: angles in degrees, ratios in %, costs in mm."""
    return {
        "schema": 1,
        "software": {"name": "barsight", "version": barsight.__version__},
        "source": source,
        "state": check.state,
        "range_m": json_value(check.range_m),
        "lines": json_value(check.lines),
    }


def write_rig_check_report(check: RigCheck, source: str, html: Path, data: Path) -> None:
    """Write the page to `html` and its numbers to `data`, each completely or not at all."""
    rows, summary = check.rows, rig_check_summary(check, source)
    figures = [KeyFigure("State", check.state)]
    if not isinstance(rows, Failed):
        figures.append(
            KeyFigure(
                "Rows", format_number(rows.rms_px, 3, "px"), f"{rows.matches} matches of {rows.frames} pairs"
            )
        )
    figures += [
        KeyFigure(
            line.name.capitalize(),
            format_number(line.value, 4, line.unit),
            f"± {format_number(line.sigma, 4)}, {line.state}",
        )
        for line in check.lines
    ]
    plots = [] if isinstance(rows, Failed) else [_rows_plot(rows, left) for left in (False, True)]
    if not isinstance(check.drift, Failed):
        plots.append(_depth_plot(check.drift, check.range_m))
    write_summary_page("rig_check_page.html.jinja", summary, figures, plots, html, data)


def _rows_plot(rows: RowDrift, left: bool) -> Plot:
    """Plot row errors of matches over the picture, as measured or after the fitted drift is removed."""
    values = rows.left_px if left else rows.seen_px
    reach = float(np.nanmax(np.abs(rows.seen_px)))
    trace = {
        "type": "heatmap",
        "z": [json_numbers(row, 4) for row in values.reshape(ROWS, COLUMNS)],
        "zmin": -reach,
        "zmax": reach,
        "colorscale": "RdBu",
        "colorbar": {"title": {"text": "px"}, "thickness": 12},
        "hovertemplate": "%{z:.3f} px<extra></extra>",
    }
    axis = {"showticklabels": False, "ticks": "", "constrain": "domain"}
    layout = {
        "xaxis": axis,
        "yaxis": {**axis, "autorange": "reversed", "scaleanchor": "x"},
        "showlegend": False,
    }
    caption = (
        "What pitch, roll and focal ratio leave of it: lens and texture." if left
        else "How far matches lie off their rows, over the right picture. Blank: too few matches."
    )  # fmt: skip
    return Plot("rows-left" if left else "rows-seen", [trace], layout, 360, caption)


def _depth_plot(drift: RigDrift, range_m: float) -> Plot:
    reach = np.linspace(0, FARTHEST * range_m, 60)
    cost = 1e3 * np.array([drift.depth_error_m(at) for at in reach])
    band = SIGMAS_95 * 1e3 * drift.yaw_sigma_rad * reach**2 / drift.baseline_m
    x = json_numbers(np.concatenate([reach, reach[::-1]]), 3)
    y = json_numbers(np.concatenate([cost - band, (cost + band)[::-1]]), 3)
    traces: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "lines",
            "x": x,
            "y": y,
            "fill": "toself",
            "hoverinfo": "skip",
            "fillcolor": "--band",
            "line": {"width": 0},
            "name": f"± {SIGMAS_95} sigma",
        },
        {
            "type": "scatter",
            "mode": "lines",
            "x": json_numbers(reach, 3),
            "y": json_numbers(cost, 3),
            "name": "yaw",
            "line": {"color": "--series-0", "width": 1.4},
        },
    ]
    layout = {"xaxis": {"title": {"text": "range / m"}}, "yaxis": {"title": {"text": "depth error / mm"}}}
    return Plot("depth", traces, layout, 360, f"What the yaw costs; the rig measures at {range_m:.1f} m.")
