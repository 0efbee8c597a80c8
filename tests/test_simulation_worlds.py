"""Drawn worlds: packs, piles that physics settles, what covers a bundle, and a recording with its truth."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barsight.cli.main import run
from barsight.core.errors import ConfigError
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.travel import TravelSettings
from barsight.simulation.textures import label_text
from barsight.simulation.truth import label_rows
from barsight.simulation.worlds.conditions import draw_conditions
from barsight.simulation.worlds.packing import packed
from barsight.simulation.worlds.piles import Manner, Upright, pile_up
from barsight.simulation.worlds.recording import cover, draw_world
from barsight.simulation.worlds.settling import SKIN_M, BarPack, settle
from barsight.simulation.worlds.solids import SolidYard, cylinder
from barsight.simulation.worlds.surfaces import owners, scene_of
from barsight.simulation.worlds.yards import (
    KINDS,
    LOOSE,
    ORDERLY,
    SPILLED,
    DrawnBundle,
    draw_yard,
    kind_of,
)

GIVEN = SimulationSettings(
    length_m=1.6, frames=4, depth_views=0,
    camera=CameraSettings(width_px=160, height_px=128, focal_px=156.0),
)  # fmt: skip
Y = np.array([0.0, 1.0, 0.0])


def test_packs_are_tight_and_not_always_a_lattice() -> None:
    loose = 0
    for seed in range(12):
        places = packed(12, 0.08, np.random.default_rng(seed))
        away = np.hypot(*(places[:, None] - places[None]).T)
        nearest = np.sort(away + np.eye(12), axis=1)
        assert nearest[:, 0].min() > 0.08 * 0.999 and nearest[:, 1].max() < 0.12
        # In a lattice no two lie between one and 1.73 diameters apart.
        loose += bool(((away > 1.1 * 0.08) & (away < 1.65 * 0.08)).any())
    assert loose >= 2


def test_a_bar_settles_in_the_groove_of_two_that_lie_fast() -> None:
    lying = [BarPack(np.array([[x, 0.05]]), 0.05) for x in (-0.07, 0.07)]
    bar = settle([BarPack(np.array([[0.02, 0.3]]), 0.05)], lying)[0]
    groove = 0.05 + math.sqrt(0.1**2 - 0.07**2)
    assert bar.cross[0] == pytest.approx([0.0, groove], abs=3 * SKIN_M)


def test_a_bundle_on_its_edge_falls_onto_its_flat_side() -> None:
    discs = np.array([[x, z] for x in (-0.1, 0.0, 0.1) for z in (0.0, 0.1)])
    turn = math.radians(55)
    c, s = math.cos(turn), math.sin(turn)
    on_edge = BarPack(discs @ np.array([[c, s], [-s, c]]) + (0.0, 0.3), 0.05)
    settled = settle([on_edge])[0]
    low = settled.cross[:, 1]
    assert np.sort(low) == pytest.approx(np.repeat([0.05, 0.15], 3), abs=0.003)
    assert np.hypot(*(settled.cross[0] - settled.cross[5])) == pytest.approx(np.hypot(0.2, 0.1))


def deepest_overlap(packs: Sequence[BarPack]) -> float:
    """The deepest overlap between discs of different packs, m; negative where all lie apart."""
    discs = np.vstack([np.column_stack([p.cross, np.full(len(p.cross), p.radius)]) for p in packs])
    number = np.repeat(np.arange(len(packs)), [len(p.cross) for p in packs])
    deepest = -np.inf
    for k, (x, z, radius) in enumerate(discs):
        other = number > number[k]
        if other.any():
            away = np.hypot(discs[other, 0] - x, discs[other, 1] - z)
            deepest = max(deepest, float((radius + discs[other, 2] - away).max()))
    return deepest


@pytest.mark.parametrize(
    ("manner", "upright"),
    [("layered", "wedges"), ("nested", "stanchions"), ("loose", "walls"), ("orderly", "wedges")],
)
def test_piles_cut_into_nothing(manner: Manner, upright: Upright) -> None:
    for seed in range(3):
        pile = pile_up(manner, upright, 1.6, 3.0, np.random.default_rng(seed))
        packs = [one.pack for one in pile.lying]
        assert len(packs) >= 3 and deepest_overlap(packs) < SKIN_M
        assert min(float(p.cross[:, 1].min()) - p.radius for p in packs) > -2 * SKIN_M


@pytest.mark.parametrize("seed", range(10))
def test_yards_are_piled_without_cutting_into_each_other(seed: int) -> None:
    world = draw_yard(seed, 2.0, 2.4)
    assert world.kind == KINDS[seed] and len(world.bundles) >= 3
    counts = {b.number: len(b.cross_m) for b in world.bundles}
    for bundle in world.bundles:
        bars = world.yard.bars(bundle.number)
        assert len(bars) % counts[bundle.number] == 0  # a bowed bar is several pieces
        volume = sum(math.pi * b.half[1] ** 2 * 2 * b.half[0] for b in bars)
        whole = counts[bundle.number] * math.pi * (bundle.diameter_m / 2) ** 2 * bundle.length_m
        assert 0.75 * whole < volume <= 1.001 * whole
    for y in (-0.6, 0.0, 0.5):
        for section in {b.section for b in world.bundles}:
            _expect_apart([b for b in world.bundles if b.section == section and b.layer < 3], y)


def test_orderly_yards_hold_whole_bundles_of_one_sort() -> None:
    """Full hexagons in even layers: six bars at one diameter's distance about the middle one."""
    for seed in range(6):
        world = draw_yard(seed, 2.0, 2.4, kind=ORDERLY)
        strapped = [b for b in world.bundles if b.number < LOOSE]
        assert world.kind == ORDERLY and {b.manner for b in strapped} == {"orderly"}
        for section in {b.section for b in strapped}:
            own = [b for b in strapped if b.section == section]
            assert len({(len(b.cross_m), b.diameter_m) for b in own}) == 1
            for one in own:
                away = np.sort(np.hypot(*one.cross_m.T)) / one.diameter_m
                assert len(away) in (7, 19, 37, 61)
                assert away[0] < 1e-6 and away[1:7] == pytest.approx(1.001, abs=1e-6)
                # Cut to 2 %, of which uneven ends take up to 0.13 m on the average.
                assert one.length_m >= 0.97 * max(o.length_m for o in own) - 0.15
    assert kind_of(seed) != ORDERLY and draw_yard(5, 2.0, 2.4).kind == KINDS[5]


