"""Supervise the run's processes: start them, restart each on its own, judge the mode and report it."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess

from barsight.core.errors import BarsightError
from barsight.core.stamps import NS_PER_S
from barsight.live.capture import capture
from barsight.live.link import Link
from barsight.live.mapper import build_live_map
from barsight.live.modes import (
    FOR_LIFTS,
    TROUBLES,
    EncoderFaults,
    FreezeWatch,
    Mode,
    SensorActivity,
    judge_mode,
)
from barsight.live.pose_output import output_poses
from barsight.live.record import record
from barsight.live.shared.counters import DRAIN, OFF, Counters
from barsight.live.shared.processes import end_with_parent, signals_blocked
from barsight.live.source import ReplayClock
from barsight.live.state import ProcessState, RunState, write_health, write_state
from barsight.live.survey import INTERRUPTED, SurveyWatch
from barsight.live.track import track

PROCESSES: dict[str, Callable[[Link], None]] = {
    "capture": capture, "track": track, "pose": output_poses, "map": build_live_map, "record": record,
}  # fmt: skip
BEAT_S = 0.1
"""Interval in seconds at which the mode is judged and the processes are checked."""
MAX_RESTARTS, RESTARTS_WITHIN_S = 5, 30.0
"""Maximum number of restarts of a process, and the time in seconds within which they count; more end the
run.
"""
STALLED_S = 5.0
"""Time in seconds without a heartbeat after which a process counts as down, before it is ended."""
START_S = 120.0
"""Longest time in seconds that processes may take to start on a busy machine."""
FINISH_S = 60.0
"""Longest silence of the map process in seconds at the end, between one pair or tile and the next."""
DRAIN_S = 60.0
"""Longest time in seconds that the recorder may take to write what is left."""
SIGNS = {
    ("record", "paused"): "recording stopped, the disk is too full: {} (1: stopped, 0: goes on)",
    ("record", "deleted"): "{} old segments were deleted so far, the disk is filling",
    **{
        ("sensors", f"{sensor}_{sign}"): f"{sensor}: {told}"
        for sensor in ("cam0", "cam1", "imu", "crane")
        for sign, told in (("settled", "its clock is settled: {}"), ("jumps", "its stamps jumped {} times"))
    },
    **{("sensors", f"cam{k}_connects"): f"cam{k}: connected {{}} times" for k in (0, 1)},
    **{
        ("sensors", f"{one}_restarts"): f"{one}: its sender began anew {{}} times" for one in ("imu", "crane")
    },
}
"""Counters whose changes are logged, each with its line."""


def run_process(role: str, link: Link) -> None:
    """Run one process of the run. Ctrl-C is left to its parent, with which it dies."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    end_with_parent()
    link.tell(role, "")
    try:
        PROCESSES[role](link)
    except Exception as error:
        link.tell(role, f"{type(error).__name__}: {error}")
        if not isinstance(error, BarsightError) and link.folder.exists():  # else the command tells of it
            traceback.print_exc()
        sys.exit(1)


