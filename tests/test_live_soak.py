"""The soak: what grows is told, what doesn't isn't, killings are timed, and its own memory is bounded."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from barsight.cli.main import run
from barsight.live.soak import faults
from barsight.live.soak.faults import RandomKills
from barsight.live.soak.processes import command_of, family, read_usage
from barsight.live.soak.report import SoakBounds, soak_content, soak_table, write_soak
from barsight.live.soak.trend import MAX_WINDOWS, Windows
from barsight.live.soak.watch import RunWatch, Watched
from barsight.simulation.simulate import simulate
from cli_runs import FAST, TINY
from test_live import content

HOURS = float(os.environ.get("BARSIGHT_SOAK_H", "0.05"))


@pytest.mark.parametrize("days", [1 / 24, 1.0, 10.0])
@pytest.mark.parametrize("per_h", [0.0, 2.0])
def test_a_trend_is_found_in_an_hour_or_ten_days_and_memory_is_bounded(days: float, per_h: float) -> None:
    """A process that lives 25 minutes, grows by 80 MiB each time, with 3 MiB of noise; another that stays."""
    rng, at_s = np.random.default_rng(3), np.arange(0, 86400 * days, 10.0)
    saw = 100 + 80 * (at_s % 1500) / 1500 + per_h * at_s / 3600 + rng.normal(0, 3, at_s.size)
    steady = 100 + per_h * at_s / 3600 + rng.normal(0, 3, at_s.size)
    for values, of_peaks, cycle_s in ((saw, True, 1500.0), (steady, False, 0.0)):
        windows = Windows()
        for at, value in zip(at_s.tolist(), values.tolist(), strict=True):
            windows.add(at, value)
        assert len(windows._windows) <= MAX_WINDOWS
        assert (windows.first, windows.last, windows.peak) == (values[0], values[-1], values.max())
        trend = windows.trend(600.0, cycle_s, of_peaks=of_peaks)
        assert (trend is None) == (days < 1 and cycle_s > 0), "two cycles an hour tell nothing yet"
        if trend is None:
            continue
        assert abs(trend.per_h - per_h) < 4 * trend.sigma_per_h + 0.01
        assert days < 1 or trend.sigma_per_h < 0.5


def test_a_trend_needs_time_after_the_warm_up() -> None:
    windows = Windows()
    for at in range(0, 200, 10):
        windows.add(float(at), 7.0)
    assert windows.trend(100.0, 0.0, of_peaks=True) is None
    trend = windows.trend(0.0, 0.0, of_peaks=True)
    assert trend is not None and (trend.per_h, trend.sigma_per_h) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_usage_is_the_processs_own() -> None:
    holds = "import os, sys; fds = [os.dup(0) for _ in range(40)]; kept = bytearray(b'1' * 64 << 20)"
    plain, holding = (
        subprocess.Popen(
            [sys.executable, "-c", f"{code}\nprint(flush=True)\ninput()"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )
        for code in ("pass", holds.replace("'1' * 64 << 20", "'1' * (64 << 20)"))
    )  # fmt: skip
    try:
        for one in (plain, holding):
            assert one.stdout is not None and one.stdout.readline() == "\n"
        less, more = read_usage(plain.pid), read_usage(holding.pid)
        assert less is not None and more is not None
        assert more.descriptors - less.descriptors == 40
        assert 60 < more.rss_mib - less.rss_mib < 75 and 60 < more.pss_mib - less.pss_mib < 75
        assert {plain.pid, holding.pid} <= family(os.getpid(), {}).keys()
        assert command_of(plain.pid) is None, "no fork server began it"
    finally:
        for one in (plain, holding):
            one.communicate("\n")
    assert read_usage(plain.pid) is None


def watched(per_h: float, descriptors: int, new: int = 0) -> Watched:
    """A process over two hours."""
    one = Watched(pid=1, new=new)
    for at in range(0, 7200, 10):
        one.rss_mib.add(float(at), 100 + per_h * at / 3600)
        one.descriptors.add(float(at), float(20 + descriptors * at // 7200))
    return one


@pytest.mark.parametrize(
    ("processes", "broken", "unsure"),
    [
        ({"command": watched(0.5, 0), "map": watched(0.9, 2, new=7)}, [], []),
        ({"map": watched(3.0, 0)}, ["map: memory grows by 3.00 MiB/h"], []),
        ({"command": watched(0, 30)}, ["command: 26 descriptors more"], []),
        ({"command": watched(0, 0, new=2)}, ["command: begun anew 2 times"], []),
        ({"track": Watched()}, [], ["track: too short to tell"]),
        ({}, [], ["no process was seen"]),
    ],
)
def test_bounds_are_judged_by_name(
    processes: dict[str, Watched], broken: list[str], unsure: list[str], tmp_path: Path
) -> None:
    watch = RunWatch(tmp_path)
    watch.processes = processes
    found = soak_content(watch, {}, 0.1, SoakBounds())
    assert len(found["broken"]) == len(broken) and len(found["unsure"]) == len(unsure)
    assert all(
        told in one for told, one in zip(broken + unsure, found["broken"] + found["unsure"], strict=True)
    )
    write_soak(found, tmp_path)
    assert content(tmp_path / "soak.json")["processes"].keys() == processes.keys()
    table = (tmp_path / "soak.md").read_text()
    assert all(f"| {role} |" in table for role in processes)
    assert ("All bounds hold." in table) == (not broken and not unsure)


def test_fewer_descriptors_between_two_surveys_are_no_growth(tmp_path: Path) -> None:
    watch, command = RunWatch(tmp_path), Watched(pid=1, new=0)
    for at in range(0, 7200, 10):
        command.rss_mib.add(float(at), 100.0)
        command.descriptors.add(float(at), 5.0 if at == 400 else float(17 + at // 10 % 4))
    watch.processes = {"command": command}
    assert soak_content(watch, {}, 0.1, SoakBounds())["broken"] == []


class Told:
    """A run of one process that is killed: its state.json, written by a thread as a supervisor does."""

    def __init__(self, folder: Path, tells: bool, revokes: bool) -> None:
        self._folder, self._tells, self._revokes = folder, tells, revokes
        self._restarts, self._over = 0, threading.Event()
        self.process = self._begin()
        self._write("running")
        self._thread = threading.Thread(target=self._supervise)
        self._thread.start()

    def pause(self) -> None:
        self._over.set()
        self._thread.join()

    def end(self) -> None:
        self.pause()
        self.process.kill()
        self.process.wait()

    def _begin(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])

    def _supervise(self) -> None:
        while not self._over.wait(0.02):
            if self.process.poll() is not None and self._tells:
                self._restarts += 1
                self._write("restarting")
                self._over.wait(0.3)
                self.process = self._begin()
            self._write("running")

    def _write(self, state: str) -> None:
        one = {"pid": self.process.pid, "state": state, "restarts": self._restarts}
        may_stand = state == "running" or not self._revokes
        told = {"phase": "measuring", "processes": {"map": one}, "lifts": {"may_stand": may_stand}}
        (self._folder / "fresh").write_text(json.dumps(told))
        (self._folder / "fresh").replace(self._folder / "state.json")


@pytest.mark.parametrize(("tells", "revokes"), [(True, True), (True, False), (False, False)])
def test_a_killing_is_timed_by_what_the_run_tells(
    tells: bool, revokes: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(faults, "GIVE_UP_S", 2.0)
    monkeypatch.setattr(RunWatch, "owns", lambda _, pid: True)
    watch, one = RunWatch(tmp_path), Told(tmp_path, tells, revokes)
    try:
        kills = RandomKills(watch, 0, time.sleep)
        kills.step()
        killed = kills.killed["map"]
        before = killed.times
        kills.step()
        assert (before, killed.times) == (1, 1), "the next one is due later"
    finally:
        one.end()
    missed = killed.not_told, killed.not_revoked, killed.not_back
    assert (
        missed
        == {(True, True): (0, 0, 0), (True, False): (0, 1, 0), (False, False): (1, 0, 1)}[tells, revokes]
    )
    if tells:
        assert len(killed.told_s) == len(killed.back_s) == 1
        assert killed.told_s[0] < 0.3 < killed.back_s[0] + 0.1
        assert watch.restarts == {"map": 1}
    table = soak_table(soak_content(watch, kills.killed, 0.0, SoakBounds()))
    assert ("1 times never" in table) == (any(missed))


def test_processes_of_others_are_neither_watched_nor_killed(tmp_path: Path) -> None:
    """state.json of a run that is over names numbers that others have now."""
    one = Told(tmp_path, tells=False, revokes=False)
    try:
        one.pause()
        told = content(tmp_path / "state.json") | {"pid": one.process.pid}
        (tmp_path / "state.json").write_text(json.dumps(told))
        watch = RunWatch(tmp_path)
        assert not watch.sample() and not watch.processes
        kills = RandomKills(watch, 0, time.sleep)
        kills.step()
        assert one.process.poll() is None and kills.killed["map"].times == 0
    finally:
        one.end()


@pytest.mark.parametrize(
    ("flags", "code", "word"),
    [
        ((), 2, "needs OUT of a run that goes on, or --replay"),
        (("{tmp}", "--replay", "{whole}"), 2, "needs OUT of a run that goes on, or --replay"),
        (("{tmp}", "--", "--preset", "fast"), 2, "flags after -- are for --replay"),
        (("{tmp}",), 3, "no live run writes here"),
        (("{tmp}", "--hours", "-1"), 2, "--hours"),
        (("{tmp}", "--seed", "-1"), 2, "--seed -1"),
        (("--replay", "{tmp}/nowhere"), 5, "nowhere"),
    ],
)
def test_what_cannot_be_soaked_is_one_line(
    flags: tuple[str, ...],
    code: int,
    word: str,
    whole: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    filled = [flag.format(whole=whole, tmp=tmp_path) for flag in flags]
    assert run(["live", "soak", "-o", str(tmp_path / "out"), *filled]) == code
    told = [line for line in capfd.readouterr().err.splitlines() if line.startswith("barsight:")]
    assert len(told) == 1 and word in told[0]


@pytest.fixture
def surveys(tmp_path: Path) -> Iterator[Path]:
    """OUT of a run that replays 12 s over and over."""
    simulate(tmp_path / "recording", replace(TINY, frames=40, length_m=6.0))
    command = [sys.executable, "-m", "barsight", "live", "--replay", str(tmp_path / "recording"), "--surveys"]
    process = subprocess.Popen([*command, "-o", str(tmp_path / "live"), *FAST], stderr=subprocess.DEVNULL)
    try:
        give_up = time.monotonic() + 120
        while not (tmp_path / "live" / "current" / "state.json").is_file():
            assert process.poll() is None and time.monotonic() < give_up
            time.sleep(0.2)
        yield tmp_path / "live"
    finally:
        for _ in range(2):
            process.send_signal(signal.SIGINT)
            time.sleep(2.0)
        process.wait(120)


@pytest.mark.slow
def test_a_run_that_goes_on_is_watched_until_ctrl_c(surveys: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "barsight", "live", "soak", str(surveys), "-o", str(tmp_path / "soak")]
    process = subprocess.Popen([*command, "--warm-up-h", "0"], stdout=subprocess.PIPE, text=True)
    time.sleep(90.0)
    process.send_signal(signal.SIGINT)
    told, _ = process.communicate(timeout=60)
    found = content(tmp_path / "soak" / "soak.json")
    assert process.returncode == (5 if found["broken"] or found["unsure"] else 0)
    assert {"command", "forkserver", "resource tracker", "capture", "track", "pose", "map"} == set(
        found["processes"]
    )
    assert found["surveys"]["done"] >= 1 and found["processes"]["map"]["begun"] >= 2
    assert found["processes"]["command"]["begun"] == 1 and found["processes"]["map"]["restarts"] == 0
    assert 200 < found["total_mib"]["max"] < 2048 and "| command |" in told
    assert found["processes"]["command"]["descriptors"]["more_since_warm_up"] in (None, 0, 1, 2)


@pytest.mark.slow
def test_a_recording_is_soaked_with_faults(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Three minutes, or `BARSIGHT_SOAK_H` hours; the second half with processes killed at random."""
    simulate(tmp_path / "recording", replace(TINY, frames=60, length_m=20.0))
    out, half = tmp_path / "soak", str(HOURS / 2)
    times = ("--hours", str(HOURS), "--warm-up-h", str(HOURS / 4), "--faults-after-h", half)
    code = run(["live", "soak", "--replay", str(tmp_path / "recording"), "-o", str(out), *times, "--", *FAST])
    found: dict[str, Any] = content(out / "soak.json")
    sys.stderr.write((out / "soak.md").read_text())
    assert code == (5 if found["broken"] or found["unsure"] else 0)
    kills = found["faults"].values()
    assert sum(one["times"] for one in kills) >= 1
    assert not any(one["not_told"] or one["not_revoked"] or one["not_back"] for one in kills)
    assert not [told for told in found["broken"] if "memory" not in told and "killed" not in told]
    assert found["surveys"]["done"] >= 1
    kept = [path for path in (out / "surveys").iterdir() if not path.is_symlink()]
    assert 1 <= len(kept) <= 5
    assert not list((out / "surveys").glob("*/.live"))
