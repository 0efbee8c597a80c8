"""Approximate lenses with more coefficients by the four that Kalibr accepts, and state the error."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy.optimize import least_squares

from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64
from barsight.core.errors import Failed

MAX_OFF_PX = 0.1
"""Maximum error (px) of a fit anywhere in the picture; a larger one would describe a different lens."""
GRID = (25, 19)
TAKEN = 4


def rig_for_kalibr(rig: StereoRig) -> tuple[StereoRig, float] | Failed:
    """Return the rig with lenses that Kalibr accepts, and their maximum error in px.

    Failed `lens` where four radial-tangential coefficients can't describe a lens.
    """
    cameras, worst = [], 0.0
    for name, camera in (("cam0", rig.cam0), ("cam1", rig.cam1)):
        if camera.distortion is not Distortion.RADTAN or len(camera.coefficients) == TAKEN:
            cameras.append(camera)
            continue
        fitted, off_px = fit_four(camera)
        if off_px > MAX_OFF_PX:
            return Failed(
                "lens", f"{name} has a lens of {len(camera.coefficients)} coefficients, Kalibr {TAKEN}, "
                f"and those are up to {off_px:.2f} px off ({MAX_OFF_PX:g} px are allowed)",
            )  # fmt: skip
        cameras.append(fitted)
        worst = max(worst, off_px)
    return replace(rig, cam0=cameras[0], cam1=cameras[1]), worst


def fit_four(camera: Camera) -> tuple[Camera, float]:
    """Fit a lens with four coefficients to one with more by least squares over the rays of the whole picture.

    Returns the camera and the maximum error in px.
    """
    across, down = np.meshgrid(
        np.linspace(0, camera.width - 1, GRID[0]), np.linspace(0, camera.height - 1, GRID[1])
    )
    seen = np.stack([across.ravel(), down.ravel()], axis=1)
    coefficients = np.array(camera.coefficients)
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-12)
    flat = cv2.undistortPointsIter(seen[:, None], camera.matrix, coefficients, np.eye(3), np.eye(3), until)
    rays = np.concatenate([np.asarray(flat, np.float64).reshape(-1, 2), np.ones((len(seen), 1))], axis=1)

    def off(parameters: Float64) -> Float64:
        return (_projected(rays, parameters) - seen).ravel()

    start = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *coefficients[:TAKEN]])
    found = least_squares(off, start, x_scale=np.maximum(np.abs(start), 1e-3)).x
    largest = float(np.linalg.norm(off(found).reshape(-1, 2), axis=1).max())
    fx, fy, cx, cy, *four = found.tolist()
    return replace(camera, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, coefficients=tuple(four)), largest


def _projected(rays: Float64, parameters: Float64) -> Float64:
    fx, fy, cx, cy = parameters[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, parameters[4:])[0]
    return np.asarray(pixels, np.float64).reshape(-1, 2)
