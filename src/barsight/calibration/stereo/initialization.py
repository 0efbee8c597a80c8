"""Estimate start values of a stereo calibration: focal lengths, board poses and the rig."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.board_views import BoardView, Corners
from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.projection import Lens
from barsight.calibration.stereo.bundle_adjustment import AdjustmentState
from barsight.core.arrays import Float64
from barsight.core.errors import Failed

FOCAL_SHARES = (0.3, 0.45, 0.6, 0.8, 1.1, 1.6, 2.4)
TRIED_VIEWS = 12


def start_lens(
    lens: Lens, corners: Sequence[Corners], points_m: Float64, size: tuple[int, int]
) -> Float64 | Failed:
    """Estimate fx, fy, cx, cy, with zero coefficients, by choosing the focal length that fits the boards
    best.

    size: width, height. Candidates are the closed form [Zhang 2000] and fixed fractions of the picture's
    width.
    """
    width, height = size
    centre = (width - 1) / 2, (height - 1) / 2
    some = corners[:: max(len(corners) // TRIED_VIEWS, 1)]
    candidates = [share * width for share in FOCAL_SHARES]
    try:
        matrix = cv2.initCameraMatrix2D(
            [points_m[c.ids].astype(np.float32) for c in corners],
            [c.pixels.astype(np.float32) for c in corners], size,
        )  # fmt: skip
        candidates += [float(matrix[0, 0]), float(matrix[1, 1])]
    except cv2.error:
        pass
    best, best_error = None, np.inf
    for focal in candidates:
        if not (np.isfinite(focal) and 0.1 * width < focal < 20 * width):
            continue
        parameters = np.concatenate([[focal, focal, *centre], np.zeros(len(lens.coefficient_names))])
        camera = lens.camera(parameters, width, height)
        errors = [board_pose(camera, c, points_m)[2] for c in some]
        error = float(np.median(errors))
        if error < best_error:
            best, best_error = parameters, error
    if best is None or not np.isfinite(best_error):
        return Failed("no-start", "no focal length explains the boards' corners")
    return best


def board_pose(camera: Camera, corners: Corners, points_m: Float64) -> tuple[Float64, Float64, float]:
    """Solve PnP: rotation (3, 3) and translation (3,) of cam_from_board, and RMS in px (inf where there is no
    solution).
    """
    rays = camera.rays(corners.pixels)
    inside = np.isfinite(rays).all(axis=1) & (np.abs(rays[:, :2]).max(axis=1) < 10)
    if inside.sum() < 4:
        return np.eye(3), np.array([0.0, 0.0, 1.0]), np.inf
    # The start values assume a flat board; a bow of some millimetres changes them little.
    flat = points_m[corners.ids[inside]] * [1.0, 1.0, 0.0]
    found, rotations, translations, _ = cv2.solvePnPGeneric(
        flat, rays[inside, :2], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    best: tuple[Float64, Float64, float] = (np.eye(3), np.array([0.0, 0.0, 1.0]), np.inf)
    for vector, place in zip(rotations, translations, strict=True) if found else ():
        rotation = Rotation.from_rotvec(vector.ravel()).as_matrix()
        points = points_m[corners.ids] @ rotation.T + place.ravel()
        if points[:, 2].min() <= 0:
            continue
        error = float(np.sqrt(((camera.project(points) - corners.pixels) ** 2).sum(axis=1).mean()))
        if error < best[2]:
            best = rotation, place.ravel(), error
    return best


def start_rig(
    cameras: tuple[Camera, Camera], lenses: tuple[Float64, Float64], views: Sequence[BoardView],
    points_m: Float64,
) -> AdjustmentState | Failed:  # fmt: skip
    """Solve the board poses from each camera alone, and the rig as the median over the views of R = R_R
    R_L^-1, T = T_R - R T_L [paper Eq. 3]. Failed `no-common-view` where both cameras share no view.
    """
    poses = [
        [
            None if c is None else board_pose(camera, c, points_m)
            for c in (view.cameras[number] for view in views)
        ]
        for number, camera in enumerate(cameras)
    ]
    turns, shifts = [], []
    for left, right in zip(*poses, strict=True):
        if left is not None and right is not None and np.isfinite(left[2] + right[2]):
            turn = right[0] @ left[0].T
            turns.append(turn)
            shifts.append(right[1] - turn @ left[1])
    if not turns:
        return Failed("no-common-view", "no view shows the board to both cameras")
    rotation = _middle_rotation(np.array(turns))
    near = np.linalg.norm(np.array(turns) - rotation, axis=(1, 2)) < 0.2
    translation = np.median(np.array(shifts)[near if near.any() else slice(None)], axis=0)
    board_rotation, board_translation = np.tile(np.eye(3), (len(views), 1, 1)), np.zeros((len(views), 3))
    for number, (left, right) in enumerate(zip(*poses, strict=True)):
        if left is not None and np.isfinite(left[2]):
            board_rotation[number], board_translation[number] = left[:2]
        elif right is not None:
            board_rotation[number] = rotation.T @ right[0]
            board_translation[number] = rotation.T @ (right[1] - translation)
    return AdjustmentState(lenses, rotation, translation, board_rotation, board_translation, np.zeros(0))


def _middle_rotation(rotations: Float64) -> Float64:
    """Compute the L1 median rotation, which no outlier can be."""
    apart = np.linalg.norm(rotations[:, None] - rotations[None], axis=(2, 3))
    chosen: Float64 = rotations[int(apart.sum(axis=1).argmin())]
    return chosen
