"""Monitor a live run, survey after survey: its processes, what it reports of them, how surveys ended."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from barsight.core.errors import BarsightError
from barsight.core.reading.bounded_reading import read_json
from barsight.core.reading.live_run import running_folder
from barsight.live.soak.processes import COMMAND, HELPERS, SERVER, command_of, family, read_usage
from barsight.live.soak.trend import Windows

LASTING = (COMMAND, *HELPERS.values())
"""Processes that live as long as the command; the others last one survey."""


@dataclass
class Watched:
    """A role's process over the whole time, across restarts. new: how often its process id changed."""

    pid: int = 0
    new: int = -1
    cpu_s: float = 0.0
    _before_s: float = 0.0
    rss_mib: Windows = field(default_factory=Windows)
    descriptors: Windows = field(default_factory=Windows)

    def add(self, at_s: float, pid: int, rss_mib: float, descriptors: int, cpu_s: float) -> None:
        """Add a sample."""
        if pid != self.pid:
            self.pid, self._before_s, self.new = pid, 0.0, self.new + 1
        self.cpu_s += cpu_s - self._before_s
        self._before_s = cpu_s
        self.rss_mib.add(at_s, rss_mib)
        self.descriptors.add(at_s, descriptors)


class RunWatch:
    """Monitors the run in `folder`, a single one or one of surveys. command: its process, if known.

    processes: by role. total_mib: memory of all together. restarts: processes that were restarted within a
    survey. surveys: how many ended, by phase.
    """

    def __init__(self, folder: Path, command: int | None = None) -> None:
        self._folder, self._command = folder, command
        self.processes: dict[str, Watched] = {}
        self.total_mib = Windows()
        self.restarts: dict[str, int] = {}
        self.surveys = {"done": 0, "failed": 0}
        self._here: Path | None = None
        self._state: dict[str, Any] = {}
        self._ended = False
        self._began = time.monotonic()

    @property
    def seconds(self) -> float:
        """Return how long the run has been monitored."""
        return time.monotonic() - self._began

    def state(self) -> dict[str, Any] | None:
        """Read the run's state.json and count what has ended since the last call; None if there is no run."""
        folder = running_folder(self._folder).resolve()
        if folder != self._here:
            if self._here is not None:
                self._take(_read_state(self._here))
            self._here, self._ended, self._state = folder, False, {}
        state = _read_state(folder)
        self._take(state)
        return state

    def _take(self, state: dict[str, Any] | None) -> None:
        """Count a survey's restarts since its last state, and its end."""
        if state is None:
            return
        before = self._state.get("processes", {})
        for role, process in state["processes"].items():
            more = process["restarts"] - before.get(role, {}).get("restarts", 0)
            self.restarts[role] = self.restarts.get(role, 0) + max(more, 0)
        if state["phase"] in self.surveys and not self._ended:
            self._ended = True
            self.surveys[state["phase"]] += 1
        self._state = state

    @property
    def survey_s(self) -> float:
        """Return the duration of a survey, 0 if none has ended."""
        ended = sum(self.surveys.values())
        return self.seconds / ended if ended else 0.0

    @property
    def has_command(self) -> bool:
        """Check that the command was running at the last sample."""
        return self._command is not None

    def owns(self, pid: int) -> bool:
        """Check that a process currently belongs to the run."""
        return self._command is not None and command_of(pid) == self._command

    @property
    def survey(self) -> Path | None:
        """Return the folder of the survey seen last."""
        return self._here

    def sample(self) -> bool:
        """Record the current usage of each process; return whether the run exists."""
        state = self.state()
        roles = {} if state is None else {one["pid"]: role for role, one in state["processes"].items()}
        running = {} if self._command is None else family(self._command, roles)
        if not running and state is not None:
            # The process id may have been reused; the run's own process has a fork server.
            named = family(state.get("pid", 0), roles)
            running = named if SERVER in named.values() else {}
            self._command = state["pid"] if running else None
        if not running:
            self._command = None
            return False
        at_s, total = self.seconds, 0.0
        for pid, role in running.items():
            used = read_usage(pid)
            if used is None:
                continue
            total += used.pss_mib
            if role:
                watched = self.processes.setdefault(role, Watched())
                watched.add(at_s, pid, used.rss_mib, used.descriptors, used.cpu_s)
        self.total_mib.add(at_s, total)
        return True


def _read_state(folder: Path) -> dict[str, Any] | None:
    try:
        state = dict(read_json(folder / "state.json"))
        keys = ("pid", "state", "restarts")
        known = all(key in one for one in state["processes"].values() for key in keys)
        return state if known and {"phase", "lifts"} <= state.keys() else None
    except (BarsightError, OSError, KeyError, TypeError, ValueError, AttributeError):
        return None
