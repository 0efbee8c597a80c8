"""The bench of drawn worlds: its scores by hand, what is kept, what counts as looked at."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from barsight.benchmarks.yard import world_runs, world_scores
from barsight.benchmarks.yard.bundle_scores import TrueBundle, bars_mass, read_true_bundles, score_bundles
from barsight.benchmarks.yard.world_runs import WorldKeys, keep_measured, looked_at_list, read_note, run_world
from barsight.benchmarks.yard.world_scores import WorldScore, world_rows
from barsight.cli.main import run
from barsight.core.errors import MeasurementError, OutputError
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from lift_yards import laid, record

GIVEN = SimulationSettings(
    length_m=1.6, frames=4, depth_views=0,
    camera=CameraSettings(width_px=160, height_px=128, focal_px=156.0),
)  # fmt: skip
MAP = {"samples": 100.0, "p95_mm": 8.0, "within_95_pct": 90.0, "coverage_pct": 99.0}
COUNTS = {
    "free": 4, "found": 3, "claimed": 4, "wrong": 1, "said_count": 2, "right_count": 1, "single": 0,
    "single_found": 0, "nowhere": 0,
}  # fmt: skip


def world(seed: int, kind: str, p95_mm: float, samples: float, inside: float) -> WorldScore:
    figures = MAP | {"p95_mm": p95_mm, "samples": samples, "within_95_pct": inside}
    errors = {"top": [0.001 * seed, -0.004, float("nan")]}
    sigmas = {"top": [0.002, 0.001, 0.001]}
    poses = {"samples": 6.0, "rmse_mm": 2.0, "max_mm": 3.0, "within_95_pct": 50.0}
    return WorldScore(seed, kind, (), "", "", {"height, seen by two": figures}, poses, COUNTS, errors, sigmas)


def test_rows_are_medians_worst_cases_and_weighted_shares() -> None:
    refused = replace(world(9, "loose", 0.0, 1.0, 0.0), refused="too dark", maps={}, counts={})
    worlds = [world(1, "loose", 10.0, 100.0, 100.0), world(2, "nested", 30.0, 300.0, 80.0), refused]
    rows = {(row.kind, row.figure): row for row in world_rows(worlds)}
    cells = rows["all", "height, seen by two: P95, mm"]
    assert (cells.n, cells.median, cells.worst, cells.seed) == (400, 20.0, 30.0, 2)
    assert cells.within_95_pct == pytest.approx(85)
    assert rows["loose", "height, seen by two: P95, mm"].worst == 10
    top = rows["all", "bundles: top, mm"]
    assert (top.n, top.worst, top.seed) == (4, 4.0, 1) and top.median == pytest.approx(3.0)
    assert top.within_95_pct == pytest.approx(50)
    found = rows["all", "free bundles found, %"]
    assert (found.n, found.median) == (8, 75.0)
    assert rows["all", "said to be free and is not, %"].worst == 25
    assert ("all", "single bars found, %") not in rows


def test_a_true_width_is_that_of_the_outline(tmp_path: Path) -> None:
    row = {
        "center": [1.0, 0.0, 0.2], "yaw_deg": 0.0, "length": 5.0, "bundle_radius": 0.17, "top_z": 0.4,
        "bar_diameter": 0.05, "bars": 30, "on_top": True, "outline": [[0.86, 0.2], [1.0, 0.4], [1.15, 0.2]],
    }  # fmt: skip
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "bundles.json").write_text(json.dumps([row]))
    (true,) = read_true_bundles(tmp_path)
    assert true.width_m == pytest.approx(0.29)


def test_a_mass_is_held_against_the_true_bars() -> None:
    found = record(laid(0.3))
    assert found.bars is not None
    mass = bars_mass(found.bars, found.bar_diameter_m, found.length_m)
    true = TrueBundle(
        found.centre_m, found.yaw_rad, found.length_m, found.width_m, found.top_z_m, found.bar_diameter_m,
        found.bars, True, mass + 30.0,
    )  # fmt: skip
    scores = score_bundles((found,), (true,))
    assert scores.found == 1 and 1e3 * scores.errors["mass"][0] == pytest.approx(-30)
    # A diameter of another packing is an error like any.
    thick = score_bundles((replace(found, bar_diameter_m=3 * found.bar_diameter_m),), (true,))
    assert thick.errors["diameter"][0] == pytest.approx(2 * found.bar_diameter_m)


def test_poses_are_scored_on_the_ground_below(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A body 5 mm too far along x, and turned by 1 mrad about y: 8 mm on the ground 8 m below."""
    recording, out = tmp_path / "recording", tmp_path / "out"
    truth = recording / "mav0/state_groundtruth_estimate0"
    for folder in (truth, recording / "truth", out):
        folder.mkdir(parents=True)
    head = "#timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z\n"
    rows = [f"{10**15 + k * 10**8},{0.1 * k:.4f},0,8,1,0,0,0\n" for k in range(10)]
    (truth / "data.csv").write_text(head + "".join(rows))
    (recording / "truth/rig.json").write_text(json.dumps({"time_offset_s": 0.05}))
    stamps = [10**15 + k * 10**8 - 5 * 10**7 for k in range(2, 8)]
    tum = [
        f"{t // 10**9}.{t % 10**9:09d} {0.1 * k + 0.005:.4f} 0 8 0 0.0005 0 1\n"
        for k, t in enumerate(stamps, 2)
    ]
    (out / "trajectory.tum").write_text("# t x y z qx qy qz qw\n" + "".join(tum))
    travel = {"stamp_ns": stamps, "sigma_m": [[0.01, 0.001, 0.001]] * 6}
    monkeypatch.setattr(world_scores, "read_summary", lambda _: {"reference": "yard", "travel": travel})
    poses = world_scores._poses(recording, out)
    assert poses["samples"] == 18 and poses["within_95_pct"] == 100
    assert poses["rmse_mm"] == pytest.approx(3.0, abs=0.01)  # 5 mm forward, 8 mm back by the turn
    assert poses["turn_rmse_deg"] == pytest.approx(math.degrees(0.001), abs=1e-4)
    assert poses["aligned_turn_rmse_deg"] < 1e-4
    # The turn would have lifted the frames at one end, which aren't: 1 mrad over the way's spread.
    assert poses["aligned_rmse_mm"] == pytest.approx(0.1 * math.sqrt(35 / 12), abs=0.01)
    travel["sigma_m"] = [[0.001, 0.001, 0.001]] * 6
    assert world_scores._poses(recording, out)["within_95_pct"] == pytest.approx(200 / 3)


