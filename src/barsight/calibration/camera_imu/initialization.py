"""Estimate start values of a camera-IMU calibration without a prior guess.

The board's pose in each picture gives the camera's trajectory. The time shift is the one at which the angular
speeds of camera and gyro correlate best, and the rotation of the mounting aligns their turn rates. Between
the pictures, the integrated gyro carries the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.board_views import Corners
from barsight.calibration.geometry.camera import Camera
from barsight.calibration.stereo.initialization import board_pose
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.core.pose import nearest_rotation

MAX_SHIFT_S = 1.0
MAX_STEP_S = 0.35
MIN_CORRELATION = 0.5
FEWEST_STEPS = 20
MIN_RATE_RADPS = 0.05
MAX_PNP_PX = 5.0
REFIT_PX = 1.0
UNIT_RATIO = (0.8, 1.25)
DEGREES = 180 / np.pi


@dataclass(frozen=True, eq=False)
class CameraPoses:
    """Camera poses estimated from the board alone.

    stamp_s: (F,). rotation (F, 3, 3) and place_m (F, 3): board_from_cam. error_px: (F,) RMS reprojection
    error.
    """

    stamp_s: Float64
    rotation: Float64
    place_m: Float64
    error_px: Float64


@dataclass(frozen=True, eq=False)
class GyroAlignment:
    """Alignment of the gyro with a camera's turn rates.

    rotation: (3, 3) body_from_cam. shift_s: t_imu = t_cam + shift. gyro_bias_radps: (3,). correlation: of the
    turn rates, 1 where they agree.
    """

    rotation: Float64
    shift_s: float
    gyro_bias_radps: Float64
    correlation: float


def camera_poses(
    camera: Camera, stamp_s: Float64, corners: Sequence[Corners], points_m: Float64
) -> CameraPoses:
    """Estimate the camera's pose in each picture by PnP on the board, robust to a few bad corners."""
    poses = [_robust_pose(camera, own, points_m) for own in corners]
    turn = np.array([pose[0] for pose in poses]).transpose(0, 2, 1)
    place = -np.einsum("nij,nj->ni", turn, np.array([pose[1] for pose in poses]))
    return CameraPoses(stamp_s, turn, place, np.array([pose[2] for pose in poses]))


def _robust_pose(camera: Camera, corners: Corners, points_m: Float64) -> tuple[Float64, Float64, float]:
    """Run `board_pose` again without the outlying corners where the first fit is poor."""
    pose = board_pose(camera, corners, points_m)
    if not REFIT_PX < pose[2] < np.inf:
        return pose
    projected = camera.project(points_m[corners.ids] @ pose[0].T + pose[1])
    length = np.linalg.norm(projected - corners.pixels, axis=1)
    good = length <= 3 * np.median(length)
    return board_pose(camera, corners.keep(good), points_m) if good.sum() >= 4 else pose


def align_gyro(way: CameraPoses, time_s: Float64, gyro_radps: Float64) -> GyroAlignment | Failed:
    """Estimate the rotation of the mounting and the time shift from turn rates alone.

    Failed `too-few`, `still` (hardly any rotation), `no-overlap`, `degrees` (the gyro's readings are 57 times
    too large), `ratio`, `no-match` (the turn rates don't agree).
    """
    step = np.diff(way.stamp_s)
    good = (step < MAX_STEP_S) & _near(way)[1:] & _near(way)[:-1]
    if good.sum() < FEWEST_STEPS:
        return Failed("too-few", f"only {int(good.sum())} pairs of neighbouring pictures show the board")
    turn = Rotation.from_matrix(way.rotation[:-1].transpose(0, 2, 1) @ way.rotation[1:])
    rate = (turn.as_rotvec() / step[:, None])[good]
    early, late = way.stamp_s[:-1][good], way.stamp_s[1:][good]
    if float(np.sqrt((rate**2).sum(axis=1).mean())) < MIN_RATE_RADPS:
        return Failed("still", "the camera hardly turns")
    integral = _integral(time_s, gyro_radps)
    shift = _by_speed(rate, early, late, time_s, integral)
    best: GyroAlignment | None = None
    for span in (0.05, 0.01, 0.002):
        for trial in shift + span * np.linspace(-1, 1, 11):
            found = _rotation_between(rate, early + trial, late + trial, time_s, integral, trial)
            if found is not None and (best is None or found.correlation > best.correlation):
                best = found
        shift = shift if best is None else best.shift_s
    if best is None:
        return Failed("no-overlap", "the IMU doesn't cover the pictures' time")
    mean = _mean_rate(early + shift, late + shift, time_s, integral)
    spread = np.nanstd(mean, axis=0), rate.std(axis=0)
    ratio = float(np.linalg.norm(spread[0]) / np.linalg.norm(spread[1]))
    if best.correlation < MIN_CORRELATION:
        return Failed(
            "no-match", f"the gyro's turns don't match the pictures' (correlation {best.correlation:.2f})"
        )
    if UNIT_RATIO[0] < ratio / DEGREES < UNIT_RATIO[1]:
        return Failed("degrees", f"the gyro turns {ratio:.0f} times as fast as the camera")
    if not UNIT_RATIO[0] < ratio < UNIT_RATIO[1]:
        return Failed("ratio", f"the gyro turns {ratio:.2g} times as fast as the camera")
    return best


