"""Spoil a live run at a crane of Aravis cameras at random moments, and tell how soon it told and came back.

Usage: python tests/fault_rounds.py [ROUNDS] [SEED] [lines] (root, libaravis, network namespaces). Every fault
of `FAULTS`, or with `lines`, readings coming by serial lines, of `LINE_FAULTS`, comes once a round, in random
order. The table has, of each fault: how often; from the fault to mode
and reason in state.json, and to lifts revoked; from its end to mode full with lifts and all processes
running; seconds, median and most.
"""

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import barsight as bs
from barsight.core.records.pairs import StereoFrame
from barsight.recording.base import Recording
from barsight.simulation.simulate import simulate
from cli_runs import FAST, TINY
from crane_network import PORTS, TESTS, Plant, describe, end, plant

PAUSE_S = (0.3, 2.5)
GIVE_UP_S = 45.0
STILL_S = 0.12
WALK = replace(TINY, frames=60, length_m=3.0)
CLOCK = """
import os, time
_real, _path = time.time_ns, os.environ["BARSIGHT_CLOCK_STEP"]
def _stepped():
    with open(_path) as file:
        return _real() + int(file.read() or 0)
time.time_ns = _stepped
"""
"""What steps the run's wall clock: a sitecustomize of its own."""


@dataclass(frozen=True)
class Fault:
    """begin spoils; finish mends after `seconds`. reason: in state.json, none where nothing need be told."""

    begin: Callable[["Crane"], None]
    reason: str = ""
    seconds: float = 0.0
    finish: Callable[["Crane"], None] | None = None
    forbids: bool = True
    moving: bool = False


@dataclass
class Found:
    told_s: list[float] = field(default_factory=list)
    revoked_s: list[float] = field(default_factory=list)
    back_s: list[float] = field(default_factory=list)
    missed: int = 0
    invalid: int = 0


