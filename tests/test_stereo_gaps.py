"""Gaps between bars are unknown; bars of another brightness are not gaps. Bars along the rows that are
matched in pieces are unknown, too.
"""

import numpy as np

from barsight.core.records.disparity import Disparity
from barsight.stereo.masking import gap_mask, mask_disparity, mask_gaps, mask_pieces, streak_mask


def steel(level: float, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 8, (120, 200))
    return np.clip(level + noise, 0, 255)


def test_a_dark_stripe_is_a_gap_and_steel_is_not() -> None:
    image = steel(100)
    image[:, 90:98] = 15
    gap = gap_mask(image.astype(np.uint8), 0.55)
    assert gap[:, 91:97].all()
    assert gap[:, :88].mean() < 0.001 and gap[:, 100:].mean() < 0.001


def test_a_darker_bundle_is_no_gap() -> None:
    image = steel(100)
    image[:, 100:] = steel(60, seed=1)[:, 100:]
    assert gap_mask(image.astype(np.uint8), 0.55).mean() < 0.005


def test_a_black_picture_has_no_gap() -> None:
    assert not gap_mask(np.zeros((60, 60), np.uint8), 0.55).any()


def test_gaps_lose_disparity_and_sigma() -> None:
    image = steel(100).astype(np.uint8)
    image[:, 90:98] = 10
    known = np.full(image.shape, 20, np.float32)
    masked = mask_gaps(Disparity(known, known * 0 + 0.1, 0.05), image, 0.55)
    assert np.isnan(masked.disparity_px[:, 92:96]).all() and np.isnan(masked.sigma_px[:, 92:96]).all()
    assert np.isfinite(masked.disparity_px[:, :80]).all() and masked.bias_sigma_px == 0.05
    assert mask_gaps(masked, image, 0.0) is masked


def streaked(along_rows: bool) -> np.ndarray:
    """A picture (240, 400) of bare ground with a bundle of thin bars in its middle."""
    rng = np.random.default_rng(2)
    image = 100 + rng.normal(0, 8, (240, 400))
    bars = 60 * np.sin(np.arange(300) * 2 * np.pi / 5)
    if along_rows:
        image[70:170, 50:350] += bars[:100, None]
    else:
        image[20:220, 50:350] += bars
    return image.clip(0, 255).astype(np.uint8)


def test_bars_along_the_rows_alone_are_streaks() -> None:
    marked = streak_mask(streaked(along_rows=True))
    assert marked[80:160, 70:330].all()
    assert not marked[:55].any() and not marked[185:].any()
    assert not streak_mask(streaked(along_rows=False)).any()


def test_an_edge_along_the_rows_is_no_streak() -> None:
    image = streaked(along_rows=False)
    image[212:222, 40:360] = 20
    image[222:230, 40:360] = 200
    assert not streak_mask(image).any()


def in_pieces(scatter_px: float) -> tuple[np.ndarray, np.ndarray]:
    """The picture with some of its bars in shadow, and a disparity that is scattered there and has gaps on a
    quarter of the pixels.
    """
    image, known = streaked(along_rows=True), np.full((240, 400), 90, np.float32)
    image[120:150] = 0.4 * image[120:150]
    known[120:150] += np.random.default_rng(4).normal(0, scatter_px, (30, 400)).astype(np.float32)
    known[120:150, 100:300:8], known[120:150, 101:300:8] = np.nan, np.nan
    return image, known


def kept_pieces(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    return np.isfinite(mask_pieces(Disparity(known, known * 0 + 0.1, 0.05), image).disparity_px)


def test_bars_along_the_rows_in_pieces_are_unknown_and_whole_ones_stay() -> None:
    image, known = in_pieces(0.6)
    kept = kept_pieces(image, known)
    assert not kept[122:148, 150:250].any()
    assert kept[80:118, 70:330].all()
    assert (kept_pieces(streaked(along_rows=False), known) == np.isfinite(known)).all()


def test_dark_pieces_at_one_disparity_stay_and_bright_ones_are_unknown() -> None:
    """In the shadow of a flank the floor is matched in places; a highlight shines."""
    image, known = in_pieces(0.1)
    matched = np.isfinite(known)
    assert (kept_pieces(image, known) == matched)[122:148].all()
    crests = np.arange(126, 148, 5)
    assert not kept_pieces(streaked(along_rows=True), known)[crests, 150:250].any()


def test_a_dark_piece_matched_behind_its_bar_is_unknown() -> None:
    image, known = in_pieces(0.05)
    known[120:150, 180:220] -= 4
    kept = kept_pieces(image, known)
    assert not kept[122:148, 165:195].any() and not kept[122:148, 205:235].any()


def test_what_is_kept_keeps_its_bits() -> None:
    rng = np.random.default_rng(5)
    known, sigma = rng.normal(0, 9, (2, 7, 33)).astype(np.float32)
    known[rng.random(known.shape) < 0.2] = np.nan
    kept = rng.random(known.shape) < 0.7
    masked = mask_disparity(Disparity(known, sigma, 0.05), kept)
    np.testing.assert_array_equal(masked.disparity_px, np.where(kept, known, np.nan))
    assert (
        masked.disparity_px.view(np.uint32) == np.where(kept, known, np.float32(np.nan)).view(np.uint32)
    ).all()
    np.testing.assert_array_equal(masked.sigma_px, np.where(kept, sigma, np.nan))
    assert masked.bias_sigma_px == 0.05
