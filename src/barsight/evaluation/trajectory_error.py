"""Compare a trajectory with the true one; for evaluation only, never for measuring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from barsight.core.arrays import Bool, Float64, Int64, rms
from barsight.core.pose import nearest_rotation
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.core.stamps import NS_PER_S, interpolate_at
from barsight.recording.formats.ground_truth import GroundTruth

MAX_GAP_RATIO = 3.0
"""Maximum interval of the truth, relative to its median, across which it is interpolated."""


@dataclass(frozen=True)
class Drift:
    """frames: number compared. aligned_*: after the best rigid motion. reference_*: without, NaN in `world`.

    drift_percent: translation error over all segments of at least `min_length_m`, relative to their length
    [Geiger 2012]; NaN if the trajectory is shorter. nees_*: NEES per degree of freedom, 1 if the stated
    covariance is right; NaN in `world`, for which the truth is known only up to a rigid motion.
    """

    frames: int
    aligned_rmse_mm: float
    aligned_rmse_deg: float
    reference_rmse_mm: float
    reference_rmse_deg: float
    drift_percent: float
    min_length_m: float
    nees_position: float
    nees_attitude: float


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """Estimate minus truth of the frames that the truth covers. stamp_ns: (N,). place_m, turn_rad: (N, 3)
    on the axes of the reference; in `world` after the best rigid motion.
    """

    stamp_ns: Int64
    place_m: Float64
    turn_rad: Float64


def frame_errors(trajectory: Trajectory, truth: GroundTruth, shift_ns: int) -> FrameErrors | None:
    """Compute per-frame errors; None if fewer than 3 frames overlap the truth.

    shift_ns: the truth's clock minus the frames'.
    """
    met = _met(trajectory, truth, shift_ns)
    if met is None:
        return None
    place, true_place = met.place, met.true_place
    off = met.turn * met.true_turn.inv()
    if trajectory.reference != "yard":
        place, off = align_umeyama(place, true_place), off.mean().inv() * off
    stamps = np.array([frame.stamp_ns for frame in met.frames], np.int64)
    return FrameErrors(stamps, place - true_place, off.as_rotvec())


@dataclass(frozen=True, eq=False)
class _Met:
    """The frames that the truth covers, and the truth at their stamps."""

    frames: list[PosedFrame]
    place: Float64
    turn: Rotation
    true_place: Float64
    true_turn: Rotation


def _met(trajectory: Trajectory, truth: GroundTruth, shift_ns: int) -> _Met | None:
    stamps = trajectory.stamp_ns + shift_ns
    inside = (stamps >= truth.stamp_ns[0]) & (stamps <= truth.stamp_ns[-1])
    inside[inside] = _covered(stamps[inside], truth.stamp_ns)
    if inside.sum() < 3:
        return None
    frames = [frame for frame, kept in zip(trajectory.frames, inside, strict=True) if kept]
    place = np.array([frame.reference_from_body.translation for frame in frames])
    turn = Rotation.from_matrix(np.array([frame.reference_from_body.rotation for frame in frames]))
    places = np.array([pose.translation for pose in truth.poses])
    true_place = interpolate_at(stamps[inside], truth.stamp_ns, places)
    seconds = (truth.stamp_ns - truth.stamp_ns[0]) / NS_PER_S
    turns = Rotation.from_matrix(np.array([pose.rotation for pose in truth.poses]))
    true_turn = Slerp(seconds, turns)((stamps[inside] - truth.stamp_ns[0]) / NS_PER_S)
    return _Met(frames, place, turn, true_place, true_turn)


def _covered(stamps_ns: Int64, truth_ns: Int64) -> Bool:
    """Mark stamps (N,) within the truth that aren't in a gap of it, in which its tracker saw nothing."""
    interval_ns = np.diff(truth_ns)
    if not interval_ns.size:
        return np.ones(stamps_ns.shape, np.bool_)
    after = np.searchsorted(truth_ns, stamps_ns)
    is_short = interval_ns[after - 1] <= MAX_GAP_RATIO * np.median(interval_ns)
    covered: Bool = is_short | (truth_ns[after] == stamps_ns)
    return covered


def trajectory_drift(
    trajectory: Trajectory, truth: GroundTruth, shift_ns: int, min_length_m: float = 10.0
) -> Drift | None:
    """Compute the drift of a trajectory; None if fewer than 3 frames overlap the truth.

    shift_ns: the truth's clock minus the frames' (`timeshift_cam_imu`).
    """
    met = _met(trajectory, truth, shift_ns)
    if met is None:
        return None
    frames, place, turn = met.frames, met.place, met.turn
    true_place, true_turn = met.true_place, met.true_turn
    aligned = align_umeyama(place, true_place)
    off = turn * true_turn.inv()
    spread = (off.mean().inv() * off).magnitude()
    nan = float("nan")
    in_yard = trajectory.reference == "yard"
    error, angle = place - true_place, off.as_rotvec()
    covariance = np.array([frame.covariance for frame in frames])
    return Drift(
        len(frames),
        rms(aligned - true_place) * 1e3,
        float(np.degrees(np.sqrt((spread**2).mean()))),
        rms(error) * 1e3 if in_yard else nan,
        float(np.degrees(rms(angle))) if in_yard else nan,
        _drift(place, turn, true_place, true_turn, min_length_m),
        min_length_m,
        _nees(error, covariance[:, 3:, 3:]) if in_yard else nan,
        _nees(angle, covariance[:, :3, :3]) if in_yard else nan,
    )


def align_umeyama(place: Float64, target: Float64) -> Float64:
    """Align positions (N, 3) rigidly to the target, without scale [Umeyama 1991]."""
    centred, wanted = place - place.mean(axis=0), target - target.mean(axis=0)
    aligned: Float64 = centred @ nearest_rotation(wanted.T @ centred).T + target.mean(axis=0)
    return aligned


def _nees(error: Float64, covariance: Float64) -> float:
    scaled = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
    return float((error * scaled).sum(axis=1).mean() / error.shape[1])


def _drift(
    place: Float64, turn: Rotation, true_place: Float64, true_turn: Rotation, min_length_m: float
) -> float:
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(true_place, axis=0), axis=1))])
    shares: list[float] = []
    for first in range(len(way)):
        last = np.flatnonzero(way - way[first] >= min_length_m)
        if last.size == 0:
            break
        moved = turn[first].inv().apply(place[last] - place[first])
        truly = true_turn[first].inv().apply(true_place[last] - true_place[first])
        shares += (np.linalg.norm(moved - truly, axis=1) / (way[last] - way[first])).tolist()
    return 100 * float(np.mean(shares)) if shares else float("nan")
