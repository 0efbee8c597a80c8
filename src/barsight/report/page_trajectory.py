"""Plot the trajectory for the page: from above, and position and attitude over time."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64
from barsight.core.stamps import NS_PER_S
from barsight.report.plots import MAX_POINTS, SERIES, Plot, Trace, json_numbers, line_trace
from barsight.result_folder import CameraPath

MIN_SPAN_MM, MIN_SPAN_DEG = 20.0, 0.2
"""Minimum range of an axis, so that a plot doesn't magnify noise."""
MAX_MARKED = 400
"""Maximum number of poses that are marked each."""


def path_plots(path: CameraPath, reference: str) -> tuple[Plot, ...]:
    """Plot the trajectory from above, and over time. Empty if the path has no pose."""
    if path.stamp_ns.size == 0:
        return ()
    step = -(-path.stamp_ns.size // MAX_POINTS)
    thinned = CameraPath(path.stamp_ns[::step], path.position_m[::step], path.quaternion_xyzw[::step])
    note = f" Every {step}th pose." if step > 1 else ""
    return _from_above(thinned, reference, note), _over_time(thinned, reference, note)


def _from_above(path: CameraPath, reference: str, note: str) -> Plot:
    x, y, _ = path.position_m.T
    traces: list[Trace] = [
        {
            **line_trace("body", x, y, "--series-0", 1.6, (4, 4)),
            "mode": "lines+markers" if path.stamp_ns.size <= MAX_MARKED else "lines",
            "marker": {"color": "--series-0", "size": 5},
        },
        _mark("start", x[0], y[0], "--series-2"),
        _mark("end", x[-1], y[-1], "--series-1"),
    ]
    half = max(float(np.ptp(x)), float(np.ptp(y)) * 3, 0.2) * 0.55
    middle = (float(x.min()) + float(x.max())) / 2
    layout = {
        "xaxis": {"title": {"text": "x / m"}, "range": [middle - half, middle + half]},
        "yaxis": {"title": {"text": "y / m"}, "scaleanchor": "x", "scaleratio": 1},
    }
    caption = f"The body's way from above in the {reference} frame, both axes at one scale.{note}"
    return Plot("path-above", traces, layout, 320, caption)


def _over_time(path: CameraPath, reference: str, note: str) -> Plot:
    seconds = (path.stamp_ns - path.stamp_ns[0]) / NS_PER_S
    moved_mm = (path.position_m - path.position_m[0]) * 1e3
    turned_deg = turned_since_start_deg(path)
    rows = [(f"Δ{axis} / mm", moved_mm[:, [k]], MIN_SPAN_MM) for k, axis in enumerate("xyz")]
    rows.append(("turned / °", turned_deg, MIN_SPAN_DEG))
    traces: list[Trace] = []
    layout: dict[str, Any] = {"xaxis": {"title": {"text": "time / s"}, "anchor": f"y{len(rows)}"}}
    share = 1 / len(rows)
    for row, (title, values, min_span) in enumerate(rows):
        axis = "y" if row == 0 else f"y{row + 1}"
        top = 1 - row * share
        layout["yaxis" if row == 0 else f"yaxis{row + 1}"] = {
            "title": {"text": title},
            "domain": [top - share * 0.84, top],
            "range": _range(values, min_span),
        }
        for column in range(values.shape[1]):
            single = values.shape[1] == 1
            traces.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": title.split(" ")[0] if single else f"about {'XYZ'[column]}",
                    "showlegend": not single,
                    "x": json_numbers(seconds, 3),
                    "y": json_numbers(values[:, column], 3),
                    "yaxis": axis,
                    "line": {"color": SERIES[row if single else column], "width": 1.5},
                }
            )
    caption = (
        f"Position against the first frame, and the rotation since then as a rotation vector, "
        f"{reference} axes.{note}"
    )
    return Plot("path-time", traces, layout, 620, caption)


def turned_since_start_deg(path: CameraPath) -> Float64:
    """Compute rotation vectors (N, 3) from the first attitude to each one, reference axes, degrees.

    Rotation vectors are ambiguous by 360 degrees; each is the one nearest to its predecessor.
    """
    attitude = Rotation.from_quat(path.quaternion_xyzw)
    vectors = (attitude * attitude[0].inv()).as_rotvec()
    for k in range(1, len(vectors)):
        angle, before = float(np.linalg.norm(vectors[k])), float(np.linalg.norm(vectors[k - 1]))
        if max(angle, before) < 1e-9:
            continue
        along = vectors[k] / angle if angle > 1e-9 else vectors[k - 1] / before
        turns = np.round((float(along @ vectors[k - 1]) - angle) / (2 * np.pi))
        vectors[k] += turns * 2 * np.pi * along
    return np.degrees(vectors)


def _mark(name: str, x: float, y: float, colour: str) -> Trace:
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": [round(float(x), 4)],
        "y": [round(float(y), 4)],
        "marker": {"color": colour, "size": 11, "symbol": "diamond"},
    }


def _range(values: Float64, min_span: float) -> list[float]:
    """Choose a range that includes all values and doesn't magnify noise to the panel's height."""
    low, high = float(values.min()), float(values.max())
    half = max((high - low) * 0.55, min_span / 2)
    return [(low + high) / 2 - half, (low + high) / 2 + half]
