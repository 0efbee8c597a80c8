"""Files of a measured folder belong together: one that was changed or is another map's is refused by name."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import jsonschema
import pytest

import barsight as bs
import barsight.cli.yard.lifts as lift_command
from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.result_folder import file_digest
from barsight.store.adding import read_survey
from lift_yards import laid
from yard_folders import lifts, schema, write_folder


def content(path: Path) -> dict:  # type: ignore[type-arg]
    found: dict = json.loads(path.read_text(encoding="utf-8"))  # type: ignore[type-arg]
    return found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = write_folder(tmp_path / "out")
    assert lifts(made) == 0
    return made


def test_all_three_files_carry_the_same_ids_and_fit_their_schemas(folder: Path) -> None:
    result, bundles, chosen = (content(folder / f"{n}.json") for n in ("result", "bundles", "lifts"))
    jsonschema.validate(bundles, schema("bundles"))
    jsonschema.validate(chosen, schema("lifts"))
    for name in ("map_id", "calibration_id", "yard_frame_id", "captured_from_ns", "captured_to_ns"):
        assert result[name] == bundles[name] == chosen[name]
    assert bundles["height_sha256"] == chosen["height_sha256"] == result["files"]["height.tif"]
    assert chosen["bundles_sha256"] == bundles["content_sha256"]
    assert chosen["sequence"] == 1
    assert lifts(folder) == 0
    assert content(folder / "lifts.json")["sequence"] == 2


def rewrite(name: str, old: str, new: str) -> Callable[[Path, Path], None]:
    def change(folder: Path, _: Path) -> None:
        text = (folder / name).read_text(encoding="utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1), encoding="utf-8")

    return change


def foreign(name: str) -> Callable[[Path, Path], None]:
    return lambda folder, other: Path(shutil.copyfile(other / name, folder / name)) and None


CHANGES = [
    (rewrite("bundles.json", '"bars": 7', '"bars": 5'), "bundles.json"),
    (rewrite("result.json", '"captured_to_ns": 1', '"captured_to_ns": 2'), "result.json"),
    (rewrite("result.json", '"calibration": "ca1b"', '"calibration": "beef"'), "result.json"),
    (rewrite("result.json", '"configuration": "c0f1"', '"configuration": "beef"'), "result.json"),
    (foreign("bundles.json"), "bundles.json"),
    (foreign("height.tif"), "height.tif"),
]
LIFT_CHANGES = [
    (rewrite("lifts.json", '"rank": 1', '"rank": 2'), "lifts.json"),
    (foreign("lifts.json"), "lifts.json"),
]


@pytest.mark.parametrize(("change", "named"), [*CHANGES, *LIFT_CHANGES])
def test_a_changed_or_foreign_file_is_refused_by_name(
    folder: Path, change: Callable[[Path, Path], None], named: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    other = write_folder(tmp_path / "other", shift_m=0.02)
    lifts(other)
    capsys.readouterr()
    change(folder, other)
    with pytest.raises(InputError, match=named):
        bs.load(folder)
    commands = [["report", str(folder)], ["explain", str(folder), "1"]]
    if named != "lifts.json":
        commands += [["lifts", str(folder)], ["export", str(folder), str(tmp_path / "map.tif")]]
    for command in commands:
        assert run(command) == 3
        said = capsys.readouterr().err
        assert named in said and ";" in said and said.count("\n") == 1
    if named == "lifts.json":
        assert lifts(folder) == 0, "choosing anew is the remedy"
        assert len(bs.load(folder).lifts) == 2


def test_a_loaded_yard_offers_what_was_chosen_last(folder: Path) -> None:
    """Those read first stayed on offer, though lifts were chosen again there with a no-lift area."""
    yard = bs.load(folder)
    assert len(yard.lifts) == 2
    assert lifts(folder, "--no-lift-areas", "-9", "-9", "9", "9") == 0
    assert len(yard.lifts) == 0 and len(yard.lifts.refused) == 2


def test_a_folder_of_an_earlier_version_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = content(folder / "result.json")
    del result["map_id"]
    (folder / "result.json").write_text(json.dumps(result), encoding="utf-8")
    capsys.readouterr()
    assert lifts(folder) == 3
    assert "measure the recording again" in capsys.readouterr().err


def test_a_calibration_changed_since_forbids_every_lift(tmp_path: Path) -> None:
    rig = tmp_path / "recording" / "mav0" / "cam0" / "sensor.yaml"
    rig.parent.mkdir(parents=True)
    rig.write_text("old", encoding="utf-8")
    hashes = {"calibration": "ca1b", "configuration": "c0f1", "inputs": {"cam0/sensor.yaml": "1a2b"}}
    told = {"recording": {"path": str(tmp_path / "recording"), "format": "euroc"}, "hashes": hashes}
    folder = write_folder(tmp_path / "out", **told)  # type: ignore[arg-type]
    assert lifts(folder) == 0
    found = content(folder / "lifts.json")
    assert [veto["code"] for veto in found["vetoes"]] == ["calibration-changed"]
    assert found["lifts"] == []


def test_a_calibration_changed_since_forbids_the_lifts_that_are_there(tmp_path: Path) -> None:
    rig = tmp_path / "recording" / "body.yaml"
    rig.parent.mkdir()
    rig.write_text("old", encoding="utf-8")
    inputs = {"body.yaml": file_digest(rig)}
    hashes = {"calibration": "ca1b", "configuration": "c0f1", "inputs": inputs}
    told = {"recording": {"path": str(tmp_path / "recording"), "format": "euroc"}, "hashes": hashes}
    folder = write_folder(tmp_path / "out", **told)  # type: ignore[arg-type]
    assert lifts(folder) == 0
    assert len(bs.load(folder).lifts) == 2
    rig.write_text("new", encoding="utf-8")
    found = bs.load(folder).lifts
    assert len(found) == 0 and [code for code, _ in found.vetoes] == ["calibration-changed"]
    assert {veto[0] for lift in found.refused for veto in lift.vetoes} == {"calibration-changed"}


def test_lifts_that_look_back_are_never_offered(tmp_path: Path) -> None:
    for name, age_s in (("fresh", 60.0), ("old", 3e7)):
        folder = write_folder(tmp_path / name, age_s=age_s)
        assert lifts(folder, "--at", "end") == 0
        found = bs.load(folder).lifts
        assert len(found) == 0 and [lift.bundles for lift in found.past] == [(0,), (1,)]


def test_a_lift_is_offered_no_longer_than_it_is_valid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_folder(tmp_path / "out")
    assert lifts(folder) == 0
    yard = bs.load(folder)
    until_ns = yard.lifts.offered[0].valid_until_ns
    assert until_ns is not None
    monkeypatch.setattr("time.time_ns", lambda: until_ns + 1)
    found = yard.lifts
    assert len(found) == 0 and not found.past
    assert {code for lift in found.refused for code, _ in lift.vetoes} == {"map-too-old"}


def test_a_lift_is_not_offered_after_an_event_beside_it(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "out", more=(laid(2.8),))
    assert lifts(folder) == 0
    yard = bs.load(folder)
    assert len(yard.lifts) == 3
    seen_ns = max(lift.record["valid_from_ns"] for lift in yard.lifts)
    for stamp_ns, offered in ((seen_ns - 3 * 10**9, 3), (seen_ns + 1, 2)):
        line = f"{stamp_ns},set-down,3.3,0,0,1,0.3\n"
        (folder / "events.csv").write_text(f"{HEAD}{line}", encoding="utf-8")
        assert len(yard.lifts) == len(bs.load(folder).lifts) == offered
    assert [(lift.rank, lift.bundles) for lift in yard.lifts.refused] == [(None, (2,))]
    assert [code for code, _ in yard.lifts.refused[0].vetoes] == ["disturbed"]


def test_a_lift_is_not_offered_after_an_event_where_its_load_would_be_put(tmp_path: Path) -> None:
    """The event is over a metre from load and magnet where they lie, and nearer to the set-down."""
    folder = write_folder(tmp_path / "out", more=(laid(2.8),))
    assert lifts(folder) == 0
    yard = bs.load(folder)
    (lift,) = (one for one in yard.lifts if one.bundles == (2,))
    put_m, from_m = lift.record["set_down"]["x_m"], lift.record["target"]["x_m"]
    x_m = put_m + 0.9 * math.copysign(1.0, put_m - from_m)
    assert abs(x_m - from_m) > 1.3
    line = f"{lift.valid_until_ns},set-down,{x_m},0,0,1,0.1\n"
    (folder / "events.csv").write_text(f"{HEAD}{line}", encoding="utf-8")
    assert (2,) not in [one.bundles for one in yard.lifts]
    (refused,) = (one for one in yard.lifts.refused if one.bundles == (2,))
    assert [code for code, _ in refused.vetoes] == ["disturbed"]
    assert lifts(folder) == 0
    (lift,) = (one for one in bs.load(folder).lifts if one.bundles == (2,))
    assert lift.record["set_down"] is None or abs(lift.record["set_down"]["x_m"] - x_m) > 1.1


def test_a_free_tif_that_the_map_never_had_is_refused(folder: Path) -> None:
    shutil.copyfile(folder / "height.tif", folder / "free.tif")
    with pytest.raises(InputError, match=r"free\.tif"):
        bs.load(folder)


def test_lifts_need_the_maps_own_photo(folder: Path) -> None:
    """Nothing else shows the labels under a face."""
    own = (folder / "ortho.tif").read_bytes()
    for photo in (None, own + b"\x00"):
        (folder / "ortho.tif").unlink(missing_ok=True)
        if photo is not None:
            (folder / "ortho.tif").write_bytes(photo)
        assert lifts(folder) == 3
    (folder / "ortho.tif").write_bytes(own)
    assert lifts(folder) == 0


HEAD = "stamp_ns,kind,x_m,y_m,yaw_deg,length_m,width_m\n"


def test_lifted_bundles_forbid_around_them_from_then_on(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "out", more=(laid(2.8),))
    assert lifts(folder, "--lifted", "0") == 0
    for _ in range(2):
        found = content(folder / "lifts.json")
        assert [lift["bundles"] for lift in found["lifts"]] == [[2]]
        assert [v["code"] for lift in found["refused"] for v in lift["vetoes"]] == ["disturbed"] * 2
        assert lifts(folder) == 0, "the event is kept"
    assert (folder / "events.csv").read_text(encoding="utf-8").count("lift") == 1


def test_a_lift_reported_while_lifts_are_chosen_is_neither_lost_nor_offered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_folder(tmp_path / "out", more=(laid(2.8), laid(5.0)))
    choose, others = lift_command.plan_lifts, iter(["2"])

    def meanwhile(*given: object, **more: object) -> object:
        for other in others:
            assert lifts(folder, "--lifted", other) == 0
        return choose(*given, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(lift_command, "plan_lifts", meanwhile)
    assert lifts(folder, "--lifted", "3") == 0
    offered = [lift["bundles"] for lift in content(folder / "lifts.json")["lifts"]]
    assert sorted(offered) == [[0], [1]]
    assert (folder / "events.csv").read_text(encoding="utf-8").count("lift") == 2


def test_a_lift_reported_with_a_fetch_that_fails_is_kept_and_the_old_lifts_are_no_longer_added(
    folder: Path,
) -> None:
    assert lifts(folder, "--lifted", "0", "--fetch", "1") == 3
    assert (folder / "events.csv").read_text(encoding="utf-8").count("lift") == 1
    with pytest.raises(InputError, match=r"before the newest of events\.csv"):
        read_survey(folder)
    assert lifts(folder) == 0
    assert read_survey(folder).lifts is not None


def test_what_was_seen_after_an_event_is_not_disturbed_by_it(tmp_path: Path) -> None:
    folder, file = write_folder(tmp_path / "out"), tmp_path / "events.csv"
    for stamp, offered in ((10**17, 2), (2 * 10**18, 0)):
        file.write_text(f"{HEAD}{stamp},set-down,0.5,0,0,7,0.3\n", encoding="utf-8")
        assert lifts(folder, "--events", str(file)) == 0
        assert len(content(folder / "lifts.json")["lifts"]) == offered


@pytest.mark.parametrize(
    ("arguments", "text", "code", "says"),
    [
        (["--lifted", "7"], "", 2, "no such bundle"),
        (["--events", "FILE"], "x,y\n1,2\n", 3, "stamp_ns,kind"),
        (["--events", "FILE"], f"{HEAD}1,push,0,0,0,1,1\n", 3, "line 2"),
        (["--events", "FILE"], f"{HEAD}1,lift,nan,0,0,1,1\n", 3, "line 2"),
        (["--events", "FILE"], f"{HEAD}1764000000,lift,0,0,0,1,1\n", 3, "isn't ns"),
        (["--events", "FILE"], None, 3, "no such file"),
    ],
)
def test_events_that_are_none_are_one_line(
    folder: Path, tmp_path: Path, arguments: list[str], text: str | None, code: int, says: str,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    file = tmp_path / "told.csv"
    if text is not None:
        file.write_text(text, encoding="utf-8")
    capsys.readouterr()
    assert lifts(folder, *(str(file) if a == "FILE" else a for a in arguments)) == code
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1
