"""Extract one pair of neighbouring frames with its matches for the report's figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Bool, Float32, Float64, Int64, UInt8
from barsight.core.errors import Failed
from barsight.core.records.pairs import RefusedFrame
from barsight.features.detectors import make_detector
from barsight.features.guided_matching import (
    GuidedMatches,
    PredictedMotion,
    predict_projections,
    triangulate_stereo,
)
from barsight.features.matching import homography_inliers, is_mutual, nearest_neighbours
from barsight.features.patch_alignment import PatchPair, patch_pair
from barsight.features.tracks import Tracks, update_tracks
from barsight.motion.frontend.motion_consensus import motion_consensus
from barsight.motion.frontend.motion_prediction import CranePredictor
from barsight.motion.frontend.relative_pose import estimate_step
from barsight.motion.frontend.settings import FrontEndSettings
from barsight.motion.frontend.tracking import describe_corners
from barsight.recording.base import Recording
from barsight.stereo.search_range import coarse_disparity

FEATURES = 1500


@dataclass(frozen=True, eq=False)
class MatchingExample:
    """old, new: (H, W) rectified left pictures of two frames. features: (N, 2) ORB features in the old one.

    raw: (R, 4) old and new position of each feature and its nearest neighbour by descriptor; filtered: (R,)
    whether a match is mutual and fits one homography. followed: (P, 2) tracked corners; predicted: (P, 2)
    their positions expected in the new picture, with covariance (P, 2, 2) px^2; found (P, 2); agreed,
    ambiguous (P,). by_sensors: whether encoders and gyro predicted, rather than the pictures themselves.
    """

    stamps_ns: tuple[int, int]
    old: UInt8
    new: UInt8
    features: Float32
    raw: Float64
    filtered: Bool
    followed: Float64
    predicted: Float64
    covariance: Float64
    found: Float64
    agreed: Bool
    ambiguous: Bool
    by_sensors: bool


def matching_example(
    recording: Recording, rectifier: Rectifier, placed_ns: Int64, settings: FrontEndSettings, with_crane: bool
) -> MatchingExample | Failed:
    """Match the two neighbouring frames in the middle of the placed ones (N,)."""
    pairs = _middle(recording, rectifier, placed_ns)
    if isinstance(pairs, Failed):
        return pairs
    old, new = pairs
    prediction, by_sensors = _predicted(recording, rectifier, old, new, settings, with_crane)
    if isinstance(prediction, Failed):
        return prediction
    none = GuidedMatches(np.empty((0, 3)), np.empty(0), np.zeros(0, np.bool_), np.zeros(0, np.bool_))
    coarse = coarse_disparity(old.pair.left, old.pair.right, rectifier.camera.doffs_px)
    tracks = update_tracks(Tracks(), old, none, none.found, coarse, settings.tracks)
    points = triangulate_stereo(tracks.stereo, rectifier.camera)
    places = predict_projections(points, settings.tracks.sigma_px, prediction, rectifier.camera)
    result = motion_consensus(tracks, new, prediction, settings)
    if isinstance(result, Failed):
        return result
    agreed, matches, _ = result
    first, second = (make_detector("orb")(pair.pair.left, FEATURES) for pair in (old, new))
    forward = nearest_neighbours(first.descriptors, second.descriptors)
    mutual = is_mutual(forward, nearest_neighbours(second.descriptors, first.descriptors))
    shown = forward.index >= 0
    raw = np.column_stack([first.pixels[shown], second.pixels[forward.index[shown]]]).astype(np.float64)
    filtered = mutual[shown]
    filtered[filtered] = homography_inliers(raw[filtered, :2], raw[filtered, 2:])
    return MatchingExample(
        (old.pair.stamp_ns, new.pair.stamp_ns), old.pair.left, new.pair.left, first.pixels, raw, filtered,
        tracks.stereo[:, :2], places.stereo[:, :2], places.covariance[:, :2, :2], matches.stereo[:, :2],
        agreed, matches.ambiguous, by_sensors,
    )  # fmt: skip


def _middle(
    recording: Recording, rectifier: Rectifier, placed_ns: Int64
) -> tuple[PatchPair, PatchPair] | Failed:
    if len(placed_ns) < 2:
        return Failed("no-pair", "fewer than two frames were placed")
    wanted = placed_ns[len(placed_ns) // 2 - 1 : len(placed_ns) // 2 + 1].tolist()
    found = []
    for frame in recording.frames():
        if frame.stamp_ns in wanted:
            pair = Failed("torn", frame.reason) if isinstance(frame, RefusedFrame) else rectifier(frame)
            if isinstance(pair, Failed):
                return pair
            found.append(patch_pair(pair))
        if len(found) == len(wanted):
            return found[0], found[1]
    return Failed("no-pair", "the frames in the middle have no pictures")


def _predicted(
    recording: Recording, rectifier: Rectifier, old: PatchPair, new: PatchPair, settings: FrontEndSettings,
    with_crane: bool,
) -> tuple[PredictedMotion | Failed, bool]:  # fmt: skip
    crane, imu = recording.crane(), recording.imu()
    if with_crane and crane is not None:
        bias = np.zeros(3) if imu is None else imu.gyro_radps.mean(axis=0)
        predictor = CranePredictor(crane, imu, bias, rectifier, recording.rig.timeshift_cam_imu_ns)
        prediction = predictor(old.pair.stamp_ns, new.pair.stamp_ns)
        if prediction is not None:
            return prediction, True
    views = [describe_corners(pair, settings) for pair in (old, new)]
    for view in views:
        if isinstance(view, Failed):
            return view, False
    step = estimate_step(views[0], views[1], settings.rough)  # type: ignore[arg-type]
    if isinstance(step, Failed):
        return step, False
    return PredictedMotion(step.rotation, step.translation, 4 * step.covariance), False
