"""Propagate a rig file's covariance to disparity: the systematic part of a sigma."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.files.rig_file import read_covariance
from barsight.calibration.files.rig_formats import holds_own_rig, read_rig_file
from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.rig import StereoRig
from barsight.calibration.stereo.projection_uncertainty import sample_pairs, triangulate_depth
from barsight.core.arrays import Float64
from barsight.core.pose import Pose

STEP_SIGMAS = 0.05
INTRINSICS = 4
NEAR_RATIO = 0.6
"""Of the range: the nearer of two distances at which depths tell a wrong yaw from a wrong scale."""


def calibrated_covariance(path: Path) -> tuple[tuple[str, ...], Float64] | None:
    """Read what a rig file's covariance is of (C,) and that, (C, C); None where it carries none, or none of
    the lenses: then they were taken as exact and may be off by anything. Raises `CalibrationError`.
    """
    if not holds_own_rig(path) or (known := read_covariance(path)) is None:
        return None
    return known if any(name.startswith("cam0.") for name in known[0]) else None


def disparity_sigma_px(path: Path | None, range_m: float) -> float | None:
    """Compute the standard deviation (px, median over the picture) that the calibration causes at `range_m`;
    None where no file is given or it carries no covariance of lenses. Raises `CalibrationError` for one that
    can't be.
    """
    if path is None or (known := calibrated_covariance(path)) is None:
        return None
    rig = read_rig_file(path)
    names, covariance = known
    _, left, right = sample_pairs(rig, [range_m])
    if len(left) == 0:
        return None
    by = differentiate(lambda moved: triangulate_depth(moved, left, right), rig, names, covariance)
    sigma_m = float(np.median(np.sqrt(np.einsum("nc,cd,nd->n", by, covariance, by))))
    return sigma_m * rig.cam0.fx_px * rig.baseline_m / range_m**2


def rig_covariance(path: Path | None, range_m: float) -> Float64 | None:
    """Propagate a rig file's covariance to yaw (rad), baseline and focal length (ratios), (3, 3), as depths
    up to `range_m` show them; None where no file is given or it carries no covariance.

    Signs: a right camera that is turned by more, and depths that are seen larger, than the file has it. What
    lenses do otherwise to depths there counts as yaw. Raises `CalibrationError` for one that can't be.
    """
    if path is None or (known := calibrated_covariance(path)) is None:
        return None
    rig = read_rig_file(path)
    names, covariance = known
    at, left, right = sample_pairs(rig, [NEAR_RATIO * range_m, range_m])
    if np.unique(at).size < 2:
        return None
    near = triangulate_depth(rig, left, right)
    design = np.column_stack([np.ones(near.size), rig.baseline_m / near])

    def errors(moved: StereoRig) -> Float64:
        """Fit yaw and scale of depths to b / z; the baseline's part of the scale is known."""
        parallax = rig.baseline_m / triangulate_depth(moved, left, right)
        yaw, shorter = np.linalg.lstsq(design, parallax, rcond=None)[0]
        longer = moved.baseline_m / rig.baseline_m
        return np.array([yaw, longer, -shorter - longer])

    by = differentiate(errors, rig, names, covariance)
    found: Float64 = by @ covariance @ by.T
    arm = np.array([1.0, -rig.baseline_m / range_m, -rig.baseline_m / range_m])
    whole = disparity_sigma_px(path, range_m)
    assert whole is not None
    found[0, 0] += max((whole / rig.cam0.fx_px) ** 2 - float(arm @ found @ arm), 0.0)
    return found


def differentiate(
    of: Callable[[StereoRig], Float64], rig: StereoRig, names: tuple[str, ...], covariance: Float64
) -> Float64:
    """Differentiate (N,) of a rig by the parameters that its file names: (N, C)."""
    columns = []
    for number, step in enumerate(STEP_SIGMAS * np.sqrt(np.diag(covariance))):
        ends = [of(_moved(rig, names, number, sign * step)) for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.column_stack(columns)


def _moved(rig: StereoRig, names: tuple[str, ...], number: int, step: float) -> StereoRig:
    """Perturb one named parameter of the rig; where it sits on its body, and its clock, move no depth."""
    owner, _, name = names[number].partition(".")
    if owner in ("cam0", "cam1"):
        first = names.index(next(other for other in names if other.startswith(f"{owner}.")))
        camera: Camera = getattr(rig, owner)
        intrinsics = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
        values: Float64 = np.array([*intrinsics, *camera.coefficients])
        values[number - first] += step
        fx, fy, cx, cy = (float(value) for value in values[:INTRINSICS])
        changed = replace(
            camera, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, coefficients=tuple(values[INTRINSICS:].tolist())
        )
        return replace(rig, cam0=changed) if owner == "cam0" else replace(rig, cam1=changed)
    if owner in ("body_from_cam0", "body_from_cam1") or "timeshift" in name:
        return rig
    change = np.zeros(6)
    change[("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m").index(name)] = step
    old = rig.cam0_from_cam1.inverse()
    turned = Rotation.from_rotvec(change[:3]).as_matrix() @ old.rotation
    cam1_from_cam0 = Pose("cam1", "cam0", turned, old.translation + change[3:])
    return replace(rig, body_from_cam1=rig.body_from_cam0 @ cam1_from_cam0.inverse())
