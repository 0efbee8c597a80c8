"""SGBM on a slanted plane whose sub-pixel disparities are known, and on what can't be matched."""

from dataclasses import replace

import numpy as np
import pytest

from barsight.core.errors import ConfigError
from barsight.core.records.disparity import DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.stereo.noise import image_noise
from barsight.stereo.sgbm import Sgbm, SgbmSettings
from synthetic_scenes import camera, slanted_pair

MATCH = Sgbm(SgbmSettings())


@pytest.mark.parametrize("mode", ["3way", "5path", "8path", "hh4"])
def test_a_slanted_plane(mode: str) -> None:
    pair, truth = slanted_pair()
    found = Sgbm(SgbmSettings(mode=mode))(pair, DisparityRange(16, 32))
    error = (found.disparity_px - truth)[4:-4]
    seen = np.arange(240) - truth[4:-4] > 4
    assert np.isfinite(error[seen]).mean() > 0.98
    assert np.nanmedian(np.abs(error)) < 0.15
    assert np.nanpercentile(np.abs(error), 99) < 0.5
    assert abs(np.nanmean(error)) < 0.03


@pytest.mark.parametrize(
    ("start_px", "candidates"),
    [(20.3, DisparityRange(16, 37)), (-25.3, DisparityRange(-30, -9)), (-6.3, DisparityRange(-20, 20))],
)
def test_the_borders_are_matched(start_px: float, candidates: DisparityRange) -> None:
    """Whichever way the disparities run, and whether or not there are 16 n candidates: all that both images
    see has a match.
    """
    pair, truth = slanted_pair(start_px=start_px)
    found = MATCH(pair, candidates).disparity_px
    column = np.arange(240) - truth
    both = (column > 4) & (column < 235)
    both[:4] = both[-4:] = both[:, :4] = both[:, -4:] = False
    assert np.isfinite(found[both]).mean() > 0.97
    landed = (np.arange(240) - found)[np.isfinite(found)]
    assert landed.min() >= 0
    assert landed.max() <= 239


def test_no_match_outside_the_candidates() -> None:
    """A plane that leaves the range is matched up to the range's end and no further."""
    pair, truth = slanted_pair(slope=(0.1, 0.0))
    found = MATCH(pair, DisparityRange(20, 36)).disparity_px
    known = np.isfinite(found)
    assert found[known].min() >= 20
    assert found[known].max() <= 35
    found = MATCH(pair, DisparityRange(20, 30)).disparity_px
    known = np.isfinite(found)
    assert found[known].max() <= 29
    both_see = np.arange(240) - truth > 4
    assert known[(truth < 28) & both_see].mean() > 0.95


def test_sigma_covers_the_error() -> None:
    pair, truth = slanted_pair(noise=3.0)
    found = MATCH(pair, DisparityRange(16, 32))
    error = np.abs(found.disparity_px - truth)
    known = np.isfinite(error)
    np.testing.assert_array_equal(known, np.isfinite(found.sigma_px))
    assert (found.sigma_px[known] >= found.bias_sigma_px).all()
    assert 0.9 < (error[known] < 1.96 * found.sigma_px[known]).mean() <= 1


def test_the_masks_are_kept() -> None:
    pair, _ = slanted_pair()
    left_valid, right_valid = np.ones((2, 160, 240), dtype=np.bool_)
    left_valid[50:60, 100:120] = False
    right_valid[80:120, 60:100] = False
    found = MATCH(replace(pair, left_valid=left_valid, right_valid=right_valid), DisparityRange(16, 32))
    assert np.isnan(found.disparity_px[~left_valid]).all()
    whole = MATCH(pair, DisparityRange(16, 32)).disparity_px
    landed = np.floor(np.arange(240) - whole)
    barred = (np.arange(160)[:, None] // 40 == 2) & (landed >= 60) & (landed < 100)
    assert barred.sum() > 1000
    assert np.isnan(found.disparity_px[barred]).all()
    untouched = left_valid & ~barred
    np.testing.assert_array_equal(found.disparity_px[untouched], whole[untouched])
    assert 0 < found.coverage < np.isfinite(whole).mean()


@pytest.mark.parametrize("level", [0, 128, 255])
def test_an_empty_image_has_no_match(level: int) -> None:
    image, valid = np.full((96, 128), level, np.uint8), np.ones((96, 128), dtype=np.bool_)
    found = MATCH(RectifiedPair(1, image, image, valid, valid, camera(128, 96)), DisparityRange(0, 32))
    assert found.coverage == 0


def test_image_noise() -> None:
    rng = np.random.default_rng(0)
    slope = 60 + 0.5 * np.arange(200)[None, :] + 0.2 * np.arange(200)[:, None]
    for noise in (2.0, 5.0):
        image = (slope + rng.normal(0, noise, slope.shape)).round().clip(0, 255).astype(np.uint8)
        assert image_noise(image) == pytest.approx(noise, rel=0.05)
    assert image_noise(np.zeros((50, 50), np.uint8)) == 0.5


def test_noise_of_whole_gray_levels_is_counted_as_it_is_sorted() -> None:
    rng = np.random.default_rng(4)
    for shape in ((3, 3), (4, 9), (50, 51), (101, 200)):
        image = rng.integers(0, 256, shape).astype(np.uint8)
        assert image_noise(image) == image_noise(image.astype(np.float32))
    checks = (255 * (np.indices((60, 61)).sum(axis=0) % 2)).astype(np.uint8)
    assert image_noise(checks) == image_noise(checks.astype(np.float32)) > 300


@pytest.mark.parametrize(
    "setting", [{"block_px": 4}, {"block_px": -1}, {"uniqueness_pct": 101}, {"subpixel_sigma_px": -0.1}]
)
def test_settings_out_of_range_are_refused(setting: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(setting))):
        SgbmSettings(**setting)
