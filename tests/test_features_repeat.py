"""Patterns that repeat along the rows, and predictions that are one bar off."""

from pathlib import Path

import numpy as np
import pytest

from barsight.benchmarks.motion.matching import stereo_places
from barsight.benchmarks.motion.matching_truth import TrueStep, true_steps
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.features.guided_matching import PredictedMotion, triangulate_stereo
from barsight.features.self_similarity import texture_period_px
from barsight.features.tracks import Tracks, TrackSettings, detect_corners
from barsight.motion.frontend.motion_consensus import motion_consensus
from barsight.motion.frontend.settings import FrontEndSettings

PLACES = np.array([[60.0, 50], [250, 200], [600, 470]])


@pytest.mark.parametrize("pitch", [12.0, 19.0, 53.0])
def test_the_pitch_of_bars(pitch: float) -> None:
    rng = np.random.default_rng(0)
    x = np.arange(640)
    bars = 110 + 50 * np.abs(np.sin(np.pi * x / pitch)) + 20 * np.cos(x / 200)
    image = (bars[None] + rng.normal(0, 6, (512, 640))).clip(0, 255).astype(np.uint8)
    np.testing.assert_allclose(texture_period_px(image, PLACES), pitch, atol=1)


def test_what_doesnt_repeat() -> None:
    rng = np.random.default_rng(1)
    for image in (rng.integers(0, 255, (512, 640), np.uint8), np.full((512, 640), 90, np.uint8)):
        assert np.isinf(texture_period_px(image, PLACES)).all()


def followed(off_m: float, tracks: Tracks, step: TrueStep, true: Pose, sure: Float64) -> bool:
    way = true.translation / np.linalg.norm(true.translation)
    motion = PredictedMotion(true.rotation, true.translation + off_m * way, sure)
    return not isinstance(motion_consensus(tracks, step.new, motion, FrontEndSettings()), Failed)


def test_a_prediction_that_is_one_bar_off_is_refused(data: Path) -> None:
    """The true motion is followed; 60 to 180 mm beside it nothing is."""
    for step in true_steps(data / "yard_dev"):
        corners = detect_corners(step.old.pair.left, TrackSettings(), np.empty((0, 2))).astype(np.float64)
        stereo, sigma, known = stereo_places(step.old, corners)
        index = np.flatnonzero(known)
        stereo, depth = stereo[index], triangulate_stereo(stereo[index], step.rectifier.camera)[:, 2]
        tracks = Tracks(
            (step.old.left,), step.old.pair, index, stereo, sigma[index], 0 * index, stereo[:, :2], depth
        )
        true = step.yard_from_new.inverse() @ step.yard_from_old
        sure = np.diag([6e-4, 6e-4, 6e-4, 3e-3, 3e-3, 3e-3]) ** 2

        assert followed(0.0, tracks, step, true, sure)
        assert not any(
            followed(sign * size, tracks, step, true, sure) for size in (0.06, 0.09, 0.18) for sign in (1, -1)
        )
