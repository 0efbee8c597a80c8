"""The fleet: keys, claims, limits, S3, restarts, comparison and promotion, against stand-ins."""

from __future__ import annotations

import hashlib
import json
import math
import operator
import os
import resource
import signal
import sys
import time
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import pytest
from fuzz.seeds import write_results
from sqlalchemy import select

from barsight.cli.arguments import load_settings
from barsight.cli.bench.seeds import over_seeds
from barsight.cli.main import run
from barsight.core.errors import ConfigError, Failed, InputError, OutputError
from barsight.core.json_values import json_digest
from barsight.core.reading.sealed_json import SEAL
from barsight.fleet.archive import download, find_recordings, manifest_digest
from barsight.fleet.cluster import connect
from barsight.fleet.comparison.comparing import FigureChange, RecordingComparison, _figures, compare_recording
from barsight.fleet.comparison.comparison_page import comparison_page, copy_pictures
from barsight.fleet.comparison.findings import holm, judge
from barsight.fleet.driver import count_states, drive, parked_reasons
from barsight.fleet.ledger import HeldRecording, claim, held, publish, published_keys
from barsight.fleet.limits import LimitedRun, run_limited
from barsight.fleet.objects import Objects, open_objects
from barsight.fleet.planning import TaskChoice, estimate, plan_tasks
from barsight.fleet.promoting import _fetch, promote
from barsight.fleet.records import note_plan, noted_keys
from barsight.fleet.scratch import _machine, scratch_folder, scratch_root, sweep
from barsight.fleet.task import run_task
from barsight.fleet.versions import FleetTask, arguments, publish_version
from barsight.fleet.window import RunWindow
from barsight.measure_settings import MeasureSettings
from barsight.store.audit import AuditChain, entry, verify_chain
from barsight.store.confirmation import open_lifts
from barsight.store.history import present_yard
from barsight.store.opening import open_store
from barsight.store.promotion import counts, promoted_version
from barsight.store.tables import FLEET_SURVEYS, PROMOTIONS, SURVEYS
from barsight.yard.magnet.description import example_magnet
from fleet_rounds import VERSION, make_archive, moto_server, no_progress, settings
from page_yards import FIRST, SECOND, survey


def test_a_key_tells_content_and_version_and_not_the_place(tmp_path: Path) -> None:
    make_archive(tmp_path / "a", {"crane1/r": "x", "crane2/moved": "x", "crane2/survey/p1": "y"})
    (tmp_path / "a/crane2/moved/mav0/name").write_text("crane1/r")
    (tmp_path / "a/crane2/survey/survey.json").write_text('{"passes": ["p1"]}')
    (tmp_path / "a/crane1/r/truth").mkdir()
    (tmp_path / "a/crane1/r/truth/t.npz").write_text("not measured")
    archive, results = open_objects(str(tmp_path / "a")), open_objects(str(tmp_path / "r"), create=True)
    found = find_recordings(archive)
    assert [one.name for one in found] == ["crane1/r", "crane2/moved", "crane2/survey"]
    assert found[2].passes == ("p1",)
    read: list[int] = []
    first, moved, other = (manifest_digest(archive, results, one, read.append) for one in found)
    assert first == moved != other
    count = len(read)
    assert manifest_digest(archive, results, found[0], read.append) == first
    assert len(read) == count, "an unchanged listing is not read again"
    assert VERSION.key(first) != replace(VERSION, calibration="c").key(first) != VERSION.key(other)


def test_files_that_a_configuration_names_count_by_their_content(tmp_path: Path) -> None:
    results = open_objects(str(tmp_path / "r"), create=True)
    places = {"a": "name,x_m,y_m\nA,1,1\n", "b": "name,x_m,y_m\nA,1,1\n", "c": "name,x_m,y_m\nA,2,1\n"}
    made = {}
    for name, text in places.items():
        (tmp_path / f"{name}.csv").write_text(text)
        (tmp_path / f"{name}.toml").write_text(f'[bundles]\nstock_list = "{tmp_path}/{name}.csv"\n')
        config = tmp_path / f"{name}.toml"
        chosen = load_settings(config, MeasureSettings)
        made[name] = publish_version(results, chosen, config, None, None)
    assert made["a"].configuration == made["b"].configuration != made["c"].configuration
    (tmp_path / "work").mkdir()
    (tmp_path / "c.csv").unlink()  # another machine does not have it
    words = arguments(results, made["c"], tmp_path / "work")
    taken = Path(words[words.index("--bundles.stock-list") + 1])
    assert taken == tmp_path / "work" / "stock.csv" and taken.read_text() == places["c"]
    (tmp_path / "c.toml").write_text('yard = "none.yaml"\n')
    with pytest.raises(InputError, match=r"none\.yaml: no such file"):
        publish_version(
            results, load_settings(tmp_path / "c.toml", MeasureSettings), tmp_path / "c.toml", None, None
        )


