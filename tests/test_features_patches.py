"""Patches found again: to hundredths of a pixel, under any gain, with an honest sigma; a slow reference."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter

from barsight.core.arrays import Float64, UInt8
from barsight.features.orb import detect_orb
from barsight.features.patch_alignment import HALF_PX, align_patches, patch_image
from synthetic_scenes import Texture, quantised


def moved(dx: float, dy: float, noise: float = 0.0, grown: float = 1.0, seed: int = 0) -> UInt8:
    """The same texture moved by (dx, dy) px to the right and down, or grown about the middle."""
    u, v = np.meshgrid(
        (np.arange(320.0) - 160) / grown + 160 - dx, (np.arange(240.0) - 120) / grown + 120 - dy
    )
    return quantised(Texture(3)(u, v) + np.random.default_rng(seed).normal(0, noise or 1e-9, u.shape))


def corners(image: UInt8) -> Float64:
    return detect_orb(image, 300).pixels.astype(np.float64)


@pytest.mark.parametrize("shift", [(0.3, -0.6), (5.25, 2.5)])
def test_finer_than_a_twentieth_pixel_whatever_the_exposure(shift: tuple[float, float]) -> None:
    source, target = moved(0, 0), moved(*shift)
    dull = (target * np.linspace(0.7, 0.85, 320) + 12).round().astype(np.uint8)
    places = corners(source)
    guesses = places + np.round(shift)
    before = guesses.copy()
    for picture in (target, dull):
        again = align_patches(patch_image(source), patch_image(picture), places, guesses)
        assert again.found.mean() > 0.95
        error = again.pixels[again.found] - places[again.found] - shift
        assert np.median(np.linalg.norm(error, axis=1)) < 0.02
        assert np.percentile(np.linalg.norm(error, axis=1), 95) < 0.05
        assert np.abs(error.mean(axis=0)).max() < 0.005
    np.testing.assert_array_equal(guesses, before)


def test_a_patch_that_grew() -> None:
    """Places move away from the middle by 15 %, and the patches' own size with them."""
    source, target = moved(0, 0), moved(0, 0, grown=1.15)
    places = corners(source)
    true = (places - (160, 120)) * 1.15 + (160, 120)
    inside = ((true > 14) & (true < (305, 225))).all(axis=1)
    places, true = places[inside], true[inside]
    size = np.full(len(places), 1.15)
    again = align_patches(patch_image(source), patch_image(target), places, true + 0.8, grown=size)
    error = np.linalg.norm(again.pixels - true, axis=1)[again.found]
    assert again.found.mean() > 0.95
    assert np.percentile(error, 95) < 0.06


def test_sigma_is_right() -> None:
    scaled = []
    for seed in range(4):
        source, target = moved(0, 0, 3.0, seed=2 * seed), moved(0.4, 0.2, 3.0, seed=2 * seed + 1)
        places = corners(source)
        again = align_patches(patch_image(source), patch_image(target), places, places, sure=True)
        error = (again.pixels - places - (0.4, 0.2))[again.found]
        scaled.append(error / again.sigma_px[again.found, None])
    spread = float(np.sqrt((np.concatenate(scaled) ** 2).mean()))
    assert 0.7 < spread < 1.2  # sigma is that of the weaker direction: a little large on average


def test_what_is_not_there_is_not_found() -> None:
    source, target = moved(0, 0), quantised(Texture(9)(*np.meshgrid(np.arange(320.0), np.arange(240.0))))
    places = corners(source)
    pictures = patch_image(source), patch_image(target)
    assert align_patches(*pictures, places, places).found.mean() < 0.05
    assert align_patches(*pictures, places[:0], places[:0]).found.shape == (0,)
    flat = patch_image(np.full((240, 320), 90, np.uint8))
    assert not align_patches(flat, flat, places, places).found.any()
    edge = np.array([[2.0, 100.0], [318.0, 5.0]])
    assert not align_patches(pictures[0], pictures[0], edge, edge).found.any()


def slowly(source: UInt8, target: UInt8, place: Float64) -> Float64:
    """The same least squares with SciPy's splines, one point, from the place itself."""
    smooth = [spline_filter(image.astype(np.float64), order=3, mode="mirror") for image in (source, target)]
    y, x = np.mgrid[-HALF_PX : HALF_PX + 1, -HALF_PX : HALF_PX + 1].astype(np.float64)

    def read(k: int, at: Float64) -> Float64:
        where = [(y + at[1]).ravel(), (x + at[0]).ravel()]
        return map_coordinates(smooth[k], where, order=3, mode="mirror", prefilter=False)

    patch = read(0, place)
    right, down = np.eye(2)
    by_x = (read(0, place + right) - read(0, place - right)) / 2
    by_y = (read(0, place + down) - read(0, place - down)) / 2
    design = np.column_stack([by_x, by_y, patch - patch.mean(), np.ones(patch.size)])
    found = place.copy()
    for _ in range(30):
        step = np.linalg.lstsq(design, read(1, found) - patch, rcond=None)[0]
        found = found - step[:2]
    return found


def test_the_kernel_agrees_with_a_slow_reference() -> None:
    source, target = moved(0, 0, 2.0), moved(0.35, -0.2, 2.0, seed=1)
    places = corners(source)[:40] + 0.3
    again = align_patches(patch_image(source), patch_image(target), places, places, sure=True)
    checked = np.flatnonzero(again.found)
    assert len(checked) > 30
    expected = np.array([slowly(source, target, places[k]) for k in checked])
    np.testing.assert_allclose(again.pixels[checked], expected, atol=0.01)


def test_a_middle_that_doesnt_fix_its_own_place_isnt_found() -> None:
    """A plain beam, alike all along, over a floor that moves: only the rim of a patch shows it."""
    v = np.arange(240.0)[:, None]
    beam = np.abs(v - 120) < 6
    shade = 128 + 40 * np.sin(0.8 * v)
    source, target = (quantised(np.where(beam, shade, moved(dx, 0))) for dx in (0, 2))
    x = np.arange(20.0, 300, 7)
    for row, on_beam in ((118.0, True), (122.0, True), (104.0, False)):
        places = np.column_stack([x, np.full(x.size, row)])
        again = align_patches(patch_image(source), patch_image(target), places, places + np.array([1.0, 0]))
        assert again.found.mean() < 0.1 if on_beam else again.found.mean() > 0.95
