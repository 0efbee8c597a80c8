"""Measure what IMU and cameras contribute to each other in the paper's method [paper Figure 6]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.core.records.trajectory import Trajectory
from barsight.core.stamps import NS_PER_S, interpolate_at
from barsight.motion.frame_to_frame.motion_trend import MotionTrend
from barsight.recording.base import Recording
from barsight.recording.formats.ground_truth import truth_of
from barsight.recording.sensor_selection import SelectedSensors


@dataclass(frozen=True)
class Architecture:
    """Parts of the paper's method, each compared with the truth. seconds, way_m: duration and length of
    the whole travel. alone_m: error, by the IMU alone, of the distance from start to end. trend_mm,
    stitched_mm: RMS error of a step's length, from the IMU with its velocity corrected by the images, and
    from the matches that pass its trend. steps: number of predicted steps.
    """

    steps: int
    seconds: float
    way_m: float
    alone_m: float
    trend_mm: float
    stitched_mm: float


def measure_architecture(recording: Recording, paper: Trajectory) -> Architecture | None:
    """Measure the parts on the frames of the paper's trajectory; None without truth or IMU."""
    truth, alone = truth_of(recording), SelectedSensors(recording, ("stereo", "imu"))
    imu, frames = alone.imu(), paper.frames
    if truth is None or imu is None or len(frames) < 3:
        return None
    stamps = np.array([frame.stamp_ns for frame in frames])
    places = np.array([pose.translation for pose in truth.poses])
    true = interpolate_at(stamps + recording.rig.timeshift_cam_imu_ns, truth.stamp_ns, places)
    poses = [frame.reference_from_body for frame in frames]
    trend = MotionTrend(imu, alone)
    predicted = [_predicted(trend, stamp, pose) for stamp, pose in zip(stamps.tolist(), poses, strict=True)]
    known = np.array([step is not None for step in predicted[1:]])
    way = np.linalg.norm(np.diff(true, axis=0), axis=1)
    steps = np.array([np.nan if step is None else np.linalg.norm(step.translation) for step in predicted[1:]])
    stitched = np.linalg.norm(np.diff([pose.translation for pose in poses], axis=0), axis=1)
    free = _dead_reckoning(MotionTrend(imu, alone), stamps.tolist(), poses[0])
    return Architecture(
        int(known.sum()), float(stamps[-1] - stamps[0]) / NS_PER_S, float(way.sum()),
        abs(free - float(np.linalg.norm(true[-1] - true[0]))),
        _rms_mm(steps[known] - way[known]), _rms_mm(stitched[known] - way[known]),
    )  # fmt: skip


def _predicted(trend: MotionTrend, stamp_ns: int, pose: Pose) -> Pose | None:
    step = trend.predict(stamp_ns)
    trend.correct(stamp_ns, pose)
    return step


def _dead_reckoning(trend: MotionTrend, stamps_ns: Sequence[int], start: Pose) -> float:
    """Chain the IMU's own predictions: distance of their end from the start, m; NaN if the chain breaks."""
    pose = start
    trend.correct(stamps_ns[0], start)
    for stamp in stamps_ns[1:]:
        step = trend.predict(stamp)
        if step is None:
            return float("nan")
        pose = pose @ step
        trend.correct(stamp, pose)
    return float(np.linalg.norm(pose.translation - start.translation))


def _rms_mm(off_m: Float64) -> float:
    return 1e3 * float(np.sqrt(np.square(off_m).mean())) if off_m.size else float("nan")