def test_a_claim_has_one_owner_until_its_lease_runs_out(tmp_path: Path) -> None:
    results = open_objects(str(tmp_path / "r"), create=True)
    mine = claim(results, "k", 0.3)
    assert isinstance(mine, HeldRecording) and claim(results, "k", 0.3) == "claimed"
    time.sleep(0.35)
    later = claim(results, "k", 5)
    assert isinstance(later, HeldRecording) and later.number == 2
    assert publish(results, later, {"n": 2}) and publish(results, later, {"n": 2}), "a put sent twice"
    assert not publish(results, mine, {"n": 1}), "the slow one comes too late"
    assert claim(results, "k", 5) == "published" and published_keys(results) == {"k"}
    with held(results, HeldRecording("z", 1, "t"), 0.4):
        time.sleep(0.6)
        assert claim(results, "z", 5) == "claimed", "a claim that is held is renewed"
    assert isinstance(claim(results, "z", 5), HeldRecording)


@pytest.mark.parametrize(
    ("code", "wanted"),
    [
        ("import sys; sys.exit('it is damaged')", "refused: exit code 1: it is damaged"),
        ("x = bytearray(300 << 20); x[::4096] = b'1' * len(x[::4096]); import time; time.sleep(9)",
         "over-memory"),
        ("import time; time.sleep(9)", "timeout: did not end in 0.8 s"),
    ],
)  # fmt: skip
def test_limits_end_a_command_and_say_why(tmp_path: Path, code: str, wanted: str) -> None:
    seconds = 8.0 if "bytearray" in code else 0.8
    failed = run_limited([sys.executable, "-I", "-c", code], tmp_path, os.environ, 0.2, seconds)
    assert isinstance(failed, Failed) and f"{failed.code}: {failed.reason}".startswith(wanted)
    assert isinstance(run_limited(["true"], tmp_path, os.environ, 1, 5), LimitedRun)


@pytest.mark.slow
def test_a_run_on_s3_parks_the_bad_and_publishes_the_rest_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = {f"r{i}": "good" for i in range(6)} | {"bad": "poison", "slow": "hangs"}
    archive = open_objects(str(make_archive(tmp_path / "a", kinds)))
    with moto_server() as (url, _):
        for name, value in {
            "AWS_ENDPOINT_URL": url, "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "y",
            "AWS_REGION": "us-east-1",
        }.items():  # fmt: skip
            monkeypatch.setenv(name, value)
        results = open_objects("s3://yard/results", create=True)
        tasks = plan_tasks(archive, results, VERSION, None, no_progress)
        shared = settings(tmp_path, results.url, timeout_s=1.0)
        with open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store:
            assert note_plan(store, tasks, "t") == 8
            with connect(2, None) as client:
                drive(client, tasks, shared, store, results, RunWindow(), no_progress)
            with store.reading() as connection:
                assert noted_keys(connection) == published_keys(results)
                assert isinstance(verify_chain(connection), AuditChain)
        assert count_states(results, tasks).published == 6
        told = {task.name: reason for task, reason in parked_reasons(results, tasks)}
        assert told["bad"] == "refused: exit code 1: barsight: this recording is damaged"
        assert told["slow"] == "timeout: did not end in 1 s"
        for task in tasks:
            note = results.read_json(f"results/{task.key}/result.json")
            if note is not None:
                data = results.read(f"files/{task.key}/{note['token']}/bundles.json")
                assert data is not None
                assert hashlib.sha256(data).hexdigest() == note["files"]["bundles.json"]["sha256"]
                whole = b"good" + task.name.encode()
                assert json.loads(data)["sha"] == hashlib.sha256(whole).hexdigest()


