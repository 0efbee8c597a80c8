"""Bars of 20, 40 and 90 mm: predictions that are bars off are refused, and pictures alone don't take them."""

from functools import lru_cache

import numpy as np
import pytest

from bar_pictures import CAMERA, bar_view
from barsight.core.errors import Failed
from barsight.features.guided import GuidedMatches, PredictedMotion
from barsight.features.patches import PatchPair
from barsight.features.tracks import Tracks, TrackSettings, carry_on
from barsight.motion.sightings import FrontEndSettings, consensus, look_at_corners
from barsight.motion.step import move
from barsight.motion.views import View
from barsight.stereo.disparity_range import coarse_disparity

WAY_M = 0.5


@lru_cache
def views(pitch_m: float, contrast: float) -> tuple[Tracks, PatchPair]:
    old, new = bar_view(pitch_m, 0.0, contrast), bar_view(pitch_m, WAY_M, contrast, seed=9)
    none = np.zeros(0, np.bool_)
    nothing = GuidedMatches(np.empty((0, 3)), np.empty(0), none, none)
    coarse = coarse_disparity(old.pair.left, old.pair.right, CAMERA.doffs_px)
    return carry_on(Tracks(), old, nothing, none, coarse, TrackSettings()), new


def moved(pitch_m: float, contrast: float, bars_off: float, sure_m: float) -> float | Failed:
    """The way that is found (m) from a prediction that is some bars off, good to `sure_m` as it says."""
    tracks, new = views(pitch_m, contrast)
    covariance = np.diag([3e-4] * 3 + [sure_m] * 3) ** 2
    predicted = PredictedMotion(np.eye(3), np.array([-WAY_M - bars_off * pitch_m, 0, 0]), covariance)
    found = consensus(tracks, new, predicted, FrontEndSettings())
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


@pytest.mark.parametrize("contrast", [12.0, 6.0])
@pytest.mark.parametrize("pitch_m", [0.02, 0.04, 0.09])
def test_pictures_alone_find_the_right_bar(pitch_m: float, contrast: float) -> None:
    """Standing still, there and back, far; bars of three pixels may be refused."""
    settings = FrontEndSettings()
    old = look_at_corners(bar_view(pitch_m, 0.0, contrast), settings)
    for way in (0.0, WAY_M, -WAY_M, 1.0):
        new = look_at_corners(bar_view(pitch_m, way, contrast, seed=9), settings)
        assert isinstance(old, View)
        assert isinstance(new, View)
        step = move(old, new, settings.rough)
        if isinstance(step, Failed):
            assert pitch_m == 0.02
        else:
            assert abs(step.translation[0] + way) < pitch_m / 8