def test_a_world_is_done_once_and_a_refusal_is_a_score(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise MeasurementError("too dark")

    def full(*_: object, **__: object) -> None:
        raise OutputError("no space left")

    keys = WorldKeys.of(GIVEN)
    with pytest.raises(OutputError, match="no space"):
        run_world(tmp_path, 101, GIVEN, keys, full, "")
    first = run_world(tmp_path, 101, GIVEN, keys, refuse, "")
    assert (first.seed, first.refused, first.looked_at) == (101, "too dark", "") and not first.maps

    def never(*_: object, **__: object) -> None:
        raise AssertionError("done again")

    monkeypatch.setattr(world_runs, "simulate_world", never)
    assert run_world(tmp_path, 101, GIVEN, keys, never, "a threshold") == replace(
        first, looked_at="a threshold"
    )
    assert run_world(tmp_path, 101, GIVEN, keys, never, "").looked_at == "a threshold"
    with pytest.raises(AssertionError, match="done again"):
        run_world(tmp_path, 101, GIVEN, replace(keys, measured="other sources"), never, "")
    with pytest.raises(AssertionError, match="done again"):
        run_world(tmp_path, 101, GIVEN, replace(keys, recording="other settings"), never, "")
    assert not (tmp_path / "seed_101/recording").exists()
    (tmp_path / "seed_1").mkdir()
    (tmp_path / "seed_1/letter.txt").write_text("dear")
    with pytest.raises(OutputError, match="other things"):
        run_world(tmp_path, 1, GIVEN, keys, never, "")


def test_a_killed_run_leaves_nothing_under_another_runs_keys(tmp_path: Path) -> None:
    """Pictures of one yard were measured as another's."""
    one, other = WorldKeys("r1", "m1", "s1"), WorldKeys("r2", "m2", "s2")
    seen: list[str] = []

    def run(keys: WorldKeys, *, killed: bool = False) -> list[str]:
        def render(recording: Path) -> None:
            recording.mkdir()
            (recording / "of").write_text(keys.recording)

        def measure(recording: Path, out: Path) -> None:
            if killed:
                raise KeyboardInterrupt
            seen.append((recording / "of").read_text())
            out.mkdir()

        seen.clear()
        keep_measured(tmp_path, read_note(tmp_path, "worlds"), keys, render, measure)
        return seen.copy()

    assert run(one) == ["r1"] and run(one) == []
    with pytest.raises(KeyboardInterrupt):
        run(other, killed=True)
    assert run(one) == ["r1"]
    assert run(replace(one, measured="m3")) == ["r1"]
    shutil.rmtree(tmp_path / "measured")
    assert run(replace(one, measured="m3")) == ["r1"], "what was removed by hand is done again"
    with pytest.raises(OutputError, match="belongs to bench worlds"):
        read_note(tmp_path, "lifts")


def test_keys_follow_settings() -> None:
    one, two = WorldKeys.of(GIVEN), WorldKeys.of(replace(GIVEN, frames=5))
    assert one == WorldKeys.of(GIVEN) and one.recording != two.recording and one.score != two.score


def test_seeds_that_were_looked_at_are_listed() -> None:
    listed = looked_at_list()
    assert listed[0] and 10**6 not in listed


@pytest.mark.parametrize("flags", [["--seeds", "5"], ["--seeds", "5:5"], ["--looked-at", "why"]])
def test_mistakes_end_in_one_line(flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "worlds", *flags]) == 2
    assert capsys.readouterr().err.count("\n") == 1
