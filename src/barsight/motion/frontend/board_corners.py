"""Track points with known identities: nothing is searched for, only their agreement is checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.records.pairs import NamedPoints, RectifiedCamera, RefusedFrame
from barsight.features.guided_matching import PredictedMotion, triangulate_stereo
from barsight.motion.frontend.relative_pose import ransac, refine_pose
from barsight.motion.frontend.sightings import Sighting
from barsight.motion.frontend.stereo_features import OdometrySettings

TURN = 7
SIGMA_PX = 0.3
"""Initial noise of a corner (1 sigma); the estimate rescales it to the residuals."""
MAX_OFF_ROW_PX = 2.0
MIN_POINTS = 12
MAX_FRAMES = 20
"""Maximum number of frames in a track; after that the point takes a new name, since the estimate's work grows
with the square of the longest track. Points change their names in turn, so neighbouring frames share most of
them.
"""


class PointTracker:
    """Tracks named points; each frame must share enough of them with the one before."""

    def __init__(self, rectifier: Rectifier, rough: OdometrySettings) -> None:
        self._rectifier, self._settings = rectifier, replace(rough, min_inliers=MIN_POINTS)
        self._last: Sighting | None = None

    def push(self, points: NamedPoints) -> Sighting | RefusedFrame:
        """Track the next frame's points, or refuse it."""
        seen = _sighting(points, self._rectifier)
        if self._last is not None and isinstance(seen, Sighting):
            seen = _tied(self._last, seen, self._rectifier, self._settings)
        if isinstance(seen, Failed):
            return RefusedFrame(points.stamp_ns, seen.reason)
        self._last = seen
        return seen


def split_tracks(sightings: Sequence[Sighting]) -> tuple[Sighting, ...]:
    """Give points new names every `MAX_FRAMES` frames."""
    most = len(sightings) // MAX_FRAMES + 2
    return tuple(
        replace(seen, track=seen.track * most + (k + seen.track * TURN % MAX_FRAMES) // MAX_FRAMES)
        for k, seen in enumerate(sightings)
    )


def _sighting(points: NamedPoints, rectifier: Rectifier) -> Sighting | Failed:
    left, right = rectifier.places(points.left, points.right)
    kept = np.abs(left[:, 1] - right[:, 1]) < MAX_OFF_ROW_PX
    if kept.sum() < MIN_POINTS:
        return Failed("no-features", f"only {kept.sum()} points are seen by both cameras on one row")
    row = (left[:, 1] + right[:, 1]) / 2
    stereo = np.column_stack([left[:, 0], row, right[:, 0]])[kept]
    return Sighting(points.stamp_ns, points.names[kept], stereo, np.full(len(stereo), SIGMA_PX), None, 0)


def _tied(
    old: Sighting, new: Sighting, rectifier: Rectifier, settings: OdometrySettings
) -> Sighting | Failed:
    """Estimate the new sighting's motion since the old one, and drop the points that don't follow it."""
    _, first, second = np.intersect1d(old.track, new.track, return_indices=True)
    if len(first) < MIN_POINTS:
        return Failed("no-matches", f"only {len(first)} points are those of the frame before")
    camera = rectifier.camera
    points, target = triangulate_stereo(old.stereo[first], camera), new.stereo[second]
    step = refine_pose(points, target, *_nearby(points, target[:, :2], camera), camera, settings)
    if isinstance(step, Failed):
        start = ransac(points, target[:, :2], camera, settings)
        step = start if isinstance(start, Failed) else refine_pose(points, target, *start, camera, settings)
    if isinstance(step, Failed):
        return step
    kept = np.ones(len(new.track), np.bool_)
    kept[second[~step.kept]] = False
    return replace(
        new, track=new.track[kept], stereo=new.stereo[kept], sigma_px=new.sigma_px[kept],
        motion=PredictedMotion(step.rotation, step.translation, step.covariance),
    )  # fmt: skip


def _nearby(points: Float64, pixels: Float64, camera: RectifiedCamera) -> tuple[Float64, Float64]:
    """Fit the motion to all points, starting from rest. A flat board has a mirrored solution that fits almost
    as well, and three points at a time can't tell the two apart.
    """
    matrix = np.array([[camera.focal_px, 0, camera.cx_px], [0, camera.focal_px, camera.cy_px], [0, 0, 1]])
    turn, translation = np.zeros(3), np.zeros(3)
    _, turn, translation = cv2.solvePnP(
        points, np.ascontiguousarray(pixels), matrix, None, turn, translation, True, cv2.SOLVEPNP_ITERATIVE
    )
    return Rotation.from_rotvec(turn.ravel()).as_matrix(), translation.ravel()
