"""The peers as methods: synthetic pairs with known disparity, bad input, and Middlebury's scenes."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.benchmarks.stereo.middlebury_scenes import load_scenes
from barsight.benchmarks.stereo.scores import StereoScore, score_disparity
from barsight.core.errors import ConfigError
from barsight.core.records.disparity import DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.stereo.baselines.census import Census, CensusSettings
from barsight.stereo.baselines.csca import Csca, CscaSettings
from barsight.stereo.baselines.nonlocal_aggregation import Nonlocal, NonlocalSettings
from barsight.stereo.baselines.paper import Paper, PaperSettings
from barsight.stereo.baselines.postprocessing import OutputSettings
from barsight.stereo.image_pair import pair_from_images
from barsight.stereo.method import StereoMethod
from barsight.stereo.settings import StereoSettings, make_method
from barsight.stereo.sgbm import Sgbm, SgbmSettings

DATA = Path(os.environ.get("BARSIGHT_DATA", Path(__file__).parents[2] / "shared" / "data")) / "middlebury"
METHODS: dict[str, StereoMethod] = {
    "csca": Csca(CscaSettings()),
    "csca-tree": Csca(CscaSettings(aggregation="tree")),
    "nonlocal": Nonlocal(NonlocalSettings()),
    "census": Census(CensusSettings()),
    "paper": Paper(PaperSettings()),
    "paper-census": Paper(PaperSettings(initial="census")),
}
every_method = pytest.mark.parametrize("name", METHODS)


def _pair(disparity_px: np.ndarray, seed: int = 0) -> RectifiedPair:
    """A textured pair whose left image shows `disparity_px` (slowly varying) exactly."""
    height, width = disparity_px.shape
    rng = np.random.default_rng(seed)
    wide = cv2.GaussianBlur(rng.normal(128, 260, (height, width + 128)), (0, 0), 1.2).astype(np.float32)
    rows = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, 1)
    columns = np.repeat(np.arange(width, dtype=np.float32)[None, :], height, 0) + 64
    right = wide[:, 64 : 64 + width]
    left = cv2.remap(wide, columns - disparity_px.astype(np.float32), rows, cv2.INTER_CUBIC)
    images = [
        (image + rng.normal(0, 1, image.shape)).clip(0, 255).astype(np.uint8) for image in (left, right)
    ]
    return pair_from_images(*images)


@every_method
@pytest.mark.parametrize("shift", [-6, 0, 11])
def test_a_whole_shift_is_found_everywhere_it_can_be_seen(name: str, shift: int) -> None:
    pair = _pair(np.full((60, 110), float(shift)))
    found = METHODS[name](pair, DisparityRange(shift - 9, shift + 8)).disparity_px
    error = np.abs(found[4:-4, 16:-16] - shift)
    assert np.isfinite(error).mean() > 0.98
    assert np.nanpercentile(error, 95) < 0.2


@every_method
def test_a_slanted_plane_is_found_below_a_pixel_and_sigma_covers_it(name: str) -> None:
    truth = np.repeat(np.linspace(8, 14, 160)[None, :], 90, 0) + np.linspace(0, 2, 90)[:, None]
    found = METHODS[name](_pair(truth), DisparityRange(0, 24))
    inner = (slice(6, -6), slice(24, -10))
    error = (found.disparity_px - truth)[inner]
    assert np.nanmedian(np.abs(error)) < 0.3
    assert 0.5 < np.nanmean(np.abs(error) < found.sigma_px[inner]) <= 1


@every_method
def test_black_or_flat_images_have_no_match(name: str) -> None:
    for gray in (0, 130):
        flat = np.full((48, 64), gray, dtype=np.uint8)
        found = METHODS[name](pair_from_images(flat, flat), DisparityRange(0, 16))
        assert np.isnan(found.disparity_px).all() and np.isnan(found.sigma_px).all()
        assert found.disparity_px.dtype == found.sigma_px.dtype == np.float32


@every_method
def test_a_range_beyond_the_image_has_no_match(name: str) -> None:
    pair = _pair(np.full((48, 64), 3.0))
    assert np.isnan(METHODS[name](pair, DisparityRange(70, 100)).disparity_px).all()


@every_method
@pytest.mark.parametrize("shape", [(1, 40), (2, 2), (5, 7), (60, 9), (33, 70)])
def test_small_images_and_odd_ranges_give_disparities_in_range_or_none(
    name: str, shape: tuple[int, int]
) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    pair = pair_from_images(image, np.roll(image, -3, 1))
    for lowest, highest in ((0, 16), (-20, 5), (3, 4), (0, 300), (-300, -290)):
        found = METHODS[name](pair, DisparityRange(lowest, highest))
        known = np.isfinite(found.disparity_px)
        assert found.disparity_px.shape == found.sigma_px.shape == shape
        assert (known == np.isfinite(found.sigma_px)).all()
        inside = (found.disparity_px >= lowest - 0.51) & (found.disparity_px <= highest - 0.49)
        assert inside[known].all()


@every_method
def test_invalid_pixels_of_the_left_image_stay_empty(name: str) -> None:
    pair = _pair(np.full((60, 110), 5.0))
    invalid = np.zeros((60, 110), dtype=bool)
    invalid[20:30, 40:70] = True
    found = METHODS[name](replace(pair, left_valid=~invalid), DisparityRange(0, 16))
    assert np.isnan(found.disparity_px[invalid]).all() and np.isnan(found.sigma_px[invalid]).all()
    assert (np.isnan(found.disparity_px) == np.isnan(found.sigma_px)).all()
    assert np.nanmedian(np.abs(found.disparity_px - 5)) < 0.1


def _with_strip() -> tuple[RectifiedPair, np.ndarray]:
    """A near strip (d = 18) before a far plane (d = 6), and the mask of what it hides on the left."""
    rng = np.random.default_rng(5)
    far = cv2.GaussianBlur(rng.normal(70, 100, (80, 200)), (0, 0), 1.2)
    near = cv2.GaussianBlur(rng.normal(190, 100, (80, 200)), (0, 0), 1.2)
    left, right = far[:, 24:184].copy(), far[:, 30:190].copy()
    left[:, 80:120], right[:, 62:102] = near[:, :40], near[:, :40]
    hidden = np.zeros(left.shape, dtype=bool)
    hidden[:, 68:80] = True
    images = [image.clip(0, 255).astype(np.uint8) for image in (left, right)]
    return pair_from_images(*images), hidden


@pytest.mark.parametrize("name", ["csca", "nonlocal", "census", "paper"])
def test_hidden_pixels_are_filled_with_a_large_sigma_or_left_out(name: str) -> None:
    pair, hidden = _with_strip()
    output = OutputSettings(subpixel_sigma_px=0.2, filled_sigma_px=3.0)
    settings = METHODS[name].settings  # type: ignore[attr-defined]
    kind = type(METHODS[name])
    filled = kind(replace(settings, output=output))(pair, DisparityRange(0, 32))  # type: ignore[call-arg]
    sparse = kind(replace(settings, output=replace(output, fill=False)))(  # type: ignore[call-arg]
        pair, DisparityRange(0, 32)
    )
    inner = np.zeros_like(hidden)
    inner[5:-5, 70:78] = True
    assert np.isfinite(filled.disparity_px[inner]).mean() > 0.9
    if name != "paper":  # The paper's loop doesn't know what lies behind: it spreads what is near.
        assert np.nanmedian(np.abs(filled.disparity_px[inner] - 6)) < 0.5
    assert np.nanmedian(filled.sigma_px[inner]) == pytest.approx(3)
    assert np.isnan(sparse.disparity_px[inner]).mean() > 0.8
    known = np.isfinite(sparse.disparity_px)
    np.testing.assert_array_equal(sparse.disparity_px[known], filled.disparity_px[known])


def test_csca_sees_an_edge_that_only_colour_shows() -> None:
    pair, hidden = _with_strip()
    truth = np.full(hidden.shape, 6)
    truth[:, 80:120] = 18
    dull = [(128 + (image.astype(float) - 128) / 8).astype(np.uint8) for image in (pair.left, pair.right)]
    rng = np.random.default_rng(6)
    gray = [cv2.add(image, rng.integers(0, 8, image.shape).astype(np.uint8)) for image in dull]
    red = [np.zeros_like(pair.left), np.zeros_like(pair.right)]
    red[0][:, 80:120] = red[1][:, 62:102] = 100
    plain = pair_from_images(*gray)
    coloured = pair_from_images(*gray, *(np.dstack([g, g, r]) for g, r in zip(gray, red, strict=True)))
    wrong = [
        (np.abs(METHODS["csca"](one, DisparityRange(0, 32)).disparity_px - truth) > 1)[:, 30:].mean()
        for one in (plain, coloured)
    ]
    assert wrong[1] < 0.2 * wrong[0]


def test_the_papers_loop_smooths_but_does_not_undo_a_bias() -> None:
    """Errata on Eq. 5: away from the truncation the loop is a weighted mean of D."""
    truth = np.full((60, 160), 9.7)
    pair = _pair(truth)
    initial = Sgbm(SgbmSettings(mode="5path"))(pair, DisparityRange(0, 16)).disparity_px[5:-5, 20:-5]
    looped = Paper(PaperSettings())(pair, DisparityRange(0, 16)).disparity_px[5:-5, 20:-5]
    assert np.nanstd(looped) < 0.8 * np.nanstd(initial)
    assert np.nanmean(looped) == pytest.approx(np.nanmean(initial), abs=0.01)


def test_every_name_in_the_settings_makes_its_method() -> None:
    kinds = {"sgbm": Sgbm, "csca": Csca, "nonlocal": Nonlocal, "census": Census, "paper": Paper}
    for name, kind in kinds.items():
        assert type(make_method(StereoSettings(method=name))) is kind  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "make",
    [
        lambda: CscaSettings(regulariser=-1),
        lambda: CscaSettings(radius_px=0),
        lambda: CscaSettings(median_radius_px=0),
        lambda: NonlocalSettings(sigma=0),
        lambda: CensusSettings(rounds=0),
        lambda: CensusSettings(short_arm_px=20),
        lambda: CensusSettings(min_vote_ratio=2),
        lambda: PaperSettings(eta=0),
        lambda: PaperSettings(max_rounds=0),
        lambda: OutputSettings(filled_sigma_px=-1),
    ],
)
def test_settings_out_of_range_are_refused(make: object) -> None:
    with pytest.raises(ConfigError):
        make()  # type: ignore[operator]


@pytest.fixture(scope="module")
def middlebury() -> dict[str, StereoScore]:
    """Mean scores over the four scenes."""
    if not DATA.is_dir():
        pytest.skip(f"{DATA} is absent")
    scenes = load_scenes(DATA)
    methods = {**METHODS, "sgbm": Sgbm(SgbmSettings())}
    means = {}
    for name in ("sgbm", "csca", "nonlocal", "census"):
        scores = [
            score_disparity(methods[name](scene.pair, scene.candidates), scene.truth_px, scene.counted)
            for scene in scenes
        ]
        fields = StereoScore.__dataclass_fields__
        means[name] = StereoScore(
            **{key: float(np.mean([getattr(s, key) for s in scores])) for key in fields}
        )
    return means


@pytest.mark.slow
def test_csca_comes_near_its_authors_program(middlebury: dict[str, StereoScore]) -> None:
    """Theirs has 6.2 %."""
    assert middlebury["csca"].counted_bad1_pct < 6.2 + 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nonlocal", "census"])
def test_tree_and_census_keep_up_with_sgbm(middlebury: dict[str, StereoScore], name: str) -> None:
    assert middlebury[name].counted_bad2_pct < 1.5 * middlebury["sgbm"].counted_bad2_pct
    assert middlebury[name].bad2_pct < 1.5 * middlebury["sgbm"].bad2_pct