def test_single_bars_lie_in_grooves_of_a_spilled_yards_highest_bundles() -> None:
    laid = 0
    for seed in range(4):
        world = draw_yard(seed, 2.0, 2.4, kind=SPILLED)
        strapped = [b for b in world.bundles if b.number < LOOSE]
        for bar in (b for b in world.bundles if b.number >= LOOSE):
            below = min(strapped, key=lambda b: float(np.hypot(*(b.centre_m - bar.centre_m)[[0, 2]])))
            across = np.array([math.cos(below.yaw_rad), math.sin(below.yaw_rad)])
            aside = float((bar.centre_m - below.centre_m)[:2] @ across)
            up = float(bar.centre_m[2] - below.centre_m[2])
            apart = np.sort(np.hypot(*(below.cross_m - (aside, up)).T))
            touching = (bar.diameter_m + below.diameter_m) / 2
            assert apart[:2] == pytest.approx(touching, abs=0.003)
            assert up > below.cross_m[:, 1].max() and bar.length_m < below.length_m + 0.1
            laid += 1
    assert laid > 6


def _expect_apart(bundles: list[DrawnBundle], y: float) -> None:
    """Hold the bars' axes apart on a line across the pile."""
    yaw = float(np.median([b.yaw_rad for b in bundles]))
    along = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    packs = []
    for b in bundles:
        turned = abs(b.yaw_rad - yaw)
        if turned > 0.1:  # it lies across
            continue
        c, s = math.cos(b.yaw_rad), math.sin(b.yaw_rad)
        own = np.array([-s, c, 0.0])
        at = b.centre_m + (y - b.centre_m @ along) * own
        side = np.array([math.cos(yaw), math.sin(yaw), 0.0]) @ at
        bow = b.bow_m * (1 / 3 - (2 * (y - b.centre_m @ along) / b.length_m) ** 2)
        packs.append(BarPack(b.cross_m + np.array([side + bow, at[2]]), b.diameter_m / 2))
    if len(packs) > 1:
        assert deepest_overlap(packs) < 0.002