def body_poses(
    way: CameraPoses, alignment: GyroAlignment, time_s: Float64, gyro_radps: Float64
) -> tuple[Float64, Float64, Float64]:
    """Interpolate body poses at IMU times (K,): the times, rotation (K, 3, 3) world_from_body and place (K,
    3) without lever arm.

    The rotation is the integrated gyro, corrected at each picture to agree with the picture's pose.
    """
    near = _near(way)
    frame_s = way.stamp_s[near] + alignment.shift_s
    seen = Rotation.from_matrix(way.rotation[near] @ alignment.rotation.T)
    steps = np.diff(time_s)[:, None] * ((gyro_radps[1:] + gyro_radps[:-1]) / 2 - alignment.gyro_bias_radps)
    turns = [np.eye(3)]
    for step in Rotation.from_rotvec(steps).as_matrix():
        turns.append(turns[-1] @ step)
    carried = Rotation.from_matrix(np.array(turns))
    at = np.clip(np.searchsorted(time_s, frame_s), 0, time_s.size - 1)
    correction = (seen * carried[at].inv()).as_matrix()
    after = np.clip(np.searchsorted(frame_s, time_s), 1, frame_s.size - 1)
    share = np.clip((time_s - frame_s[after - 1]) / (frame_s[after] - frame_s[after - 1]), 0, 1)
    between = Rotation.from_matrix(correction[after - 1].transpose(0, 2, 1) @ correction[after]).as_rotvec()
    mended = Rotation.from_matrix(correction[after - 1]) * Rotation.from_rotvec(between * share[:, None])
    place = np.column_stack([np.interp(time_s, frame_s, way.place_m[near, i]) for i in range(3)])
    return time_s, (mended * carried).as_matrix(), place


def _near(way: CameraPoses) -> Bool:
    """Select the pictures whose board pose is credible."""
    finite = np.isfinite(way.error_px)
    usual = float(np.median(way.error_px[finite])) if finite.any() else np.inf
    near: Bool = way.error_px < max(3 * usual, MAX_PNP_PX)
    return near


def _integral(time_s: Float64, gyro_radps: Float64) -> Float64:
    """Integrate the gyro over time (S, 3), so that differences give mean rates for any spacing of the
    pictures.
    """
    steps = np.diff(time_s)[:, None] * (gyro_radps[1:] + gyro_radps[:-1]) / 2
    return np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])


def _mean_rate(early: Float64, late: Float64, time_s: Float64, integral: Float64) -> Float64:
    """Average the gyro between pairs of times (N, 3); NaN outside the gyro's log."""
    ends = [
        np.column_stack([np.interp(at, time_s, integral[:, i], np.nan, np.nan) for i in range(3)])
        for at in (early, late)
    ]
    mean: Float64 = (ends[1] - ends[0]) / (late - early)[:, None]
    return mean


def _by_speed(rate: Float64, early: Float64, late: Float64, time_s: Float64, integral: Float64) -> float:
    """Find the time shift that maximises the correlation of angular speeds, to about half the picture
    interval.
    """
    speed = np.linalg.norm(rate, axis=1)
    step = float(np.median(late - early)) / 4
    best, best_shift = -np.inf, 0.0
    for shift in np.arange(-MAX_SHIFT_S, MAX_SHIFT_S + step, step):
        other = np.linalg.norm(_mean_rate(early + shift, late + shift, time_s, integral), axis=1)
        known = np.isfinite(other)
        if known.sum() < max(FEWEST_STEPS, speed.size // 2):
            continue
        correlation = float(np.corrcoef(speed[known], other[known])[0, 1])
        if correlation > best:
            best, best_shift = correlation, float(shift)
    return best_shift


def _rotation_between(
    rate: Float64, early: Float64, late: Float64, time_s: Float64, integral: Float64, shift_s: float
) -> GyroAlignment | None:
    """Estimate the rotation that aligns both turn rates [Arun 1987], with outliers removed in a second
    round.
    """
    mean = _mean_rate(early, late, time_s, integral)
    kept = np.isfinite(mean).all(axis=1)
    for _ in range(2):
        if kept.sum() < FEWEST_STEPS:
            return None
        a, b = rate[kept] - rate[kept].mean(axis=0), mean[kept] - mean[kept].mean(axis=0)
        turn = nearest_rotation(b.T @ a)
        bias = mean[kept].mean(axis=0) - turn @ rate[kept].mean(axis=0)
        scale = float((b * (a @ turn.T)).sum() / (a**2).sum())
        size = float(np.sqrt((a**2).sum() * (b**2).sum()))
        correlation = float((b * (a @ turn.T)).sum()) / max(size, 1e-12)
        off = np.linalg.norm(mean - bias - scale * rate @ turn.T, axis=1)
        kept &= off <= 6 * np.median(off[kept]) + 1e-9
    return GyroAlignment(turn, shift_s, bias, correlation)
