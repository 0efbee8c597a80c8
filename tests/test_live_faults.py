"""Faults while a run goes on: processes killed, sensors silent or frozen, a torn picture, Ctrl-C."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import barsight as bs
from barsight.live.run import replay
from barsight.live.settings import LiveSettings
from barsight.simulation.simulate import simulate
from cli_runs import FAST, TINY, cut_short, edit, pictures
from test_live import BEGIN_NS, SETTINGS, content

LONGER = replace(TINY, frames=20, length_m=3.0)
"""Pictures 0.3 s apart."""


@pytest.fixture(scope="module")
def longer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("longer") / "recording"
    simulate(path, LONGER)
    return path


class Run:
    """A live run in a process of its own, watched through state.json."""

    def __init__(self, recording: Path, out: Path, speed: float, *flags: str) -> None:
        command = [sys.executable, "-m", "barsight", "live", "--replay", str(recording), "-o", str(out)]
        self.out = out
        self.process = subprocess.Popen(
            [*command, "--speed", str(speed), *FAST, *flags],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def state(self) -> Any:
        return content(self.out / "state.json") if (self.out / "state.json").is_file() else None

    def until(self, holds: Callable[[Any], bool], seconds: float) -> float:
        """Wait until the state holds; return how long that took."""
        began = time.monotonic()
        while True:
            state = self.state()
            if state is not None and holds(state):
                return time.monotonic() - began
            assert time.monotonic() - began < seconds, state
            assert self.process.poll() is None, state
            time.sleep(0.02)

    def running(self, seconds: float = 60.0) -> float:
        return self.until(
            lambda s: s["phase"] == "measuring" and s["mode"] == "full" and s["lifts"]["may_stand"], seconds
        )

    def end(self) -> Any:
        assert self.process.wait(180) == 0
        return self.state()


def expect_replays(out: Path, recording: Path, again: Path) -> None:
    """Replaying what a run kept, as fast as possible, gives the same heights to the byte."""
    replay(
        recording, again, SETTINGS, LiveSettings(), speed=0, keyframes=out / "keyframes.json",
        tell=lambda _: None,
    )  # fmt: skip
    assert (out / "height.tif").read_bytes() == (again / "height.tif").read_bytes()


KILLS = 24


@pytest.mark.slow
def test_a_killed_process_is_told_and_comes_back(longer: Path, tmp_path: Path) -> None:
    """At random moments: mode and reason within 1 s, all well within 10 s, and what was kept replays."""
    rng = np.random.default_rng(5)
    told: dict[str, list[float]] = {"capture": [], "track": [], "pose": [], "map": []}
    back: dict[str, list[float]] = {role: [] for role in told}
    live = Run(longer, tmp_path / "out", 0.07)
    for number in range(KILLS):
        role, count = list(told)[number % len(told)], 1 + number // len(told)
        live.running()
        time.sleep(rng.uniform(2.0, 4.0))  # one that ends six times within 30 s ends the run
        os.kill(live.state()["processes"][role]["pid"], signal.SIGKILL)
        told[role].append(live.until(partial(is_told, role, count), 5.0))
        back[role].append(live.running(20.0))
    live.process.send_signal(signal.SIGINT)
    state = live.end()
    for role in told:
        worst = f"told {max(told[role]):.2f} s, back {max(back[role]):.2f} s at most"
        sys.stderr.write(f"{role}: {len(told[role])} kills, {worst}\n")
        assert max(told[role]) < 1.0 and max(back[role]) < 10.0
        assert state["processes"][role]["restarts"] == len(told[role])
    expect_replays(live.out, longer, tmp_path / "again")


@pytest.mark.slow
def test_a_process_that_hangs_is_ended_and_comes_back(longer: Path, tmp_path: Path) -> None:
    live = Run(longer, tmp_path / "out", 0.07, "--live.hang-s", "5")
    for role in ("capture", "track", "pose", "map"):
        live.running()
        os.kill(live.state()["processes"][role]["pid"], signal.SIGSTOP)
        told_s = live.until(lambda s, role=role: s["processes"][role]["restarts"] == 1, 15.0)  # type: ignore[misc]
        assert told_s < 7.0
        assert any(f"{role} is down: did not go on for 5 s" in r for r in live.state()["reasons"])
        assert live.running(20.0) < 15.0
    live.process.send_signal(signal.SIGINT)
    live.end()


def is_told(role: str, restarts: int, state: Any) -> bool:
    """Check that the state names the process that was killed, and lets no lift stand."""
    reasons = " ".join(state["reasons"])
    is_named = f"{role} is down: was ended by SIGKILL" in reasons
    return is_named and state["processes"][role]["restarts"] == restarts and not state["lifts"]["may_stand"]


def without(path: Path, first_s: float, last_s: float) -> None:
    """Leave out the rows of a part of a sensor's time."""

    def change(lines: list[str]) -> list[str]:
        seconds = [(int(line.split(",")[0]) - BEGIN_NS) / 1e9 for line in lines[1:]]
        return lines[:1] + [
            line for line, s in zip(lines[1:], seconds, strict=True) if not first_s < s < last_s
        ]

    edit(path, change)