def test_bundles_end_where_their_bars_do_on_the_average() -> None:
    world = draw_yard(23, 5.0, 3.5)
    straight = [b for b in world.bundles if len(world.yard.bars(b.number)) == len(b.cross_m)]
    assert len(straight) > 5
    for b in straight:
        along = np.array([-math.sin(b.yaw_rad), math.cos(b.yaw_rad), 0.0])
        ends = [
            [(bar.centre + s * bar.half[0] * bar.axes[0] - b.centre_m) @ along for s in (-1, 1)]
            for bar in world.yard.bars(b.number)
        ]  # fmt: skip
        assert np.mean(ends, axis=0) == pytest.approx([-b.length_m / 2, b.length_m / 2], abs=1e-6)


def test_the_same_seed_draws_the_same_world() -> None:
    one, two = (draw_world(15, GIVEN) for _ in range(2))
    assert one.settings == two.settings and one.finishes == two.finishes
    np.testing.assert_array_equal(one.scene.primitives.shape, two.scene.primitives.shape)
    assert draw_world(16, GIVEN).settings != one.settings


def bar(x: float, z: float, number: int, along: np.ndarray = Y, length: float = 2.0) -> tuple:
    return cylinder("bar", np.array([x, 0.0, z]), along, 0.05, length, number)


@pytest.mark.parametrize(
    ("above", "share", "widest"),
    [
        (bar(0.5, 0.2, 1), 0.0, 0.0),
        (bar(0.05, 0.2, 1), 0.5, 0.5),
        (bar(0.0, 0.2, 1, np.array([1.0, 0.0, 0.0]), 0.4), 0.05, 1.0),
        (cylinder("bar", np.array([0.0, 0.013, 0.11]), np.array([1.0, 0.0, 0.0]), 0.005, 0.4, 1), 0.005, 1.0),
    ],
)
def test_cover_is_what_hides_a_bundle_from_above(above: tuple, share: float, widest: float) -> None:
    yard = SolidYard((bar(0.0, 0.05, 0), above))
    scene = scene_of(yard, {0: "rusty", 1: "oiled"}, np.random.default_rng(0))
    lying = DrawnBundle(0, 0, 0, "loose", np.array([0.0, 0.0, 0.05]), 0.0, np.zeros((1, 2)), 0.1, 2.0, 0.0)
    assert cover(scene, owners(yard), lying) == pytest.approx((share, widest), abs=0.04)


def test_short_bars_do_not_hide_their_bundle() -> None:
    """One of two bars ends early, over another bundle that lies lower: nothing lies on either."""
    short = cylinder("bar", np.array([0.1, -0.3, 0.15]), Y, 0.05, 1.4, 0)
    yard = SolidYard((bar(0.0, 0.15, 0), short, bar(0.1, 0.05, 1)))
    scene = scene_of(yard, {0: "rusty", 1: "oiled"}, np.random.default_rng(0))
    cross = np.array([[-0.05, 0.0], [0.05, 0.0]])
    lying = DrawnBundle(0, 0, 0, "nested", np.array([0.05, 0.0, 0.15]), 0.0, cross, 0.1, 2.0, 0.0)
    assert cover(scene, owners(yard), lying) == (0.0, 0.0)
    below = DrawnBundle(1, 0, 0, "nested", np.array([0.1, 0.0, 0.05]), 0.0, np.zeros((1, 2)), 0.1, 2.0, 0.0)
    assert cover(scene, owners(yard), below) == pytest.approx((0.7, 1.0), abs=0.03)


