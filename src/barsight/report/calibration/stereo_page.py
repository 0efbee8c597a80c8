"""Write the page and JSON of a stereo calibration: verdicts, residuals, coverage, uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import barsight
from barsight.calibration.stereo.calibration import StereoCalibration
from barsight.calibration.stereo.outlier_removal import view_rms
from barsight.calibration.stereo.projection_uncertainty import picture_grid
from barsight.calibration.stereo.verdict import Assessment, tilts
from barsight.core.arrays import Float64, rms
from barsight.core.errors import Failed
from barsight.core.json_values import json_value
from barsight.report.page import KeyFigure, format_number, write_summary_page
from barsight.report.plots import Plot, Trace, json_numbers, line_trace

SCHEMA = 1
HEAT = [[0.0, "#f7fbff"], [0.35, "#6baed6"], [0.7, "#2171b5"], [1.0, "#08306b"]]
ARROW_LENGTH_PX = 40.0


def calibration_summary(calibration: StereoCalibration, assessment: Assessment) -> dict[str, Any]:
    """Collect all data of the report as JSON values."""
    rig = calibration.rig
    errors = view_rms(calibration.observed, calibration.residuals_px, len(calibration.views))
    sigmas = np.sqrt(np.diag(calibration.covariance))
    width = len(calibration.lens.parameter_names)
    values = [float(v) for lens in calibration.state.lenses for v in lens]
    pose = rig.cam0_from_cam1.inverse()
    values += [0.0, 0.0, 0.0, *(float(v) for v in pose.translation)]
    return {
        "schema": SCHEMA,
        "software": {"name": "barsight", "version": barsight.__version__},
        "source": calibration.source.name,
        "board": str(calibration.board),
        "board_shape": [
            {"name": name, "value": float(value), "sigma": float(sigma)}
            for name, value, sigma in zip(
                calibration.shape.names, calibration.shape.values, calibration.shape.sigma, strict=True
            )
        ],
        "board_shape_words": str(calibration.shape),
        "lens": str(calibration.lens),
        "verdict": str(assessment.verdict),
        "lines": [
            {"name": line.name, "value": line.value, "verdict": str(line.verdict), "reason": line.reason}
            for line in assessment.lines
        ],
        "advice": list(assessment.advice),
        "rms_px": calibration.rms_px,
        "rms_alone_px": list(calibration.alone_rms_px),
        "corner_sigma_px": calibration.sigma_px,
        "correlation": calibration.correlation,
        "baseline_mm": rig.baseline_m * 1e3,
        "baseline_sigma_mm": calibration.baseline_sigma_m * 1e3,
        "epipolar_rms_px": float(np.sqrt((assessment.epipolar_px**2).mean())),
        "coverage": [float(picture_grid(calibration, camera).covered.mean()) for camera in (0, 1)],
        "depth": [
            {"range_m": r, "sigma_median_mm": json_value(1e3 * m), "sigma_max_mm": json_value(1e3 * w)}
            for r, (m, w) in zip(assessment.ranges_m, assessment.depth_sigma_m, strict=True)
        ],
        "cross_validation": _cross_validation(assessment),
        "views": [
            {"name": view.name, "rms_px": float(error), "tilt_deg": [float(t) for t in tilt],
             "corners": [0 if c is None else int(c.ids.size) for c in view.cameras]}
            for view, error, tilt in zip(calibration.views, errors, tilts(calibration), strict=True)
        ],
        "removed": [{"view": r.view, "camera": r.camera, "reason": r.reason} for r in calibration.removed],
        "parameters": [
            {"name": name, "value": value, "sigma": float(sigma)}
            for name, value, sigma in zip(calibration.parameter_names, values, sigmas, strict=True)
        ],
        "parameters_per_camera": width,
    }  # fmt: skip


def _cross_validation(assessment: Assessment) -> dict[str, Any]:
    """Collect the results of cross-validation with two halves of the views, or why there are none."""
    cross = assessment.cross
    if isinstance(cross, Failed):
        return {"failed": cross.reason}
    return {
        "ratio": cross.ratio, "difference_px": list(cross.difference_px),
        "predicted_px": list(cross.predicted_px), "ranges_m": list(cross.ranges_m),
        "depth_mm": list(cross.depth_mm), "depth_predicted_mm": list(cross.depth_predicted_mm),
        "baseline_mm": cross.baseline_mm, "baseline_predicted_mm": cross.baseline_predicted_mm,
    }  # fmt: skip


def write_calibration_report(
    calibration: StereoCalibration, assessment: Assessment, html: Path, data: Path
) -> None:
    """Write the page to `html` and its numbers to `data`, each completely or not at all."""
    summary = calibration_summary(calibration, assessment)
    write_summary_page(
        "calibration_page.html.jinja",
        summary,
        _figures(summary),
        calibration_plots(calibration, assessment),
        html,
        data,
    )


def calibration_plots(calibration: StereoCalibration, assessment: Assessment) -> list[Plot]:
    """Draw the page's figures: two per camera, then views, epipolar errors and depth."""
    plots = []
    for camera in (0, 1):
        plots += [
            _residual_plot(calibration, camera),
            _sigma_plot(calibration, assessment.projection_sigma_px[camera], camera),
        ]
    return [*plots, _view_plot(calibration), _epipolar_plot(assessment), _depth_plot(assessment)]


