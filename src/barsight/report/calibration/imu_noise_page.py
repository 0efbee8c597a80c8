"""Write the page and JSON of an IMU's noise: Allan deviations with their fits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import barsight
from barsight.calibration.camera_imu.allan_deviation import AxisNoise, ImuNoiseFit
from barsight.report.page import KeyFigure, format_number, write_summary_page
from barsight.report.plots import Plot

UNITS = {"gyro": "rad/s", "accel": "m/s²"}


def imu_noise_summary(fit: ImuNoiseFit, source: str, notes: tuple[str, ...]) -> dict[str, Any]:
    """Collect all data of the report as JSON values in SI units."""
    keys = ("density", "walk", "instability")
    return {
        "schema": 1,
        "software": {"name": "barsight", "version": barsight.__version__},
        "source": source,
        "rate_hz": fit.rate_hz,
        "duration_s": fit.duration_s,
        "gaps": fit.gaps,
        "notes": list(notes),
        "axes": [
            {"name": axis.name, "unit": UNITS[axis.name.split()[0]]}
            | {key: getattr(axis, key) for key in keys}
            | {f"{key}_sigma": getattr(axis, f"{key}_sigma") for key in keys}
            | {"tau_s": axis.tau_s.tolist(), "allan_deviation": axis.deviation.tolist()}
            for axis in fit.axes
        ],
    }


def write_imu_noise_report(
    fit: ImuNoiseFit, source: str, notes: tuple[str, ...], html: Path, data: Path
) -> None:
    """Write the page to `html` and its numbers to `data`, each completely or not at all."""
    summary = imu_noise_summary(fit, source, notes)
    plots = [_allan_plot("gyro", fit.axes[:3]), _allan_plot("accel", fit.axes[3:])]
    noise = fit.noise
    figures = [
        KeyFigure("Gyro density", f"{noise.gyro_density:.3e}", "rad/s/√Hz, noisiest axis"),
        KeyFigure("Gyro walk", f"{noise.gyro_walk:.3e}", "rad/s²/√Hz"),
        KeyFigure("Accel density", f"{noise.accel_density:.3e}", "m/s²/√Hz"),
        KeyFigure("Accel walk", f"{noise.accel_walk:.3e}", "m/s³/√Hz"),
        KeyFigure(
            "Log",
            format_number(fit.duration_s, 0, "s"),
            f"{format_number(fit.rate_hz, 2, 'Hz')}, {fit.gaps} gaps",
        ),
    ]
    write_summary_page("imu_noise_page.html.jinja", summary, figures, plots, html, data)


def _allan_plot(name: str, axes: tuple[AxisNoise, ...]) -> Plot:
    traces: list[dict[str, Any]] = []
    for order, axis in enumerate(axes):
        colour = f"--series-{order}"
        error = axis.deviation / np.sqrt(2 * axis.freedom)
        traces.append({
            "type": "scatter", "mode": "markers", "name": axis.name, "x": axis.tau_s.tolist(),
            "y": axis.deviation.tolist(), "marker": {"color": colour, "size": 6},
            "error_y": {"type": "data", "array": error.tolist(), "color": colour, "thickness": 1},
        })  # fmt: skip
        traces.append({
            "type": "scatter", "mode": "lines", "name": f"fit {axis.name[-1]}", "x": axis.tau_s.tolist(),
            "y": axis.model(axis.tau_s).tolist(), "line": {"color": colour, "width": 1.4},
        })  # fmt: skip
    layout = {
        "xaxis": {"title": {"text": "averaging time / s"}, "type": "log"},
        "yaxis": {
            "title": {"text": f"Allan deviation / {UNITS[name]}"},
            "type": "log",
            "exponentformat": "e",
        },
        "hovermode": "closest",
    }
    caption = "Falling by 1/√τ: white noise (read at 1 s). Flat: bias instability. Rising by √τ: random walk."
    return Plot(f"allan-{name}", traces, layout, 440, caption)
