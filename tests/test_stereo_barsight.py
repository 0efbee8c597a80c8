"""Our own stereo against truth: sub-pixel error, pixel locking, sigma, gloss, bad input, Middlebury."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.core.errors import ConfigError
from barsight.core.records.disparity import DisparityRange
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair
from barsight.stereo.direct.confidence import vertical_error_px
from barsight.stereo.direct.kernels.cubic_spline import row_coefficients, value_and_slope
from barsight.stereo.direct.pipeline import BarsightSettings, BarsightStereo
from barsight.stereo.direct.refinement import RefinementSettings
from barsight.stereo.settings import StereoSettings, make_method
from barsight.stereo.sgbm import Sgbm, SgbmSettings

DATA = Path(os.environ.get("BARSIGHT_DATA", Path(__file__).parents[2] / "shared" / "data"))
HEIGHT, WIDTH = 240, 360
RANGE = DisparityRange(32, 64)
BEST = BarsightStereo(BarsightSettings(fill_occlusions=False))
FAST = BarsightStereo(BarsightSettings(fill_occlusions=False, preset="fast"))
presets = pytest.mark.parametrize("method", [BEST, FAST], ids=["best", "fast"])
Shape = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _pair(left: np.ndarray, right: np.ndarray) -> RectifiedPair:
    images = [np.rint(image).clip(0, 255).astype(np.uint8) for image in (left, right)]
    valid = np.ones(left.shape, dtype=np.bool_)
    camera = RectifiedCamera(
        1000.0, left.shape[1] / 2, left.shape[0] / 2, 0.5, 0.0, left.shape[1], left.shape[0]
    )
    return RectifiedPair(0, images[0], images[1], valid, valid, camera)


def _render(
    shape: Shape, seed: int, noise: float = 2.0, gain: float = 1.0, shift_rows: float = 0.0
) -> tuple[RectifiedPair, np.ndarray]:
    """A surface painted with texture that is known between the pixels, and the left image's disparity."""
    rng = np.random.default_rng(seed)
    fine = 4
    size = (HEIGHT * fine, (WIDTH + 80) * fine)
    texture = 110 + 14 * sum(
        share * _unit(cv2.GaussianBlur(rng.standard_normal(size).astype(np.float32), (0, 0), blur * fine))
        for share, blur in ((1.0, 1.0), (0.6, 4.0))
    )
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)

    def read(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return cv2.remap(
            texture, (x * fine).astype(np.float32), (y * fine).astype(np.float32), cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REFLECT,
        )  # fmt: skip

    seen = columns + shape(columns, rows)
    for _ in range(40):
        seen = columns + shape(seen, rows)
    left, right = read(columns, rows), read(seen, rows + shift_rows) * gain + 8 * (gain - 1)
    left, right = (image + noise * rng.standard_normal(image.shape) for image in (left, right))
    return _pair(left, right), shape(columns, rows)


def _unit(image: np.ndarray) -> np.ndarray:
    return image / image.std()


def _plane(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 40 + 0.02 * x + 0.011 * y


def _inner(truth: np.ndarray) -> np.ndarray:
    columns = np.arange(WIDTH)[None, :]
    inner = columns - truth > 4
    inner[:5] = inner[-5:] = False
    inner[:, -5:] = False
    return inner


@presets
@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_tilted_plane_error_and_locking(method: BarsightStereo, gain: float) -> None:
    pair, truth = _render(_plane, seed=1, gain=gain)
    found = method(pair, RANGE).disparity_px
    inner = _inner(truth)
    assert np.isfinite(found[inner]).mean() > 0.99
    error = found - truth
    assert np.nanmedian(np.abs(error[inner])) < 0.025
    fraction = truth % 1
    waves = [np.nanmedian(error[inner & (np.floor(fraction * 10) == tenth)]) for tenth in range(10)]
    assert np.ptp(waves) < 0.02
    assert abs(np.mean(waves)) < 0.005


def test_sgbm_is_locked_on_the_same_plane() -> None:
    """The guard of the test above: the scene does show pixel locking."""
    pair, truth = _render(_plane, seed=1)
    error = Sgbm(SgbmSettings())(pair, RANGE).disparity_px - truth
    inner = _inner(truth)
    waves = [np.nanmedian(error[inner & (np.floor(truth % 1 * 10) == tenth)]) for tenth in range(10)]
    assert np.ptp(waves) > 0.1


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_sigma_is_right_on_a_plane(noise: float) -> None:
    within = []
    for seed in (2, 3):
        pair, truth = _render(_plane, seed=seed, noise=noise)
        found = BEST(pair, RANGE)
        share = (np.abs(found.disparity_px - truth) / found.sigma_px)[_inner(truth)]
        within.append(((share < 1).mean(), (share < 2).mean()))
    one, two = np.mean(within, axis=0)
    assert 0.62 < one < 0.84
    assert 0.93 < two < 0.997  # with little noise what else may be wrong rules


def test_error_falls_with_noise_towards_the_bound() -> None:
    """Within a factor of two of Cramer and Rao for the support's Gaussian weight on this texture."""
    pair, truth = _render(_plane, seed=4, noise=3.0)
    found = BarsightStereo(BarsightSettings(refinement=RefinementSettings(short_px=0.0, gloss_px=0.0)))(
        pair, RANGE
    )
    inner = _inner(truth)
    clean = _render(_plane, seed=4, noise=0.0)[0].left.astype(np.float32)
    _, slope = value_and_slope(row_coefficients(clean), np.zeros_like(clean))
    # A Gaussian support of 16 x 1.5 px hears as much as 4 pi 16 * 1.5 pixels in full.
    bound = np.sqrt(2 * 3.0**2 / (4 * np.pi * 16 * 1.5 * float((slope**2).mean())))
    spread = np.percentile(np.abs(found.disparity_px - truth)[inner], 68.3)
    assert bound / 1.3 < spread < 2 * bound


def test_a_highlight_along_the_bar_does_not_bend_the_disparity() -> None:
    """A bright line along the bar, 0.8 px behind: taken off, the bias is a fraction of the kept one."""
    pair, truth = _render(lambda x, y: 0 * x + 41.3, seed=5, noise=1.0)
    columns = np.arange(WIDTH, dtype=np.float64)[None, :]

    def highlight(shift_px: float) -> np.ndarray:
        return 60 * np.exp(-0.5 * ((columns + shift_px - np.round((columns + shift_px) / 24) * 24) / 3) ** 2)

    glossy = _pair(pair.left * 0.7 + highlight(0.0), pair.right * 0.7 + highlight(41.3 - 0.8))
    inner = _inner(truth)

    def bias(settings: RefinementSettings) -> float:
        found = BarsightStereo(BarsightSettings(refinement=settings))(glossy, RANGE).disparity_px
        return float(np.nanmedian((found - truth)[inner]))

    kept, taken_off = bias(RefinementSettings(gloss_px=0.0)), bias(RefinementSettings())
    assert kept < -0.15
    assert abs(taken_off) < 0.25 * abs(kept)


def test_hidden_pixels_stay_empty_or_are_filled_with_large_sigma() -> None:
    def box(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where((x > 150) & (x < 250), 52.0, 38.0)

    rng = np.random.default_rng(6)
    wide = 120 + 30 * _unit(cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH + 100)), (0, 0), 1.0))
    front = 120 + 30 * _unit(cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH)), (0, 0), 1.0))
    left, right = wide[:, :WIDTH].copy(), wide[:, 38 : 38 + WIDTH].copy()
    left[:, 151:250], right[:, 151 - 52 : 250 - 52] = front[:, 151:250], front[:, 151:250]
    pair = _pair(left, right)
    hidden = (slice(10, -10), slice(139, 149))
    sparse = BEST(pair, RANGE)
    assert np.isfinite(sparse.disparity_px[hidden]).mean() < 0.2
    dense = BarsightStereo(BarsightSettings(fill_occlusions=True))(pair, RANGE)
    assert np.isfinite(dense.disparity_px).mean() > 0.999
    assert np.abs(dense.disparity_px[hidden] - 38).mean() < 1
    assert np.median(dense.sigma_px[hidden]) >= 1
    columns = np.arange(WIDTH)[None, :].repeat(HEIGHT, axis=0)
    seen = (columns > 70) & ~((columns > 130) & (columns < 151))
    assert (np.abs(dense.disparity_px - box(columns, columns))[seen] > 1).mean() < 0.01


