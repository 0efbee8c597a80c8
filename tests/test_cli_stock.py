"""A stock list as a user gives it to `barsight measure`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cli_runs import measure, refused


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, ("no such file",)),
        ("name,x_m\nA,1\n", ("no column y_m",)),
        ("name,x_m,y_m\nA,1,two\n", ("bundle 1", "y_m")),
        ("name,x_m,y_m\nA,1,2\nA,2,2\n", ("'A' 2 times",)),
    ],
)
def test_a_bad_list_fails_before_anything_is_measured(
    content: str | None, words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    recording: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    def never(*_: object) -> None:
        raise AssertionError("a frame was looked at")

    monkeypatch.setattr("barsight.reconstruction.probed_recording.probe_recording", never)
    listed = tmp_path / "stock.csv"
    if content is not None:
        listed.write_text(content)
    refused(recording, capsys, "stock.csv", *words, flags=("--bundles.stock-list", str(listed)))


def test_what_the_list_names_and_the_map_lacks_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], recording: Path
) -> None:
    listed = tmp_path / "stock.csv"
    listed.write_text("name,x_m,y_m\nA7,90,0\n")
    code, said = measure(recording, capsys, "--bundles.stock-list", str(listed))
    assert code == 0 and "1 of 1 listed bundles weren't found: A7" in " ".join(said.split())
    bundles = json.loads((recording.parent / "out" / "bundles.json").read_text())
    assert bundles["stock"]["missing"] == ["A7"]
