"""Estimate stereo visual odometry: ORB features, metric PnP with RANSAC, refined on both pictures of the
new pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.motion.estimator import FrameInput, ImmediatePoses, TrajectoryEstimator, pictures_of
from barsight.motion.frontend.relative_pose import estimate_step, rotate_covariance, transport_covariance
from barsight.motion.frontend.stereo_features import FeatureView, OdometrySettings, feature_view
from barsight.motion.gravity import GravityAlignment, align_with_gravity
from barsight.recording.base import Recording


@dataclass(frozen=True)
class StereoOdometry(TrajectoryEstimator):
    """Estimates any stereo recording; the reference is `world` with its origin at the first body.

    Errors accumulate along the path, and so does the covariance.
    """

    settings: OdometrySettings

    def begin(self, recording: Recording, rectifier: Rectifier) -> ChainedPoses:
        """Begin at the first frame, levelled."""
        return ChainedPoses(self.settings, align_with_gravity(recording), rectifier)


class ChainedPoses(ImmediatePoses):
    """`PoseEstimator` that ties each frame to the last good one."""

    def __init__(self, settings: OdometrySettings, level: GravityAlignment, rectifier: Rectifier) -> None:
        self._settings, self._level, self._body_from_rect0 = settings, level, rectifier.body_from_rect0
        super().__init__()
        self._last: FeatureView | None = None
        self._noise, self._stretch = np.diag([1e-12] * 6), np.zeros(3)

    def place(self, seen: FrameInput) -> PosedFrame | Failed:
        """Chain the frame; Failed where too few features agree."""
        pair = pictures_of(seen)
        view = pair if isinstance(pair, Failed) else feature_view(pair, self._settings)
        if isinstance(view, Failed):
            return view
        if self._last is None:
            self._last = view
            return PosedFrame(seen.stamp_ns, self._level.world_from_body, self._noise)
        step = estimate_step(self._last, view, self._settings)
        if isinstance(step, Failed):
            return step
        old_from_new = Pose("rect0", "rect0", step.rotation, step.translation).inverse()
        old = self.placed[-1].reference_from_body
        world_from_new = old @ self._body_from_rect0 @ old_from_new
        pose = world_from_new @ self._body_from_rect0.inverse()
        way = pose.translation - old.translation
        lever = pose.translation - world_from_new.translation
        self._noise = transport_covariance(self._noise, way) + transport_covariance(
            rotate_covariance(step.covariance, world_from_new.rotation), lever
        )
        self._stretch = self._stretch + step.scale_sigma * way
        covariance = self._noise.copy()
        covariance[3:, 3:] += np.outer(self._stretch, self._stretch)
        self._last = view
        return PosedFrame(seen.stamp_ns, pose, covariance)

    def finish(self) -> Trajectory:
        """Return all poses."""
        sensors = ("stereo", "imu") if self._level.from_imu else ("stereo",)
        return Trajectory("world", tuple(self.placed), tuple(self.refused), sensors, self._level.warnings)
