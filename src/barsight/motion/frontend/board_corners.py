"""Track points with known identities: no search, only the check that they agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.types import NamedPoints, RectifiedCamera, RefusedFrame
from barsight.features.guided_matching import PredictedMotion, triangulate_stereo
from barsight.motion.frontend.relative_pose import ransac, refine_pose
from barsight.motion.frontend.stereo_features import OdometrySettings
from barsight.motion.frontend.tracking import Sighting
from barsight.recording.formats.board_corners import CornerRecording

TURN = 7
SIGMA_PX = 0.3
"""A corner's noise to begin with; the estimate scales it to what the residuals show."""
MAX_OFF_ROW_PX = 2.0
MIN_POINTS = 12
MAX_FRAMES = 20
"""A point takes a new name after so many frames, since the estimate's work grows with the longest track's
square. Points change their names by turns: neighbouring frames always share most of them."""


def track_named_points(
    recording: CornerRecording, rectifier: Rectifier, rough: OdometrySettings, advance: Callable[[], None]
) -> tuple[tuple[Sighting, ...], tuple[RefusedFrame, ...]]:
    """Track points of all frames that share enough of them with the one before; the others are refused."""
    settings = replace(rough, min_inliers=MIN_POINTS)
    sightings: list[Sighting] = []
    refused: list[RefusedFrame] = []
    for points in recording.points():
        advance()
        seen = _sighting(points, rectifier)
        if sightings and isinstance(seen, Sighting):
            seen = _tied(sightings[-1], seen, rectifier, settings)
        if isinstance(seen, Failed):
            refused.append(RefusedFrame(points.stamp_ns, seen.reason))
        else:
            sightings.append(seen)
    return _renamed(sightings), tuple(refused)


def _renamed(sightings: list[Sighting]) -> tuple[Sighting, ...]:
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
    """Estimate the new sighting's motion since the old one, without the points that don't follow it."""
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
    """Fit the motion to all points, starting from rest: a flat board has a mirrored one that fits almost as
    well, which three points at a time can't tell apart.
    """
    matrix = np.array([[camera.focal_px, 0, camera.cx_px], [0, camera.focal_px, camera.cy_px], [0, 0, 1]])
    turn, way = np.zeros(3), np.zeros(3)
    _, turn, way = cv2.solvePnP(
        points, np.ascontiguousarray(pixels), matrix, None, turn, way, True, cv2.SOLVEPNP_ITERATIVE
    )
    return Rotation.from_rotvec(turn.ravel()).as_matrix(), way.ravel()
