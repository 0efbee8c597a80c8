"""Sealed records of acceptance that were damaged and sealed again end in one line, whatever they hold."""

import json
from pathlib import Path
from typing import Any

import pytest
from fuzz.mutators import reseal_folder
from fuzz.seeds import measured_from, write_results

from barsight.acceptance.commissioning import begin, read_done
from barsight.acceptance.watch.record import read_watch
from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.core.reading.sealed_json import write_sealed

FIGURE = {"name": "yaw / deg", "value": 0.1, "sigma": 0.02}
SURVEY = {"recording": "r", "recording_id": "i", "calibration_id": "c", "figures": [FIGURE]}
STEP = {"name": "cameras", "result": "good", "given": "a", "made": "b", "done_at": "now"}


def test_a_whole_record_is_read(tmp_path: Path) -> None:
    write_sealed({"schema_version": 1, "surveys": [SURVEY], "approvals": []}, tmp_path / "w.json")
    assert read_watch(tmp_path / "w.json").surveys[0].figures[0].sigma == 0.02
    write_sealed({"schema_version": 1, "steps": [STEP]}, tmp_path / "commissioning.json")
    assert read_done(tmp_path)[0].name == "cameras"


@pytest.mark.parametrize(
    ("survey", "says"),
    [
        ({"figures": [FIGURE | {"sigma": 0}]}, "sigma is 0"),
        ({"figures": [FIGURE | {"value": "x"}]}, "value is"),
        ({"figures": [FIGURE | {"value": None}]}, "value is null"),
        ({"recording": []}, "recording is a list"),
        ({"more": 1}, "more is unknown"),
    ],
)
def test_a_watch_of_another_form_is_refused(tmp_path: Path, survey: dict[str, Any], says: str) -> None:
    write_sealed({"schema_version": 1, "surveys": [SURVEY | survey], "approvals": []}, tmp_path / "w.json")
    with pytest.raises(InputError, match=says):
        read_watch(tmp_path / "w.json")


def test_a_step_whose_name_is_a_list_is_refused(tmp_path: Path) -> None:
    write_sealed({"schema_version": 1, "steps": [STEP | {"name": []}]}, tmp_path / "commissioning.json")
    with pytest.raises(InputError, match="name is a list"):
        read_done(tmp_path)


def test_first_settings_of_a_commissioning_appear_whole_or_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "write_text", _no_space)
    with pytest.raises(OSError, match="no space"):
        begin(tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []


def _no_space(path: Path, text: str, **_: Any) -> None:
    path.write_bytes(text.encode()[:20])
    raise OSError("no space")


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"configuration": {}}, "doesn't say how sure the rig's calibration is"),
        (
            {"configuration": {"stereo": {"calibration_sigma_px": []}}},
            "doesn't say how sure the rig's calibration is",
        ),
        ({"configuration": {"stereo": {"calibration_sigma_px": 1e100}}}, "rig's calibration is impossible"),
        ({"rig_uncertainty": {"yaw_deg": 0.01}}, "doesn't say how sure the rig's calibration is"),
        ({"rig_uncertainty": [3]}, "isn't as its schema says"),
        (
            {"configuration": {"stereo": {"calibration_sigma_px": 0.1}}},
            "doesn't say bundles.shared_lateral_m",
        ),
        ({"travel": None}, "doesn't say how sure the travel is"),
    ],
)
def test_a_budget_says_what_a_result_lacks(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    changed: dict[str, Any], says: str,
) -> None:  # fmt: skip
    out = tmp_path / "out"
    write_results(out, 0.0)
    measured_from(out, whole)
    monkeypatch.chdir(whole.parent)
    assert run(["budget", str(out)]) == 0
    result = json.loads((out / "result.json").read_text())
    (out / "result.json").write_text(json.dumps(result | changed))
    reseal_folder(out)
    capsys.readouterr()
    assert run(["budget", str(out)]) == 3
    assert says in capsys.readouterr().err


@pytest.mark.parametrize("row", [{}, {"group": "touch_mm", "name": 7, "error": "x"}, "x"])
def test_a_budget_names_the_torn_certificate(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], row: Any
) -> None:
    write_results(tmp_path / "out", 0.0)
    measured_from(tmp_path / "out", whole)
    monkeypatch.chdir(whole.parent)
    path, told = tmp_path / "certificate.json", json.loads((tmp_path / "out" / "result.json").read_text())
    ids = {name: told[name] for name in ("calibration_id", "yard_frame_id")}
    write_sealed({"schema_version": 1, "quantities": [row], "plan": {}, **ids}, path)
    assert run(["budget", str(tmp_path / "out"), "--certificate", str(path)]) == 3
    assert "certificate.json: is damaged" in capsys.readouterr().err
