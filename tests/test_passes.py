"""Several passes over one yard: how they are tied, what changed between them, one map and one result."""

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest

import barsight as bs
from barsight.core.errors import ConfigError, InputError
from barsight.core.pose import Pose
from barsight.core.records.heights import HeightSource
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.mapping.free_space import FreeSpace
from barsight.mapping.passes.changes import PlaceHistory
from barsight.mapping.passes.joined_surface import PassSurface, join_surfaces
from barsight.mapping.passes.slides import SeenBundle, find_moves
from barsight.mapping.surface.cloud import CloudPart
from barsight.mapping.surface.surface import Layers, write_tile
from barsight.mapping.surface.tile_figures import gather_surface, tile_figures
from barsight.mapping.top_photo import TopPhoto
from barsight.reconstruction.joined_passes import (
    MAX_PASSES,
    STALE,
    JoinedPasses,
    MappedPass,
    in_order,
    join_passes,
)
from barsight.reconstruction.tracked_recording import TrackedRecording
from barsight.registration.block_shifts import BlockShifts, MatchedMap, block_shifts
from barsight.registration.pass_ties import PassCorrection, PassPrior, PassTies, tie_passes
from barsight.result_folder import changed_inputs, read_heights
from barsight.simulation.passes import simulate_passes
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.travel import PassesSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.simulate import simulate
from cli_runs import TINY

CELL_M = 0.01
NO_CORRECTION = PassCorrection(np.zeros(3), np.zeros(7), np.zeros((7, 7)))


def yard(x: np.ndarray, y: np.ndarray, *, detail: bool) -> tuple[np.ndarray, np.ndarray]:
    """Bars of 90 mm along Y; the picture has stripes and, if asked, specks."""
    gray = 90 + 40 * np.cos(2 * np.pi * x / 0.09)
    if detail:
        gray = gray + 12 * np.sin(23 * x + 31 * y) * np.sin(17 * y - 9 * x)
    return 0.3 + 0.015 * np.cos(2 * np.pi * x / 0.09), gray


