"""Gaps between bars are unknown; bars of another brightness are not gaps."""

import numpy as np

from barsight.core.types import Disparity
from barsight.stereo.masking import gap_mask, mask_disparity, mask_gaps


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
