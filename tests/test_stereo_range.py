"""The disparity range found from the images, and what makes it fail."""

from dataclasses import replace

import numpy as np
import pytest

from barsight.core.errors import Failed
from barsight.core.records.disparity import DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.stereo.search_range import coarse_disparity, find_disparity_range, follow_disparity_range
from synthetic_scenes import camera, slanted_pair


@pytest.mark.parametrize(("start_px", "slope"), [(12.4, (0.02, 0.01)), (60.2, (0.05, -0.03)), (90.0, (0, 0))])
def test_the_range_holds_the_truth(start_px: float, slope: tuple[float, float]) -> None:
    pair, truth = slanted_pair(480, 320, start_px, slope)
    found = find_disparity_range(pair)
    assert isinstance(found, DisparityRange)
    assert found.lowest_px <= truth.min()
    assert truth.max() < found.highest_px
    assert found.count % 16 == 0
    assert found.count < np.ptp(truth) + 64
    assert found.lowest_px >= 0


def test_a_followed_range_holds_what_is_predicted_and_what_is_new() -> None:
    pair, truth = slanted_pair(480, 320, 40.0, (0.02, 0.01))
    for known in (truth < np.quantile(truth, 0.7), np.ones(truth.shape, dtype=np.bool_)):
        predicted = np.where(known, truth, np.nan).astype(np.float32)
        found = follow_disparity_range(pair, predicted)
        assert isinstance(found, DisparityRange)
        assert found.lowest_px <= truth.min()
        assert truth.max() < found.highest_px
        assert found.count <= 48
    predicted[:] = 90
    further = follow_disparity_range(pair, predicted)
    assert isinstance(further, DisparityRange)
    assert further.lowest_px <= truth.min()
    assert further.highest_px > 90
    unknown = np.full(truth.shape, np.nan, dtype=np.float32)
    assert follow_disparity_range(pair, unknown) == find_disparity_range(pair)


def test_converging_cameras_have_disparities_below_zero() -> None:
    """With doffs 70 px depth reaches down to a disparity of -70 px."""
    pair, truth = slanted_pair(480, 320, -30.0, doffs_px=70.0)
    found = find_disparity_range(pair)
    assert isinstance(found, DisparityRange)
    assert -70 <= found.lowest_px <= truth.min()
    assert truth.max() < found.highest_px


def test_the_range_ends_at_infinity() -> None:
    pair, _ = slanted_pair(480, 320, 3.0)
    found = find_disparity_range(pair)
    assert isinstance(found, DisparityRange)
    assert found.lowest_px == 0


@pytest.mark.parametrize("doffs_px", [0.0, 6.0])
def test_swapped_images_are_found_out(doffs_px: float) -> None:
    pair, _ = slanted_pair(480, 320, 40.0, doffs_px=doffs_px)
    found = find_disparity_range(replace(pair, left=pair.right, right=pair.left))
    assert isinstance(found, Failed)
    assert found.code == "swapped"
    assert "swapped" in found.reason


def test_images_without_texture() -> None:
    valid = np.ones((320, 480), dtype=np.bool_)
    noise = np.random.default_rng(0).integers(126, 130, (2, 320, 480), dtype=np.uint8)
    for left, right in (np.zeros((2, 320, 480), np.uint8), noise):
        found = find_disparity_range(RectifiedPair(1, left, right, valid, valid, camera(480, 320)))
        assert isinstance(found, Failed)
        assert found.code == "no-texture"


def test_coarse_disparity() -> None:
    pair, truth = slanted_pair(480, 320, 40.0)
    coarse = coarse_disparity(pair.left, pair.right)
    assert coarse.shape == (80, 120)
    error = coarse - truth[2::4, 2::4]
    assert np.isfinite(error).mean() > 0.75
    assert np.nanpercentile(np.abs(error), 95) < 2


@pytest.mark.parametrize("start_px", [180.0, 200.0, 230.0])
def test_a_surface_nearer_than_usual(start_px: float) -> None:
    """Disparities about and over 40 % of the width, where the search ends at first."""
    pair, truth = slanted_pair(480, 320, start_px, (0.02, 0.05))
    found = find_disparity_range(pair)
    assert isinstance(found, DisparityRange)
    assert found.lowest_px <= np.percentile(truth, 5)
    assert np.percentile(truth, 95) < found.highest_px


def test_saturated_images_are_not_taken_for_swapped() -> None:
    pair, truth = slanted_pair(480, 320, 40.0)
    left, right = pair.left.copy(), pair.right.copy()
    left[:, 140:], right[:, 100:] = 255, 255
    found = find_disparity_range(replace(pair, left=left, right=right))
    assert isinstance(found, DisparityRange)
    assert found.lowest_px <= truth.min() and truth.max() < found.highest_px
    assert np.isnan(coarse_disparity(left, right)[:, 40:]).all()