def test_what_is_done_is_not_done_again(tmp_path: Path) -> None:
    archive = open_objects(str(make_archive(tmp_path / "a", {"r": "good"})))
    results = open_objects(str(tmp_path / "r"), create=True)
    (task,) = plan_tasks(archive, results, VERSION, None, no_progress)
    shared = settings(tmp_path, results.url)
    assert run_task(task, shared) == task.key
    before = sorted(one.path for one in results.list())
    assert run_task(task, shared) == task.key
    assert sorted(one.path for one in results.list()) == before
    assert not [p for p in scratch_root().iterdir() if p.name.startswith(task.key[:16])]


def test_folders_of_the_dead_are_swept_and_no_others() -> None:
    dead = scratch_root() / f"k-{_machine()}-999999999-1.00-x"
    others = scratch_root() / "k-12345678-999999999-1.00-x"
    others.mkdir(exist_ok=True)
    dead.mkdir(exist_ok=True)
    sweep()
    assert dead.exists(), "it is young"
    sweep(min_age_s=0)
    assert not dead.exists()
    assert others.exists(), "another machine's, of which this one knows nothing"
    others.rmdir()
    with scratch_folder("k") as alive:
        sweep(min_age_s=0)
        assert alive.exists()
    dead.mkdir()
    os.utime(dead, (1, 1))
    with scratch_folder("k"):
        assert not dead.exists(), "each task sweeps the machine that it runs on"


def test_the_night_passes_midnight() -> None:
    night = RunWindow(("22:00", "06:00"))
    at = [night.is_open(datetime(2026, 1, 1, hour)) for hour in (21, 22, 3, 6)]
    assert at == [False, True, True, False]
    assert not RunWindow(idle=True).is_open(busy_ratio=1.0) and RunWindow(idle=True).is_open(busy_ratio=0.0)


def test_the_estimate_is_by_what_was_measured_and_priorities_come_first(tmp_path: Path) -> None:
    archive = open_objects(str(make_archive(tmp_path / "a", {"a": "x", "b": "x", "c/d": "x"})))
    results = open_objects(str(tmp_path / "r"), create=True)
    tasks = [replace(t, pairs=10) for t in plan_tasks(archive, results, VERSION, None, no_progress)]
    told = estimate(tasks, [(1, 5, 20.0, 7), (1, 10, 40.0, 9)])
    assert told.seconds == pytest.approx(3 * 40.0) and told.written_bytes == 24
    assert [task.name for task in TaskChoice(first=("c/", "b")).of(tasks)] == ["c/d", "b", "a"]


def change(
    recording: str, shift: float, sigma: float, p: float, lifts: dict[str, tuple[int, int]] | None = None
) -> RecordingComparison:
    one = FigureChange(recording, 1, "top_z_m", 1.0, 1.0 + shift, sigma, p)
    return RecordingComparison(recording, (one,), (), (), (), lifts or {}, {}, (1.0, 1.0), ("a", "b"))


def test_holm_keeps_its_level_and_a_shared_shift_is_found(tmp_path: Path) -> None:
    assert holm([0.01, 0.04, 0.03]) == [True, False, False]
    shifted = judge("a", "b", [change(f"r{i}", 0.003 + 0.0002 * (i % 3), 0.01, 0.8) for i in range(30)], [])
    assert [s.figure for s in shifted.shifts if s.is_found] == ["top_z_m"] and not shifted.beyond
    same = judge("a", "b", [change(f"r{i}", 0.0, 0.01, 1.0) for i in range(30)], ["<lost>"])
    assert not any(s.is_found for s in same.shifts) and not same.beyond
    worst = judge("a", "b", [change("<r>", 1.0, 0.01, 1e-9), change("<s>", 1.0, 0.01, 1e-9)], ["<lost>"])
    results = open_objects(str(tmp_path / "r"), create=True)
    results.write("a", b"<r> before")
    (tmp_path / "page").mkdir()
    copied = copy_pictures(results, worst, tmp_path / "page")
    assert copied["<r>"] == ("pictures/000-before.png", ""), "the other result lacks its picture"
    assert (tmp_path / "page/pictures/000-before.png").read_bytes() == b"<r> before"
    page = comparison_page(worst, copied)
    assert page.count("not known") == 12 and page.count("too few") == 6, "nothing told is no interval of 0"
    assert page.count('href="pictures/') == 2 and "file://" not in page and results.url not in page
    assert "&lt;r&gt;" in page and "<r>" not in page and "<lost>" not in page