def raster(shift_m: np.ndarray, rng: np.random.Generator, *, detail: bool = True) -> MatchedMap:
    """Sample the yard moved by a shift, blurred as matching does, with noise."""
    x, y = np.meshgrid(np.arange(400) * CELL_M - shift_m[0], np.arange(320) * CELL_M - shift_m[1])
    z, gray = yard(x, y, detail=detail)
    noise = rng.normal(0, 1, (2, *z.shape))
    return MatchedMap(
        (z + shift_m[2] + 0.002 * noise[0]).astype(np.float32), np.full(z.shape, 0.002, np.float32),
        (gray + noise[1]).astype(np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_blocks_find_the_shift_of_two_maps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = rng.normal(0, [0.006, 0.006, 0.01])
    found = block_shifts(raster(true, rng), raster(np.zeros(3), rng), (0, 0), CELL_M)
    assert len(found.place_m) == 30
    assert np.abs(np.median(found.shift_m, axis=0) - true).max() < 0.0007


def test_bars_alone_say_nothing_of_the_shift_along_them() -> None:
    rng = np.random.default_rng(1)
    pair = [raster(shift, rng, detail=False) for shift in (np.array([0.004, 0.02, 0.003]), np.zeros(3))]
    found = block_shifts(*pair, (0, 0), CELL_M)
    across, along = (np.median(found.information[:, k, k]) for k in (0, 1))
    assert along < 0.1 * across
    ties = tie_passes([prior(), prior()], {(0, 1): found})
    moved = ties.corrections[1].unknowns - ties.corrections[0].unknowns
    assert moved[3] == pytest.approx(0.004, abs=0.001) and moved[5] == pytest.approx(0.003, abs=0.001)


def prior(shift_sigma_m: float = 0.005, x_m: float = 0.0) -> PassPrior:
    sigma = np.array([2e-4, 2e-4, 2e-4, *[shift_sigma_m] * 3, 2e-4])
    return PassPrior(np.array([x_m, 0.0, 8.0]), np.diag(sigma**2))


def blocks(shift_m: np.ndarray, rng: np.random.Generator, wrong: int = 0) -> BlockShifts:
    place = np.column_stack([rng.uniform(0, 6, 60), rng.uniform(-1, 1, 60), np.full(60, 0.4)])
    shifts = shift_m + rng.normal(0, 0.002, (60, 3))
    shifts[:wrong] += [0.02, -0.02, 0.05]
    return BlockShifts(place, shifts, np.tile(np.eye(3) / 0.002**2, (60, 1, 1)))


def test_an_offset_is_spread_over_both_by_their_sigmas() -> None:
    rng = np.random.default_rng(2)
    true = np.array([0.006, -0.004, 0.005])
    ties = tie_passes([prior(0.002, 3.0), prior(0.006, 3.0)], {(0, 1): blocks(true, rng, wrong=12)})
    place = np.array([[3.0, 0.0, 0.4]])
    first, second = (one.shift_at(place)[0] for one in ties.corrections)
    assert np.abs(second - first - true).max() < 0.0025
    assert 3 < np.linalg.norm(second) / np.linalg.norm(first) < 12
    assert not ties.pairs[0].contradicts


def test_passes_further_apart_than_they_may_be_contradict() -> None:
    far = blocks(np.array([0.0, 0.0, 0.08]), np.random.default_rng(3))
    assert tie_passes([prior(), prior()], {(0, 1): far}).pairs[0].contradicts


def test_what_nothing_ties_stays_with_its_encoders() -> None:
    ties = tie_passes([prior(), prior()], {})
    assert not ties.pairs and all((one.unknowns == 0).all() for one in ties.corrections)


def test_ties_are_as_far_off_as_their_sigmas_say() -> None:
    """NEES of the difference over drawn priors, 3 degrees of freedom."""
    rng, errors = np.random.default_rng(4), []
    for _ in range(150):
        drawn = rng.normal(0, 0.005, (2, 3))
        ties = tie_passes([prior(), prior()], {(0, 1): blocks(drawn[1] - drawn[0], rng)})
        first, second = (one.unknowns[3:6] for one in ties.corrections)
        tie = ties.pairs[0]
        errors.append(((second - first - drawn[1] + drawn[0]) / tie.sigma_m)[:2])
    assert 0.02 < np.mean(np.square(errors)) < 1.5  # the floor is for what blocks have wrong together


def history() -> PlaceHistory:
    """A yard of 6 x 8 m; the second pass sees the upper half, where a thing of 1 x 2 m is gone."""
    one = PlaceHistory((0.0, 0.0), (160, 120), 0.05)
    z, sigma = np.zeros((160, 120), np.float32), np.full((160, 120), 0.005, np.float32)
    z[60:130, 40:60] = 0.3
    one.add(0, z, sigma, 0)
    later = np.zeros((160, 120), np.float32)
    later[:90] = np.nan
    one.add(1, later, sigma, 1)
    return one


def test_a_change_is_told_once_with_place_and_height() -> None:
    (change,) = history().changes
    assert change.pass_index == 1 and change.rise_m == pytest.approx(-0.3)
    assert change.low_m == (2.0, 4.5) and change.high_m == (3.0, 6.5)
    assert change.area_m2 == pytest.approx(2.0)


def test_two_pairs_of_one_time_see_no_change_but_both_see_what_changed_before() -> None:
    """The second pair of a pass finds a change where the first saw nothing; none lies between them."""
    one, sigma = PlaceHistory((0.0, 0.0), (160, 120), 0.05), np.full((160, 120), 0.005, np.float32)
    old, left = np.zeros((2, 160, 120), np.float32)
    old[60:130, 40:60] = 0.3
    left[:, 30:] = np.nan
    left[100:120, 5:20] = 0.5  # what the other pair, which saw it at the same time, hasn't
    for number, (z, since) in enumerate(((old, 0), (left, 1), (np.zeros((160, 120), np.float32), 1))):
        one.add(number, z, sigma, since)
    rises = [(change.pass_index, round(change.rise_m, 2)) for change in one.changes]
    assert rises == [(1, 0.5), (1, -0.3)]
    assert set(np.unique(one.changed_by)) == {-1, 1} and one.seen_by.max() == 2


def test_more_passes_than_a_place_remembers_are_refused_before_they_are_measured() -> None:
    one = PlaceHistory((0.0, 0.0), (4, 4), 0.05)
    for number in range(MAX_PASSES):
        one.add(number, np.zeros((4, 4), np.float32), np.full((4, 4), 0.01, np.float32), number)
    assert (one.newest_pass(np.array([0.1]), np.array([0.1])) == MAX_PASSES).all()
    many = [SimpleNamespace(path=Path(f"pass_{number}")) for number in range(MAX_PASSES + 1)]
    with pytest.raises(InputError, match="128 passes, 127 are the most"):
        in_order(cast(Any, many), bs.MeasureSettings())


def test_of_passes_of_one_time_the_one_that_hangs_differently_is_named() -> None:
    first, second = (
        SimpleNamespace(
            path=Path(name), index=SimpleNamespace(stamps_ns=(0, 5)), rig=name,
            crane=lambda lever=lever: SimpleNamespace(crane_to_body_m=lever, yard_from_body_nominal=0.0),
        )
        for name, lever in (("first", 1.0), ("second", 2.0))
    )  # fmt: skip
    with pytest.raises(InputError, match=r"^second: its cameras.* differ from those of first"):
        in_order(cast(Any, [first, second]), bs.MeasureSettings())


def test_passes_before_the_clock_began_are_told_apart() -> None:
    passes = [
        SimpleNamespace(
            path=Path("pass"), index=SimpleNamespace(stamps_ns=(first, first + 5)), rig="one",
            crane=lambda: SimpleNamespace(crane_to_body_m=1.0, yard_from_body_nominal=0.0),
        )
        for first in (-30, -20, -10, 0)
    ]  # fmt: skip
    assert in_order(cast(Any, passes[::-1]), bs.MeasureSettings()) == tuple(passes)


def test_noise_and_edges_are_no_change() -> None:
    rng, one = np.random.default_rng(5), PlaceHistory((0.0, 0.0), (160, 120), 0.05)
    z = np.zeros((160, 120))
    z[:, 40:60] = 0.3
    shifted = z.copy()
    shifted[:, 40] = 0.0  # an edge that one view has 50 mm further in
    for number, seen in enumerate((z, shifted)):
        noisy = (seen + rng.normal(0, 0.008, z.shape)).astype(np.float32)
        one.add(number, noisy, np.full(z.shape, 0.008, np.float32), number)
    assert not one.changes and (one.changed_by == -1).all()


@pytest.mark.parametrize(
    ("x_m", "y_m", "length_m", "stale"),
    [(2.5, 3.8, 3.0, True), (2.5, 5.5, 4.0, True), (2.5, 6.8, 1.5, False), (5.5, 4.0, 3.0, False)],
    ids=["half-of-it-left", "its-end-where-it-was-seen-once", "all-seen-since", "far-away"],
)
def test_a_bundle_half_seen_beside_a_change_is_stale(
    x_m: float, y_m: float, length_m: float, stale: bool
) -> None:
    assert history().is_stale(np.array([x_m, y_m, 0.1]), 0.0, length_m, 0.3, 0.5) is stale


def pictured(
    folder: Path, rows: tuple[int, int], moved_m: dict[float, float], seed: int, since: int
) -> PassSurface:
    """A pass over six bundles of 6 m at x = 1, 2 ... that sees so many rows of cells; those whose x is named
    were moved along y, by nan exchanged.
    """
    rng, cell_m = np.random.default_rng(1), 0.01
    layers = Layers.unknown(256 * 4, 256 * 3)
    y, x = np.mgrid[: 256 * 4, : 256 * 3]
    gray = 90 + 6 * rng.standard_normal((256 * 4, 256 * 3))
    for k in range(1, 7):
        looks = cv2.GaussianBlur(rng.normal(0, 60, (700, 30)), (0, 0), 2) + 120
        shift = moved_m.get(float(k), 0.0)
        if np.isnan(shift):
            looks, shift = np.roll(looks[::-1], 7, axis=1), 0.0
        first = round((2.0 + shift) / cell_m)
        gray[first : first + 600, 100 * k - 15 : 100 * k + 15] = looks[:600]
    gray += np.random.default_rng(seed).normal(0, 3, gray.shape) + 0.03 * x
    seen = (y >= rows[0]) & (y < rows[1])
    whole = replace(
        layers, z_m=np.where(seen, 0.3, np.nan).astype(np.float32),
        sigma_m=np.full(seen.shape, 0.005, np.float32), views=seen.astype(np.float32),
        source=np.where(seen, HeightSource.VISION, HeightSource.UNKNOWN).astype(np.uint8),
        intensity=np.where(seen, gray, np.nan).astype(np.float32),
    )  # fmt: skip
    folder.mkdir()
    figures = {}
    for i in range(4):
        for j in range(3):
            part = {
                f.name: getattr(whole, f.name)[256 * i : 256 * (i + 1), 256 * j : 256 * (j + 1)]
                for f in fields(Layers)
            }
            write_tile(folder, (j, i), Layers(**part))
            figures[j, i] = tile_figures((j, i), Layers(**part))
    return PassSurface(gather_surface(folder, cell_m, figures), NO_CORRECTION, since)


def test_what_was_moved_along_itself_or_exchanged_is_told_by_its_picture(tmp_path: Path) -> None:
    """All lie as high as before; only from y = 3.5 to 6.5 m both passes see them."""
    older = pictured(tmp_path / "older", (150, 650), {}, 5, 0)
    newer = pictured(tmp_path / "newer", (350, 950), {2.0: 0.5, 4.0: -0.3, 5.0: float("nan")}, 6, 1)
    twin = replace(newer, since=0)
    bundles = [SeenBundle(np.array([[k, 2.0, 0.2], [k, 8.0, 0.2]]), 0.3) for k in range(1, 7)]
    told = {move.ends_m[0, 0]: move.along_m for move in find_moves([older, newer], bundles)}
    assert told == {2.0: pytest.approx(0.5, abs=0.011), 4.0: pytest.approx(-0.3, abs=0.011), 5.0: None}
    assert find_moves([older, twin], bundles) == [], "two pairs of one time see no change"
    history = PlaceHistory((0.0, 0.0), (200, 160), 0.05)
    height = np.full((200, 160), 0.3, np.float32)
    for number, rows in ((0, slice(30, 130)), (1, slice(70, 190))):
        z = np.full_like(height, np.nan)
        z[rows] = height[rows]
        history.add(number, z, np.full_like(height, 0.005), number)
    for move in find_moves([older, newer], bundles):
        history.note(move)
    assert not history.changes and len(history.moves) == 3
    stale = [history.is_stale(np.array([k, 5.0]), 0.0, 6.0, 0.3, 0.1) for k in range(1, 7)]
    assert stale == [False, True, False, True, True, False]
    ties = PassTies((), ())
    joined = JoinedPasses((), (), older.surface, FreeSpace(CELL_M), TopPhoto(CELL_M), ties, history)
    said = [notice.message for notice in joined.notices()]
    assert said[0].endswith("around x 2.00, y 5.00 m was moved 0.50 m along itself towards +Y")
    assert said[1].endswith("was moved 0.30 m along itself towards -Y") and "exchanged" in said[2]


def one_tile(folder: Path, z_m: np.ndarray, views: int, since: int, gray: float = 100.0) -> PassSurface:
    """A pass over one tile, all of it seen by so many views."""
    same = np.ones_like(z_m)
    layers = Layers(z_m, 0.003 * same, views * same, same.astype(np.uint8), gray * same)
    folder.mkdir()
    write_tile(folder, (0, 0), layers)
    none = np.empty(0, np.float32)
    CloudPart(
        none.reshape(0, 3), none.astype(np.uint8), none, none, none.astype(np.int32), none.astype(bool)
    ).write(folder, (0, 0))
    return PassSurface(
        gather_surface(folder, CELL_M, {(0, 0): tile_figures((0, 0), layers)}), NO_CORRECTION, since
    )


@pytest.mark.parametrize(("late_views", "shown_m"), [(2, 0.345), (9, 0.3)])
def test_a_thin_bar_stays_that_a_later_pass_of_fewer_views_missed(
    tmp_path: Path, late_views: int, shown_m: float
) -> None:
    """It may forbid a lift; nor does a wrong match of the later pass dig a hole where many views saw none."""
    before = np.full((256, 256), 0.3, np.float32)
    after = before.copy()
    before[100:104], after[50:53, 50:53] = 0.345, 0.0
    passes = [one_tile(tmp_path / "a", before, 9, 0), one_tile(tmp_path / "b", after, late_views, 1)]
    joined = join_surfaces(passes, tmp_path)
    assert not joined.history.changes
    z_m = joined.surface.window(0, 0, 256, 256).z_m
    assert z_m[101, 50] == pytest.approx(shown_m)
    assert z_m[51, 51] == pytest.approx(0.3 if late_views == 2 else 0.0)


@pytest.mark.parametrize(("since", "shown_m"), [(1, 0.38), (0, 0.3)], ids=["later", "at-one-time"])
def test_a_bar_laid_across_since_stands_however_often_the_older_pass_saw_the_place(
    tmp_path: Path, since: int, shown_m: float
) -> None:
    """It is too narrow for a change. Of two pairs of one time the one with more views counts."""
    before = np.full((256, 256), 0.3, np.float32)
    after = before.copy()
    after[:, 100:108] += np.float32(0.08)
    passes = [one_tile(tmp_path / "a", before, 20, 0), one_tile(tmp_path / "b", after, 5, since)]
    joined = join_surfaces(passes, tmp_path)
    assert not joined.history.changes
    z_m = joined.surface.window(0, 0, 256, 256).z_m
    assert np.abs(z_m[:, 100:108] - shown_m).max() < 1e-6 and np.abs(z_m[:, :99] - 0.3).max() < 1e-6


@pytest.mark.parametrize(("since", "shown"), [(1, 180), (0, 140)], ids=["later", "at-one-time"])
def test_the_photo_is_the_newest_pass_s_where_heights_agree(tmp_path: Path, since: int, shown: int) -> None:
    """A label put on since is as bright as that pass saw it."""
    level = np.full((256, 256), 0.3, np.float32)
    passes = [one_tile(tmp_path / "a", level, 20, 0), one_tile(tmp_path / "b", level, 5, since, 180.0)]
    window = join_surfaces(passes, tmp_path).surface.window(0, 0, 256, 256)
    assert np.abs(window.intensity - shown).max() < 1e-3 and (window.views == 25).all()


def mapped(stamps_ns: list[int], free: FreeSpace, tops: TopPhoto) -> MappedPass:
    """A pass of three frames with its free space and its top photo."""
    frames = tuple(
        PosedFrame(k, Pose("yard", "body", np.eye(3), np.array([k, 1.0, 8.0])), 1e-4 * np.eye(6))
        for k in range(3)
    )
    way = TrackedRecording(Trajectory("yard", frames, (), ()), *cast(Any, (None,) * 3), (), {}, (), iter(()))
    source = SimpleNamespace(index=SimpleNamespace(stamps_ns=stamps_ns))
    built = SimpleNamespace(free=free, tops=tops)
    return MappedPass(cast(Any, SimpleNamespace(source=source)), way, cast(Any, built))


def test_a_top_photo_shows_each_place_as_the_newest_passes_saw_it(tmp_path: Path) -> None:
    """The second and the third pass are of one time. A bar laid since the first one, of many views, would
    pale among its pictures.
    """
    x, y = np.meshgrid(np.arange(256) * CELL_M, np.arange(256) * CELL_M)
    level = yard(x, y, detail=False)[0].astype(np.float32)
    passes, surfaces = list[MappedPass](), []
    seen = (([0, 1], 90, 20, 0, 256), ([10, 12], 200, 4, 0, 128), ([11, 13], 100, 4, 64, 192))
    for number, (stamps_ns, gray, views, left, right) in enumerate(seen):
        tops = TopPhoto(CELL_M)
        tops.tiles[0, 0] = np.zeros((2, 256, 256), np.uint16)
        tops.tiles[0, 0][:, :, left:right] = np.array([gray * views, views])[:, None, None]
        passes.append(mapped(stamps_ns, FreeSpace(CELL_M), tops))
        surfaces.append(one_tile(tmp_path / f"{number}", level, 5, number).surface)
    shown = join_passes(passes, surfaces, tmp_path, 600.0).tops.window(0, 0, 256, 256)
    for at, gray in ((30, 200), (100, 150), (150, 100), (220, 90)):
        assert (shown[:, at] == gray).all()


def test_what_was_proven_free_is_given_up_where_it_changed() -> None:
    old, new = FreeSpace(CELL_M), FreeSpace(CELL_M)
    old.tiles[0, 0] = np.full((2, 256, 256), 0.1, np.float32)
    new.tiles[0, 0] = np.full((2, 256, 256), 0.4, np.float32)
    old.join(new, 0.01, lambda x, y: np.broadcast_to(x < 1.0, (len(y), len(x))))
    window = old.window(0, 0, 200, 10)
    assert (window[:, :98] == np.float32(0.41)).all() and (window[:, 104:] == np.float32(0.1)).all()


@pytest.mark.parametrize(("late_s", "stays"), [(500, True), (700, False)])
def test_what_an_old_pass_proved_free_counts_only_away_from_what_was_seen_since(
    tmp_path: Path, late_s: int, stays: bool
) -> None:
    """Neither pass saw the place, which has no height that shows an age; what stands there since hides."""
    level = np.full((256, 256), 0.3, np.float32)
    hole = slice(100, 110), slice(100, 110)
    passes, surfaces = list[MappedPass](), []
    for number in range(2):
        free = FreeSpace(CELL_M)
        free.tiles[0, 0] = np.full((2, 256, 256), 0.35, np.float32)
        z_m = level.copy()
        z_m[hole] = np.nan
        if number:
            free.tiles[0, 0][:, *hole] = np.inf
            z_m[:, 200:] = np.nan
            free.tiles[0, 0][:, :, 200:] = np.inf
        begin_ns = number * late_s * 10**9
        passes.append(mapped([begin_ns, begin_ns + 1], free, TopPhoto(CELL_M)))
        surfaces.append(one_tile(tmp_path / f"{number}", z_m, 5, number).surface)
    found = join_passes(passes, surfaces, tmp_path, 600.0).free.window(0, 0, 256, 256)
    assert (np.isfinite(found[hole]) == stays).all() and np.isfinite(found[:, :90]).all()
    assert np.isfinite(found[:, 255]).all(), "only the old pass saw it, and its heights are as old"


def test_what_is_proven_free_is_moved_onto_the_joined_map_with_each_pass(tmp_path: Path) -> None:
    """The second pass lies 24 mm higher, both are as sure: each is moved by half. Either proves 50 mm over
    its own surface free, the first one on the left, the second one on the right.
    """
    x, y = np.meshgrid(np.arange(256) * CELL_M, np.arange(256) * CELL_M)
    level = yard(x, y, detail=False)[0].astype(np.float32)
    passes, surfaces, off_m = list[MappedPass](), [], np.float32(0.024)
    for number in range(2):
        free = FreeSpace(CELL_M)
        bound = np.full((2, 256, 256), np.inf, np.float32)
        bound[:, :, 128 * number : 128 * number + 128] = 0.35 + number * off_m
        free.tiles[0, 0] = bound
        passes.append(mapped([10 * number, 10 * number + 1], free, TopPhoto(CELL_M)))
        surfaces.append(one_tile(tmp_path / f"{number}", level + number * off_m, 5, number).surface)
    joined = join_passes(passes, surfaces, tmp_path, 600.0)
    z_m = joined.surface.window(0, 0, 256, 256).z_m
    over_m = joined.free.window(0, 0, 256, 256) - (z_m - level + 0.3)
    assert np.abs(over_m[20:240, 20:120] - 0.05).max() < 0.002
    assert np.abs(over_m[20:240, 140:240] - 0.05).max() < 0.002


PASSES = replace(
    TINY, length_m=3.0, frames=7, seed=710010, yard=YardSettings(max_layers=1, bar_length_m=7.5),
    camera=CameraSettings(width_px=512, height_px=400, focal_px=500, samples_per_side=1),
    passes=PassesSettings(trolley_y_m=(-2.0, 2.0), changes=("taken",)),
)  # fmt: skip
COARSE = {"stereo": {"method": "sgbm"}, "map": {"cell_m": 0.02}}


@pytest.fixture(scope="module")
def passes(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("passes") / "yard"
    simulate_passes(folder, PASSES)
    return folder / "pass_1", folder / "pass_2"


@pytest.fixture(scope="module")
def joined(passes: tuple[Path, Path]) -> bs.Yard:
    return bs.measure(passes[::-1], at="end", **COARSE)


def test_both_ends_are_closed_that_one_pass_leaves_open(passes: tuple[Path, Path], joined: bs.Yard) -> None:
    alone = bs.measure(passes[1], at="end", **COARSE)
    assert all(any(bundle.ends_open) for bundle in alone.bundles)
    whole = [bundle for bundle in joined.bundles if abs(bundle.length_m - 7.5) < 0.15]
    assert len(whole) >= 3 and not any(any(bundle.ends_open) for bundle in whole)
    assert (np.diff(joined.trajectory.stamp_ns) > 0).all()
    assert len(joined.trajectory.stamp_ns) == 14


def test_passes_lie_together_as_well_as_their_sigmas_say(passes: tuple[Path, Path], joined: bs.Yard) -> None:
    first, second = joined.summary["passes"]
    (tie,) = second["ties"]
    assert first["ties"] == [] and tie["blocks"] > 5 and not tie["contradicts"]
    for one, path in zip((first, second), passes, strict=True):
        assert Path(one["recording"]["path"]) == path
        assert np.abs(np.median(places_off_m(joined, one, path), axis=1)).max() < 0.008


@pytest.mark.slow
def test_a_pass_whose_encoders_lost_their_reference_contradicts_and_is_moved_back(
    passes: tuple[Path, Path], tmp_path: Path
) -> None:
    """The bridge reads half a metre too much; the bars' pattern alone would fit anywhere."""
    off = tmp_path / "pass_2"
    shutil.copytree(passes[1], off)
    path = off / "mav0/crane0/data.csv"
    header, *lines = path.read_text().splitlines()
    rows = [line.split(",") for line in lines]
    moved = [f"{stamp},{float(x) + 0.5:.6f},{y},{z}" for stamp, x, y, z in rows]
    path.write_text("\n".join([header, *moved]) + "\n")
    yard = bs.measure([passes[0], off], at="end", **COARSE)
    (tie,) = yard.summary["passes"][1]["ties"]
    assert tie["contradicts"] and tie["shift_m"][0] == pytest.approx(-0.5, abs=0.01)
    assert "passes-contradict" in [one["code"] for one in yard.summary["warnings"]]
    assert "trajectory-degraded" in [one["code"] for one in yard.summary["vetoes"]]


def test_passes_whose_trolley_travels_meanwhile_lie_together(tmp_path: Path) -> None:
    """The way back is driven obliquely too: the trolley goes 0.8 m within each pass."""
    oblique = replace(PASSES, seed=720021, motion=replace(PASSES.motion, trolley_m=0.8))
    simulate_passes(tmp_path / "yard", oblique)
    recordings = [tmp_path / "yard" / f"pass_{number}" for number in (1, 2)]
    yard = bs.measure(recordings, at="end", **COARSE)
    (tie,) = yard.summary["passes"][1]["ties"]
    assert tie["blocks"] > 5 and not tie["contradicts"]
    ways = []
    for one, path in zip(yard.summary["passes"], recordings, strict=True):
        assert np.abs(np.median(places_off_m(yard, one, path), axis=1)).max() < 0.008
        ways.append(np.ptp(bs.open_recording(path).crane().position_m[:, 1]))
    assert min(ways) > 0.7
    alone = bs.measure(recordings[0], at="end", **COARSE)
    one, both = (np.nanmedian(np.abs(heights_off_m(each, recordings[0]))) for each in (alone, yard))
    assert both < one + 0.002


def heights_off_m(yard: bs.Yard, path: Path) -> np.ndarray:
    """Errors of a map's heights against a recording's truth."""
    heights = yard.height_map
    with np.load(path / "truth/height.npz") as truth:
        i = np.abs(truth["x"][:, None] - heights.x_m).argmin(axis=0)
        j = np.abs(truth["y"][:, None] - heights.y_m).argmin(axis=0)
        off: np.ndarray = heights.z_m - truth["z"][np.ix_(i, j)].T
    return off


def places_off_m(joined: bs.Yard, one: dict[str, Any], path: Path) -> np.ndarray:
    """(3, N) errors of a pass's poses, m."""
    truth = np.loadtxt(path / "mav0/state_groundtruth_estimate0/data.csv", delimiter=",", usecols=range(4))
    stamps = joined.trajectory.stamp_ns
    own = (stamps >= one["trajectory"]["first_ns"]) & (stamps <= one["trajectory"]["last_ns"])
    at = (stamps[own] - truth[0, 0]) / 1e9 + open_recording_shift(path)
    true = np.stack([np.interp(at, (truth[:, 0] - truth[0, 0]) / 1e9, axis) for axis in truth[:, 1:].T])
    off: np.ndarray = joined.trajectory.position_m[own].T - true
    return off


def open_recording_shift(path: Path) -> float:
    return bs.open_recording(path).rig.timeshift_cam_imu_ns / 1e9


def test_what_was_taken_is_told_and_the_newer_height_stands(
    passes: tuple[Path, Path], joined: bs.Yard
) -> None:
    (gone,) = json.loads((passes[1] / "truth/changes.json").read_text())
    x, _, z = gone["center"]
    changes = joined.summary["passes"][1]["changes"]
    here = [c for c in changes if c["low_m"][0] < x < c["high_m"][0]]
    assert here and all(c["rise_m"] < -0.1 for c in here)
    assert any(code == "yard-changed" for code, _ in joined.warnings)
    with np.load(passes[1] / "truth/height.npz") as truth:
        seen = truth["z"][np.ix_(np.abs(truth["x"] - x) < 0.08, np.abs(truth["y"]) < 0.8)]
    heights = joined.height_map
    there = heights.z_m[np.ix_(np.abs(heights.y_m) < 0.8, np.abs(heights.x_m - x) < 0.08)]
    assert np.nanmedian(there) == pytest.approx(np.median(seen), abs=0.1)  # it was 0.35 m high
    assert z > 0.15
    left = [b for b in joined.bundles if abs(b.centre_m[0] - x) < 0.1]
    assert all(STALE in b.cover_doubts for b in left)


def test_a_lift_is_as_old_as_the_pass_that_alone_saw_a_part_of_it(joined: bs.Yard) -> None:
    """Pass 1 goes at y = -2, pass 2 at y = 2 two minutes later; bundles reach from -3.75 to 3.75 m."""
    first, second = joined.summary["passes"]
    assert second["captured_from_ns"] - first["captured_to_ns"] > 60e9
    heights = read_heights(joined.folder)
    seen = heights.whole().passes
    assert seen is not None and set(np.unique(seen)) == {0, 1, 2}
    y_m = heights.y0_m + heights.cell_m * np.arange(heights.shape[0])
    assert (seen[y_m < -3.0] < 2).mean() > 0.9 and (seen[y_m > 2.0] != 1).all()
    lifts = [one for one in (*joined.lifts.past, *joined.lifts.refused) if one.record["valid_from_ns"]]
    low = {b.id: min(b.ends_m[:, 1]) for b in joined.bundles}
    reaching = [one for one in lifts if one.bundles and min(low[k] for k in one.bundles) < -3.3]
    assert len(reaching) >= 3
    assert all(one.record["valid_from_ns"] <= first["captured_to_ns"] for one in reaching)


@pytest.mark.slow
def test_a_session_of_two_passes_ends_as_the_batch(passes: tuple[Path, Path], joined: bs.Yard) -> None:
    recordings = [bs.open_recording(path) for path in passes]
    session = bs.Session(recordings[0].rig, imu_noise=recordings[0].imu_noise(), is_simulated=True, **COARSE)
    for number, recording in enumerate(recordings):
        if number:
            session.next_pass()
        for packet in bs.packets(recording):
            session.push(packet)
    yard = session.finish()
    for name in (
        "height.tif",
        "contour.csv",
        "trajectory.tum",
        "cloud.ply",
        "free.tif",
        "tops.tif",
        "passes.tif",
    ):
        assert (yard.folder / name).read_bytes() == (joined.folder / name).read_bytes(), name


@pytest.fixture(scope="module")
def two_pairs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """One pass, seen by two pairs on one body, 2.4 m apart across the travel."""
    folder = tmp_path_factory.mktemp("pairs")
    one = replace(PASSES, seed=710011, passes=PassesSettings())
    for number, across_m in enumerate((-1.2, 1.2)):
        camera = replace(one.camera, aside_m=across_m)
        simulate(folder / f"pair_{number}", replace(one, camera=camera))
    return folder / "pair_0", folder / "pair_1"


def test_a_second_pair_on_the_body_sees_further_and_agrees(two_pairs: tuple[Path, Path]) -> None:
    """Two pairs make one map, as right as one alone, and what stands in both is no change."""
    alone, both = (bs.measure(given, at="end", map={"cell_m": 0.02}) for given in (two_pairs[:1], two_pairs))
    assert not both.summary["passes"][1]["changes"] and not both.summary["passes"][0]["changes"]
    assert {code for code, _ in both.warnings}.isdisjoint(
        {"passes-contradict", "passes-untied", "yard-changed"}
    )
    assert np.all(np.diff(both.trajectory.stamp_ns) >= 0)
    known, off = [], []
    for yard in (alone, both):
        error = heights_off_m(yard, two_pairs[0])
        known.append(np.isfinite(error).sum())
        off.append(np.nanmedian(np.abs(error)))
    assert known[1] > 1.3 * known[0]
    assert off[1] < off[0] + 0.001


def test_a_list_of_one_is_one_recording(whole: Path) -> None:
    one, listed = (bs.measure(path, at="end", **COARSE) for path in (whole, [whole]))
    for path in sorted(one.folder.iterdir()):
        if path.name != "result.json":
            assert path.read_bytes() == (listed.folder / path.name).read_bytes(), path.name
    timed = ("measured_at", "stages", "seconds", "peak_memory_mib")
    left, right = ({k: v for k, v in y.summary.items() if k not in timed} for y in (one, listed))
    assert left == right and "passes" not in left


def test_what_can_not_be_joined_is_refused(passes: tuple[Path, Path], whole: Path) -> None:
    with pytest.raises(InputError, match="at the same time"):
        bs.measure([passes[0], passes[0]])
    with pytest.raises(InputError, match="differ from those"):
        bs.measure([passes[1], whole])
    with pytest.raises(InputError, match="encoders"):
        bs.measure(list(passes), use=("stereo", "imu"))
    with pytest.raises(ConfigError, match="no recording"):
        bs.measure([])


def test_a_changed_calibration_of_an_older_pass_forbids_the_lifts(
    passes: tuple[Path, Path], joined: bs.Yard, tmp_path: Path
) -> None:
    summary = json.loads(json.dumps(joined.summary))
    assert changed_inputs(summary) == ""
    summary["passes"][0]["inputs"]["cam0/sensor.yaml"] = "0" * 64
    summary["passes"][0]["inputs"].pop("mav0/cam0/sensor.yaml", None)
    assert changed_inputs(summary).endswith("pass_1/mav0/cam0/sensor.yaml")


def test_the_way_back_is_driven_backwards(passes: tuple[Path, Path]) -> None:
    out, back = (
        np.loadtxt(path / "mav0/crane0/data.csv", delimiter=",", usecols=(0, 1, 2)) for path in passes
    )
    assert out[-1, 1] > out[0, 1] + 3 and back[-1, 1] < back[0, 1] - 3
    assert back[0, 0] - out[-1, 0] == pytest.approx(PASSES.passes.pause_s * 1e9, abs=1e8)
    assert np.median(back[:, 2] - out[: len(back), 2]) == pytest.approx(4.0, abs=0.01)
