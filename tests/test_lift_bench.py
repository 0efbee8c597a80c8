"""The bench of lifts: its scenes are the drawn solids, its counts what was judged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barsight.benchmarks.lift_judge.envelopes import envelope
from barsight.benchmarks.lift_judge.judge import Judge, Target
from barsight.benchmarks.lift_judge.magnet import magnet_of, read_magnet
from barsight.benchmarks.provenance import provenance
from barsight.benchmarks.yard import world_runs
from barsight.benchmarks.yard.drawn_worlds import drawn_scene, noisy_world, recording_settings
from barsight.benchmarks.yard.judged_lifts import (
    JudgedBench,
    JudgedLift,
    bench_table,
    judge_yard,
    upper_bound,
)
from barsight.benchmarks.yard.liftable_bundles import liftable_bundles
from barsight.cli.bench import lifts
from barsight.cli.bench.lifts import bench_lift_targets
from barsight.cli.main import run
from barsight.core.errors import ConfigError
from barsight.simulation.sensors import heights
from barsight.simulation.simulate import LaidYard, World
from barsight.simulation.worlds.packing import tag
from barsight.simulation.worlds.solids import SolidYard, cylinder
from barsight.simulation.worlds.yards import DrawnYard, draw_yard
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.contact import FaceHeights
from barsight.yard.magnet.description import example_magnet, load_magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.magnet.holding import hold_load
from barsight.yard.placement.checks import face_checks
from barsight.yard.placement.clearance import FacePlane
from barsight.yard.placement.labels import find_labels, rests_on_label
from lift_yards import laid, record


@pytest.mark.parametrize("seed", [5, 7])
def test_the_renderer_sees_the_solids_that_are_judged(seed: int) -> None:
    world = draw_yard(seed, 3.0, 1.5)
    scene = drawn_scene(world)
    drawn = envelope(world.yard, (0.0, -1.5), (world.size_m[0], 2.0), step=0.037)
    i, j = np.meshgrid(np.arange(drawn.z.shape[0]), np.arange(drawn.z.shape[1]), indexing="ij")
    cast = heights(scene, (drawn.x0 + 0.037 * i).ravel(), (drawn.y0 + 0.037 * j).ravel()).reshape(i.shape)
    # At a cylinder's very side one of the two may just miss it.
    assert (np.abs(cast - drawn.z) < 1e-5).mean() > 0.999 and drawn.z.max() > 0.2
    way = World.over(LaidYard(scene, {}), recording_settings(world))
    assert way.scene is scene and len(way.frame_stamp_ns) >= 6


def test_the_bench_tells_what_was_judged(tmp_path: Path) -> None:
    described = tmp_path / "magnet.toml"
    described.write_text(example_magnet(), encoding="utf-8")
    magnet, settings = read_magnet(described), LiftSettings()
    world = draw_yard(4, 2 * magnet.half_span_m + 0.3, 1.2)
    mapped = noisy_world(world, settings)
    judged = tuple(judge_yard(world, mapped, load_magnet(described), magnet, settings, 4))
    masses = [world.yard.load(bundle)[0] for bundle in world.yard.bundles]
    assert len(judged) >= 4 and all(not one.vetoes for one in judged if one.offered)
    for one in judged:
        assert np.isnan(one.true_mass_kg) or min(abs(one.true_mass_kg - kg) for kg in masses) < 1e-6
    offered = {one.load for one in judged if one.offered}
    bundles = tuple(liftable_bundles(world, magnet, offered))
    assert bundles and {one.bundle for one in bundles} <= set(world.free)
    for one in bundles:
        target = Target(one.x_m, one.y_m, np.radians(one.yaw_deg), magnet.tolerance)
        verdict = Judge(world.yard, magnet).judge(target)
        assert verdict.is_fine and verdict.load == (one.bundle,) and one.offered == (verdict.load in offered)
    table = bench_table(JudgedBench.of(1, judged, bundles))
    assert table.row_count == 11


def layer_with_label(diameter_m: float, along_m: float | None) -> DrawnYard:
    """A flat layer of bars on the floor, perhaps with a label on the middle one."""
    radius, along = diameter_m / 2, np.array([0.0, 1.0, 0.0])
    cross = np.array([(k * diameter_m, radius) for k in range(-4, 5)])
    solids = [cylinder("bar", np.array([x, 0.0, z]), along, radius, 5.7, 0) for x, z in cross]
    solids += [] if along_m is None else [tag(cross[4:5], radius, along_m * along, np.eye(3), 0)]
    return DrawnYard(0, "row", SolidYard(tuple(solids)), (), (0.4, 6.0))


def test_a_label_that_would_hold_the_faces_off_shows_in_the_photo() -> None:
    found = []
    for along_m in (None, 0.7):
        height_map = noisy_world(layer_with_label(0.09, along_m), LiftSettings()).scene.heights
        place, plane = Placement(0.0, 0.0, 0.0), FacePlane(0.09, 0.0, 0.0, 0.002)
        found.append(find_labels(place, height_map, load_magnet(None), plane))
    assert not found[0] and found[1][0].place_under(place) == pytest.approx((0.7, 0.0), abs=0.05)


@pytest.mark.parametrize("along_m", [0.7, 2.3])
@pytest.mark.parametrize("diameter_m", [0.025, 0.05, 0.09])
def test_faces_on_a_label_pull_and_touch_no_less_than_is_told(
    tmp_path: Path, diameter_m: float, along_m: float
) -> None:
    described = tmp_path / "magnet.toml"
    described.write_text(example_magnet(), encoding="utf-8")
    magnet, settings, world = load_magnet(described), LiftSettings(), layer_with_label(diameter_m, along_m)
    scene, judge = noisy_world(world, settings).scene, Judge(world.yard, read_magnet(described))
    load = (record(laid(0.0), bar_diameter_m=diameter_m, bars=None),)
    for off_m in (-0.03, 0.0, 0.012):
        place = Placement(off_m, 0.0, 0.0)
        faces = FaceHeights.of(scene.heights, place, magnet)
        assert faces is not None
        bare = faces.rest(magnet, settings.contact_gap_m)
        (label,) = find_labels(place, scene.heights, magnet, FacePlane.of(bare))
        told = []
        for contact in rests_on_label(label, place, faces, bare, magnet, settings):
            held = hold_load(contact, magnet, load, settings.strap_m)
            (share,) = (
                c for c in face_checks(held, 1.0, magnet, load, settings) if c.what.startswith("share")
            )
            told.append((held.pull_low_n, share.value - share.sigma))
        verdict = judge.judge(Target(off_m, 0.0, 0.0, (0.0, 0.0, 0.0)))
        pull_n, least = np.min(told, axis=0)
        assert 0 < pull_n <= verdict.pull_n and pull_n < hold_load(bare, magnet, load, 0.0012).pull_low_n
        assert 0 < least <= -verdict.figures["share on the load"]


def test_placements_for_danger_say_nothing_of_what_is_refused(tmp_path: Path) -> None:
    described = tmp_path / "magnet.toml"
    described.write_text(example_magnet(), encoding="utf-8")
    magnet, settings = read_magnet(described), LiftSettings()
    world = draw_yard(45, 2 * magnet.half_span_m + 0.3, 1.2)
    given = world, noisy_world(world, settings), load_magnet(described), magnet, settings
    offered = len(tuple(judge_yard(*given, 0)))
    judged = tuple(judge_yard(*given, 1, 5))
    more = judged[offered + 1 :]
    assert more and all(one.for_danger and not one.vetoes for one in more)
    assert not any(one.for_danger for one in judged[: offered + 1])
    both, first = (
        [str(cell) for cell in bench_table(JudgedBench.of(1, lifts)).columns[1].cells]
        for lifts in (judged, judged[: offered + 1])
    )
    assert both[0] != first[0] and both[5:8] == first[5:8]


def test_the_judge_reads_the_magnet_as_the_product_does(tmp_path: Path) -> None:
    described = tmp_path / "magnet.toml"
    described.write_text(example_magnet(), encoding="utf-8")
    magnet, other = load_magnet(described), read_magnet(described)
    assert other.poles == pytest.approx(magnet.pole_table)
    assert other.reach_m == magnet.reach_m and other.factor == magnet.needed_factor
    assert other.carries_kg == min(magnet.capacity_kg, magnet.crane_capacity_kg - magnet.own_mass_kg)
    with pytest.raises(KeyError):
        magnet_of({"poles": []})


def test_the_upper_bound_is_clopper_and_pearsons() -> None:
    assert upper_bound(0, 2995) == pytest.approx(1 - 0.05 ** (1 / 2995))
    assert upper_bound(2, 140) == pytest.approx(0.0443, abs=5e-4)
    assert upper_bound(3, 3) == 1.0


def test_what_is_kept_is_done_again_for_other_sources_magnets_and_sizes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = list[str]()

    def make(name: str, made: Path) -> None:
        done.append(name)
        made.mkdir()

    def render(_: object, out: Path, *, full_size: bool, trolley_y_m: tuple[float, ...]) -> None:
        make("rendered", out)
        for number in range(len(trolley_y_m)):
            (out / f"pass_{number + 1}").mkdir()

    def measure(paths: Path | list[Path], out: Path, *_: object, **__: object) -> None:
        make("measured" if isinstance(paths, Path) else f"measured {[path.name for path in paths]}", out)

    monkeypatch.setattr(lifts, "render_world", render)
    monkeypatch.setattr(lifts, "measure_into", measure)
    monkeypatch.setattr(lifts, "measured_world", lambda *_: noisy_world(draw_yard(4, 3, 1), LiftSettings()))
    monkeypatch.setattr(lifts, "judge_yard", lambda *_: ())
    monkeypatch.setattr(lifts, "liftable_bundles", lambda *_: ())
    short = tmp_path / "short.toml"
    short.write_text(example_magnet().replace("2.1", "1.6"), encoding="utf-8")

    def run(magnet: Path | None = None, *trolley_y_m: float, full_size: bool = False) -> list[str]:
        done.clear()
        choice = lifts.YardChoice(rendered=True, full_size=full_size, trolley_y_m=trolley_y_m)
        bench_lift_targets("4:5", choice, 0, keep=tmp_path / "kept", magnet=magnet)
        return done.copy()

    both = ["rendered", "measured"]
    assert run() == both and run() == []
    assert run(full_size=True) == both and run(short) == both and run(short) == []
    assert run(short, -1.5, 1.8) == ["rendered", "measured ['pass_1', 'pass_2']"]
    assert run(short, -1.5, 1.8) == [] and len(run(short, -1.5, 1.9)) == 2
    assert run(short) == both
    monkeypatch.setattr(world_runs, "sources_digest", lambda _, names: str("yard" in names))
    assert run(short) == both
    monkeypatch.setattr(world_runs, "sources_digest", lambda _, names: "new" if "yard" in names else "False")
    assert run(short) == ["measured"]


def test_passes_need_pictures_and_places_on_the_yard() -> None:
    for rendered, trolley_y_m in ((False, (0.0,)), (True, (0.0, 99.0))):
        with pytest.raises(ConfigError, match=r"trolley.y.m"):
            lifts.YardChoice(rendered=rendered, trolley_y_m=trolley_y_m)


def test_a_hundred_placements_on_one_yard_are_not_a_hundred_yards() -> None:
    """A tenth of the yards hold a danger in half of their placements: the bound holds in 95 %."""
    one = JudgedLift(0, "", False, 0, 0, 0, (), (), (), 1, 1, 1, 1, 1, (0,))
    rng, held, made = np.random.default_rng(5), 0, provenance()
    for _ in range(100):
        lifts = [
            replace(one, seed=seed, dangerous=("over",) * (is_bad and k % 2))
            for seed, is_bad in enumerate((rng.random(16) < 0.1).tolist()) for k in range(10)
        ]  # fmt: skip
        told = str(list(bench_table(JudgedBench(16, tuple(lifts), (), made)).columns[1].cells)[1])
        assert "of 16 yards" in told
        held += float(told.split("bound ")[1].split(" %")[0]) >= 5.0
    assert held >= 95


@pytest.mark.parametrize(
    ("offered", "vetoes", "dangerous", "code"),
    [(True, (), ("on",), 5), (False, (), ("on",), 5), (False, ("edge",), ("on",), 0), (True, (), (), 0)],
)
def test_a_danger_without_a_veto_fails_the_bench(
    offered: bool, vetoes: tuple[str, ...], dangerous: tuple[str, ...], code: int,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    one = JudgedLift(0, "", offered, 0, 0, 0, vetoes, dangerous, (), 1, 1, 1, 1, 1, (0,))
    monkeypatch.setattr(lifts, "over_seeds", lambda *_: [(0, ((one,), ()))])
    assert run(["bench", "lifts", "--seeds", "0:1"]) == code
    assert ("dangerous placements without a veto: 1" in capsys.readouterr().err) == (code != 0)


@pytest.mark.parametrize("seeds", ["7", "9:9", "a:b"])
def test_seeds_that_are_none_are_told(seeds: str) -> None:
    with pytest.raises(ConfigError, match="500:560"):
        bench_lift_targets(seeds=seeds)