def test_a_promoted_version_hides_the_other_survey_of_its_recording(tmp_path: Path) -> None:
    def seen() -> list[str]:
        with store.reading() as connection:
            return sorted(connection.execute(select(SURVEYS.c.map_id).where(counts())).scalars())

    def switch(version: str) -> None:
        with entry(store, "t", "switch") as opened:
            opened.add(PROMOTIONS, version=version, who="t", at_ns=opened.at_ns)

    with open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store:
        with entry(store, "t", "surveys") as opened:
            for name, at_ns in (("live1", 10), ("new1", 10), ("live2", 20)):
                opened.add(
                    SURVEYS, map_id=name, captured_from_ns=at_ns, captured_to_ns=at_ns + 1, added_ns=0,
                    calibration_id="", is_simulated=True, software_version="", folder="", files="",
                    heights=b"",
                )  # fmt: skip
            opened.add(FLEET_SURVEYS, version="v", map_id="new1", is_own=True)
        assert seen() == ["live1", "live2"]
        switch("v")
        assert seen() == ["live2", "new1"]
        switch("")
        assert seen() == ["live1", "live2"]
        with store.reading() as connection:
            assert promoted_version(connection) == "" and isinstance(verify_chain(connection), AuditChain)


def test_promoted_surveys_share_the_names_of_their_bundles_and_offer_nothing(tmp_path: Path) -> None:
    results = open_objects(str(tmp_path / "r"), create=True)
    tasks = [FleetTask(key * 32, key, (), VERSION, key, "archive") for key in "ab"]
    for task, stock, age_s in zip(tasks, (FIRST, SECOND), (3600.0, 60.0), strict=True):
        survey(tmp_path / "surveys" / task.key, stock, age_s)
        results.write(f"results/{task.key}/result.json", b"{}")
    with open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store:
        assert promote(store, results, VERSION, tasks, tmp_path / "surveys", "ann", no_progress) == 2
        with store.reading() as connection:
            assert len(present_yard(connection)) == len(SECOND)
            assert open_lifts(connection) == ()


def test_a_survey_that_another_promotion_copies_meanwhile_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results, task = (
        open_objects(str(tmp_path / "r"), create=True),
        FleetTask("a" * 32, "a", (), VERSION, "a", ""),
    )
    results.write(f"results/{task.key}/result.json", b"{}")

    def late(*_: object) -> None:
        survey(tmp_path / "surveys" / task.key, FIRST, 60.0)
        raise OutputError("exists and is not empty")

    monkeypatch.setattr("barsight.fleet.promoting._fetch", late)
    with open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store:
        assert promote(store, results, VERSION, [task], tmp_path / "surveys", "ann", no_progress) == 1


@pytest.mark.parametrize("now", [b"other", b"longer than it was", b""])
def test_only_what_was_published_is_promoted(tmp_path: Path, now: bytes) -> None:
    results = open_objects(str(tmp_path / "r"), create=True)
    told = {"bytes": 5, "sha256": hashlib.sha256(b"first").hexdigest()}
    note = {
        "key": "k", "token": "t", "measured_s": 1, "whole_s": 1, "peak_bytes": 1, "files": {"a.json": told},
    }  # fmt: skip
    results.write("results/k/result.json", json.dumps(note).encode())
    (tmp_path / "r/files/k/t").mkdir(parents=True)
    for content in (b"first", now):
        (tmp_path / "r/files/k/t/a.json").write_bytes(content)
        if content == b"first":
            _fetch(results, "k", tmp_path / "out")
            assert (tmp_path / "out/a.json").read_bytes() == b"first"
        else:
            with pytest.raises(InputError, match=r"a\.json: was changed after it was published"):
                _fetch(results, "k", tmp_path / "again")
            assert not (tmp_path / "again").exists()


def test_a_pipe_among_the_results_is_not_waited_for(tmp_path: Path) -> None:
    objects = open_objects(str(tmp_path))
    os.mkfifo(tmp_path / "a.json")
    for read in (objects.read, lambda path: list(objects.chunks(path))):
        with pytest.raises(InputError, match=r"a\.json: is a pipe or a device"):
            read("a.json")


def test_sizes_are_looked_at_before_anything_is_read(tmp_path: Path) -> None:
    make_archive(tmp_path / "a", {"r": "x"})
    objects = open_objects(str(tmp_path / "a"))
    (tmp_path / "a/large.json").touch()
    for path in (tmp_path / "a/large.json", tmp_path / "a/r/mav0/kind"):
        os.truncate(path, 1 << 33)
    began = time.process_time()
    with pytest.raises(InputError, match=r"large\.json: has 8589934592 bytes"):
        objects.read_json("large.json")
    with pytest.raises(InputError, match=r"r/mav0/kind: has 8589934592 bytes"):
        plan_tasks(objects, open_objects(str(tmp_path / "r"), create=True), VERSION, None, no_progress)
    with pytest.raises(InputError, match=r"large\.json: has 8589934592 bytes"):
        publish_version(objects, MeasureSettings(yard=tmp_path / "a/large.json"), None, None, None)
    assert time.process_time() - began < 4


