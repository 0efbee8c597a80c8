"""Stitch as the paper does, for comparison: each frame is tied to the previous one by the SVD of matched
points.

Its errors accumulate along the path, and its homography discards whatever lies off the dominant plane; our
own estimate does neither.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

import cv2
import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Bool, Float32, Float64, Int64
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.core.settings.values import POSITIVE, expect_ranges
from barsight.features.guided_matching import project_stereo
from barsight.features.matching import hamming_distances, match_mutual
from barsight.motion.crane.encoder_trajectory import CraneSettings, EncoderOdometry
from barsight.motion.estimator import FrameInput, ImmediatePoses, TrajectoryEstimator, pictures_of
from barsight.motion.frame_to_frame.motion_trend import MotionTrend
from barsight.motion.frontend.relative_pose import rotate_covariance, transport_covariance
from barsight.motion.frontend.stereo_features import FeatureView, OdometrySettings, feature_view
from barsight.motion.gravity import align_with_gravity
from barsight.recording.base import Recording
from barsight.registration.rigid import Alignment, align_rigid


@dataclass(frozen=True)
class StitchingSettings:
    """The paper's stitching."""

    trend: Literal["imu", "crane"] = "imu"
    """Source of the predicted motion from frame to frame: imu, the paper's own, by its kinematics alone (Eq.
    11 and 12), or crane, the encoders. If the chosen one is missing, the other is used; without both nothing
    is predicted.
    """
    homography_px: float = 3.0
    """Maximum distance of a match from the common homography; matches further off are left out."""
    trend_px: float = 5.0
    """Maximum distance of a match from the predicted motion; matches further off are left out."""
    hamming: int = 256
    """Maximum Hamming distance in bits between matched descriptors (Eq. 6); 256 keeps all matches."""
    min_matches: int = 12
    """Minimum number of matches; a frame with fewer is refused."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "stitching.", homography_px=POSITIVE, trend_px=POSITIVE, min_matches=(4, inf),
            hamming=(1, 256),
        )  # fmt: skip


@dataclass(frozen=True)
class PaperStitching(TrajectoryEstimator):
    """Estimates by mutual ORB matches by Hamming distance [paper Eq. 6], filtered by one homography [paper
    Eq. 7] and by the predicted motion [paper Eq. 12], chained by SVD [paper Eq. 13-20].

    The first frame is placed by the crane (`yard`), else levelled at the origin (`world`).
    """

    settings: StitchingSettings
    features: OdometrySettings
    crane: CraneSettings

    def begin(self, recording: Recording, rectifier: Rectifier) -> StitchedPoses:
        """Begin at the first frame."""
        return StitchedPoses(self, recording, rectifier)


class StitchedPoses(ImmediatePoses):
    """`PoseEstimator` that ties each frame to the last good one."""

    def __init__(self, estimator: PaperStitching, recording: Recording, rectifier: Rectifier) -> None:
        super().__init__()
        self._settings, self._features = estimator.settings, estimator.features
        self._recording, self._rectifier = recording, rectifier
        self._crane = None
        if recording.crane() is not None:
            self._crane = EncoderOdometry(estimator.crane).begin(recording, rectifier)
        self.delay_ns = self._crane.delay_ns if self._crane else 0
        self._imu: MotionTrend | None = None
        imu = None
        if estimator.settings.trend == "imu" or self._crane is None:
            imu = recording.imu()
        if imu is not None and recording.index.stamps_ns:
            self._imu = MotionTrend(imu, recording)
        self._last: tuple[FeatureView, Pose | None] | None = None
        self._noise = np.diag([1e-12] * 6)

    def place(self, seen: FrameInput) -> PosedFrame | Failed:
        """Chain the frame; Failed where too few matches agree."""
        pair = pictures_of(seen)
        view = pair if isinstance(pair, Failed) else feature_view(pair, self._features)
        if isinstance(view, Failed):
            return view
        by_crane = self._crane.push(seen) if self._crane else None
        predicted = by_crane.reference_from_body if isinstance(by_crane, PosedFrame) else None
        if self._last is not None:
            pose = self._chained(self._last, view, predicted)
            if isinstance(pose, Failed):
                return pose
        elif predicted is not None:
            pose = predicted
        elif self._crane is not None:
            return Failed("no-encoder", "the encoders don't cover the first frame")
        else:
            pose = align_with_gravity(self._recording).world_from_body
        if self._imu is not None:
            self._imu.correct(seen.stamp_ns, pose)
        self._last = view, predicted
        return PosedFrame(seen.stamp_ns, pose, self._noise)

    def _chained(
        self, last: tuple[FeatureView, Pose | None], view: FeatureView, predicted: Pose | None
    ) -> Pose | Failed:
        """Compute the pose from the last good frame's and the step since, and update its covariance."""
        rectifier = self._rectifier
        if self._imu is not None:
            moved = self._imu.predict(view.stamp_ns)
            body = rectifier.body_from_rect0
            trend = None if moved is None else body.inverse() @ moved.inverse() @ body
        else:
            trend = _between(last[1], predicted, rectifier)
        step = self._step(last[0], view, rectifier.camera, trend)
        if isinstance(step, Failed):
            return step
        old = self.placed[-1].reference_from_body
        old_rect0 = old @ rectifier.body_from_rect0
        new_rect0 = old_rect0 @ step.target_from_source
        pose = new_rect0 @ rectifier.body_from_rect0.inverse()
        added = rotate_covariance(step.covariance, old_rect0.rotation)
        lever = pose.translation - new_rect0.translation
        noise = transport_covariance(self._noise, pose.translation - old.translation)
        self._noise = noise + transport_covariance(added, lever)
        return pose

    def finish(self) -> Trajectory:
        """Return all poses."""
        by_crane = self._crane is not None
        imu = ("imu",) if self._imu is not None else ()
        sensors = ("stereo", *imu, *(("crane",) if by_crane else ()))
        doubt = "the paper's stitching is for comparison: nothing holds the sensors against each other"
        reference = "yard" if by_crane else "world"
        return Trajectory(reference, tuple(self.placed), tuple(self.refused), sensors, doubts=(doubt,))

    def _step(
        self, old: FeatureView, new: FeatureView, camera: RectifiedCamera, trend: Pose | None
    ) -> Alignment | Failed:
        pairs = match_mutual(old.features, new.features)
        bits = hamming_distances(old.features.descriptors[pairs[:, 0]], new.features.descriptors[pairs[:, 1]])
        pairs = pairs[bits <= self._settings.hamming]
        first, second = old.points(pairs[:, 0], self._features), new.points(pairs[:, 1], self._features)
        kept = np.isfinite(first[:, 2]) & np.isfinite(second[:, 2])
        if kept.sum() >= self._settings.min_matches:
            kept[kept] = self._on_plane(old, new, pairs[kept])
            kept &= self._on_trend(first, new.features.pixels[pairs[:, 1]], camera, trend)
        if kept.sum() < self._settings.min_matches:
            return Failed("no-matches", f"only {int(kept.sum())} matches with the frame before agree")
        return align_rigid(second[kept], first[kept], ("rect0", "rect0"))

    def _on_plane(self, old: FeatureView, new: FeatureView, pairs: Int64) -> Bool:
        cv2.setRNGSeed(1)
        _, inliers = cv2.findHomography(
            old.features.pixels[pairs[:, 0]], new.features.pixels[pairs[:, 1]], cv2.RANSAC,
            self._settings.homography_px,
        )  # fmt: skip
        if inliers is None:
            return np.zeros(len(pairs), np.bool_)
        agreeing: Bool = inliers.ravel().astype(np.bool_)
        return agreeing

    def _on_trend(self, points: Float64, seen: Float32, camera: RectifiedCamera, trend: Pose | None) -> Bool:
        if trend is None:
            return np.ones(len(points), np.bool_)
        with np.errstate(invalid="ignore"):
            off = np.linalg.norm(project_stereo(trend.apply(points), camera)[:, :2] - seen, axis=1)
            near: Bool = off <= self._settings.trend_px
        return near


def _between(old: Pose | None, new: Pose | None, rectifier: Rectifier) -> Pose | None:
    """Compute new_from_old of `rect0` from two body poses."""
    if old is None or new is None:
        return None
    return (new @ rectifier.body_from_rect0).inverse() @ (old @ rectifier.body_from_rect0)