def _figures(summary: dict[str, Any]) -> list[KeyFigure]:
    removed = f"{len(summary['removed'])} removals"
    sigma = format_number(summary["baseline_sigma_mm"], 2, "mm")
    alone = " and ".join(format_number(value, 2) for value in summary["rms_alone_px"])
    cross = summary["cross_validation"]
    return [
        KeyFigure("Verdict", summary["verdict"]),
        KeyFigure("Reprojection", format_number(summary["rms_px"], 3, "px"), f"each camera alone {alone} px"),
        KeyFigure("Baseline", format_number(summary["baseline_mm"], 2, "mm"), f"sigma {sigma}"),
        KeyFigure(
            "Epipolar error", format_number(summary["epipolar_rms_px"], 3, "px"), "after rectification"
        ),
        KeyFigure(
            "Cross-validation", format_number(cross.get("ratio"), 2, "sigma"), "two halves solved apart"
        ),
        KeyFigure("Views", str(len(summary["views"])), removed),
    ]


def _residual_plot(calibration: StereoCalibration, camera: int) -> Plot:
    """Draw corners over the picture with lines for their residuals: coverage and reprojection errors."""
    seen, residual = calibration.observed[camera].pixels, calibration.residuals_px[camera]
    most = 4000
    kept = np.linspace(0, len(seen) - 1, min(most, len(seen))).astype(int)
    seen, residual = seen[kept], residual[kept]
    gain = ARROW_LENGTH_PX / max(float(np.percentile(np.linalg.norm(residual, axis=1), 99)), 1e-6)
    gain = float(f"{gain:.1g}")
    gap = np.full(len(seen), np.nan)
    ends = seen + gain * residual
    traces = [
        _line(
            "residual",
            np.column_stack([seen[:, 0], ends[:, 0], gap]).ravel(),
            np.column_stack([seen[:, 1], ends[:, 1], gap]).ravel(),
            "--series-1",
        ),
        {**_line("corner", seen[:, 0], seen[:, 1], "--series-0"), "mode": "markers",
         "marker": {"color": "--series-0", "size": 3}},
    ]  # fmt: skip
    caption = (
        f"cam{camera}: corners of all used views, residuals {gain:g} times as long. White places have none."
    )
    return Plot(f"residuals-{camera}", traces, _picture_layout(calibration, camera), 420, caption)


def _sigma_plot(calibration: StereoCalibration, sigma: Float64, camera: int) -> Plot:
    grid = picture_grid(calibration, camera)
    highest = float(min(np.percentile(sigma, 95), 5 * np.median(sigma)))
    trace = {
        "type": "heatmap", "x": json_numbers(grid.x_px, 1), "y": json_numbers(grid.y_px, 1),
        "z": [json_numbers(row, 4) for row in sigma], "zmin": 0, "zmax": highest, "colorscale": HEAT,
        "colorbar": {"title": {"text": "px"}, "thickness": 12}, "hovertemplate": "%{z:.3f} px<extra></extra>",
    }  # fmt: skip
    layout = {**_picture_layout(calibration, camera), "showlegend": False}
    caption = (
        f"cam{camera}: one standard deviation of where a far point is projected to, after the best common "
        f"rotation. Median {np.median(sigma):.3f} px, largest {sigma.max():.2f} px."
    )
    return Plot(f"projection-{camera}", [trace], layout, 420, caption)


def _picture_layout(calibration: StereoCalibration, camera: int) -> dict[str, Any]:
    model = (calibration.rig.cam0, calibration.rig.cam1)[camera]
    return {
        "xaxis": {"title": {"text": "x / px"}, "range": [0, model.width], "constrain": "domain"},
        "yaxis": {"title": {"text": "y / px"}, "range": [model.height, 0], "scaleanchor": "x"},
        "hovermode": "closest",
    }


def _view_plot(calibration: StereoCalibration) -> Plot:
    names = [view.name for view in calibration.views]
    traces = []
    for camera in (0, 1):
        view, residual = calibration.observed[camera].view, calibration.residuals_px[camera]
        values = [rms(residual[view == n]) if (view == n).any() else float("nan") for n in range(len(names))]
        colour = f"--series-{camera}"
        traces.append({
            "type": "bar", "name": f"cam{camera}", "x": names, "y": json_numbers(np.array(values), 4),
            "marker": {"color": colour},
        })  # fmt: skip
    layout = {"xaxis": {"type": "category"}, "yaxis": {"title": {"text": "RMS / px"}, "rangemode": "tozero"}}
    return Plot("views", traces, layout, 340, "Reprojection error of each view. Stand-outs are worth a look.")


def _epipolar_plot(assessment: Assessment) -> Plot:
    error = assessment.epipolar_px
    reach = max(float(np.percentile(np.abs(error), 99.5)), 1e-3)
    counts, edges = np.histogram(error, np.linspace(-reach, reach, 61))
    trace = _line("corners", (edges[:-1] + edges[1:]) / 2, 100 * counts / error.size, "--series-0")
    trace["line"]["shape"] = "hvh"
    layout = {
        "xaxis": {"title": {"text": "right row − left row / px"}, "zeroline": True},
        "yaxis": {"title": {"text": "share of corners / %"}, "rangemode": "tozero"}, "showlegend": False,
    }  # fmt: skip
    caption = f"Rows of the same corner after rectification: mean {error.mean():.3f} px."
    return Plot("epipolar", [trace], layout, 320, caption)


def _depth_plot(assessment: Assessment) -> Plot:
    x = np.array(assessment.ranges_m)
    sigma = 1e3 * assessment.depth_sigma_m
    traces = [
        _line("median over the picture", x, sigma[:, 0], "--series-0"),
        _line("largest", x, sigma[:, 1], "--series-1"),
    ]
    layout = {
        "xaxis": {"title": {"text": "range / m"}},
        "yaxis": {"title": {"text": "sigma of depth / mm"}, "type": "log"},
    }
    caption = (
        "What the calibration alone costs: the same error in every picture, which no averaging takes off."
    )
    return Plot("depth", traces, layout, 320, caption)


def _line(name: str, x: Float64, y: Float64, colour: str) -> Trace:
    return line_trace(name, x, y, colour, 1.4, (3, 4))
