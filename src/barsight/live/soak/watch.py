"""Watch a live run, survey after survey: its processes, what it says of them, how surveys ended."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from barsight.core.errors import BarsightError
from barsight.core.reading.bounded_reading import read_json
from barsight.core.reading.live_run import running_folder
from barsight.live.soak.processes import COMMAND, HELPERS, command_of, family, read_usage
from barsight.live.soak.trend import Windows

LASTING = (COMMAND, *HELPERS.values())
"""Processes that live as long as the command; the others live one survey."""


@dataclass
class Watched:
    """A process over the whole time, all that had its role. new: how often its number changed."""

    pid: int = 0
    new: int = -1
    cpu_s: float = 0.0
    _before_s: float = 0.0
    rss_mib: Windows = field(default_factory=Windows)
    descriptors: Windows = field(default_factory=Windows)

    def add(self, at_s: float, pid: int, rss_mib: float, descriptors: int, cpu_s: float) -> None:
        """Take a sample."""
        if pid != self.pid:
            self.pid, self._before_s, self.new = pid, 0.0, self.new + 1
        self.cpu_s += cpu_s - self._before_s
        self._before_s = cpu_s
        self.rss_mib.add(at_s, rss_mib)
        self.descriptors.add(at_s, descriptors)


class RunWatch:
    """Watches the run in `folder`, that of one run or of surveys. command: its process, if it is known.

    processes: by role. total_mib: memory of all together. restarts: processes that were started anew within
    a survey. surveys: how many ended, by phase.
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
        """Return for how long it was watched."""
        return time.monotonic() - self._began

    def state(self) -> dict[str, Any] | None:
        """Read the run's state.json and count what came to an end since; None where there is none."""
        here = running_folder(self._folder).resolve()
        if here != self._here:
            if self._here is not None:
                self._take(_read_state(self._here))
            self._here, self._ended, self._state = here, False, {}
        state = _read_state(here)
        self._take(state)
        return state

    def _take(self, state: dict[str, Any] | None) -> None:
        """Count a survey's restarts since its last state, and its end."""
        if state is None:
            return
        before = self._state.get("processes", {})
        for role, one in state["processes"].items():
            more = one["restarts"] - before.get(role, {}).get("restarts", 0)
            self.restarts[role] = self.restarts.get(role, 0) + max(more, 0)
        if state["phase"] in self.surveys and not self._ended:
            self._ended = True
            self.surveys[state["phase"]] += 1
        self._state = state

    @property
    def survey_s(self) -> float:
        """Return how long a survey takes, 0 where none has ended."""
        ended = sum(self.surveys.values())
        return self.seconds / ended if ended else 0.0

    @property
    def has_command(self) -> bool:
        """Check that the command was there at the last sample."""
        return self._command is not None

    @property
    def survey(self) -> Path | None:
        """Return the folder of the survey that was seen last."""
        return self._here

    def sample(self) -> bool:
        """Note what each process uses now; return whether the run is there."""
        state = self.state()
        roles = {} if state is None else {one["pid"]: role for role, one in state["processes"].items()}
        there = {} if self._command is None else family(self._command, roles)
        if not there:
            known = (command_of(pid) for pid in roles)
            self._command = next((pid for pid in known if pid is not None), None)
            there = {} if self._command is None else family(self._command, roles)
        if not there:
            return False
        at_s, total = self.seconds, 0.0
        for pid, role in there.items():
            used = read_usage(pid)
            if used is None:
                continue
            total += used.pss_mib
            if role:
                one = self.processes.setdefault(role, Watched())
                one.add(at_s, pid, used.rss_mib, used.descriptors, used.cpu_s)
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