def frozen(path: Path, first_s: float, last_s: float) -> None:
    """Repeat one reading over a part of the encoders' time."""

    def change(lines: list[str]) -> list[str]:
        held, changed = "", lines[:1]
        for line in lines[1:]:
            stamp, _, place = line.partition(",")
            inside = first_s < (int(stamp) - BEGIN_NS) / 1e9 < last_s
            held = (held or place) if inside else ""
            changed.append(f"{stamp},{held or place}")
        return changed

    edit(path, change)


FAULTS: dict[str, tuple[str, str, Callable[[Path, float, float], None]]] = {
    "imu": ("imu0", "no-imu", without),
    "silent": ("crane0", "no-encoders", without),
    "frozen": ("crane0", "no-encoders", frozen),
    "camera": ("cam1", "encoders-only", without),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("seed", range(2))
def test_a_silent_sensor_is_told_and_comes_back(fault: str, seed: int, longer: Path, tmp_path: Path) -> None:
    folder, mode, spoil = FAULTS[fault]
    recording = Path(shutil.copytree(longer, tmp_path / "recording"))
    stamps = bs.open_recording(longer).index.stamps_ns
    begin_s = (stamps[3] - BEGIN_NS) / 1e9 + np.random.default_rng(seed).uniform(0, 1.0)
    bound_s, gap_s = 0.3, 2.0
    if fault == "camera":
        bound_s, gap_s = 1.5 * float(np.percentile(np.diff(stamps), 95)) / 1e9, 5.0
    spoil(recording / "mav0" / folder / "data.csv", begin_s, begin_s + gap_s)
    live = Run(recording, tmp_path / "out", 1.0, "--live.camera-silence-intervals", "1.5")
    live.running()
    live.until(lambda s: s["mode"] == mode and s["reasons"], 40.0)
    found = live.state()
    late_s = (found["now_ns"] - BEGIN_NS) / 1e9 - begin_s - bound_s
    assert found["lifts"]["may_stand"] == (mode == "no-imu")
    live.running(20.0)
    sys.stderr.write(f"{fault} {seed}: told {late_s:.2f} s after the bound\n")
    assert late_s < 1.0
    # Measuring may refuse a recording with such a gap, by name; then nothing is offered.
    if live.process.wait(180) == 3:
        assert live.state()["phase"] == "failed" and not live.state()["lifts"]["may_stand"]
        assert not (live.out / "lifts.json").exists()
    else:
        assert live.process.returncode == 0 and live.state()["phase"] == "done"


@pytest.mark.slow
def test_ctrl_c_ends_in_a_whole_folder(longer: Path, tmp_path: Path) -> None:
    live = Run(longer, tmp_path / "out", 0.5)
    live.running()
    live.until(lambda s: s["frames"]["kept"] >= 5, 60.0)
    live.process.send_signal(signal.SIGINT)
    state = live.end()
    assert state["phase"] == "done" and bs.load(live.out).height_map is not None
    assert "interrupted" in (live.out / "live.log").read_text()
    expect_replays(live.out, longer, tmp_path / "again")


@pytest.mark.slow
def test_a_torn_picture_is_counted(longer: Path, tmp_path: Path) -> None:
    recording = Path(shutil.copytree(longer, tmp_path / "recording"))
    cut_short(pictures(recording, "cam1")[4])
    replay(recording, tmp_path / "out", SETTINGS, LiveSettings(), speed=0, tell=lambda _: None)
    frames = content(tmp_path / "out" / "latency.json")["frames"]
    assert frames["dropped"]["torn"] == 1 and frames["dropped"]["unpaired_cam0"] == 1
    assert frames["paired"] == frames["tracked"] == 19
