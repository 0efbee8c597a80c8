"""Write the page and JSON of a camera-IMU calibration: verdicts, mountings, residuals over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import barsight
from barsight.calibration.camera_imu.calibration import CameraImuCalibration
from barsight.calibration.camera_imu.problem import MOUNT
from barsight.calibration.camera_imu.verdict import CameraImuAssessment
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.report.page import KeyFigure, format_number, write_summary_page
from barsight.report.plots import SERIES, Plot, Trace, keep_extremes, line_trace, time_plot

MAX_POINTS = 6000
"""Maximum number of samples of a line, of which the page has many."""
SENSORS = ("pictures", "gyro", "accel")


def camera_imu_summary(calibration: CameraImuCalibration, assessment: CameraImuAssessment) -> dict[str, Any]:
    """Collect all data of the report as JSON values."""
    problem, state = calibration.problem, calibration.solution.state
    sigma = calibration.sigma
    return {
        "schema": 1,
        "software": {"name": "barsight", "version": barsight.__version__},
        "source": calibration.source.name,
        "board": str(calibration.board),
        "verdict": str(assessment.verdict),
        "lines": [
            {"name": line.name, "value": line.value, "verdict": str(line.verdict), "reason": line.reason}
            for line in assessment.lines
        ],
        "advice": list(assessment.advice),
        "notes": list(calibration.notes),
        "seconds": float(problem.imu.time_s[-1] - problem.imu.time_s[0]),
        "pictures": [int(s.stamp_s.size) for s in problem.sightings],
        "corners": [int(s.ids.size) for s in problem.sightings],
        "removed_corners": calibration.removed_corners,
        "steps": calibration.solution.steps,
        "knot_rate_hz": 1 / state.spline.step_s,
        "body_from_cam": [
            pose.matrix.tolist() for pose in (calibration.rig.body_from_cam0, calibration.rig.body_from_cam1)
        ],
        "timeshift_cam_imu_s": [mount.shift_s for mount in state.mounts],
        "rotation_sigma_deg": np.degrees(sigma[: 2 * MOUNT].reshape(2, MOUNT)[:, :3]).tolist(),
        "translation_sigma_mm": (1e3 * sigma[: 2 * MOUNT].reshape(2, MOUNT)[:, 3:6]).tolist(),
        "timeshift_sigma_s": sigma[: 2 * MOUNT].reshape(2, MOUNT)[:, 6].tolist(),
        "baseline_mm": calibration.rig.baseline_m * 1e3,
        "baseline_sigma_mm": calibration.baseline_sigma_m * 1e3,
        "gravity_in_board_mps2": state.gravity_mps2.tolist(),
        "gyro_bias_radps": state.spline.gyro_bias_radps.mean(axis=0).tolist(),
        "accel_bias_mps2": state.spline.accel_bias_mps2.mean(axis=0).tolist(),
        "gyro_matrix": state.gyro_matrix.tolist() if problem.scales else None,
        "accel_matrix": state.accel_matrix.tolist() if problem.scales else None,
        "corner_sigma_px": calibration.corner_px,
        "sigmas_used": vars(problem.sigmas),
        "stated_noise": vars(calibration.stated),
        "residuals": {
            name: {
                "scatter_in_sigma": spread.factor, "absorbed": spread.absorbed,
                "autocorrelation": spread.after.tolist(),
                "autocorrelation_of_white_noise": spread.after_expected.tolist(),
            }
            for name, spread in zip(SENSORS, calibration.spreads, strict=True)
        },
        **_parameters(calibration, assessment),
    }  # fmt: skip


def _parameters(calibration: CameraImuCalibration, assessment: CameraImuAssessment) -> dict[str, Any]:
    """Collect the parameters with sigmas and observability, and the estimates from each half of the data."""
    known, halves = calibration.uncertainty, assessment.halves
    names = calibration.problem.parameter_names
    values = np.zeros(len(names))
    for camera, mount in enumerate(calibration.solution.state.mounts):
        values[camera * MOUNT + 3 : camera * MOUNT + 7] = [*mount.place_m, mount.shift_s]
    return {
        "correlation": known.correlation,
        "singular_values": known.singular_values.tolist(),
        "undetermined": list(known.undetermined),
        "held_fixed": [
            {"name": g.name, "gain": g.chi, "counted": bool(g.matters), "changes": dict(g.changes)}
            for g in known.fixed
        ],
        "two_halves": {"failed": halves.reason} if isinstance(halves, Failed) else {
            "ratio": halves.ratio, "parameters": list(names[: 2 * MOUNT]),
            "difference": halves.difference.tolist(), "predicted_sigma": halves.predicted.tolist(),
        },
        "parameters": [
            {"name": name, "value": float(value), "sigma": float(own), "noise_sigma": float(noise)}
            for name, value, own, noise in zip(
                names, values, calibration.sigma, known.noise_sigma, strict=True
            )
        ],
    }  # fmt: skip


def write_camera_imu_report(
    calibration: CameraImuCalibration, assessment: CameraImuAssessment, html: Path, data: Path
) -> None:
    """Write the page to `html` and its numbers to `data`, each completely or not at all."""
    summary = camera_imu_summary(calibration, assessment)
    write_summary_page(
        "camera_imu_page.html.jinja", summary, _figures(summary), camera_imu_plots(calibration), html, data
    )


def camera_imu_plots(calibration: CameraImuCalibration) -> list[Plot]:
    """Draw residuals over time in sigma: pictures, gyro, accelerometer; and their autocorrelations."""
    samples, problem = calibration.solution.linearised.samples, calibration.problem
    count = problem.imu.time_s.size
    traces = []
    for camera, sightings in enumerate(problem.sightings):
        square = (calibration.solution.linearised.residuals_px[camera] ** 2).mean(axis=1)
        frames = sightings.stamp_s.size
        each = np.bincount(sightings.frame, square, frames) / np.bincount(sightings.frame, minlength=frames)
        traces.append(_line(f"cam{camera}", sightings.stamp_s, np.sqrt(each) / calibration.corner_px, camera))
    plots = [
        time_plot(
            "corners", "sigma", traces, "Each picture's corners, root mean square over one corner's noise."
        )
    ]
    for name, own, spread in (("gyro", slice(0, 3), 1), ("accel", slice(3, 6), 2)):
        freed = np.sqrt(1 - calibration.spreads[spread].absorbed)
        rows = samples.residual[-count:, own] / freed
        traces = [_line(axis, problem.imu.time_s, rows[:, k], k) for k, axis in enumerate("xyz")]
        caption = (
            f"{name}: measured minus predicted, over the sigma used and the share that the spline takes up. "
            f"Scatter {calibration.spreads[spread].factor:.2f} sigma."
        )
        plots.append(time_plot(name, "sigma", traces, caption))
    traces = []
    for order, (name, spread) in enumerate((("gyro", 1), ("accel", 2))):
        own_spread = calibration.spreads[spread]
        lags = np.arange(1, own_spread.after.size + 1, dtype=np.float64)
        traces.append(_line(name, lags, own_spread.after, order))
        expected = _line(f"{name}, white noise", lags, own_spread.after_expected, order)
        traces.append({**expected, "line": {**expected["line"], "dash": "dash"}})
    layout = {"xaxis": {"title": {"text": "lag / samples"}, "dtick": 1}, "yaxis": {"zeroline": True}}
    caption = "Autocorrelation. Dashed: what white noise shows after the same fit, which takes up slow parts."
    plots.append(Plot("whiteness", traces, layout, 300, caption))
    return plots


def _line(name: str, x: Float64, y: Float64, colour: int) -> Trace:
    """Make a line of at most MAX_POINTS samples."""
    kept = keep_extremes(y, MAX_POINTS)
    return line_trace(name, x[kept], y[kept], SERIES[colour], 1.0, (3, 3))


def _figures(summary: dict[str, Any]) -> list[KeyFigure]:
    rotation = format_number(float(np.max(summary["rotation_sigma_deg"])), 3, "°")
    translation = format_number(float(np.max(summary["translation_sigma_mm"])), 2, "mm")
    shift, shift_sigma = summary["timeshift_cam_imu_s"][0] * 1e3, summary["timeshift_sigma_s"][0] * 1e3
    baseline_sigma = format_number(summary["baseline_sigma_mm"], 2, "mm")
    return [
        KeyFigure("Verdict", summary["verdict"]),
        KeyFigure("Rotation", rotation, "one sigma, worst axis"),
        KeyFigure("Translation", translation, "one sigma, worst axis"),
        KeyFigure(
            "Time shift", format_number(shift, 3, "ms"), f"sigma {format_number(shift_sigma, 3, 'ms')}"
        ),
        KeyFigure("Baseline", format_number(summary["baseline_mm"], 2, "mm"), f"sigma {baseline_sigma}"),
        KeyFigure(
            "Two halves", format_number(summary["two_halves"].get("ratio"), 2, "sigma"), "solved apart"
        ),
    ]
