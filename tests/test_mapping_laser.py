"""The laser as a sensor: right profiles improve the map by what their sigma says, wrong ones are found."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from barsight.core.pose import Pose
from barsight.core.records.heights import Contour, HeightSource
from barsight.core.records.sensor_samples import LaserProfile
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface.laser_check import check_laser
from barsight.mapping.surface.laser_fusion import fuse_laser
from barsight.mapping.surface.laser_profiles import Profiles, cut_profiles
from barsight.mapping.surface.surface import Layers, Surface
from barsight.recording.base import Recording
from mapping_views import block, fused, view

COLUMNS, ROWS, LASER_ROW = 500, 90, 40
X_M = 0.01 * np.arange(COLUMNS)
SETTINGS = MapSettings(laser="fuse")


def stack(x_m: np.ndarray) -> np.ndarray:
    """Round bars of 90 mm along Y in two layers, with gullies between them."""
    across = (x_m % 0.1) - 0.05
    bar = np.sqrt(np.maximum(0.045**2 - across**2, 0))
    return np.asarray(0.045 + bar + np.where((x_m % 1.3) > 0.7, 0.09, 0))


def errors(rng: np.random.Generator, rows: int = 1) -> np.ndarray:
    """Vision's errors, m: of all of the map, alike along a few centimetres of X and, by exp(-way / 0.12 m),
    along Y; (rows, COLUMNS)."""
    held = np.exp(-0.01 / 0.12)
    field = np.empty((rows, COLUMNS))
    field[0] = rng.normal(0, 1, COLUMNS)
    for k in range(1, rows):
        field[k] = held * field[k - 1] + np.sqrt(1 - held**2) * rng.normal(0, 1, COLUMNS)
    near = np.exp(-0.5 * (np.arange(-6, 7) / 2) ** 2)
    field = np.apply_along_axis(np.convolve, 1, field, near / np.linalg.norm(near), "same")
    return rng.normal(0, 0.0015) + 0.0025 * field


def contour(rng: np.random.Generator) -> Contour:
    seen = np.full(COLUMNS, HeightSource.VISION, np.uint8)
    sigma = np.full(COLUMNS, 0.003)
    sigma[::20] = 0.0018
    return Contour(0, X_M, X_M * 0 + 0.4, stack(X_M) + errors(rng)[0], sigma, seen)


def laser(rng: np.random.Generator, row: int = LASER_ROW) -> LaserProfile:
    z = stack(X_M) + rng.normal(0, 0.001, COLUMNS)
    return LaserProfile(0, X_M, np.full(COLUMNS, 0.01 * row), z, 0.001)


def test_right_profiles_are_believed_and_ten_millimetres_found() -> None:
    """At most one of 24 right ones is doubted; of those that are 10 mm off in height, or 20 mm along x, none
    is believed."""
    doubted, believed = 0, 0
    for seed in range(24):
        rng = np.random.default_rng((3, seed))
        seen, right = contour(rng), laser(rng)
        doubted += not check_laser(seen, right, SETTINGS).is_believed
        x, z = [(0, 0.01), (0, -0.01), (0.02, 0), (-0.02, 0)][seed % 4]
        check = check_laser(seen, replace(right, x_m=right.x_m + x, z_m=right.z_m + z), SETTINGS)
        believed += check.is_believed
        if z and check.offset is not None:
            assert check.offset.z_offset_m == pytest.approx(z, abs=0.005)
            assert "in height" in check.reason
    assert doubted <= 1 and believed == 0


def test_what_can_not_be_told_is_not_believed() -> None:
    rng = np.random.default_rng(1)
    seen, right = contour(rng), laser(rng)
    unsure = check_laser(replace(seen, sigma_m=seen.sigma_m * 4), right, SETTINGS)
    assert "were it 10 mm off in height" in unsure.reason
    assert check_laser(
        replace(seen, sigma_m=seen.sigma_m * 4), right, replace(SETTINGS, laser_off_m=0.03)
    ).is_believed
    level = replace(seen, z_m=seen.z_m - stack(X_M))
    flat = check_laser(level, replace(right, z_m=right.z_m - stack(X_M)), SETTINGS)
    assert "were it 20 mm off along x" in flat.reason
    short = check_laser(
        seen, replace(right, **{n: getattr(right, n)[:40] for n in ("x_m", "y_m", "z_m")}), SETTINGS
    )
    assert short.offset is None and short.reason.startswith("vision has 40 of its 40 points")
    other = right.z_m + np.repeat(rng.normal(0, 0.2, COLUMNS // 10), 10)
    elsewhere = check_laser(seen, replace(right, z_m=other), SETTINGS)
    assert "% of its points lie on the map's surface" in elsewhere.reason


def surface(z_m: np.ndarray, folder: Path, sigma_m: float = 0.003) -> Surface:
    x, y = block(*z_m.shape[::-1])
    known = np.isfinite(z_m)
    return fused([view(x[known], y[known], z_m[known], sigma_m)], folder, MapSettings(min_views=1, fill_m=0))


def window(of: Surface) -> Layers:
    return of.window(0, 0, COLUMNS, ROWS)


def test_the_map_takes_the_lasers_sigma_and_none_gets_worse(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    error = errors(rng, ROWS)
    before = surface(stack(X_M) + error, tmp_path / "a", 0.003)
    (tmp_path / "b").mkdir()
    after = fuse_laser(before, [laser(rng)], SETTINGS, tmp_path / "b")
    old, new = window(before), window(after)
    wrong = np.abs(new.z_m - stack(X_M))
    assert (new.source[LASER_ROW] == HeightSource.LASER).all()
    assert (np.delete(new.source, LASER_ROW, axis=0) == HeightSource.VISION).all()
    assert np.sqrt((wrong[LASER_ROW] ** 2).mean()) < 0.0011
    assert np.sqrt((error[LASER_ROW] ** 2).mean()) > 0.002
    assert (new.sigma_m[LASER_ROW] <= 0.002).all()
    beside = np.abs(error[LASER_ROW + 4]).mean() - wrong[LASER_ROW + 4].mean()
    assert beside > 0.2 * np.abs(error[LASER_ROW + 4]).mean()
    for row in (LASER_ROW - 12, LASER_ROW + 12, LASER_ROW + 30):
        assert wrong[row].mean() <= 1.01 * np.abs(error[row]).mean()
    np.testing.assert_array_equal(new.z_m[80:], old.z_m[80:])
    np.testing.assert_array_equal(new.sigma_m[80:], old.sigma_m[80:])
    assert np.mean(wrong[4:76] <= 1.96 * new.sigma_m[4:76]) > 0.94
    assert after.seen == before.seen
    # The old surface still reads as it was: tiles are new files.
    np.testing.assert_array_equal(window(before).z_m, old.z_m)


def test_the_higher_one_counts_and_the_unknown_takes_the_laser(tmp_path: Path) -> None:
    z = np.full((ROWS, COLUMNS), 0.5)
    z[:, 200:220] = np.nan
    before = surface(z, tmp_path / "a")
    heights = np.full(COLUMNS, 0.5)
    heights[50:60], heights[100:110] = 0.3, 0.8
    (tmp_path / "b").mkdir()
    profile = LaserProfile(0, X_M, np.full(COLUMNS, 0.01 * LASER_ROW), heights, 0.001)
    new = window(fuse_laser(before, [profile], SETTINGS, tmp_path / "b"))
    row = new.z_m[LASER_ROW], new.sigma_m[LASER_ROW], new.source[LASER_ROW]
    np.testing.assert_allclose(row[0][53:57], 0.5)
    assert (row[1][53:57] >= 0.1).all() and (row[2][53:57] == HeightSource.VISION).all()
    np.testing.assert_allclose(row[0][103:107], 0.8)
    assert (row[1][103:107] >= 0.15).all() and (row[2][103:107] == HeightSource.LASER).all()
    # An unsure map agrees with a laser that is 20 mm higher, but that says nothing of the cells beside it.
    unsure = surface(np.full((ROWS, COLUMNS), 0.5), tmp_path / "c", 0.02)
    (tmp_path / "d").mkdir()
    higher = replace(profile, z_m=np.full(COLUMNS, 0.52))
    beside = window(fuse_laser(unsure, [higher], SETTINGS, tmp_path / "d")).z_m
    np.testing.assert_allclose(beside[LASER_ROW], 0.52, atol=1e-3)
    np.testing.assert_array_equal(beside[LASER_ROW + 1], window(unsure).z_m[LASER_ROW + 1])
    np.testing.assert_allclose(row[0][200:220], 0.5)
    assert (row[2][200:220] == HeightSource.LASER).all()
    assert np.isnan(new.z_m[LASER_ROW + 1, 200:220]).all()


def test_a_profile_between_rows_reaches_both(tmp_path: Path) -> None:
    """At y = 0.404 m and with points between the cells along x: a slope is met at the cells' centres."""
    x = X_M + 0.003
    slope = np.broadcast_to(0.5 + 0.2 * X_M, (ROWS, COLUMNS))
    before = surface(slope + 0.002, tmp_path / "a")
    (tmp_path / "b").mkdir()
    profile = LaserProfile(0, x, np.full(COLUMNS, 0.404), 0.5 + 0.2 * x, 0.001)
    new = window(fuse_laser(before, [profile], replace(SETTINGS, laser_sigma_m=1e-4), tmp_path / "b"))
    for row in (40, 41):
        assert (new.source[row, 1:] == HeightSource.LASER).all()
        np.testing.assert_allclose(new.z_m[row, 1:], slope[row, 1:], atol=3e-4)
    assert (new.source[42] == HeightSource.VISION).all()


