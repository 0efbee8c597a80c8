"""Bars of 20, 40 and 90 mm: predictions that are bars off are refused, and pictures alone don't take them."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from bar_pictures import CAMERA, bar_view
from barsight.core.errors import Failed
from barsight.features.guided_matching import GuidedMatches, PredictedMotion
from barsight.features.patch_alignment import PatchPair, patch_pair
from barsight.features.tracks import Tracks, TrackSettings, update_tracks
from barsight.motion.frontend.motion_consensus import motion_consensus
from barsight.motion.frontend.relative_pose import estimate_step
from barsight.motion.frontend.settings import FrontEndSettings
from barsight.motion.frontend.stereo_features import FeatureView
from barsight.motion.frontend.tracking import describe_corners
from barsight.stereo.search_range import coarse_disparity

WAY_M = 0.5


@lru_cache
def views(pitch_m: float, contrast: float) -> tuple[Tracks, PatchPair]:
    return followed(bar_view(pitch_m, 0.0, contrast)), bar_view(pitch_m, WAY_M, contrast, seed=9)


def followed(old: PatchPair) -> Tracks:
    none = np.zeros(0, np.bool_)
    nothing = GuidedMatches(np.empty((0, 3)), np.empty(0), none, none)
    coarse = coarse_disparity(old.pair.left, old.pair.right, CAMERA.doffs_px)
    return update_tracks(Tracks(), old, nothing, none, coarse, TrackSettings())


def moved(pitch_m: float, contrast: float, bars_off: float, sure_m: float) -> float | Failed:
    """The way that is found (m) from a prediction that is some bars off, good to `sure_m` as it says."""
    tracks, new = views(pitch_m, contrast)
    covariance = np.diag([3e-4] * 3 + [sure_m] * 3) ** 2
    predicted = PredictedMotion(np.eye(3), np.array([-WAY_M - bars_off * pitch_m, 0, 0]), covariance)
    found = motion_consensus(tracks, new, predicted, FrontEndSettings())
    return found if isinstance(found, Failed) else -float(found[2].translation[0])


@pytest.mark.parametrize("contrast", [12.0, 6.0])
@pytest.mark.parametrize("pitch_m", [0.02, 0.04, 0.09])
def test_bars_off_is_refused(pitch_m: float, contrast: float) -> None:
    for bars_off in (1, -1, 2, -2):
        for sure_m in (0.002, pitch_m / 9):
            assert isinstance(moved(pitch_m, contrast, bars_off, sure_m), Failed)


@pytest.mark.parametrize("contrast", [12.0, 6.0])
@pytest.mark.parametrize("pitch_m", [0.04, 0.09])
def test_the_true_place_is_followed(pitch_m: float, contrast: float) -> None:
    way = moved(pitch_m, contrast, 0, 0.002)
    assert not isinstance(way, Failed)
    assert abs(way - WAY_M) < 1e-3


@pytest.mark.parametrize("pitch_m", [0.02, 0.04, 0.09])
def test_a_prediction_as_coarse_as_the_bars_is_refused(pitch_m: float) -> None:
    """Also the true one: nothing would tell the bars apart."""
    for bars_off in (0, 1, -1):
        refused = moved(pitch_m, 12.0, bars_off, pitch_m / 3)
        assert isinstance(refused, Failed)
        assert "can't be told from the next bar's" in refused.reason


@pytest.mark.slow
def test_the_motion_that_thick_bars_show_tells_thin_ones_apart() -> None:
    """The prediction is fine enough for 90 mm in the lower half only; points on 40 mm above are found too."""
    old, new = (half_and_half(0.04, 0.09, x_m, seed) for x_m, seed in ((0.0, 0), (WAY_M, 9)))
    tracks = followed(old)
    covariance = np.diag([3e-4] * 3 + [0.007] * 3) ** 2
    predicted = PredictedMotion(np.eye(3), np.array([-WAY_M - 0.003, 0, 0]), covariance)
    found = motion_consensus(tracks, new, predicted, FrontEndSettings())
    assert not isinstance(found, Failed)
    kept, matches, motion = found
    assert abs(motion.translation[0] + WAY_M) < 1e-3
    assert not matches.ambiguous.any()
    above = tracks.stereo[:, 1] < CAMERA.height / 2 - 20
    assert kept[above].sum() > 0.6 * (above & (tracks.stereo[:, 0] > WAY_M * 150 + 10)).sum() > 50
    off = matches.stereo[kept, 0] - tracks.stereo[kept, 0]
    depth = CAMERA.focal_px * CAMERA.baseline_m / (tracks.stereo[kept, 0] - tracks.stereo[kept, 2])
    assert np.abs(off * depth / CAMERA.focal_px + WAY_M).max() < 0.01


def half_and_half(above_m: float, below_m: float, x_m: float, seed: int) -> PatchPair:
    above, below = bar_view(above_m, x_m, seed=seed).pair, bar_view(below_m, x_m, seed=seed).pair
    middle = CAMERA.height // 2
    left = np.vstack([above.left[:middle], below.left[middle:]])
    right = np.vstack([above.right[:middle], below.right[middle:]])
    return patch_pair(replace(above, left=left, right=right))


@pytest.mark.parametrize(
    ("pitch_m", "contrast"),
    [
        (0.02, 6.0),
        (0.09, 12.0),
        *(
            pytest.param(*bars, marks=pytest.mark.slow)
            for bars in [(0.02, 12.0), (0.04, 12.0), (0.04, 6.0), (0.09, 6.0)]
        ),
    ],
)
def test_pictures_alone_find_the_right_bar(pitch_m: float, contrast: float) -> None:
    """Standing still, there and back, far; bars of three pixels may be refused."""
    settings = FrontEndSettings()
    old = describe_corners(bar_view(pitch_m, 0.0, contrast), settings)
    for way in (0.0, WAY_M, -WAY_M, 1.0):
        new = describe_corners(bar_view(pitch_m, way, contrast, seed=9), settings)
        assert isinstance(old, FeatureView)
        assert isinstance(new, FeatureView)
        step = estimate_step(old, new, settings.rough)
        if isinstance(step, Failed):
            assert pitch_m == 0.02
        else:
            assert abs(step.translation[0] + way) < pitch_m / 8
