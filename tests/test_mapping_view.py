"""One frame's way to the map: which columns are matched, and that this changes no depth."""

import numpy as np
import pytest

from barsight.calibration.rectification import Rectifier
from barsight.core.timing import Stopwatch
from barsight.core.types import Disparity, DisparityRange, RectifiedPair, StereoFrame
from barsight.mapping.view import Matched, Matcher
from barsight.stereo.method import StereoMethod
from barsight.stereo.points import triangulate
from barsight.stereo.settings import StereoSettings, make_method
from motion_recordings import ideal_rig
from synthetic_scenes import slanted_pair


def matched(method: StereoMethod, lowest_px: int, highest_px: int) -> Matched:
    pair, _ = slanted_pair()
    settings = StereoSettings(
        lowest_disparity_px=lowest_px, highest_disparity_px=highest_px, gap_darkness=0.0
    )
    rectifier = Rectifier(ideal_rig(240, 160))
    found = Matcher(settings, method, rectifier, Stopwatch())(StereoFrame(1, pair.left, pair.right))
    assert isinstance(found, Matched)
    return found


@pytest.mark.parametrize(("lowest_px", "cut"), [(-8, 0), (16, 16)])
def test_a_method_sees_the_columns_that_a_candidate_leads_to(lowest_px: int, cut: int) -> None:
    seen: list[RectifiedPair] = []

    def method(pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        assert (candidates.lowest_px, candidates.highest_px) == (lowest_px - cut, 40 - cut)
        seen.append(pair)
        return Disparity(
            np.full_like(pair.left, 21 - cut, np.float32), np.full_like(pair.left, 0.1, np.float32)
        )

    found = matched(method, lowest_px, 40)
    np.testing.assert_array_equal(seen[0].left, found.pair.left[:, cut:])
    np.testing.assert_array_equal(seen[0].right, found.pair.right[:, : 240 - cut])
    assert np.isnan(found.disparity.disparity_px[:, :cut]).all()
    np.testing.assert_array_equal(found.disparity.disparity_px[:, cut:], 21)
    narrow = triangulate(seen[0], method(seen[0], DisparityRange(lowest_px - cut, 40 - cut)), 0.05)
    np.testing.assert_allclose(triangulate(found.pair, found.disparity, 0.05).xyz_m, narrow.xyz_m, rtol=1e-6)


@pytest.mark.parametrize("lowest_px", [-8, 16])
def test_disparities_are_the_whole_pictures(lowest_px: int) -> None:
    found = matched(make_method(StereoSettings(method="sgbm")), lowest_px, 40).disparity.disparity_px
    error = np.abs(found - slanted_pair()[1])[:, 30:]
    assert np.isfinite(error).mean() > 0.95
    assert np.nanmedian(error) < 0.15