def cut(before: Surface, profiles: tuple[LaserProfile, ...], folder: Path, settings: MapSettings) -> Profiles:
    frames = tuple(
        PosedFrame(k, Pose("yard", "body", np.eye(3), np.array([k, 0, 0])), np.zeros((6, 6)))
        for k in range(2)
    )
    source = cast(Recording, SimpleNamespace(laser=lambda: profiles))
    folder.mkdir()
    return cut_profiles(source, Trajectory("yard", frames, (), ("crane",)), before, settings, folder)


def test_agreement_is_of_vision_alone_and_a_profile_that_is_off_stays_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    before = surface(stack(X_M) + errors(rng, ROWS), tmp_path / "a", 0.0025)
    right, off = laser(rng), replace(laser(rng, 70), profile=1)
    off = replace(off, z_m=off.z_m + 0.01)
    compared = cut(before, (right, off), tmp_path / "b", MapSettings())
    assert compared.checks is None and compared.sensors == () and compared.surface is before
    both = cut(before, (right, off), tmp_path / "c", SETTINGS)
    assert both.agreed == compared.agreed and both.sensors == ("laser",)
    assert [check.is_believed for check in both.checks or ()] == [True, False]
    (notice,) = both.notices()
    assert notice.code == "laser-off" and notice.message.startswith("profile 1 is not fused: it lies +")
    assert [HeightSource.LASER in one.source for one in both.contours] == [True, False]
    none = cut(before, (off,), tmp_path / "d", SETTINGS)
    assert none.surface is before and none.sensors == ()


def test_a_contour_outside_the_map_is_told(tmp_path: Path) -> None:
    before = surface(np.tile(stack(X_M), (ROWS, 1)), tmp_path / "a")
    made = cut(before, (), tmp_path / "b", MapSettings(profile_y_m=(0.0, 100.0)))
    (notice,) = made.notices()
    assert notice.code == "profile-outside"
    assert notice.message.startswith("contour at y 100 m: empty, the map reaches from ")