class Crane:
    """The plant, a player of readings, and the run; `run` begins it."""

    def __init__(
        self, here: Plant, folder: Path, rng: np.random.Generator, minutes: float, *, by_lines: bool
    ) -> None:
        self.plant, self.folder, self.rng, self.out = here, folder, rng, folder / "out"
        self.disk, self.step = folder / "disk", folder / "step"
        recording = folder / "recording"
        simulate(recording, WALK)
        self.begin_ns = time.time_ns() + 5 * 10**9
        self.period_s, self.moving = prepare(bs.open_recording(recording), folder, self.begin_ns, minutes)
        self.cameras = [self.camera(0), self.camera(1)]
        self.player = subprocess.Popen(
            ["ip", "netns", "exec", here.spaces[0], sys.executable, str(TESTS / "crane_player.py"),
             str(folder / "readings.npz"), str(self.begin_ns), *([str(folder)] if by_lines else [])],
            stdin=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.changes = {
            "rate_hz = 3.0": "rate_hz = 8.4",
            "[measure": f'[recorder]\nfolder = "{self.disk}"\nsegment_mib = 16\n[measure',
        }
        if by_lines:
            self.changes |= {
                f"port = {port}": f'device = "{folder / name}"\nbaud = 921600' for name, port in PORTS.items()
            }
        self.config = describe(recording, folder, changes=self.changes)

    def camera(self, number: int) -> subprocess.Popen[str]:
        return self.plant.camera(number, self.folder / f"cam{number}.npy", str(self.folder / "times.npy"))

    def run(self) -> subprocess.Popen[str]:
        """Begin the run, with a wall clock of its own."""
        (self.folder / "site").mkdir()
        (self.folder / "site" / "sitecustomize.py").write_text(CLOCK)
        self.step.write_text("0")
        before = os.environ.get("PYTHONPATH", "")
        os.environ["PYTHONPATH"] = f"{self.folder / 'site'}:{before}"
        os.environ["BARSIGHT_CLOCK_STEP"] = str(self.step)
        command = ("-m", "barsight", "live", "--config", str(self.config), "-o", str(self.out), *FAST)
        process = self.plant.start(
            0, *command, "--live.keyframe-way-m", "1.0", "--live.passed-every-s", "5", quiet=False
        )
        os.environ["PYTHONPATH"] = before
        return process

    def state(self) -> Any:
        with suppress(OSError, ValueError):
            return json.loads((self.out / "state.json").read_text())
        return None

    def tell(self, line: str) -> None:
        assert self.player.stdin is not None
        self.player.stdin.write(line + "\n")
        self.player.stdin.flush()

    def is_moving(self) -> bool:
        """Check that the crane goes at its speed for the next second."""
        at = ((time.time_ns() - self.begin_ns) / 1e9) % self.period_s
        return any(first < at < last - 1.0 for first, last in self.moving)

    def pid(self, role: str) -> int:
        return int(self.state()["processes"][role]["pid"])

    def is_well(self) -> bool:
        state = self.state()
        return (
            state is not None and state["phase"] == "measuring" and state["mode"] == "full"
            and state["lifts"]["may_stand"] and not state["reasons"]
            and all(one["state"] == "running" for one in state["processes"].values())
        )  # fmt: skip

    def until(self, holds: Callable[[], bool], seconds: float = GIVE_UP_S) -> float | None:
        """Wait; return how long it took, None where it took too long."""
        began = time.monotonic()
        while not holds():
            if time.monotonic() - began > seconds:
                return None
            time.sleep(0.01)
        return time.monotonic() - began


def prepare(
    recording: Recording, folder: Path, begin_ns: int, minutes: float
) -> tuple[float, list[tuple[float, float]]]:
    """Write what cameras and player play: the recording there and back, standing at both ends.

    Turned back in time, places and accelerations stay what they are and turn rates change their sign, but for
    the gyro's bias: one that turned round too would, by gravity, be an acceleration that no encoder follows.
    Returns the period (s) and when the crane goes at speed.
    """
    crane, imu = recording.crane(), recording.imu()
    assert crane is not None and imu is not None
    shift_ns, frames = recording.rig.timeshift_cam_imu_ns, list(recording.frames())
    zero_ns, last_ns = (
        int(crane.stamp_ns[0]) - shift_ns,
        int(min(crane.stamp_ns[-1], imu.stamp_ns[-1])) - shift_ns,
    )
    half_s = (last_ns - zero_ns) / 1e9
    held = {"period_s": np.array(2 * half_s)}
    values = {"imu": np.hstack([imu.gyro_radps, imu.accel_mps2]), "crane": crane.position_m}
    begins = imu.stamp_ns < imu.stamp_ns[0] + round(1e9 * (WALK.motion.standstill_s - 0.5))
    bias = np.hstack([imu.gyro_radps[begins].mean(axis=0), np.zeros(3)])
    turned = {"imu": np.array([-1.0] * 3 + [1.0] * 3), "crane": np.ones(3)}
    off = {"imu": 2 * bias, "crane": np.zeros(3)}
    for name, samples in (("imu", imu), ("crane", crane)):
        s = (samples.stamp_ns - shift_ns - zero_ns) / 1e9
        inside = (s > 0) & (s < half_s)
        s, there = s[inside], values[name][inside]
        held[f"{name}_s"] = np.concatenate([s, 2 * half_s - s[::-1]]) + shift_ns / 1e9
        held[f"{name}_values"] = np.vstack([there, off[name] + there[::-1] * turned[name]])
    np.savez(folder / "readings.npz", **held)
    at = (np.array(recording.index.stamps_ns) - zero_ns) / 1e9
    still = [np.arange(low + STILL_S, high - STILL_S / 2, STILL_S) for low, high in (
        (-at[0], at[0]), (at[0], at[1]), (at[-2], at[-1]), (at[-1], half_s))]  # fmt: skip
    s = np.concatenate([still[0], at[:1], still[1], at[1:-1], still[2], at[-1:], still[3]])
    s = s[s >= 0]
    shown = np.searchsorted((at[1:] + at[:-1]) / 2, s)
    s, shown = np.concatenate([s, 2 * half_s - s[::-1]]), np.concatenate([shown, shown[::-1]])
    keep = np.r_[True, np.diff(s) > STILL_S / 2]
    s, shown = s[keep], shown[keep]
    loops = int(minutes * 60 / (2 * half_s)) + 1
    times = np.concatenate(
        [begin_ns + np.round(1e9 * (s + k * 2 * half_s)).astype(np.int64) for k in range(loops)]
    )
    np.save(folder / "times.npy", times)
    for number, side in enumerate(("left", "right")):
        pictures = np.array([getattr(one, side) for one in frames if isinstance(one, StereoFrame)])
        np.save(folder / f"cam{number}.npy", pictures[shown])
    fast = at[8], at[-8]
    return 2 * half_s, [fast, (2 * half_s - fast[1], 2 * half_s - fast[0])]


def kill(role: str, crane: Crane) -> None:
    os.kill(crane.pid(role), 9)


def tear(crane: Crane) -> None:
    """Kill the recorder and cut its newest segment short."""
    kill("record", crane)
    newest = max(crane.disk.glob("*/segment_*.mcap"), key=lambda path: path.stat().st_mtime)
    cut = int(crane.rng.integers(1, 200))
    os.truncate(newest, max(newest.stat().st_size - cut, 100))


def cable(state: str, crane: Crane) -> None:
    crane.plant.cable(0, state)


def lose(percent: float, crane: Crane) -> None:
    for number in (0, 1):
        crane.plant.lose(number, percent)


def stop_camera(crane: Crane) -> None:
    end(crane.cameras[1])


def start_camera(crane: Crane) -> None:
    crane.cameras[1] = crane.camera(1)


def spoil(line: str, crane: Crane) -> None:
    """Tell the player; a sign is drawn."""
    crane.tell(line.replace("~", "-" if crane.rng.uniform() < 0.5 else ""))


def set_clock(seconds: float, crane: Crane) -> None:
    crane.step.write_text(str(round(seconds * 1e9)))


def fill(crane: Crane) -> None:
    """Fill the recorder's disk to 97 %."""
    usage = os.statvfs(crane.disk)
    spare = usage.f_bavail * usage.f_frsize - 0.03 * usage.f_blocks * usage.f_frsize
    subprocess.run(["fallocate", "-l", str(int(spare)), str(crane.disk / "full")], check=True)


def empty(crane: Crane) -> None:
    (crane.disk / "full").unlink()


FAULTS = {
    "capture killed": Fault(partial(kill, "capture"), "capture is down: was ended by SIGKILL"),
    "track killed": Fault(partial(kill, "track"), "track is down: was ended by SIGKILL"),
    "map killed": Fault(partial(kill, "map"), "map is down: was ended by SIGKILL"),
    "record killed": Fault(partial(kill, "record"), "record: was ended by SIGKILL", forbids=False),
    "segment torn": Fault(tear, "record: was ended by SIGKILL", forbids=False),
    "link down 2 s": Fault(partial(cable, "down"), "cam0: silent", 2.0, partial(cable, "up")),
    "0.2 % loss, 5 s": Fault(partial(lose, 0.2), "", 5.0, partial(lose, 0.0), forbids=False),
    "a camera dead 2 s": Fault(stop_camera, "cam1: silent", 2.0, start_camera),
    "IMU gap 1 s": Fault(partial(spoil, "imu silent 1"), "the IMU: silent", 1.0, forbids=False),
    "encoders silent 1 s": Fault(partial(spoil, "crane silent 1"), "the encoders: silent", 1.0),
    "encoders frozen 1 s": Fault(
        partial(spoil, "crane freeze 1"), "the encoders are frozen", 1.0, moving=True
    ),
    "encoders jump 0.5 m, 1 s": Fault(partial(spoil, "crane jump 1 ~0.5"), "the encoders jumped", 1.0),
    "encoders' stamps jump 5 s": Fault(partial(spoil, "crane stamps ~5"), "the encoders: silent"),
    "IMU's stamps jump 5 s": Fault(partial(spoil, "imu stamps ~5"), "the IMU: silent", forbids=False),
    "clock steps 1 min, 2 s": Fault(
        partial(set_clock, 60.0), "clock was stepped", 2.0, partial(set_clock, 0.0)
    ),
    "disk full 2 s": Fault(fill, "recording is stopped", 2.0, empty, forbids=False),
}
LINE_FAULTS = {
    "encoders unplugged 2 s": Fault(partial(spoil, "crane unplug 2"), "the encoders: silent", 2.0),
    "IMU unplugged 2 s": Fault(partial(spoil, "imu unplug 2"), "the IMU: silent", 2.0, forbids=False),
}


def reasons_of(state: Any) -> list[str]:
    """List why not all is well: the mode's reasons, and why a recorder that is down ended."""
    record = state["processes"]["record"]
    down = [f"record: {record['reason']}"] if record["state"] != "running" else []
    return [*state["reasons"], *down]


def try_fault(crane: Crane, fault: Fault, found: Found) -> None:
    """Let a fault come at a random moment of a run that is well, and watch until it is well again."""
    assert crane.until(crane.is_well, 120.0) is not None, crane.state()
    time.sleep(crane.rng.uniform(*PAUSE_S))
    if fault.moving:
        crane.until(crane.is_moving)
    if crane.until(crane.is_well, 120.0) is None:
        raise AssertionError(crane.state())
    fault.begin(crane)
    began, told, stood = time.monotonic(), None, 0.0
    over = began + fault.seconds
    while time.monotonic() < max(over, began + 1.5) or (told is None and time.monotonic() < began + 5.0):
        state, now = crane.state(), time.monotonic()
        if state is not None:
            if told is None and any(re.search(fault.reason or "$.", reason) for reason in reasons_of(state)):
                told = now - began
            is_past = (told is not None and now > over) or not fault.forbids
            stood = stood if is_past or not state["lifts"]["may_stand"] else now - began
        if not fault.reason and now > over:
            break
        if told is not None and now > over:
            break
        time.sleep(0.01)
    if fault.finish is not None:
        fault.finish(crane)
    mended = time.monotonic() if fault.finish is not None else max(over, began)
    if fault.reason:
        found.missed += told is None
        found.told_s += [] if told is None else [told]
    if fault.forbids:
        found.revoked_s.append(stood)
        found.invalid += stood > 1.0
    crane.until(crane.is_well, GIVE_UP_S)
    found.back_s.append(time.monotonic() - mended)


@contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1200m", "tmpfs", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def run_rounds(
    rounds: int, seed: int, faults: dict[str, Fault], folder: Path
) -> tuple[dict[str, Found], str]:
    """Run rounds of faults; return what was found, and how the run ended."""
    rng, table, names = np.random.default_rng(seed), {name: Found() for name in faults}, list(faults)
    with plant() as here, small_disk(folder / "disk"):
        minutes = 10 + rounds * len(names) * 0.35
        crane = Crane(here, folder, rng, minutes, by_lines=faults is LINE_FAULTS)
        try:
            time.sleep(max(crane.begin_ns - time.time_ns(), 0) / 1e9 + 1.0)
            process = crane.run()
            with suppress(KeyboardInterrupt):  # Ctrl-C ends the rounds, not the table
                for number, name in ((k, n) for k in range(rounds) for n in rng.permutation(names).tolist()):
                    try_fault(crane, faults[name], table[name])
                    sys.stderr.write(f"{number} {row(name, table[name])}\n")
            frames = crane.state()["frames"]
            process.send_signal(2)
            _, errors = process.communicate(timeout=900)
            recorded = next(path for path in crane.disk.iterdir() if path.is_dir())
            pairs = len(bs.open_recording(recorded).index.stamps_ns)
            last = [line for line in errors.splitlines() if line.startswith("barsight:")]
            ended = f"exit code {process.returncode}; {pairs} pairs can be read again; {last}; {frames}"
        finally:
            end(crane.player)
    return table, ended


def row(name: str, found: Found) -> str:
    def spread(values: list[float]) -> str:
        return f"{np.median(values):.2f} / {max(values):.2f}" if values else "-"

    parts = [spread(values) for values in (found.told_s, found.revoked_s, found.back_s)]
    return f"| {name} | {len(found.back_s)} | {' | '.join(parts)} | {found.missed} | {found.invalid} |"


def main() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background has it ignored
    faults = LINE_FAULTS if "lines" in sys.argv else FAULTS
    words = [int(word) for word in sys.argv[1:] if word != "lines"]
    rounds, seed = [*words, *(20, 1)[len(words) :]]
    with tempfile.TemporaryDirectory() as folder:
        table, ended = run_rounds(rounds, seed, faults, Path(folder))
    head = "| fault | times | told, s | lifts revoked, s | well again, s | not told | lifts stood over 1 s |"
    lines = [head, "|---|---|---|---|---|---|---|", *(row(name, found) for name, found in table.items())]
    sys.stdout.write("\n".join(lines) + f"\n\n{ended}\n")


if __name__ == "__main__":
    main()
