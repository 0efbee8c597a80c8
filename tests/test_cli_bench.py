"""`barsight bench`: tables and JSON from the command line; mistakes in one line."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.cli.main import run
from barsight.core.records.disparity import Disparity
from barsight.stereo.disparity_files import write_disparity
from cli_runs import cut_short, pictures


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    folder = tmp_path / "data" / "wall"
    folder.mkdir(parents=True)
    noise = np.random.default_rng(2).integers(0, 255, (120, 220)).astype(np.uint8)
    wall = cv2.GaussianBlur(noise, (0, 0), 1.1)
    cv2.imwrite(str(folder / "left.png"), wall[:, :-10])
    cv2.imwrite(str(folder / "right.png"), wall[:, 10:])
    truth = np.full((120, 210), 10, np.float32)
    write_disparity(folder / "disp.pfm", Disparity(truth, truth))
    return tmp_path / "data"


def test_stereo_methods_side_by_side(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    saved = tmp_path / "bench.json"
    arguments = ["bench", "stereo", str(scenes), "--methods", "sgbm", "barsight", "--json", str(saved)]
    assert run([*arguments, "--repeats", "5"]) == 0
    printed = capsys.readouterr().out
    assert "sgbm" in printed and "barsight" in printed and "wall" in printed
    methods = {method["method"]: method for method in json.loads(saved.read_text())["methods"]}
    assert set(methods) == {"sgbm", "barsight"}
    assert methods["barsight"]["scenes"][0]["scene"] == "wall"


@pytest.mark.slow
def test_ablation_leaves_out_one_part_at_a_time(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    saved = tmp_path / "ablation.json"
    assert run(["bench", "ablation", str(scenes), "--scenes", "1", "--json", str(saved)]) == 0
    assert "no refinement" in capsys.readouterr().out
    errors = {m["method"]: m["mean"]["average_px"] for m in json.loads(saved.read_text())["methods"]}
    assert len(errors) == 7 and errors["whole"] < 0.2, errors


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "everything"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    for flags in (
        ["stereo-speed", "--repeats", "0"], ["length", str(tmp_path), "--times", "1"],
        ["stereo", str(tmp_path), "--repeats", "0"], ["front-end", str(tmp_path), "--repeats", "0"],
        ["subpixel", "--scenes", "0"], ["target-size", "--poses", "0"],
        ["ablation", str(tmp_path), "--scenes", "0"],
        ["bundles", "--seed", "-1"], ["features", str(tmp_path), "--count", "0"],
        ["matching", str(tmp_path), "--count", "0"],
    ):  # fmt: skip
        assert run(["bench", *flags]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert run(["bench", "stereo", str(tmp_path)]) == 3
    text = capsys.readouterr().err
    assert text.count("\n") == 1 and str(tmp_path) in text
    assert run(["bench", "lifts", "--magnet", str(tmp_path / "none.toml")]) == 3
    text = capsys.readouterr().err
    assert text.count("\n") == 1 and "none.toml: no such file; check the path" in text


def test_the_live_estimate_is_timed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(["bench", "live", "--keyframes", "30", "--json", str(tmp_path / "live.json")])
    assert "30 keyframes" in capsys.readouterr().out
    bench = json.loads((tmp_path / "live.json").read_text())
    assert bench["rmse_mm"] < 3
    assert 0.2 < bench["nees"] < 3
    assert len(bench["wall_ms"]) == len(bench["grown_mib"]) == 10
    assert bench["grown_mib"][-1] - bench["grown_mib"][2] < 20


def test_a_live_step_is_timed_whole_and_by_parts(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved = tmp_path / "step.json"
    cut_short(pictures(recording, "cam1")[1])
    assert run(["bench", "live-step", str(recording), "--json", str(saved)]) == 0
    assert "2 in the map" in capsys.readouterr().out
    bench = json.loads(saved.read_text())
    assert (bench["pairs"], bench["fused"]) == (4, 2), "one is damaged, the last waits for the one after it"
    assert bench["others"] == 1, "the torn one's step isn't counted"
    parts = {part["part"].strip(): part for part in bench["parts"]}
    step, added = parts["step"], parts["placed, matched, fused"]
    assert 0 < parts["of that stereo"]["wall_ms"] < added["wall_ms"] < step["wall_ms"]
    assert step["cpu_p95_ms"] >= step["cpu_ms"] > parts["rectified"]["cpu_ms"] > 0


def test_the_front_end_is_timed(data: Path, tmp_path: Path) -> None:
    saved = tmp_path / "front_end.json"
    still = str(data / "euroc_v101_still")
    assert run(["bench", "front-end", still, "--repeats", "1", "--json", str(saved)]) == 0
    (row,) = json.loads(saved.read_text())["rows"]
    assert row["predicted_by"] == "pictures" and row["pairs"] == 10 and row["refused"] == 0
    assert row["points"] > 300
    assert 0 < row["time"]["median_ms"] < 5000 and row["cpu_ms"] > 1
