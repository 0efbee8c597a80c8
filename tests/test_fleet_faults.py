"""The fleet where archives move, results are others', workers are strangers, and files are gone."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Timer
from typing import Any

import pytest
from distributed import LocalCluster

from barsight.cli.bench.seeds import _one_seed, over_seeds
from barsight.cli.main import run
from barsight.core.errors import CalibrationError, ConfigError, Failed, InputError
from barsight.fleet.archive import download, find_recordings, manifest_digest
from barsight.fleet.cluster import connect, run_all
from barsight.fleet.driver import FleetCounts, count_states, drive, open_tasks, parked_reasons
from barsight.fleet.ledger import HeldRecording, claim, discard, publish, published_keys
from barsight.fleet.limits import run_limited, thread_variables
from barsight.fleet.objects import UnreachableError, open_objects
from barsight.fleet.planning import TaskChoice, plan_tasks
from barsight.fleet.records import find_version, note_plan, noted_keys, read_tasks
from barsight.fleet.task import run_task
from barsight.fleet.versions import arguments, publish_version
from barsight.fleet.window import RunWindow
from barsight.measure_settings import MeasureSettings
from barsight.recording.formats.bag_setup import _find
from barsight.recording.formats.segments import segments_of
from barsight.store.audit import AuditChain, verify_chain
from barsight.store.opening import open_store
from fleet_rounds import AZURE, VERSION, azure_server, dask_commands, make_archive, no_progress, settings
from opcua_servers import free_port


def write(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)


def test_parts_of_a_bag_are_one_recording_with_the_calibration_beside_it(tmp_path: Path) -> None:
    live = ("live/d/segment_000000.mcap", "live/d/segment_000001.mcap", "live/d/alarms/segment_000000.mcap")
    ros = ("ros/b/metadata.yaml", "ros/b/b_0.db3", "ros/b/b_1.db3", "ros/b/camchain.yaml")
    loose = ("loose/one.bag", "loose/two.bag", "loose/camchain-imucam.yaml", "loose/imu.yaml", "loose/x.yaml")
    write(tmp_path / "a", *live, "live/camchain.yaml", *ros, "ros/camchain.yaml", *loose)
    archive, results = open_objects(str(tmp_path / "a")), open_objects(str(tmp_path / "r"), create=True)
    found = {one.name: [one.relative(file) for file in one.files] for one in find_recordings(archive)}
    assert found == {
        "live/d": ["../camchain.yaml", "segment_000000.mcap", "segment_000001.mcap"],
        "loose/one.bag": ["../camchain-imucam.yaml", "../imu.yaml", "one.bag"],
        "loose/two.bag": ["../camchain-imucam.yaml", "../imu.yaml", "two.bag"],
        "ros/b": ["b_0.db3", "b_1.db3", "camchain.yaml", "metadata.yaml"],
    }
    (passed,) = download(archive, "live/d", (".",), tmp_path / "1")
    assert len(segments_of(passed)) == 2 and not (passed / "alarms").exists()
    assert _find([passed, passed.parent], ("*camchain*",), ()) == passed.parent / "camchain.yaml"
    (passed,) = download(archive, "loose/two.bag", (".",), tmp_path / "2")
    assert passed.read_text() == "loose/two.bag" and not (passed.parent / "one.bag").exists()
    assert _find([passed.parent], ("imu", "*imu*"), ("camchain",)) == passed.parent / "imu.yaml"
    before = [manifest_digest(archive, results, one, no_progress) for one in find_recordings(archive)]
    (tmp_path / "a/loose/camchain-imucam.yaml").write_text("another calibration")
    after = [manifest_digest(archive, results, one, no_progress) for one in find_recordings(archive)]
    assert [one == other for one, other in zip(before, after, strict=True)] == [True, False, False, True]
    (tmp_path / "a/loose/imu.yaml").unlink()
    (tmp_path / "a/loose/imu.yaml").symlink_to(tmp_path / "a/ros/camchain.yaml")
    with pytest.raises(InputError, match=r"imu\.yaml: is a link out"):
        list(download(archive, "loose/two.bag", (".",), tmp_path / "3"))


def test_a_recording_that_cannot_be_read_is_left_out_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = make_archive(tmp_path / "a", {"good": "good", "large": "good", "linked": "good"})
    os.truncate(archive / "large/mav0/kind", 1 << 33)
    (archive / "linked/mav0/out").symlink_to("/etc/hostname")
    where = ["--results", str(tmp_path / "r"), "--store", f"sqlite:///{tmp_path}/s.db"]
    assert run(["fleet", "plan", str(archive), *where]) == 3
    told = capsys.readouterr()
    assert "1 recordings, 1 new in the plan" in told.out
    lines = [line for line in told.err.splitlines() if line.startswith("left out: ")]
    assert len(lines) == 2 and "large/mav0/kind" in lines[0] and "linked/mav0/out" in lines[1]


def test_recordings_of_two_archives_and_of_one_that_moved(tmp_path: Path) -> None:
    results = open_objects(str(tmp_path / "r"), create=True)
    shared = settings(tmp_path, results.url)
    with open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store:
        for crane in ("crane1", "crane2"):
            archive = open_objects(str(make_archive(tmp_path / crane, {"monday": "good"})))
            (tmp_path / crane / "monday/mav0/name").write_text(crane)
            assert note_plan(store, plan_tasks(archive, results, VERSION, None, no_progress), "t") == 1
        shutil.move(tmp_path / "crane2", tmp_path / "moved")
        moved = open_objects(str(tmp_path / "moved"))
        assert note_plan(store, plan_tasks(moved, results, VERSION, None, no_progress), "t") == 0
        with store.reading() as connection:
            tasks = read_tasks(connection, VERSION)
            assert isinstance(verify_chain(connection), AuditChain)
        assert [Path(task.archive).name for task in tasks] == ["crane1", "moved"]
        assert len({task.manifest for task in tasks}) == 2 and {task.name for task in tasks} == {"monday"}
        for task in tasks:
            run_task(task, shared)
        assert not parked_reasons(results, tasks)
        left = open_tasks(store, results, tasks, "t")
        with store.reading() as connection:
            assert noted_keys(connection) == {task.key for task in tasks} and not left


def test_the_limit_counts_what_is_left(tmp_path: Path) -> None:
    archive = open_objects(str(make_archive(tmp_path / "a", {"a": "good", "b": "good", "c": "good"})))
    results = open_objects(str(tmp_path / "r"), create=True)
    shared, choice = settings(tmp_path, results.url), TaskChoice(limit=1)
    done = []
    with open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store:
        tasks = plan_tasks(archive, results, VERSION, None, no_progress)
        for _ in range(3):
            (task,) = choice.of(open_tasks(store, results, tasks, "t"))
            run_task(task, shared)
            done.append(task.name)
    assert done == ["a", "b", "c"]
    with pytest.raises(ConfigError, match="limit"):
        TaskChoice(limit=0)
    assert run(["fleet", "plan", archive.url, "--results", results.url, "--workers", "0"]) == 2
    assert run(["fleet", "plan", archive.url, "--results", results.url, "--limit", "-1"]) == 2


def test_results_that_don_t_hold_a_version_measure_nothing_by_it(tmp_path: Path) -> None:
    archive = open_objects(str(make_archive(tmp_path / "a", {"r": "good"})))
    (tmp_path / "c.toml").write_text('preset = "fast"\n')
    planned, others = (open_objects(str(tmp_path / name), create=True) for name in ("planned", "others"))
    version = publish_version(planned, MeasureSettings(preset="fast"), tmp_path / "c.toml", None, None)
    (task,) = plan_tasks(archive, others, version, None, no_progress)
    with pytest.raises(ConfigError, match="was planned for other results"):
        run_task(task, settings(tmp_path, others.url))
    (tmp_path / "task").mkdir()
    assert arguments(planned, version, tmp_path / "task") == ["--config", f"{tmp_path}/task/config.toml"]
    planned.write(f"versions/{version.name}/config.toml", b'preset = "accurate"\n')
    with pytest.raises(ConfigError, match=r"config\.toml: is not as it was planned"):
        arguments(planned, version, tmp_path / "task")
    planned.write(f"versions/{version.name}/files.json", b'{"../config.toml": "0"}')
    with pytest.raises(ConfigError, match="is damaged"):
        arguments(planned, version, tmp_path / "task")


def test_a_recording_that_is_gone_is_parked_by_its_reason(tmp_path: Path) -> None:
    archive = open_objects(str(make_archive(tmp_path / "a", {"r": "good"})))
    results = open_objects(str(tmp_path / "r"), create=True)
    tasks = plan_tasks(archive, results, VERSION, None, no_progress)
    shutil.rmtree(tmp_path / "a/r")
    run_task(tasks[0], settings(tmp_path, results.url))
    ((_, reason),) = parked_reasons(results, tasks)
    assert reason == f"refused: {tmp_path}/a/r: is gone; plan the archive again"


def test_a_parked_recording_is_named_by_its_place_in_the_archive(tmp_path: Path) -> None:
    archive = open_objects(str(make_archive(tmp_path / "a", {"crane/r": "named"})))
    results = open_objects(str(tmp_path / "r"), create=True)
    tasks = plan_tasks(archive, results, VERSION, None, no_progress)
    run_task(tasks[0], settings(tmp_path, results.url))
    ((_, reason),) = parked_reasons(results, tasks)
    assert f": {tmp_path}/a/crane/r: is damaged; record it again ({tmp_path}/a/crane/imu.yaml" in reason


def test_storage_that_does_not_answer_parks_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = open_objects(str(tmp_path / "r"), create=True)
    archive = open_objects(str(make_archive(tmp_path / "a", {"r": "good"})))
    tasks = plan_tasks(archive, results, VERSION, None, no_progress)
    shared = settings(tmp_path, results.url)

    def refuse(*_: Any) -> None:
        raise UnreachableError("s3://yard", "can't be reached")

    monkeypatch.setattr("barsight.fleet.task.download", refuse)
    with pytest.raises(UnreachableError):
        run_task(tasks[0], shared)
    assert not parked_reasons(results, tasks) and isinstance(claim(results, tasks[0].key, 5), HeldRecording)


def test_files_of_tries_that_were_not_published_are_removed(tmp_path: Path) -> None:
    results = open_objects(str(tmp_path / "r"), create=True)
    for token in ("killed", "mine", "late"):
        results.write(f"files/k/{token}/result.json", b"{}")
    mine, late = (HeldRecording("k", number, token) for number, token in ((2, "mine"), (3, "late")))
    assert publish(results, mine, {})
    discard(results, mine, is_ours=True)
    assert [one.path for one in results.list("files/")] == ["files/k/mine/result.json"]
    results.write("files/k/late/result.json", b"{}")
    assert not publish(results, late, {})
    discard(results, late, is_ours=False)
    assert [one.path for one in results.list("files/")] == ["files/k/mine/result.json"]


@dataclass(frozen=True)
class ShutLater(RunWindow):
    """A window that shuts at one time of the monotonic clock and opens again at another."""

    shuts_s: float = 0.0
    opens_s: float = 0.0

    def is_open(self, *_: Any) -> bool:
        return not self.shuts_s < time.monotonic() < self.opens_s


def imported(number: int, _: Any) -> int:
    """Have the worker import this module."""
    return number


def started(task: Any, _: Any) -> str:
    """Write down when a task starts on its worker."""
    begun = time.monotonic()
    time.sleep(0.4)
    mine = claim(open_objects(task.archive), task.key, 5)
    assert isinstance(mine, HeldRecording)
    publish(open_objects(task.archive), mine, {"begun": begun, **EMPTY})
    return str(task.key)


EMPTY = {"measured_s": 0.0, "whole_s": 0.0, "peak_bytes": 0, "files": {}}


def test_nothing_starts_after_the_window_has_shut(tmp_path: Path) -> None:
    results = open_objects(str(tmp_path / "r"), create=True)
    archive = open_objects(str(make_archive(tmp_path / "a", {str(k): "good" for k in range(6)})))
    tasks = plan_tasks(archive, results, VERSION, None, no_progress)
    tasks = [replace(task, archive=results.url) for task in tasks]
    shared = settings(tmp_path, results.url)
    with open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store, connect(1, None) as client:
        assert list(run_all(client, imported, [1], None)) == [1]
        now = time.monotonic()
        window = ShutLater(("00:00", "00:00"), shuts_s=now + 1.0, opens_s=now + 4.0)
        drive(client, tasks, shared, store, results, window, no_progress, started)
    begun = sorted(results.read_json(f"results/{t.key}/result.json")["begun"] - now for t in tasks)
    assert begun[0] < 1.5 and begun[-1] > 4.0
    assert not [at for at in begun if 1.5 < at < 4.0], begun


def raise_input_error(_: Any, __: Any) -> None:
    raise CalibrationError("rig.yaml", "is damaged", "mend it")


def test_a_worker_s_errors_arrive_as_they_are(capfd: pytest.CaptureFixture[str]) -> None:

    with pytest.raises(CalibrationError, match=r"^rig\.yaml: is damaged; mend it$"):
        list(over_seeds(raise_input_error, range(1), None, 2, None))
    assert "Traceback" not in capfd.readouterr().err
    again = pickle.loads(pickle.dumps(InputError("a", "b", "c")))
    assert (str(again), again.remedy) == ("a: b; c", "c")


def test_seeds_run_on_workers_of_the_same_software() -> None:
    with pytest.raises(ConfigError, match=r"not 0\.1\+other; install the same"):
        _one_seed(1, (raise_input_error, None, "0.1+other"))


@pytest.mark.parametrize("address", ["nonsense", "tcp://host", "http://host:1", "tcp://:8786"])
def test_an_address_that_is_none_is_told_at_once(address: str) -> None:
    with pytest.raises(ConfigError, match="is not an address"), connect(1, address):
        pass


def test_threads_are_bounded_in_opencv_and_the_kernels(tmp_path: Path) -> None:
    code = "import cv2, numba; print(cv2.getNumThreads(), numba.get_num_threads())"
    for threads in (1, 2):
        environment = {"PATH": "/usr/bin", "HOME": str(tmp_path), **thread_variables(threads)}
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
        )
        assert done.stdout.split() == [str(threads)] * 2


@pytest.mark.parametrize(
    ("code", "wanted"),
    [
        ("import sys; print('x: the disk is full'); sys.exit(4)", "output: exit code 4: x: the disk is full"),
        ("import os; os.kill(os.getpid(), 9)", "refused: signal 9: no word"),
    ],
)
def test_what_a_command_could_not_write_is_no_fault_of_its_recording(
    tmp_path: Path, code: str, wanted: str
) -> None:
    ended = run_limited([sys.executable, "-I", "-c", code], tmp_path, {}, 1, 20)
    assert isinstance(ended, Failed) and f"{ended.code}: {ended.reason}" == wanted


def test_versions_are_named_by_their_beginning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refusal(name: str | None) -> str:
        with store.reading() as connection, pytest.raises(ConfigError) as told:
            find_version(connection, name)
        return str(told.value)

    results = open_objects(str(tmp_path / "r"), create=True)
    archive = open_objects(str(make_archive(tmp_path / "a", {"r": "good"})))
    with open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store:
        assert refusal(None) == "the store knows no version of a fleet; barsight fleet plan makes one"
        for name in ("ab", "ac"):
            version = replace(VERSION, name=name, configuration=name)
            note_plan(store, plan_tasks(archive, results, version, None, no_progress), "t")
        assert refusal("a") == "a: names several versions; known are ab, ac"
        assert refusal("x") == "x: names no version that is planned; known are ab, ac"
        words = ["fleet", "compare", "ab", "ac", "--results", results.url, "-o", str(tmp_path / "c")]
        assert run([*words, "--store", f"sqlite:///{tmp_path}/s.db"]) == 5
        words[3] = "ab"
        assert run([*words, "--store", f"sqlite:///{tmp_path}/s.db"]) == 2
        assert "BEFORE and AFTER name one version, ab; name two" in capsys.readouterr().err
        assert not (tmp_path / "c").exists()


@pytest.mark.slow
def test_azure_keeps_the_promises_that_a_run_rests_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "azurite").mkdir()
    with azure_server(tmp_path / "azurite") as url:
        for name, value in {**AZURE, "AZURITE_BLOB_STORAGE_URL": url}.items():
            monkeypatch.setenv(name, value)
        here = open_objects(str(make_archive(tmp_path / "a", {"r": "good", "s": "good", "bad": "poison"})))
        archive, results = (open_objects(f"az://yard/{name}") for name in ("archive", "results"))
        for one in here.list():
            archive.write(one.path, tmp_path / "a" / one.path)
        with ThreadPoolExecutor(8) as pool:
            put = [pool.submit(results.write_new, "x/y", bytes([k])) for k in range(8)]
        assert sum(one.result() for one in put) == 1 and len(results.read("x/y") or b"") == 1
        assert [one.path for one in results.list_folder("x")] == ["x/y"] and results.read("x/z") is None
        results.remove("x/y")
        tasks = plan_tasks(archive, results, VERSION, None, no_progress)
        shared = settings(tmp_path, results.url)
        with open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store:
            with connect(2, None) as client:
                drive(client, tasks, shared, store, results, RunWindow(), no_progress)
            with store.reading() as connection:
                assert noted_keys(connection) == published_keys(results)
        assert count_states(results, tasks) == FleetCounts(2, 1, 0, 0)
        assert [task.name for task, _ in parked_reasons(results, tasks)] == ["bad"]


@pytest.mark.slow
def test_an_adaptive_cluster_grows_from_no_worker_and_shrinks_again(tmp_path: Path) -> None:
    results = open_objects(str(tmp_path / "r"), create=True)
    archive = open_objects(str(make_archive(tmp_path / "a", {str(k): "good 2" for k in range(8)})))
    tasks = plan_tasks(archive, results, VERSION, None, no_progress)
    shared = settings(tmp_path, results.url)
    with (
        LocalCluster(n_workers=0, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster,
        open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store,
        connect(1, cluster.scheduler_address) as client,
    ):
        cluster.adapt(minimum=0, maximum=2, interval="200ms", wait_count=2, target_duration="1s")
        drive(client, tasks, shared, store, results, RunWindow(), no_progress)
        claims = [results.read_json(one.path) for one in results.list("claims/")]
        assert len(claims) == 8 and len({one["pid"] for one in claims}) >= 2
        assert count_states(results, tasks) == FleetCounts(8, 0, 0, 0)
        until = time.monotonic() + 20
        while client.nthreads() and time.monotonic() < until:
            time.sleep(0.2)
        assert not client.nthreads()


@pytest.mark.slow
def test_a_scheduler_that_dies_ends_the_run_by_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    archive = open_objects(str(make_archive(tmp_path / "a", {"r": "good 30"})))
    results = open_objects(str(tmp_path / "r"), create=True)
    tasks = plan_tasks(archive, results, VERSION, None, no_progress)
    shared, port = settings(tmp_path, results.url), free_port()
    commands = dask_commands(port, 1).values()
    cluster = [subprocess.Popen(command, stderr=subprocess.DEVNULL) for command in commands]
    try:
        with (
            open_store(f"sqlite:///{tmp_path}/s.db", create=True) as store,
            pytest.raises(InputError, match="no scheduler is there any more"),
            connect(1, f"tcp://127.0.0.1:{port}") as client,
        ):
            client.wait_for_workers(1)
            Timer(3.0, cluster[0].kill).start()
            drive(client, tasks, shared, store, results, RunWindow(), no_progress)
    finally:
        for process in cluster:
            process.kill()
            process.wait()
    assert capfd.readouterr().err == ""
