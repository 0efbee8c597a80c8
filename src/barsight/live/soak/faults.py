"""Kill a run's processes at random, and time how soon it reports this, revokes lifts and has recovered."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from barsight.live.soak.watch import RunWatch

PAUSE_S = (5.0, 30.0)
GIVE_UP_S = 60.0
LOOK_S = 0.01
WITHOUT_LIFTS = ("record",)
"""Processes that lifts don't depend on."""


@dataclass
class Killed:
    """Kills of a role's process, and times in seconds until state.json reported it, until lifts were revoked,
    and until the run had recovered.

    over: the survey ended meanwhile. not_told, not_revoked, not_back: not before the run had recovered, or
    not within `GIVE_UP_S`.
    """

    told_s: list[float] = field(default_factory=list)
    revoked_s: list[float] = field(default_factory=list)
    back_s: list[float] = field(default_factory=list)
    times: int = 0
    over: int = 0
    not_told: int = 0
    not_revoked: int = 0
    not_back: int = 0


class RandomKills:
    """Kills one process after another, by `seed`, while the run is healthy. rest: called while it waits."""

    def __init__(self, watch: RunWatch, seed: int, rest: Callable[[float], None]) -> None:
        self._watch, self._rest, self._rng = watch, rest, np.random.default_rng(seed)
        self.killed: dict[str, Killed] = {}
        self._due_s = 0.0

    def step(self) -> None:
        """Kill a process if one is due and the run is healthy."""
        state = self._watch.state()
        if state is None or not _is_well(state):
            self._due_s = max(self._due_s, self._watch.seconds + PAUSE_S[0])
            return
        if self._watch.seconds < self._due_s:
            return
        self._kill(str(self._rng.choice(sorted(state["processes"]))), state)
        self._due_s = self._watch.seconds + float(self._rng.uniform(*PAUSE_S))

    def _kill(self, role: str, before: dict[str, Any]) -> None:
        killed, survey = self.killed.setdefault(role, Killed()), self._watch.survey
        pid, restarts = before["processes"][role]["pid"], before["processes"][role]["restarts"]
        if not self._watch.owns(pid):
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        began, told_s, revoked_s = time.monotonic(), None, None
        killed.times += 1
        while (now_s := time.monotonic() - began) < GIVE_UP_S:
            state = self._watch.state()
            if self._watch.survey != survey or (state is not None and state["phase"] != "measuring"):
                killed.over += 1
                break
            if state is not None:
                if told_s is None and state["processes"][role]["restarts"] > restarts:
                    told_s = now_s
                if revoked_s is None and not state["lifts"]["may_stand"]:
                    revoked_s = now_s
                if told_s is not None and _is_well(state):
                    killed.back_s.append(now_s)
                    killed.not_revoked += revoked_s is None and role not in WITHOUT_LIFTS
                    break
            self._rest(LOOK_S)
        else:
            killed.not_told += told_s is None
            killed.not_back += 1
        killed.told_s += [] if told_s is None else [told_s]
        killed.revoked_s += [] if revoked_s is None or role in WITHOUT_LIFTS else [revoked_s]


def _is_well(state: dict[str, Any]) -> bool:
    return (
        state["phase"] == "measuring"
        and bool(state["lifts"]["may_stand"])
        and all(one["state"] == "running" for one in state["processes"].values())
    )
