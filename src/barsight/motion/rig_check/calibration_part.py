"""Propagate a rig file's covariance to the errors of the rig that rows of matches show."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from barsight.calibration.files.rig_formats import read_rig_file
from barsight.calibration.geometry.rectification import right_from_rectified
from barsight.calibration.geometry.rig import StereoRig
from barsight.calibration.stereo.disparity_uncertainty import calibrated_covariance, differentiate
from barsight.calibration.stereo.projection_uncertainty import sample_pairs
from barsight.core.arrays import Float64
from barsight.motion.rig_check.epipolar_error import row_design

FAR_BASELINES = 15.0
"""Range, in baselines, assumed where none is known; rows hardly depend on it."""


def calibration_covariance(path: Path | None, range_m: float) -> Float64:
    """Propagate to the covariance (4, 4) of pitch, roll, focal ratio and yaw as rows show them: a slightly
    wrong lens shifts rows as a turned camera does. Zeros where there is no file or it has no covariance.
    """
    if path is None or (known := calibrated_covariance(path)) is None:
        return np.zeros((4, 4))
    rig, (names, covariance) = read_rig_file(path), known
    _, left, right = sample_pairs(rig, [range_m if range_m == range_m else FAR_BASELINES * rig.baseline_m])
    by = differentiate(lambda moved: _row_values(moved, left, right), rig, names, covariance)
    part: Float64 = by @ covariance @ by.T
    return part


def _row_values(rig: StereoRig, left: Float64, right: Float64) -> Float64:
    """Fit pitch, roll, focal ratio and yaw (4,) to the rows of raw pixels (N, 2) of both cameras."""
    rotation = right_from_rectified(rig)
    a = rig.cam0.rays(left) @ rig.cam0_from_cam1.rotation @ rotation
    b = rig.cam1.rays(right) @ rotation
    a, b = a / a[:, 2:], b / b[:, 2:]
    found = np.linalg.lstsq(row_design(b[:, 0], b[:, 1]), b[:, 1] - a[:, 1], rcond=None)[0]
    return np.asarray(found, np.float64)