def test_an_archive_s_links_lead_to_recordings_and_not_out_of_them(tmp_path: Path) -> None:
    make_archive(tmp_path / "disk", {"r": "x"})
    make_archive(tmp_path / "a", {"s": "x"})
    (tmp_path / "a/r").symlink_to(tmp_path / "disk/r")
    objects, results = open_objects(str(tmp_path / "a")), open_objects(str(tmp_path / "r"), create=True)
    tasks = plan_tasks(objects, results, VERSION, None, no_progress)
    assert sorted(task.name for task in tasks) == ["r", "s"]
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "a/s/mav0/kind").unlink()
    (tmp_path / "a/s/mav0/kind").symlink_to(tmp_path / "secret")
    with pytest.raises(InputError, match=r"s/mav0/kind: is a link out of the recording"):
        plan_tasks(objects, results, VERSION, None, no_progress)
    (tmp_path / "work").mkdir()
    with pytest.raises(InputError, match=r"s/mav0/kind: is a link out of the recording"):
        list(download(objects, "s", (".",), tmp_path / "work"))
    assert not [path for path in (tmp_path / "work").rglob("*") if path.is_file()]


def test_a_folder_that_can_t_be_made_is_an_output_that_failed(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="a part of the path is a file"):
        open_objects(str(tmp_path / "file" / "results"), create=True)
    with pytest.raises(InputError, match="file: is a file; name the folder"):
        open_objects(str(tmp_path / "file"))


