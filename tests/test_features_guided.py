"""Guided matching: found in the ellipse, refused outside it, ambiguous where the bars repeat within it."""

import cv2
import numpy as np

from barsight.core.records.pairs import RectifiedCamera, RectifiedPair
from barsight.features.guided_matching import (
    PredictedMotion,
    match_guided,
    predict_projections,
    project_stereo,
)
from barsight.features.patch_alignment import PatchPair, patch_pair

CAMERA = RectifiedCamera(300.0, 160.0, 120.0, 0.4, 0.0, 320, 240)
DEPTH_M = 6.0


def wall(shift_px: float) -> PatchPair:
    """A textured wall at 6 m (disparity 20 px), moved along the rows."""
    noise = np.random.default_rng(5).integers(0, 255, (240, 400)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 2.0)
    texture = cv2.normalize(texture, None, 20, 235, cv2.NORM_MINMAX)

    def seen(offset: float) -> np.ndarray:
        matrix = np.array([[1, 0, offset - 30], [0, 1, 0]], np.float32)
        moved = cv2.warpAffine(texture, matrix, (320, 240), flags=cv2.INTER_CUBIC)
        return moved.clip(0, 255).astype(np.uint8)

    whole = np.ones((240, 320), np.bool_)
    return patch_pair(RectifiedPair(0, seen(shift_px), seen(shift_px - 20), whole, whole, CAMERA))


def test_found_refused_and_ambiguous() -> None:
    x, y = np.meshgrid(np.arange(-1.5, 1.6, 0.5), np.arange(-1.5, 1.6, 0.5))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, DEPTH_M)])
    places = project_stereo(points, CAMERA)[:, :2]
    depth, source = points[:, 2], wall(0).left
    shift_m = np.array([7.3 * DEPTH_M / 300, 0, 0])
    fine = np.eye(6) * 1e-6
    fine[3:, 3:] = np.eye(3) * 0.005**2
    right = predict_projections(points, 0.2, PredictedMotion(np.eye(3), shift_m, fine), CAMERA)
    matches = match_guided(source, places, depth, wall(7.3), right, 0.2)
    assert matches.found.mean() > 0.9
    error = matches.stereo[matches.found, 0] - places[matches.found, 0] - 7.3
    assert np.abs(error).max() < 0.1
    off = predict_projections(
        points, 0.05, PredictedMotion(np.eye(3), shift_m + np.array([0.12, 0, 0]), fine * 1e-2), CAMERA
    )
    assert not match_guided(source, places, depth, wall(7.3), off, 0.2).found.any()
    repeat = match_guided(source, places, depth, wall(7.3), right, 0.2, np.full(len(points), 1.0))
    assert repeat.ambiguous.all()
    assert not repeat.found.any()