def test_conditions_spread_and_refuse_what_they_draw() -> None:
    drawn = [draw_conditions(seed, GIVEN, hides=False) for seed in range(60)]
    assert all(one.camera.width_px == 160 and one.length_m == 1.6 for one in drawn)
    for share in (
        np.mean([one.light.sun_ratio > 0 for one in drawn]),
        np.mean([one.faults.haze_ratio > 0 for one in drawn]),
        np.mean([one.motion.stops > 0 for one in drawn]),
    ):
        assert 0.1 < share < 0.6
    for own, name in (
        (replace(GIVEN, motion=TravelSettings(stops=1)), "motion"),
        (replace(GIVEN, camera=replace(GIVEN.camera, tilt_deg=3.0)), "camera.tilt_deg"),
    ):
        with pytest.raises(ConfigError, match=name):
            draw_conditions(1, own, hides=False)


def test_simulate_draws_a_world_with_its_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "world"
    flags = ["--length", "1.6", "--frames", "4", "--depth-views", "0", "--camera.width-px", "160"]
    flags += ["--camera.height-px", "128", "--camera.focal-px", "156"]
    assert run(["simulate", str(out), "--draw", "21", *flags]) == 0
    truth = json.loads((out / "truth/world.json").read_text())
    assert (truth["seed"], truth["kind"]) == (21, KINDS[21 % len(KINDS)])
    world = draw_world(21, GIVEN)
    rows = json.loads((out / "truth/bundles.json").read_text())
    assert [row["col"] for row in rows] == [b.number for b in world.drawn.bundles]
    heights = np.load(out / "truth/height.npz")
    for row in rows:
        mass = 7850 * math.pi / 4 * row["bar_diameter"] ** 2 * row["length"] * row["bars"]
        assert 0.75 * mass < row["mass_kg"] <= 1.001 * mass
        if row["on_top"] and not row["is_loose"] and abs(row["center"][0] - 0.8) < 0.5:
            # Nothing above it: the highest place over its middle is its own top.
            i = np.abs(heights["x"] - row["center"][0]) < row["width"] / 2
            j = np.abs(heights["y"] - row["center"][1]) < 0.3
            assert heights["z"][np.ix_(i, j)].max() == pytest.approx(row["top_z"], abs=0.01)
    assert len(list((out / "mav0/cam0/data").glob("*.png"))) == world.settings.frames
    assert run(["simulate", str(tmp_path / "no"), "--draw", "3", "--bars", "40mm:19"]) == 2
    assert "bars" in capsys.readouterr().err and not (tmp_path / "no").exists()


def test_tags_of_a_drawn_world_bear_codes() -> None:
    """Labels are as large as asked; nothing else of the world changes."""
    plain, given = draw_world(21, GIVEN), replace(GIVEN, yard=replace(GIVEN.yard, label_m=(0.1, 0.06)))
    world = draw_world(21, given)
    tags = np.flatnonzero(
        [s.part == "tag" for s in sorted(world.drawn.yard.solids, key=lambda s: not s.is_round)]
    )
    assert tags.size > 3
    shape, old = world.scene.primitives.shape, plain.scene.primitives.shape
    np.testing.assert_allclose(shape[tags, 12:15], [[0.03, 0.05, 0.0015]] * tags.size)
    assert np.array_equal(np.delete(shape, tags, axis=0), np.delete(old, tags, axis=0))
    texts = {row["text"] for row in label_rows(world.scene, 21)}
    assert texts == {label_text(21, owners(world.drawn.yard)[k] + 1) for k in tags}
