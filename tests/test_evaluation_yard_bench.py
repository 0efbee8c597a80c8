"""bench yard on a tiny rendered yard: a row per method, each what its folder scores."""

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from barsight.benchmarks.yard.degraded_map import _opening
from barsight.benchmarks.yard.field_test import VARIANTS
from barsight.benchmarks.yard.run_cost import RunCost, cost_table, measure_apart
from barsight.cli.bench.yard import Method
from barsight.cli.main import run
from barsight.simulation.simulate import simulate
from cli_runs import FAST, TINY


def test_every_method_can_be_asked_for() -> None:
    assert tuple(VARIANTS) == get_args(Method)
    assert VARIANTS["ours"] == ()


def test_a_cell_sees_the_sky_between_what_rises_on_either_side() -> None:
    exact = np.random.default_rng(0).choice([0.0, 0.1, 0.5], (4, 90))
    opening = _opening(exact, 0.01)
    for j, i in np.ndindex(exact.shape):
        rise, away = exact[j] - exact[j, i], np.arange(90) - i
        tangent = np.full(90, np.inf)
        np.divide((np.abs(away) - 0.5) * 0.01, rise, out=tangent, where=(rise > 0) & (np.abs(away) <= 40))
        sides = (tangent[away < 0], tangent[away > 0])
        assert opening[j, i] == pytest.approx(sum(min(side.min(initial=2.0), 2.0) for side in sides))


def test_costs_stand_beside_each_other_over_one_of_them() -> None:
    slow, quick = RunCost(30, 45, 800, {"stereo": 20.0, "lifts": 1.0}), RunCost(20, 30, 1000, {"stereo": 8.0})
    table = cost_table("", {"ours": slow, "sgbm": quick}, "sgbm")
    heads, ours, sgbm = (list(column.cells) for column in table.columns)
    at = {str(head): place for place, head in enumerate(heads)}
    for head, value in {"wall s": "30", "CPU s": "45", "peak MiB": "800", "stereo": "20.0"}.items():
        assert ours[at[head]] == value
    assert [ours[at[f"{what}, times"]] for what in ("wall", "CPU", "peak")] == ["1.50", "1.50", "0.80"]
    assert sgbm[at["wall, times"]] == "1.00" and sgbm[at["lifts"]] == "-"
    assert "wall, times" not in cost_table("", {"ours": slow}, "sgbm").columns[0].cells


def test_a_run_costs_what_its_process_and_its_stages_took(recording: Path, tmp_path: Path) -> None:
    cost = measure_apart(recording, tmp_path / "out", FAST)
    content = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert cost.cpu_s > 0 and cost.wall_s > content["seconds"], "its start is included"
    assert cost.peak_memory_mib == content["peak_memory_mib"]
    assert content["seconds"] / 2 < sum(cost.stage_s.values()) < 4 * content["seconds"]


@pytest.mark.slow
def test_a_row_per_method(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    recording, saved = tmp_path / "yard", tmp_path / "bench.json"
    simulate(recording, TINY)
    flags = ["--methods", "sgbm", "paper", "--recording", str(recording), "--json", str(saved)]
    assert run(["bench", "yard", *flags]) == 0
    printed = capsys.readouterr().out
    content = json.loads(saved.read_text())
    rows = {row["method"]: row for row in content["rows"]}
    assert list(rows) == ["sgbm", "paper"]
    assert abs(content["laser_bias_mm"]) < 0.3
    assert 0.6 < content["laser_mae_mm"] < 1.0  # 1 mm of noise
    for row in rows.values():
        assert row["smooth"]["mae_mm"] > 0
        assert f"{row['smooth']['mae_mm']:.1f}" in printed
    assert rows["sgbm"]["heights"] != rows["paper"]["heights"]


def test_a_recording_without_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "yard", "--recording", str(tmp_path)]) == 3
    assert capsys.readouterr().err.count("\n") == 1