class Supervisor:
    """Runs the processes of a run. tell: receives each line of the log."""

    def __init__(self, link: Link, board: Counters, tell: Callable[[str], None]) -> None:
        self._link, self._board, self._tell = link, board, tell
        self._out = link.folder.parent
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([__name__])
        self._running: dict[str, BaseProcess] = {}
        self._roles = [role for role in PROCESSES if role != "record" or link.source.crane is not None]
        self._ends: dict[str, list[float]] = {role: [] for role in self._roles}
        self._hung: dict[str, str] = {}
        self.state = RunState(processes={role: ProcessState() for role in self._roles})
        recording = link.open_recording()
        self._sensors, self._shift_ns = link.sensors(recording), recording.rig.timeshift_cam_imu_ns
        self._crane = recording.crane() if "crane" in self._sensors else None
        self._encoders = link.readings("crane")
        self._faults = None if self._crane is None else EncoderFaults(self._crane)
        self._restarted = False
        self._survey: SurveyWatch | None = None
        if link.source.crane is not None:
            self._survey = SurveyWatch(link.source.crane.survey, is_alone=not link.source.surveys)
        self._clock: ReplayClock | None = None
        self._health_at = 0.0
        self._signs: dict[tuple[str, str], int] = {}
        self.stop_because = ""

    def run(self) -> None:
        """Run until the recording ends, `stop` is called or a process can't be kept running; then end all."""
        try:
            for role in self._roles:
                self._start(role)
            self._await_start()
            while not (self._board["track", "done"] or self.stop_because):
                wait([process.sentinel for process in self._running.values()], BEAT_S)
                self._look_after()
                self._judge()
        finally:
            self._end_all()
        self.state.mode = self.final_mode()
        self._write(health=True)

    def stop(self, because: str) -> None:
        """Request the end of the run. An interruption counts even if it is already ending: no run follows."""
        if not self.stop_because or because == INTERRUPTED:
            self.stop_because = because

    def fail(self) -> None:
        """Report, if it can be written, that the run ended without a result."""
        self.state.phase = "failed"
        with contextlib.suppress(BarsightError, OSError):
            write_state(self.state, self._board, self._out)

    def final_mode(self) -> Mode:
        """Judge the mode at the last picture, independently of the processes' pace."""
        heard = self._heard()
        if self._crane is not None:
            freeze = FreezeWatch(self._crane)
            heard = replace(heard, frozen=freeze.check(*self._link.readings("crane").read()))
        return judge_mode(heard, max(heard.cameras_ns), self._link.live)

    def _start(self, role: str) -> None:
        process = self._context.Process(
            target=run_process, args=(role, self._link), name=f"barsight {role}", daemon=True
        )
        self._board.beat(role)
        with signals_blocked():
            process.start()
        self._running[role] = process
        self.state.processes[role].pid = process.pid or 0

    def _await_start(self) -> None:
        """Wait until all processes are ready, then start the recording's clock."""
        give_up = time.monotonic() + START_S
        while not all(self._board[role, "ready"] for role in self._roles) and not self.stop_because:
            wait([process.sentinel for process in self._running.values()], BEAT_S)
            self._look_after()
            if time.monotonic() > give_up:
                self.stop("the processes didn't start")
        began_ns = time.monotonic_ns()
        first_ns = self._board["capture", "first_ns"]
        if self._link.source.crane is not None:
            first_ns = began_ns + self._link.source.epoch_ns
        self._clock = ReplayClock(began_ns, first_ns, self._link.source.speed)
        self._board["supervisor", "began_ns"] = began_ns
        self.state.phase = "measuring"

    def _look_after(self) -> None:
        """Restart each process that has ended without being done."""
        done = {
            "capture": self._board["capture", "ended"],
            "track": self._board["track", "done"],
            "pose": 0,
            "map": 0,
            "record": 0,
        }
        for role, process in list(self._running.items()):
            state = self.state.processes[role]
            if process.is_alive():
                if state.state != "running" and self._board[role, "ready"]:
                    state.state = "running"
                    if state.restarts:
                        self._log(f"{role} is running again")
                if not done[role]:
                    self._end_if_hung(role, process)
                continue
            if done[role]:
                state.state = "done"
                continue
            state.state, state.restarts, state.reason = "restarting", state.restarts + 1, self._why(role)
            self._log(f"{role} {state.reason}; starting it anew")
            now = time.monotonic()
            self._ends[role] = [at for at in self._ends[role] if now - at < RESTARTS_WITHIN_S] + [now]
            if len(self._ends[role]) > MAX_RESTARTS:
                self.stop(f"{role} {state.reason}, {MAX_RESTARTS + 1} times within {RESTARTS_WITHIN_S:.0f} s")
                return
            self._board[role, "ready"] = 0
            self._start(role)

    def _end_if_hung(self, role: str, process: BaseProcess) -> None:
        """End a process that is alive but hangs; while it is starting, `START_S` applies."""
        bound_s = self._link.live.hang_s if self._board[role, "ready"] else START_S
        if self._silent_s(role) > bound_s:
            self._hung[role] = f"did not go on for {bound_s:g} s"
            process.kill()

    def _silent_s(self, role: str) -> float:
        return (time.monotonic_ns() - self._board[role, "beat_ns"]) / NS_PER_S

    def _why(self, role: str) -> str:
        if role in self._hung:
            return self._hung.pop(role)
        code, reason = self._running[role].exitcode or 0, self._link.told(role)
        if code < 0:
            return f"was ended by {signal.Signals(-code).name}"
        if reason:
            return f"ended by {reason}"
        return f"ended with code {code}"

    def _judge(self) -> None:
        """Judge the mode and write it; log it if it has changed."""
        assert self._clock is not None
        now_ns = self._clock.stamp_now_ns()
        heard = self._heard()
        if now_ns is None or self._board["capture", "ended"]:
            now_ns = max(heard.cameras_ns)
        mode = judge_mode(heard, now_ns, self._link.live, self._down())
        if self._board["record", "paused"]:
            mode = replace(mode, reasons=(*mode.reasons, "recording is stopped, the disk is too full"))
        self.state.now_ns = now_ns
        before = self.state.mode
        changed = (mode.name, mode.lifts) != (before.name, before.lifts)
        self.state.mode = mode
        if changed and before.lifts and not mode.lifts:
            self._board["supervisor", "alarms"] += 1
        if changed:
            lifts = "" if mode.lifts else "; lifts are revoked"
            self._log(f"mode {mode.name}{lifts}" + "".join(f"; {reason}" for reason in mode.reasons))
        self._watch_survey(now_ns)
        self._watch_sensors()
        self._write(health=time.monotonic() >= self._health_at)

    def _down(self) -> dict[str, str]:
        """Return which processes don't work, with reasons; lifts don't depend on the recorder."""
        down = {}
        for role, one in self.state.processes.items():
            silent_s = self._silent_s(role)
            if one.state == "running" and silent_s > STALLED_S:
                down[role] = f"has not gone on for {silent_s:.0f} s"
            elif one.state not in ("running", "done"):
                down[role] = one.reason
        down.pop("record", None)
        return down

    def _watch_survey(self, now_ns: int) -> None:
        """Stop when the survey is over; encoders that can't be trusted don't end one."""
        if self._survey is not None:
            _, place = self._link.readings("crane").last(1 if self.state.mode.name in FOR_LIFTS else 0)
            if because := self._survey.judge(now_ns, place):
                self.stop(because)

    def _watch_sensors(self) -> None:
        """Log changes in the counters of the recorder and of the sensors' clocks."""
        for key, text in SIGNS.items():
            value = self._board[key]
            if value != self._signs.get(key, 0):
                self._log(text.format(value))
            self._signs[key] = value

    def _heard(self) -> SensorActivity:
        board, frozen, jumped_m, step_s = self._board, False, 0.0, 0.0
        # Pictures first: readings that arrive meanwhile must not look late in comparison.
        last_ns = board["capture", "last_cam0_ns"], board["capture", "last_cam1_ns"]
        pair_ns, interval_ns = board["capture", "last_pair_ns"], board["capture", "interval_ns"]
        readings: dict[str, int] = {}
        for sensor in sorted(self._sensors):
            stamps, _ = self._link.readings(sensor).last(1)
            readings[sensor] = int(stamps[-1]) - self._shift_ns if len(stamps) else 0
        if self._faults is not None:
            frozen, jumped_m = self._faults.take(*self._encoders.read())
            self._restarted |= board["sensors", "crane_restarts"] > 0  # a capture begun anew counts from 0
        if self._link.source.crane is not None:
            step_s = (time.time_ns() - time.monotonic_ns() - self._link.source.epoch_ns) / NS_PER_S
        skew_ns = board["capture", "skew_ns"] if board["sensors", "one_clock"] else 0
        troubles = {name: self._link.told(name) for name in TROUBLES}
        return SensorActivity(
            last_ns, pair_ns, interval_ns, readings, frozen, jumped_m,
            tuple(board["track", name] / 1e6 for name in OFF), self._restarted, step_s, skew_ns, troubles,
        )  # fmt: skip

    def _write(self, health: bool) -> None:
        write_state(self.state, self._board, self._out)
        if health:
            self._health_at = time.monotonic() + self._link.live.health_every_s
            began_ns = self._board["supervisor", "began_ns"] or time.monotonic_ns()
            write_health(self.state, self._board, (time.monotonic_ns() - began_ns) / NS_PER_S, self._out)

    def _log(self, text: str) -> None:
        seconds = 0.0
        if self._clock is not None:
            seconds = (time.monotonic_ns() - self._clock.began_ns) / NS_PER_S
        self._tell(f"{seconds:8.2f} s  {text}")

    def end_map(self, *, at_once: bool = False) -> None:
        """Wait until everything kept is in the map, if the map process can finish it; `at_once` ends it."""
        process = self._running.get("map")
        while process is not None and process.is_alive():
            if at_once or self._silent_s("map") > max(self._link.live.hang_s, FINISH_S):
                process.kill()
            process.join(BEAT_S)
        if process is not None:
            self.state.processes["map"].state = "done"

    def _end_all(self) -> None:
        """End the processes except the map process, which continues until `end_map`."""
        self._board["supervisor", "stop"] = 1
        for role in self._running.keys() - {"map", "record"}:
            self._end(role, self._running[role], 5.0)
        self._board["supervisor", "stop"] = DRAIN
        if "record" in self._running:
            self._end("record", self._running["record"], DRAIN_S)

    def _end(self, role: str, process: BaseProcess, within_s: float) -> None:
        process.join(within_s)
        if process.is_alive():
            process.kill()
            process.join()
        self.state.processes[role].state = "done"
