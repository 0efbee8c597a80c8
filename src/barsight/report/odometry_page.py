"""Write page and JSON of `barsight odometry`: path, velocity, biases, residuals, drift, matches."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

import barsight
from barsight.core.arrays import Float64, Int64, rms
from barsight.core.errors import Failed
from barsight.core.json_values import json_value
from barsight.core.motion_detail import NormalisedResiduals
from barsight.core.records.trajectory import Trajectory
from barsight.core.stamps import NS_PER_S
from barsight.evaluation.trajectory_error import Drift, FrameErrors
from barsight.motion.frontend.matching_example import MatchingExample
from barsight.report.match_images import draw_matches
from barsight.report.page import KeyFigure, format_number, write_summary_page
from barsight.report.page_trajectory import path_plots
from barsight.report.plots import SERIES, Plot, Trace, keep_extremes, line_trace, time_plot
from barsight.result_folder import CameraPath

MAX_POINTS = 6000
"""Maximum number of samples of a line, of which the page has many."""
MAX_MARKED = 60
"""Maximum number of samples that are marked each."""
AXES = "xyz"


@dataclasses.dataclass(frozen=True, eq=False)
class OdometryResult:
    """Content of the page. frames: number in the recording. example: a pair's matches, or why there are none.

    drift, errors: None without ground truth.
    """

    source: str
    frames: int
    trajectory: Trajectory
    example: MatchingExample | Failed
    drift: Drift | None
    errors: FrameErrors | None


def write_odometry_page(result: OdometryResult, html: Path, data: Path) -> None:
    """Write the page to `html` and its numbers to `data`, each completely or not at all."""
    pictures = () if isinstance(result.example, Failed) else draw_matches(result.example)
    summary = odometry_summary(result)
    plots = [*_path(result.trajectory), *_states(result), *_in_sigmas(result), *_sigma(result)]
    write_summary_page(
        "odometry_page.html.jinja", summary, _figures(result), plots, html, data, pictures=pictures
    )


def odometry_summary(result: OdometryResult) -> dict[str, Any]:
    """Collect all data of the page as JSON values; NaN is null."""
    trajectory, detail = result.trajectory, result.trajectory.detail
    frames: list[dict[str, Any]] = [
        {
            "stamp_ns": frame.stamp_ns,
            "position_m": frame.reference_from_body.translation.tolist(),
            "quaternion_xyzw": frame.reference_from_body.quaternion_xyzw.tolist(),
            "covariance": frame.covariance.tolist(),
        } for frame in trajectory.frames
    ]  # fmt: skip
    if detail is not None and detail.inertial is not None:
        columns = {
            f.name: [_or_null(row) for row in getattr(detail.inertial, f.name)]
            for f in dataclasses.fields(detail.inertial) if f.name != "stamp_ns"
        }  # fmt: skip
        for k, frame in enumerate(frames):
            frame |= {name: rows[k] for name, rows in columns.items()}
    parts = {} if detail is None else {
        "pictures": detail.pictures, "imu": detail.imu, "encoders": detail.encoders,
        "innovations": detail.innovations,
    }  # fmt: skip
    example = result.example
    return {
        "schema": 1,
        "software": {"name": "barsight", "version": barsight.__version__},
        "source": result.source,
        "reference": trajectory.reference,
        "sensors": list(trajectory.sensors),
        "frames_total": result.frames,
        "refused": [{"stamp_ns": one.stamp_ns, "reason": one.reason} for one in trajectory.refused],
        "warnings": [*trajectory.rig_moved, *trajectory.doubts, *trajectory.warnings],
        "length_m": trajectory.length_m,
        "seconds": _seconds(trajectory.stamp_ns[-1:], trajectory)[0],
        "drift": None if result.drift is None else json_value(result.drift),
        "rig_drift": _rig_drift(trajectory),
        "residuals_in_sigma": {
            name: {
                "names": list(part.names), "stamp_ns": part.stamp_ns.tolist(),
                "values": part.values.tolist(), "rms": np.sqrt((part.values**2).mean(axis=0)).tolist(),
            }
            for name, part in parts.items() if part is not None and part.stamp_ns.size
        },
        "matches": {"failed": example.reason} if isinstance(example, Failed) else {
            "stamps_ns": list(example.stamps_ns), "raw": len(example.raw),
            "filtered": int(example.filtered.sum()), "followed": len(example.followed),
            "agreed": int(example.agreed.sum()), "ambiguous": int(example.ambiguous.sum()),
        },
        "frames": frames,
    }  # fmt: skip


def _figures(result: OdometryResult) -> list[KeyFigure]:
    trajectory, drift = result.trajectory, result.drift
    sigma = _sigmas(trajectory)
    turn, place = rms(sigma[:, :3]), rms(sigma[:, 3:])
    figures = [
        KeyFigure(
            "Frames", f"{len(trajectory.frames)} of {result.frames}", f"{len(trajectory.refused)} refused"
        ),
        KeyFigure("Travel", format_number(trajectory.length_m, 2, "m"), f"in {trajectory.reference}"),
        KeyFigure(
            "Stated sigma",
            format_number(place * 1e3, 2, "mm"),
            format_number(math.degrees(turn), 4, "°"),
        ),
    ]
    if drift is not None:
        figures.append(KeyFigure(
            "Against truth, aligned", format_number(drift.aligned_rmse_mm, 2, "mm"),
            f"{format_number(drift.aligned_rmse_deg, 3, '°')} RMSE"))  # fmt: skip
        if not math.isnan(drift.reference_rmse_mm):
            nees = f"{format_number(drift.nees_position, 2)} and {format_number(drift.nees_attitude, 2)}"
            figures.append(KeyFigure(
                "In the yard", format_number(drift.reference_rmse_mm, 2, "mm"),
                f"{format_number(drift.reference_rmse_deg, 3, '°')} RMSE; NEES {nees}"))  # fmt: skip
        if not math.isnan(drift.drift_percent):
            note = f"over {drift.min_length_m:.0f} m and more"
            figures.append(KeyFigure("Drift", format_number(drift.drift_percent, 3, "%"), note))
    return figures


def _path(trajectory: Trajectory) -> tuple[Plot, ...]:
    quaternions = np.array([frame.reference_from_body.quaternion_xyzw for frame in trajectory.frames])
    path = CameraPath(trajectory.stamp_ns, trajectory.positions_m, quaternions)
    return path_plots(path, trajectory.reference)


def _states(result: OdometryResult) -> list[Plot]:
    """Draw velocity and biases with a band of two sigma to either side."""
    detail = result.trajectory.detail
    if detail is None or detail.inertial is None:
        return []
    known, plots = detail.inertial, []
    time = _seconds(known.stamp_ns, result.trajectory)
    for name, title, scale, values, sigma in (
        ("velocity", "velocity / mm/s", 1e3, known.velocity_mps, known.velocity_sigma_mps),
        ("gyro-bias", "gyro bias / °/s", 180 / np.pi, known.gyro_bias_radps, known.gyro_bias_sigma_radps),
        ("accel-bias", "accelerometer bias / mm/s²", 1e3, known.accel_bias_mps2, known.accel_bias_sigma_mps2),
    ):
        traces: list[Trace] = []
        for axis in range(3):
            middle, half = values[:, axis] * scale, 2 * sigma[:, axis] * scale
            traces.append(_line(AXES[axis], time, middle, axis))
            for side in (-1, 1):
                edge = _line(AXES[axis], time, middle + side * half, axis)
                edge |= {"mode": "lines", "line": {**edge["line"], "dash": "dot", "width": 0.8}}
                traces.append({**edge, "showlegend": False, "hoverinfo": "skip"})
        where = "reference axes" if name == "velocity" else "the IMU's axes"
        plots.append(time_plot(name, title, traces, f"In {where}; dotted: ± 2 sigma."))
    return plots


def _in_sigmas(result: OdometryResult) -> list[Plot]:
    detail = result.trajectory.detail
    if detail is None:
        return []
    plots = []
    for name, part, caption in (
        ("pictures", detail.pictures, "Pictures: each frame's points, root mean square of u, v and right u."),
        ("imu", detail.imu, "IMU: between neighbours, root mean square over the axes."),
        ("encoders", detail.encoders, "Encoders: each place, those left out included."),
    ):
        if part is not None and part.stamp_ns.size:
            plots.append(_sensor(name, part, caption, result.trajectory))
    if detail.innovations is not None:
        plots.append(_innovations(detail.innovations, result.trajectory))
    return plots


def _innovations(part: NormalisedResiduals, trajectory: Trajectory) -> Plot:
    """Draw innovations with the band that holds 99.7 % of them if the predicted sigma is right."""
    time = _seconds(part.stamp_ns, trajectory)
    traces = [_line(label, time, part.values[:, k], k) for k, label in enumerate(part.names)]
    for side in (-3.0, 3.0):
        edge = _line("3 sigma", time[[0, -1]], np.full(2, side), 0)
        edge |= {"mode": "lines", "line": {"color": "gray", "dash": "dash", "width": 1}}
        traces.append({**edge, "showlegend": False, "hoverinfo": "skip"})
    caption = (
        "Each frame's turn and way since the one before, as pictures find it, minus what gyro and encoders "
        "predicted, over the sigma of both; in the left camera's axes. Dashed: 3 sigma."
    )
    return time_plot("innovations-step", "sigma", traces, caption)


def _sensor(name: str, part: NormalisedResiduals, caption: str, trajectory: Trajectory) -> Plot:
    time = _seconds(part.stamp_ns, trajectory)
    traces = [_line(label, time, part.values[:, k], k) for k, label in enumerate(part.names)]
    return time_plot(
        f"in-sigma-{name}", "sigma", traces, f"{caption} Measured minus estimated, over the stated sigma."
    )


def _sigma(result: OdometryResult) -> list[Plot]:
    """Draw the stated sigma of every frame, and the errors if there is ground truth."""
    trajectory = result.trajectory
    time, sigma = _seconds(trajectory.stamp_ns, trajectory), _sigmas(trajectory)
    plots = []
    for name, title, part, scale in (
        ("place", "mm", slice(3, 6), 1e3), ("attitude", "°", slice(0, 3), 180 / np.pi),
    ):  # fmt: skip
        traces = [_line(AXES[k], time, sigma[:, part][:, k] * scale, k) for k in range(3)]
        plots.append(
            time_plot(f"sigma-{name}", f"sigma / {title}", traces, f"One sigma of each frame's {name}.")
        )
    errors = result.errors
    if errors is not None:
        over = "in the yard" if trajectory.reference == "yard" else "after the best rigid motion"
        at = _seconds(errors.stamp_ns, trajectory)
        for name, title, values, scale in (
            ("place", "mm", errors.place_m, 1e3), ("attitude", "°", errors.turn_rad, 180 / np.pi),
        ):  # fmt: skip
            traces = [_line(AXES[k], at, values[:, k] * scale, k) for k in range(3)]
            caption = f"Estimate minus truth {over}: {name}."
            plots.append(time_plot(f"error-{name}", f"error / {title}", traces, caption))
    return plots


def _rig_drift(trajectory: Trajectory) -> dict[str, float] | None:
    drift = trajectory.drift
    return None if drift is None else {
        "yaw_rad": drift.yaw_rad, "yaw_sigma_rad": drift.yaw_sigma_rad, "scale": drift.scale,
        "scale_sigma": drift.scale_sigma,
    }  # fmt: skip


def _sigmas(trajectory: Trajectory) -> Float64:
    """Compute sigmas (F, 6) of attitude (rad) and position (m)."""
    variances = np.array([np.diag(frame.covariance) for frame in trajectory.frames])
    return np.asarray(np.sqrt(variances), np.float64)


def _seconds(stamp_ns: Int64, trajectory: Trajectory) -> Float64:
    """Compute seconds since the first placed frame."""
    result: Float64 = (stamp_ns - trajectory.stamp_ns[0]) / NS_PER_S
    return result


def _line(name: str, x: Float64, y: Float64, colour: int) -> Trace:
    """Make a line of at most MAX_POINTS samples, which are marked where they are few."""
    kept = keep_extremes(y, MAX_POINTS)
    return {
        **line_trace(name, x[kept], y[kept], SERIES[colour], 1.4, (3, 5)),
        "mode": "lines+markers" if x.size <= MAX_MARKED else "lines",
        "marker": {"color": SERIES[colour], "size": 4},
    }


def _or_null(row: Float64) -> list[float] | None:
    return row.tolist() if np.isfinite(row).all() else None
