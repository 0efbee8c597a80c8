"""Build the content of result.json."""

from __future__ import annotations

from dataclasses import asdict, fields
from datetime import UTC, datetime
from typing import Any

import numpy as np

import barsight
from barsight.core.arrays import Float64
from barsight.core.json_values import json_value
from barsight.core.stamps import NS_PER_S
from barsight.mapping.ego_mask import MIN_WAY_PX
from barsight.mapping.surface.laser_check import LaserCheck, LaserOffset
from barsight.measurement import Measurement, PassRecord
from barsight.yard.identity import ID_DIGITS

SCHEMA_VERSION = 1
PASSED_OVER = (
    f"the picture had moved by less than {MIN_WAY_PX:.0f} px, or map.min_shift, since the last mapped one"
)


def summary(measurement: Measurement) -> dict[str, Any]:
    """Build the content of result.json; rounded for people, NaN as null."""
    trajectory, surface = measurement.trajectory, measurement.surface
    stamps, captured = trajectory.stamp_ns, measurement.travel.captured_ns
    rows, columns = surface.shape
    cell = surface.cell_m
    content = {
        "schema_version": SCHEMA_VERSION,
        "software": {"name": "barsight", "version": barsight.__version__},
        "measured_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "captured_from_ns": captured[0] if captured else None,
        "captured_to_ns": captured[1] if captured else None,
        "is_simulated": measurement.is_simulated,
        **_ids(measurement),
        "recording": {"path": str(measurement.recording_path), "format": measurement.recording_format},
        "reference": trajectory.reference,
        "hashes": {
            "calibration": measurement.calibration_hash,
            "configuration": measurement.configuration_hash,
            "inputs": measurement.input_hashes,
        },
        "configuration": measurement.configuration,
        "sensors_used": list(measurement.sensors_used),
        "frames": _frames_content(measurement),
        "trajectory": {
            "length_m": sum(one.length_m for one in measurement.passes) or trajectory.length_m,
            "duration_s": float(stamps[-1] - stamps[0]) / NS_PER_S if stamps.size else 0.0,
        },
        "travel": measurement.travel.content(),
        "rig_uncertainty": _rig_content(measurement.rig_covariance),
        "stages": [asdict(stage) for stage in measurement.stages],
        "seconds": measurement.seconds,
        "peak_memory_mib": measurement.peak_memory_mib,
        "map": {
            "cell_m": cell,
            "x_min_m": (surface.columns[0] - 0.5) * cell,
            "x_max_m": (surface.columns[1] - 0.5) * cell,
            "y_min_m": (surface.rows[0] - 0.5) * cell,
            "y_max_m": (surface.rows[1] - 0.5) * cell,
            "cells_seen": surface.seen,
            "cells_filled": surface.filled,
            "cells_unknown": rows * columns - surface.seen - surface.filled,
            "median_sigma_m": surface.median_sigma_m,
        },
        **_laser_content(measurement),
        "truth": None,
        "warnings": [asdict(warning) for warning in measurement.warnings],
        "vetoes": [{"code": v.code, "message": v.reason} for v in measurement.lifts.vetoes],
    }
    if measurement.passes:
        content["passes"] = [_pass_content(number, one) for number, one in enumerate(measurement.passes, 1)]
    rounded: dict[str, Any] = json_value(content, decimals=6)
    return rounded


def _ids(measurement: Measurement) -> dict[str, Any]:
    """Return the ids of the rig and of the frame of all coordinates."""
    return {
        "calibration_id": measurement.calibration_hash[:ID_DIGITS],
        "yard_frame_id": measurement.yard_frame_id, "frame_id": measurement.frame_id,
    }  # fmt: skip


def _frames_content(measurement: Measurement) -> dict[str, Any]:
    """Account for every frame: used, refused or passed over."""
    refused = [
        {"stamp_ns": one.frame.stamp_ns, "stage": one.stage, "reason": one.frame.reason}
        for one in measurement.refusals
    ]
    return {
        "total": measurement.frames_total,
        "used": measurement.frames_used,
        "refused": refused,
        "passed_over": {"count": measurement.frames_passed_over, "reason": PASSED_OVER},
    }


def _rig_content(covariance: Float64 | None) -> dict[str, Any] | None:
    """Describe the remaining uncertainty of the rig after the calibration and the travel."""
    if covariance is None:
        return None
    sigma = np.sqrt(np.diag(covariance))
    return {
        "yaw_deg": float(np.degrees(sigma[0])),
        "baseline_ratio": float(sigma[1]),
        "focal_ratio": float(sigma[2]),
        "correlation": (covariance / np.outer(sigma, sigma)).tolist(),
    }


def _laser_content(measurement: Measurement) -> dict[str, Any]:
    """Describe the agreement with the laser, and its profiles' checks if they were to be fused."""
    checks = measurement.laser_checks
    return {
        "agreement": [asdict(agreement) for agreement in measurement.agreements],
        "laser": None if checks is None else [_check_content(check) for check in checks],
    }


def _check_content(check: LaserCheck) -> dict[str, Any]:
    """Describe a profile's check; offsets in mm, null if undetermined."""
    offset = {field.name: getattr(check.offset, field.name, None) for field in fields(LaserOffset)}
    ratio = offset.pop("alike_ratio")
    offset_mm = {name.replace("_m", "_mm"): None if m is None else 1e3 * m for name, m in offset.items()}
    return {
        "profile": check.profile, "fused": check.is_believed, "samples": check.samples, **offset_mm,
        "alike_ratio": ratio, "reason": check.reason,
    }  # fmt: skip


def _pass_content(number: int, one: PassRecord) -> dict[str, Any]:
    """Describe one of several passes; angles in degrees, the scale as a ratio."""
    unknowns, sigma = one.correction.unknowns, np.sqrt(np.diag(one.correction.covariance))
    return {
        "number": number,
        "recording": {"path": str(one.recording_path), "format": one.recording_format},
        "inputs": one.input_hashes,
        "captured_from_ns": one.captured_ns[0] if one.captured_ns else None,
        "captured_to_ns": one.captured_ns[1] if one.captured_ns else None,
        "frames": {"used": one.frames_used, "total": one.frames_total},
        "trajectory": {"first_ns": one.first_ns, "last_ns": one.last_ns, "length_m": one.length_m},
        "moved": {
            "about_m": one.correction.about_m, "shift_m": unknowns[3:6], "shift_sigma_m": sigma[3:6],
            "turn_deg": np.degrees(unknowns[:3]), "turn_sigma_deg": np.degrees(sigma[:3]),
            "scale": unknowns[6], "scale_sigma": sigma[6],
        },
        "ties": [
            {
                "with_pass": tie.first + 1, "blocks": tie.blocks, "shift_m": tie.shift_m,
                "sigma_m": tie.sigma_m, "expected_sigma_m": tie.expected_sigma_m,
                "off_sigmas": tie.off_sigmas, "contradicts": tie.contradicts,
            }
            for tie in one.ties
        ],
        "changes": [
            {"low_m": c.low_m, "high_m": c.high_m, "area_m2": c.area_m2, "rise_m": c.rise_m}
            for c in one.changes
        ],
        "moves": [{"ends_m": m.ends_m, "width_m": m.width_m, "along_m": m.along_m} for m in one.moves],
    }  # fmt: skip
