"""Estimate stereo visual odometry: ORB features, metric PnP with RANSAC, refined on both images of the new
pair.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.types import PosedFrame, RefusedFrame, Trajectory
from barsight.motion.frontend.relative_pose import estimate_step, rotate_covariance, transport_covariance
from barsight.motion.frontend.stereo_features import FeatureView, OdometrySettings, feature_views
from barsight.motion.gravity import align_with_gravity
from barsight.recording.base import Recording


@dataclass(frozen=True)
class StereoOdometry:
    """`TrajectoryEstimator` for any stereo recording; the reference is `world`, its origin the first body.

    Errors add up along the way, and so does the covariance.
    """

    settings: OdometrySettings

    def __call__(self, recording: Recording, rectifier: Rectifier, advance: Callable[[], None]) -> Trajectory:
        """Estimate; frames without enough agreeing features are refused, the next one is tied to the last
        good one.
        """
        level = align_with_gravity(recording)
        body_from_rect0 = rectifier.body_from_rect0
        placed: list[PosedFrame] = []
        refused: list[RefusedFrame] = []
        last: FeatureView | None = None
        noise, stretch = np.diag([1e-12] * 6), np.zeros(3)
        for view in feature_views(recording, rectifier, self.settings, advance):
            if isinstance(view, RefusedFrame):
                refused.append(view)
                continue
            if last is None:
                placed.append(PosedFrame(view.stamp_ns, level.world_from_body, noise))
                last = view
                continue
            step = estimate_step(last, view, self.settings)
            if isinstance(step, Failed):
                refused.append(RefusedFrame(view.stamp_ns, step.reason))
                continue
            old_from_new = Pose("rect0", "rect0", step.rotation, step.translation).inverse()
            old = placed[-1].reference_from_body
            world_from_new = old @ body_from_rect0 @ old_from_new
            pose = world_from_new @ body_from_rect0.inverse()
            way = pose.translation - old.translation
            lever = pose.translation - world_from_new.translation
            noise = transport_covariance(noise, way) + transport_covariance(
                rotate_covariance(step.covariance, world_from_new.rotation), lever
            )
            stretch = stretch + step.scale_sigma * way
            covariance = noise.copy()
            covariance[3:, 3:] += np.outer(stretch, stretch)
            placed.append(PosedFrame(view.stamp_ns, pose, covariance))
            last = view
        sensors = ("stereo", "imu") if level.from_imu else ("stereo",)
        return Trajectory("world", tuple(placed), tuple(refused), sensors, level.warnings)
