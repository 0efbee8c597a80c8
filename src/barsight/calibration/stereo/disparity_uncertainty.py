"""Propagate a rig file's covariance to disparity, as the systematic part of its sigma."""

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
"""Nearer of the two distances, as a fraction of the range, at which depths separate a yaw error from a scale
error.
"""


def calibrated_covariance(path: Path) -> tuple[tuple[str, ...], Float64] | None:
    """Read a rig file's parameter names (C,) and covariance (C, C). None where it has none, or none for the
    lenses: they were then taken as exact and may have any error. Raises `CalibrationError`.
    """
    if not holds_own_rig(path) or (known := read_covariance(path)) is None:
        return None
    return known if any(name.startswith("cam0.") for name in known[0]) else None


def disparity_sigma_px(path: Path | None, range_m: float) -> float | None:
    """Compute the standard deviation of disparity (px, median over the picture) due to the calibration at
    `range_m`.

    None without a file, without a covariance of the lenses, or where no point is in both pictures. Raises
    `CalibrationError` for an invalid file.
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
    """Propagate a rig file's covariance to that (3, 3) of yaw (rad), baseline and focal length (ratios), as
    depths up to `range_m` reveal them. None without a file or a covariance, or where both cameras see too
    little.

    Signs: positive where the right camera is turned further, and depths appear larger, than the file says.
    Other effects of the lenses on depth count as yaw. Raises `CalibrationError` for an invalid file.
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
        """Fit yaw and depth scale to b / z; the baseline's part of the scale is known."""
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
    """Differentiate a function (N,) of a rig with respect to the parameters that its file names: (N, C)."""
    columns = []
    for number, step in enumerate(STEP_SIGMAS * np.sqrt(np.diag(covariance))):
        ends = [of(_moved(rig, names, number, sign * step)) for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.column_stack(columns)


def _moved(rig: StereoRig, names: tuple[str, ...], number: int, step: float) -> StereoRig:
    """Perturb one named parameter of the rig. Mounting and time shift have no effect on depth and are left
    alone.
    """
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
    rotation = Rotation.from_rotvec(change[:3]).as_matrix() @ old.rotation
    cam1_from_cam0 = Pose("cam1", "cam0", rotation, old.translation + change[3:])
    return replace(rig, body_from_cam1=rig.body_from_cam0 @ cam1_from_cam0.inverse())