def test_a_full_disk_is_no_wrong_key(tmp_path: Path) -> None:
    objects = open_objects(str(tmp_path / "o"), create=True)
    objects.write("a", b"1")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OutputError, match=r"o/b: can't be written .*free some space"):
            objects.write("b", bytes(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [one.path for one in objects.list()] == ["a"]


def test_an_open_end_leaves_the_place_along_the_bars_unknown() -> None:
    sigma = {
        "along_m": None,
        "lateral_m": 0.01,
        "top_z_m": 0.002,
        "yaw_deg": 0.1,
        "length_m": None,
        "width_m": 0.02,
    }
    one = {
        "sigma": sigma, "direction": [0.0, 1.0, 0.0], "axis_centre_m": [1.0, 2.0, 0.3], "top_z_m": 0.5,
        "yaw_deg": 90.0, "length_m": 5.0, "width_m": 0.3,
    }  # fmt: skip
    told = _figures(one)
    assert (told["x_m sigma"], told["y_m sigma"], told["length_m sigma"]) == (0.01, math.inf, math.inf)
    assert _figures(one | {"direction": [0.1, 0.995, 0.0]})["x_m sigma"] == math.inf


def test_vetoes_of_lifts_are_judged_over_the_archive() -> None:
    """One that comes and goes by chance is none; one that forbids more in most recordings is."""
    told = judge("a", "b", [
        change(f"r{i}", 0.0, 0.01, 1.0, {"gap": (3, 3 + (-1) ** i), "weak-pull": (2, 3 + i % 2)})
        for i in range(12)
    ], [])  # fmt: skip
    assert [(s.figure, s.recordings, s.is_found) for s in told.lifts] == [
        ("gap", 12, False), ("weak-pull", 12, True),
    ]  # fmt: skip
    assert told.lifts[1].shift == pytest.approx(1.5)


def test_a_changed_document_is_not_compared(tmp_path: Path) -> None:
    write_results(tmp_path / "out", 0.0)
    (tmp_path / "magnet.toml").write_text(example_magnet())
    words = ["lifts", str(tmp_path / "out"), "--magnet", str(tmp_path / "magnet.toml")]
    assert run([*words, "--at", "end"]) == 0
    results = open_objects(str(tmp_path / "r"), create=True)
    note = {"measured_s": 1.0, "whole_s": 1.0, "peak_bytes": 1, "files": {}}
    for key in ("a", "b"):
        for path in (tmp_path / "out").iterdir():
            results.write(f"files/{key}/t/{path.name}", path)
        assert publish(results, HeldRecording(key, 1, "t"), note)
    same = compare_recording(results, "one", "a", "b")
    assert same is not None and len(same.changes) == 12 and not any(one.sigma == 0 for one in same.changes)
    assert all(change.before == change.after for change in same.changes)
    assert same.vetoes == () and all(before == after for before, after in same.lifts.values())
    lifts = tmp_path / "r/files/b/t/lifts.json"
    content = json.loads(lifts.read_text())
    content["refused"].append(content["lifts"].pop() | {"vetoes": [{"code": "gap", "reason": "8 mm"}] * 2})
    del content[SEAL]
    lifts.write_text(json.dumps(content | {SEAL: json_digest(content)}))
    other = compare_recording(results, "one", "a", "b")
    assert other is not None and other.vetoes == ()
    assert (other.lifts["gap"], other.lifts["offered"]) == ((0, 1), (2, 1))
    path = tmp_path / "r/files/b/t/bundles.json"
    path.write_text(path.read_text().replace('"length_m": ', '"length_m": 1', 1))
    with pytest.raises(InputError, match="was changed after it was written"):
        compare_recording(results, "one", "a", "b")
    path.unlink()
    with pytest.raises(InputError, match=r"bundles\.json: is gone"):
        compare_recording(results, "one", "a", "b")
    (tmp_path / "r/results/b/result.json").write_text('{"key": "b", "token": 7}')
    with pytest.raises(InputError, match="as its schema says"):
        compare_recording(results, "one", "a", "b")


def test_the_listing_knows_its_objects(tmp_path: Path) -> None:
    objects: Objects = open_objects(str(tmp_path / "o"), create=True)
    assert objects.write_new("a/b", b"1") and not objects.write_new("a/b", b"2")
    assert [(one.path, one.size) for one in objects.list("a/")] == [("a/b", 1)]
    objects.remove("a/b")
    objects.remove("a/b")
    assert objects.read("a/b") is None


def test_torn_documents_of_an_archive_and_a_planted_scratch_folder_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = open_objects(str(tmp_path))
    for content in ("[" * 100_000, "{", "1" * 500):
        (tmp_path / "survey.json").write_text(content)
        with pytest.raises(InputError, match=r"survey\.json"):
            archive.read_json("survey.json")
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    (tmp_path / "elsewhere").mkdir()
    planted = tmp_path / f"barsight-fleet-{os.getuid()}"
    planted.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="only this user"):
        scratch_root()
    planted.unlink()
    planted.mkdir()
    planted.chmod(0o777)
    with pytest.raises(InputError, match="only this user"):
        scratch_root()
    planted.chmod(0o700)
    assert scratch_root() == planted


def test_seeds_run_on_workers_as_here() -> None:
    here = sorted(over_seeds(operator.add, range(3, 9), 100, 1, None))
    assert here == [(seed, seed + 100) for seed in range(3, 9)]
    assert sorted(over_seeds(operator.add, range(3, 9), 100, 2, None)) == here
    with pytest.raises(ZeroDivisionError):
        list(over_seeds(operator.floordiv, range(1), 0, 2, None))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (("lifts", "--seeds", "0:3", "--placements", "2"), ("lifts",)),
        (("bundles", "--yards", "4", "--length-m", "3"), ("counts", "figures")),
    ],
)
def test_a_bench_says_the_same_on_workers(
    tmp_path: Path, words: tuple[str, ...], kept: tuple[str, ...]
) -> None:
    told = []
    for workers in ("1", "2"):
        table = tmp_path / f"{workers}.json"
        assert run(["bench", *words, "--workers", workers, "--json", str(table)]) == 0
        content = json.loads(table.read_text())
        told.append([content[name] for name in kept])
    assert told[0] == told[1] and all(told[0])


def test_workers_of_another_version_end_the_run(tmp_path: Path) -> None:
    archive = open_objects(str(make_archive(tmp_path / "a", {"r": "good"})))
    results = open_objects(str(tmp_path / "r"), create=True)
    older = replace(VERSION, software="0.1+abc")
    tasks = plan_tasks(archive, results, older, None, no_progress)
    shared = settings(tmp_path, results.url)
    with open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store:
        note_plan(store, tasks, "t")
        with connect(1, None) as client, pytest.raises(ConfigError, match=r"0\.1\+abc"):
            drive(client, tasks, shared, store, results, RunWindow(), no_progress)
    assert not published_keys(results)
