"""`barsight explain`: every check, and a picture that shows what stands in the way."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from barsight.cli.main import run
from barsight.core.stamps import NS_PER_S
from barsight.report.explanation import BGR, PIXELS_PER_M, explain
from barsight.yard.events import YardEvent, write_events
from yard_folders import lifts, write_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = write_folder(tmp_path_factory.mktemp("explain") / "out", block_m=0.06)
    assert lifts(made) == 0
    return made


@pytest.mark.parametrize(("which", "state"), [("1", "offered at rank 1"), ("bundle:1", "refused")])
def test_every_check_is_told(
    folder: Path, which: str, state: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    target = tmp_path / "why.html"
    assert run(["explain", str(folder), which, "-o", str(target)]) == 0
    said = capsys.readouterr().out
    assert state in said
    content = json.loads((folder / "lifts.json").read_text(encoding="utf-8"))
    record = (content["lifts"] if which == "1" else content["refused"])[0]
    page = target.read_text(encoding="utf-8")
    assert page.count("<tr><td class=") == len(record["checks"]) > 15
    assert "data:image/png;base64," in page and "http" not in page
    if which != "1":
        assert "obstructed" in said and "something stands" in page


def test_a_lift_that_was_valid_once_is_said_to_be_too_old(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert explain(folder, "1").title.endswith("is offered at rank 1")
    later_ns = time.time_ns() + 3600 * NS_PER_S
    monkeypatch.setattr(time, "time_ns", lambda: later_ns)
    assert explain(folder, "1").title.endswith("forbidden now: map-too-old")


def test_a_lift_that_an_event_disturbed_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = write_folder(tmp_path / "out")
    assert lifts(made) == 0
    x_m, y_m = (explain(made, "1").record["target"][name] for name in ("x_m", "y_m"))
    write_events([YardEvent(time.time_ns(), "magnet", x_m, y_m, 0.0, 1.0, 0.3)], made / "events.csv")
    target = tmp_path / "why.html"
    assert run(["explain", str(made), "1", "-o", str(target)]) == 0
    said = capsys.readouterr().out
    assert "is forbidden now: disturbed" in said and "a magnet at" in said
    assert "is forbidden now" in target.read_text(encoding="utf-8")


def test_the_block_is_marked_where_it_stands(folder: Path) -> None:
    told = explain(folder, "bundle:1")
    assert told.picture is not None
    _, columns = np.nonzero((told.picture == BGR["offending"]).all(axis=-1))
    along = columns / PIXELS_PER_M - told.picture.shape[1] / PIXELS_PER_M / 2
    assert np.median(along) == pytest.approx(2.0 - told.record["target"]["y_m"], abs=0.03)
    offered = explain(folder, "1").picture
    assert offered is not None and not (offered == BGR["offending"]).all(axis=-1).any()


def test_what_passes_the_check_is_not_marked(tmp_path: Path) -> None:
    """The check takes the height over the steel; the whole map's error moves plane and block alike."""
    made = write_folder(tmp_path / "out", block_m=0.011)
    assert lifts(made) == 0
    told = explain(made, "bundle:1")
    assert {check["result"] for check in told.checks if check["code"] == "obstructed"} == {"passed"}
    assert told.picture is not None and not (told.picture == BGR["offending"]).all(axis=-1).any()


def test_stanchions_and_no_lift_areas_are_drawn_where_they_are(tmp_path: Path) -> None:
    made = write_folder(tmp_path / "out")
    assert lifts(made) == 0
    target = explain(made, "bundle:0").record["target"]
    assert target["yaw_deg"] == pytest.approx(0, abs=1)
    x_m, y_m = target["x_m"], target["y_m"]
    settings = tmp_path / "yard.toml"
    settings.write_text(
        f"stanchions = [[{x_m}, {y_m + 1.0}, 0.1]]\n"
        f"no_lift_areas = [[{x_m - 0.3}, {y_m + 0.5}, {x_m + 5}, {y_m + 9}]]\n"
    )
    assert lifts(made, "--config", str(settings)) == 0
    picture = explain(made, "bundle:0").picture
    assert picture is not None
    middle = np.array(picture.shape[:2]) / 2
    marked = np.argwhere((picture == BGR["stanchion"]).all(axis=-1)) - middle
    assert np.abs(marked.mean(axis=0) / PIXELS_PER_M) == pytest.approx([0.0, 1.0], abs=0.02)
    lines = (np.argwhere((picture == BGR["no-lift"]).all(axis=-1)) - middle) / PIXELS_PER_M
    assert np.abs(lines).min(axis=0) == pytest.approx([0.0, 0.5], abs=0.03)


@pytest.mark.parametrize(
    ("which", "says"),
    [("9", "no lift of rank 9"), ("bundle:99", "no lift of bundle 99"), ("first", "names no lift")],
)
def test_no_such_lift_is_one_line(
    folder: Path, which: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["explain", str(folder), which]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1


def test_a_folder_without_lifts_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["explain", str(write_folder(tmp_path / "out")), "1"]) == 3
    assert capsys.readouterr().err.count("\n") == 1
