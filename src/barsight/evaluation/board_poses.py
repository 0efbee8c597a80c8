"""Compute PnP poses from recorded board corners, and the drift of the gyro alone against them."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from barsight.calibration.boards.detection_files import NAMES, read_rows
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import NS_PER_S
from barsight.motion.frontend.board_corners import MIN_POINTS
from barsight.recording.formats.board_corners import CornerRecording
from barsight.recording.formats.ground_truth import GroundTruth

FIELDS = ("stamp_ns", "u", "v", "x", "y", "z")
MIN_POSES = 3


def board_poses(recording: CornerRecording) -> GroundTruth | None:
    """Solve PnP with cam0's corners for the pose of the body over the board at each frame.

    It takes the board as stored and the lens as calibrated; errors of both are contained in these poses.
    Frames with fewer than 12 corners are left out; None if fewer than three remain. Raises CalibrationError
    if the corners have no position on the board.
    """
    rows = read_rows(recording.path / NAMES[0], FIELDS)
    rows = rows[np.argsort(rows["stamp_ns"], kind="stable")]
    camera, body_from_cam0 = recording.rig.cam0, recording.rig.body_from_cam0
    stamps, poses = [], []
    for stamp in recording.index.stamps_ns:
        seen = rows[slice(*np.searchsorted(rows["stamp_ns"], (stamp, stamp + 1)))]
        if len(seen) < MIN_POINTS:
            continue
        board = np.column_stack([seen["x"], seen["y"], seen["z"]]).astype(np.float64)
        rays = camera.rays(np.column_stack([seen["u"], seen["v"]]).astype(np.float64))
        straight = np.ascontiguousarray((rays @ camera.matrix.T)[:, :2])
        good, turn, place = cv2.solvePnP(board, straight, camera.matrix, None)
        if good:
            rotation = Rotation.from_rotvec(turn.ravel()).as_matrix()
            cam0_from_board = Pose("cam0", "world", rotation, place.ravel())
            stamps.append(stamp)
            poses.append((body_from_cam0 @ cam0_from_board).inverse())
    if len(poses) < MIN_POSES:
        return None
    return GroundTruth(np.array(stamps, np.int64), tuple(poses))


def gyro_only_rmse_deg(imu: ImuSamples, truth: GroundTruth, shift_ns: int) -> float:
    """Compute the RMSE, degrees, of the gyro's attitude against the poses; NaN if it covers fewer than three.

    The rates are integrated step by step; the only unknowns, the initial attitude and a constant bias, are
    fitted to the poses themselves. An estimate that trusts the gyro hardly gets closer to the poses.
    """
    stamps = truth.stamp_ns + shift_ns
    known = (stamps >= imu.stamp_ns[0]) & (stamps <= imu.stamp_ns[-1])
    if known.sum() < MIN_POSES:
        return float("nan")
    turns = Rotation.from_matrix([pose.rotation for pose in truth.poses])[known]
    samples_s = (imu.stamp_ns - imu.stamp_ns[0]) / NS_PER_S
    frames_s = (stamps[known] - imu.stamp_ns[0]) / NS_PER_S

    def off(unknowns: Float64) -> Float64:
        """Return (K * 3,): rotations from the gyro's attitude to the pose's, rad.

        unknowns: bias, then rotation of the initial attitude.
        """
        gyro = Slerp(samples_s, _integrated(imu, unknowns[:3]))(frames_s)
        start = turns[0] * gyro[0].inv() * Rotation.from_rotvec(unknowns[3:])
        return np.asarray((turns.inv() * start * gyro).as_rotvec().ravel())

    found = off(least_squares(off, np.zeros(6), x_scale=(*[0.01] * 3, *[0.01] * 3)).x)
    return float(np.degrees(np.sqrt((found**2).sum() / known.sum())))


def _integrated(imu: ImuSamples, bias: Float64) -> Rotation:
    """Integrate the attitude at each sample (N,), starting from the identity."""
    rate = (imu.gyro_radps[1:] + imu.gyro_radps[:-1]) / 2 - bias
    steps = Rotation.from_rotvec(rate * np.diff(imu.stamp_ns)[:, None] / NS_PER_S).as_matrix()
    attitude = np.empty((len(steps) + 1, 3, 3))
    attitude[0] = np.eye(3)
    for k, step in enumerate(steps):
        attitude[k + 1] = attitude[k] @ step
    return Rotation.from_matrix(attitude)
