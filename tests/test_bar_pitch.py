"""Pitch of bars: drawn stripes of bars are measured in pictures that a map's cells would blur."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from barsight.bundle_pictures.diameters import with_pitch
from barsight.bundle_pictures.measuring import look_at_bundles, measure_from_pictures
from barsight.bundle_pictures.profiles import STEP_M, PitchProfile
from barsight.yard.magnet.holding import min_diameter_m
from barsight.yard.types import Bundle
from drawn_pictures import ABOVE_M, CAMERA, TOP_M, Pictures, flat_map, looking_down
from lift_yards import record
from yard_maps import Laid

WIDTH_M, LENGTH_M = 0.26, 2.0


def striped(bundle: Bundle, diameter_m: float) -> Callable[[np.ndarray], np.ndarray]:
    """Shade bars side by side, hidden in part by up to a quarter, none as bright as the next."""
    rng = np.random.default_rng(0)
    steps = diameter_m * rng.uniform(0.75, 1.05, 60)
    bright = rng.uniform(0.85, 1.0, 60)
    axes = np.cumsum(steps) - bundle.width_m / 2
    across = np.array([np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad)])

    def gray(places: np.ndarray) -> np.ndarray:
        beside = (places - bundle.centre_m[:2]) @ across
        number = np.searchsorted((axes[1:] + axes[:-1]) / 2, beside)
        near = axes[number]
        rise = np.sqrt(np.clip(1 - ((beside - near) / (diameter_m / 2)) ** 2, 0, 1))
        return np.where(np.abs(beside) < bundle.width_m / 2, 30 + 150 * rise * bright[number], 60.0)

    return gray


def told(diameter_m: float, sigma_m: float, yaw_deg: float = 7.0) -> Bundle:
    bundle = record(Laid(0.0, 0.0, TOP_M - WIDTH_M / 2, yaw_deg, length_m=LENGTH_M))
    sigma = replace(bundle.sigma, bar_diameter_m=sigma_m)
    return replace(
        bundle, bars=None, bar_diameter_m=diameter_m, width_m=WIDTH_M, top_z_m=TOP_M, sigma=sigma
    )  # fmt: skip


@pytest.mark.parametrize("diameter_mm", [16, 20, 25, 32, 40])
def test_a_diameter_is_measured_finer_than_a_cell(diameter_mm: int) -> None:
    bundle = told(0.11, 0.066)
    poses = looking_down(-2.0, 1) | looking_down(0.3, 2)
    pairs = Pictures(poses, striped(bundle, diameter_mm / 1e3))
    (measured,) = measure_from_pictures(pairs, poses, flat_map(), (bundle,))
    assert 1e3 * measured.bar_diameter_m == pytest.approx(diameter_mm, rel=0.2)
    assert 0.4 * diameter_mm < 1e3 * min_diameter_m(measured) < 1.02 * diameter_mm
    assert measured.width_m == bundle.width_m and measured.section_m2 is bundle.section_m2


def test_profiles_lie_where_the_bars_do() -> None:
    """The darkest place of a profile is the only dark line, in both pictures of the nearest frame."""
    bundle = told(0.11, 0.066, yaw_deg=-20.0)
    across = np.array([np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad)])
    poses = looking_down(-0.4, 1) | looking_down(0.2, 2) | looking_down(9.0, 3)
    pairs = Pictures(
        poses, lambda at: np.where(np.abs((at - bundle.centre_m[:2]) @ across - 0.04) < 0.004, 20, 150)
    )
    (profiles,) = look_at_bundles(pairs, poses, flat_map(), [bundle], ()).profiles
    assert len(profiles) == 10
    for profile in profiles:
        beside = STEP_M * (profile.levels.argmin() - (profile.levels.size - 1) / 2)
        assert beside == pytest.approx(0.04, abs=0.003)
        assert profile.pixel_m == pytest.approx(ABOVE_M / CAMERA.focal_px, rel=0.02)


def test_a_diameter_by_shape_holds_unless_the_pictures_contradict_it() -> None:
    poses = looking_down(0.3, 2)
    for bars_mm, told_mm in ((90, 92.0), (20, 92.0)):
        bundle = told(told_mm / 1e3, 0.06 * told_mm / 1e3)
        pairs = Pictures(poses, striped(bundle, bars_mm / 1e3))
        (measured,) = measure_from_pictures(pairs, poses, flat_map(), (bundle,))
        assert 1e3 * measured.bar_diameter_m == pytest.approx(bars_mm, rel=0.2)


@pytest.mark.parametrize("diameter_mm", [12, 16, 20])
def test_blurred_pictures_tell_nothing(diameter_mm: int) -> None:
    """Blur takes the thin bars' pitch away and would leave what looks like thick ones'."""
    bundle, poses = told(0.11, 0.066), looking_down(0.0, 1)
    pairs = Pictures(poses, striped(bundle, diameter_mm / 1e3), blur_px=1.0)
    (same,) = measure_from_pictures(pairs, poses, flat_map(), (bundle,))
    assert same is bundle


def test_what_stands_in_the_way_hides_a_bundle() -> None:
    bundle, poses = told(0.11, 0.066, yaw_deg=0.0), looking_down(-0.9, 1)
    heights, wall = flat_map(), flat_map()
    pairs = Pictures(poses, striped(bundle, 0.02))
    wall.z_m[:, np.abs(wall.x_m + 0.18) < 0.04] = TOP_M + 0.9
    counts = [len(look_at_bundles(pairs, poses, one, [bundle], ()).profiles[0]) for one in (heights, wall)]
    assert counts[0] > 0 and counts[1] == 0


def test_one_bar_keeps_its_diameter_unless_the_pitch_is_far_finer() -> None:
    poses = looking_down(0.0, 1)
    single = replace(told(0.2, 0.012), visible_bars=1)
    for bars_mm, kept in ((150, True), (20, False)):
        pairs = Pictures(poses, striped(single, bars_mm / 1e3))
        (measured,) = measure_from_pictures(pairs, poses, flat_map(), (single,))
        assert (measured.bar_diameter_m == 0.2) == kept
        assert kept or 1e3 * measured.bar_diameter_m == pytest.approx(bars_mm, rel=0.3)


def test_a_pack_that_was_fitted_as_one_bar_is_measured_by_its_pitch() -> None:
    """Straps and lines showed bars of 50 mm in what was fitted as one of 260 mm: it isn't one of those."""
    pack = replace(told(0.05, 0.03), visible_bars=1)
    poses = looking_down(0.0, 1)
    for bars_mm in (25, 40):
        pairs = Pictures(poses, striped(pack, bars_mm / 1e3))
        (measured,) = measure_from_pictures(pairs, poses, flat_map(), (pack,))
        assert 0.4 * bars_mm < 1e3 * min_diameter_m(measured) < bars_mm


def test_what_no_picture_shows_is_left_as_told() -> None:
    bundle = told(0.11, 0.066)
    counted = replace(bundle, bars=7)
    bars, smooth = striped(bundle, 0.02), lambda places: np.full(places.shape[:-1], 120.0)
    near, far = looking_down(0.0, 1), looking_down(9.0, 1)
    for one, gray, poses in ((bundle, bars, far), (counted, bars, near), (bundle, smooth, near)):
        (same,) = measure_from_pictures(Pictures(poses, gray), poses, flat_map(), (one,))
        assert same is one
    assert with_pitch(bundle, [PitchProfile(np.zeros(30), 0.006)] * 4) is bundle
