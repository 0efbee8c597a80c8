"""Run a soak test: monitor a live run, existing or started for it, until it is long enough or stopped."""

from __future__ import annotations

import contextlib
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.errors import ConfigError, InputError, MeasurementError
from barsight.core.files import expect_empty, translated_os_errors
from barsight.live.run import handled_signals
from barsight.live.soak.faults import RandomKills
from barsight.live.soak.processes import PROC
from barsight.live.soak.report import SoakBounds, soak_content, write_soak
from barsight.live.soak.trend import S_PER_H
from barsight.live.soak.watch import RunWatch
from barsight.live.survey import INTERRUPTED

SAMPLE_S = 10.0
WRITE_S = 60.0
POLL_S = 0.25
LOST_S = 120.0
"""Time in seconds after which a missing run counts as ended: a service would have restarted it by then."""
END_S = 600.0
"""Longest time in seconds that a run started for the soak test may take to end."""


@dataclass(frozen=True)
class SoakPlan:
    """Hours of a soak test, hours of warm-up within it, and the hour from which processes are killed."""

    hours: float = math.inf
    warm_up_h: float = 0.5
    faults_after_h: float = math.inf
    seed: int = 0

    def __post_init__(self) -> None:
        if not (self.hours > 0 and self.warm_up_h >= 0 and self.faults_after_h >= 0):
            raise ConfigError("--hours, --warm-up-h and --faults-after-h are hours from the soak's begin")
        if self.seed < 0:
            raise ConfigError(f"--seed {self.seed}: must be 0 or more")


def soak_replays(
    replay: Path, out: Path, plan: SoakPlan, bounds: SoakBounds, flags: Sequence[str],
    tell: Callable[[str], None],
) -> dict[str, Any]:  # fmt: skip
    """Replay a recording over and over into `out/surveys`, and soak-test that run; `out` as in `soak_run`.

    flags: of `barsight live`, for the run. Raises MeasurementError if the run ended by itself.
    """
    expect_empty(out)
    surveys = out / "surveys"
    with translated_os_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "barsight", "live", "--replay", str(replay), "--surveys"]
    log = out / "run.log"
    with log.open("wb") as stream:
        # In its own session: Ctrl-C goes to the soak test, which then ends the run.
        run = subprocess.Popen(
            [*command, "-o", str(surveys), *flags], stdout=stream, stderr=stream, start_new_session=True
        )
    try:
        content = _soak(RunWatch(surveys, run.pid), out, plan, bounds, tell, lambda: run.poll() is None)
        if run.poll() is not None:
            lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            last = lines[-1].removeprefix("barsight: ") if lines else "it said nothing"
            raise MeasurementError(f"the run ended with code {run.returncode}: {last}")
        return content
    finally:
        _end(run)


def soak_run(
    folder: Path, out: Path, plan: SoakPlan, bounds: SoakBounds, tell: Callable[[str], None]
) -> dict[str, Any]:
    """Soak-test the run that writes into `folder`, OUT of `barsight live`; return the content of soak.json.

    soak.json and soak.md are written to `out` each minute and at the end. Ends after plan.hours, at Ctrl-C or
    SIGTERM, or if the run is gone. Raises InputError if there is no run.
    """
    watch = RunWatch(folder)
    if not PROC.is_dir() or not watch.sample():
        raise InputError(folder, "no live run writes here", "name OUT of a run of barsight live that goes on")
    expect_empty(out)
    with translated_os_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    seen_at = time.monotonic()

    def is_there() -> bool:
        nonlocal seen_at
        if watch.has_command:
            seen_at = time.monotonic()
        return time.monotonic() - seen_at < LOST_S

    return _soak(watch, out, plan, bounds, tell, is_there)


def _soak(
    watch: RunWatch, out: Path, plan: SoakPlan, bounds: SoakBounds, tell: Callable[[str], None],
    is_there: Callable[[], bool],
) -> dict[str, Any]:  # fmt: skip
    """Sample, kill and write until the end."""
    sample_at = write_at = 0.0
    reasons: list[str] = []

    def rest(seconds: float) -> None:
        nonlocal sample_at
        if reasons:
            raise _ToldError
        if watch.seconds >= sample_at:
            sample_at = watch.seconds + SAMPLE_S
            watch.sample()
        time.sleep(seconds)

    kills = RandomKills(watch, plan.seed, rest)

    def write() -> dict[str, Any]:
        content = soak_content(watch, kills.killed, plan.warm_up_h, bounds)
        write_soak(content, out)
        return content

    # Ctrl-C and SIGTERM end the soak test like its time limit, so that everything is written.
    ends = dict.fromkeys((signal.SIGINT, signal.SIGTERM), INTERRUPTED)
    with handled_signals(ends, reasons.append), contextlib.suppress(_ToldError):
        tell(f"soaking; {out / 'soak.md'} has the table, each minute anew; Ctrl-C ends it")
        while watch.seconds < plan.hours * S_PER_H and is_there():
            rest(POLL_S)
            if watch.seconds >= plan.faults_after_h * S_PER_H:
                kills.step()
            if watch.seconds >= write_at:
                write_at = watch.seconds + WRITE_S
                write()
    return write()


class _ToldError(Exception):
    """The soak test was told to end."""


def _end(run: subprocess.Popen[bytes]) -> None:
    """End the run by Ctrl-C; a second one ends its measuring as well."""
    for number in (signal.SIGINT, signal.SIGINT, signal.SIGKILL):
        if run.poll() is None:
            run.send_signal(number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                run.wait(END_S)