def test_vertical_error_sees_a_vertical_shift_and_nothing_on_a_clean_pair() -> None:
    pair, truth = _render(_plane, seed=7)
    matched = _inner(truth)
    assert vertical_error_px(pair.left, pair.right, truth.astype(np.float32), matched) < 0.02
    off, truth = _render(_plane, seed=7, shift_rows=0.3)
    seen = vertical_error_px(off.left, off.right, truth.astype(np.float32), matched)
    assert seen == pytest.approx(0.3 * 1.4826, rel=0.25), "a constant shift is read as a spread"
    assert vertical_error_px(pair.left, pair.right, truth.astype(np.float32), np.zeros_like(matched)) == 0


@presets
@pytest.mark.parametrize("gray", [0, 128, 255])
def test_an_image_without_contrast_gives_nothing(method: BarsightStereo, gray: int) -> None:
    flat = np.full((60, 90), gray, dtype=np.uint8)
    found = method(_pair(flat, flat), DisparityRange(0, 16))
    assert np.isnan(found.disparity_px).all()
    assert np.isnan(found.sigma_px).all()


@presets
@pytest.mark.parametrize("size", [(48, 48), (16, 20), (5, 7), (2, 2)])
def test_tiny_images_and_ranges_wider_than_the_image(method: BarsightStereo, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(8)
    left = rng.integers(0, 255, size)
    for candidates in (DisparityRange(0, 16), DisparityRange(-500, 500), DisparityRange(900, 1000)):
        found = method(_pair(left, np.roll(left, -1, axis=1)), candidates)
        assert found.disparity_px.shape == size
        assert found.disparity_px.dtype == found.sigma_px.dtype == np.float32
        assert np.array_equal(np.isnan(found.disparity_px), np.isnan(found.sigma_px))


def test_nothing_is_matched_where_an_image_is_invalid() -> None:
    pair, truth = _render(_plane, seed=9)
    left_valid, right_valid = pair.left_valid.copy(), pair.right_valid.copy()
    left_valid[:40] = False
    right_valid[-40:] = False
    found = BEST(replace(pair, left_valid=left_valid, right_valid=right_valid), RANGE).disparity_px
    assert np.isnan(found[:40]).all()
    assert np.isnan(found[-40:]).all()
    assert np.isfinite(found[_inner(truth)]).mean() > 0.6


def test_the_same_pair_gives_the_same_disparity() -> None:
    pair, _ = _render(_plane, seed=10)
    first, second = BEST(pair, RANGE), BEST(pair, RANGE)
    assert np.array_equal(first.disparity_px, second.disparity_px, equal_nan=True)
    assert np.array_equal(first.sigma_px, second.sigma_px, equal_nan=True)


def test_settings_are_checked_and_make_the_method() -> None:
    assert isinstance(make_method(StereoSettings(method="barsight")), BarsightStereo)
    with pytest.raises(ConfigError, match="max_sigma_px"):
        BarsightSettings(max_sigma_px=0)
    with pytest.raises(ConfigError, match="must be at least 0"):
        BarsightSettings(island_px=-1)
    with pytest.raises(ConfigError, match="window_px"):
        RefinementSettings(window_px=20)
    with pytest.raises(ConfigError, match="steps"):
        RefinementSettings(steps=-1)


@pytest.mark.skipif(not (DATA / "middlebury").is_dir(), reason="the Middlebury scenes are absent")
def test_middlebury() -> None:
    """Bad-0.5 and bad-1 of all four scenes, missing counted; visible pixels where a mask says which."""
    dense = BarsightStereo(BarsightSettings(fill_occlusions=True))
    bad = []
    for folder in sorted((DATA / "middlebury").iterdir()):
        left, right = (
            cv2.imread(str(folder / f"{side}.png"), cv2.IMREAD_GRAYSCALE) for side in ("left", "right")
        )
        truth = cv2.imread(str(folder / "disp.pfm"), cv2.IMREAD_UNCHANGED)
        counted = np.isfinite(truth)
        if (folder / "nonocc.png").is_file():
            counted &= cv2.imread(str(folder / "nonocc.png"), cv2.IMREAD_GRAYSCALE) > 0
        found = dense(_pair(left, right), DisparityRange(0, int(np.nanmax(truth[counted])) // 16 * 16 + 16))
        error = np.abs(found.disparity_px - truth)[counted]
        bad.append([100 * (~(error <= threshold)).mean() for threshold in (0.5, 1.0)])
        assert np.isfinite(found.disparity_px[counted]).mean() > 0.98
    half, one = np.mean(bad, axis=0)
    assert half < 9.0
    assert one < 5.0


def test_guesses_stop_where_the_left_image_is_invalid() -> None:
    pair, _ = _render(_plane, seed=9)
    left_valid = pair.left_valid.copy()
    left_valid[:40] = False
    found = BarsightStereo(BarsightSettings())(replace(pair, left_valid=left_valid), RANGE)
    assert np.isnan(found.disparity_px[:40]).all() and np.isnan(found.sigma_px[:40]).all()
    assert np.isfinite(found.disparity_px[40:]).all()
