"""Track a PLC at the other end of the telegrams: its life counter, its commands and the answers to them."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import dataclass, replace

from barsight.core.errors import BarsightError, Failed
from barsight.plant.state import OfferedLift, PlantState, PlcReading
from barsight.plant.steps import LiftReport, LiftSteps
from barsight.store.touches import Touch

DONE, REFUSED, CONTRADICTED = 1, 2, 3
NOTHING, CLAIM, EXECUTING, EXECUTED = 0, 1, 2, 3
DOWN_M = 0.1
"""Height in metres above that of contact up to which the magnet of a lift that has begun counts as down."""
MAX_GAP_S = 1.0
"""Longest time in seconds between readings of which the later one tells what happened since the earlier."""
MAX_SPEED_MPS, MAX_JUMP_M = 10.0, 1.0
"""Speed and step between readings up to which a crane may have moved; readings may come in a bunch."""
_MAGNET_ON, _WEIGHED, _SLACK, _REACHED = 1, 2, 4, 8


@dataclass(frozen=True)
class _Magnet:
    """State of the magnet by a reading. is_low: it is no higher than where it counts as down."""

    is_on: bool
    is_low: bool
    is_slack: bool

    @classmethod
    def of(cls, reading: PlcReading, down_m: float) -> _Magnet:
        return cls(reading.is_magnet_on, reading.hoist_m <= down_m, reading.is_rope_slack)

    @property
    def grips(self) -> bool:
        return self.is_on and (self.is_low or self.is_slack)


def _jump(last: PlcReading | None, now: PlcReading, since_s: float) -> str:
    """Return how a position jumped since the last reading; empty if a crane can have moved so."""
    if last is None or last.place_m is None or now.place_m is None or since_s > MAX_GAP_S:
        return ""
    off_m = max(abs(one - other) for one, other in zip(now.place_m, last.place_m, strict=True))
    if off_m <= MAX_JUMP_M + MAX_SPEED_MPS * since_s:
        return ""
    jumped = f"its position jumped by {off_m:.2f} m within {since_s:.1f} s"
    return f"{jumped}: check the encoders, and that all 32 bits are sent"


class PlcPartner:
    """A PLC that exchanges telegrams. begun: the lift that it began last, also by an earlier connection."""

    def __init__(self, name: str, steps: LiftSteps, silent_s: float, begun: int | None = None) -> None:
        self.name, self._steps, self._silent_s = name, steps, silent_s
        self._answer: dict[str, int] = {}
        self._answered, self._heard = (NOTHING, 0), (0, NOTHING, 0)
        self._life: int | None = None
        self._alive_s, self._began_s = time.monotonic(), math.inf
        self._number: int | None = None
        self._command: dict[str, int] | None = None
        self._touches: deque[Touch] = deque()
        self._noting = threading.Lock()
        self._last: PlcReading | None = None
        self._last_s = 0.0
        self.begun = begun
        self._claimed: int | None = None
        self._shown: OfferedLift | None = None
        self._away_from: OfferedLift | None = None
        self._contact_m: float | None = None

    @property
    def answer(self) -> dict[str, int]:
        """Form the fields of the next telegram that answer the PLC: its life counter and its last command.

        Another command under the number of an answered one has no answer, or it would take that one's.
        """
        number, *asked = self._heard
        is_same = number != self._answer.get("answer_number") or tuple(asked) == self._answered
        return {"life_echo": self._life or 0, **(self._answer if is_same or asked[0] == NOTHING else {})}

    @property
    def quiet_s(self) -> float:
        """Return how long the PLC's life counter has stood still or been missing, in seconds."""
        return time.monotonic() - self._alive_s

    @property
    def is_alive(self) -> bool:
        """Check that the PLC's life counter moves."""
        return self._life is not None and self.quiet_s <= self._silent_s

    def is_second_to(self, other: PlcPartner) -> bool:
        """Check whether this is another PLC with the same name as one that began before and is alive.

        If the other has been heard since this one began, it isn't the same PLC, reconnected: then it may also
        be silent for a while.
        """
        is_later = other.name == self.name and other._began_s < self._began_s
        return is_later and (other.is_alive or other._alive_s > self._began_s)

    def receive(self, found: dict[str, int], *, is_busy: bool = False) -> bool:
        """Accept a telegram; return True if `execute` must be called, for a new command or for touches.

        is_busy: whether no command can be executed now; it is then left to the telegrams that follow.
        """
        if found["life"] != self._life:
            self._life, self._alive_s = found["life"], time.monotonic()
            self._began_s = min(self._began_s, self._alive_s)
        self._heard = found["command_number"], found["command"], found["lift_id"]
        if is_busy:
            return False
        is_new = found["command"] != NOTHING and found["command_number"] != self._number
        if is_new or found["command"] == NOTHING:
            self._number = found["command_number"]
        self._command = found if is_new else None
        return is_new or bool(self._touches)

    def watch(self, reading: PlcReading) -> str:
        """Find in the PLC's readings, one after another, where its magnet touches something; return why this
        one's position isn't believed, empty if it is.

        Without a position nothing is known, nor from the first reading, nor of what happened before one that
        came `MAX_GAP_S` late: by then the load may hang, if the magnet is on. It is down if the rope is
        slack; while a lift has begun also up to `DOWN_M` above the height of contact, otherwise whenever it
        is turned on. While one is claimed, coming below that height tells that it came down. A crane whose
        position was known since it claimed a lift, and never at the target, hasn't made it. A reading that no
        crane can have travelled to, as of an encoder's fault or of too few bits, is left out.
        """
        last, last_s = self._last, self._last_s
        jump = _jump(last, reading, time.monotonic() - last_s)
        if jump:
            return jump
        self._last_s = time.monotonic()
        self._last = None if reading.place_m is None else reading
        if self._last is None or self._last_s - last_s > MAX_GAP_S:
            last = None
            self._away_from = None
            if reading.is_magnet_on:
                self.begun = self._claimed = self._contact_m = None
        if last is None or reading.place_m is None:
            return reading.problem
        if self._away_from is not None and self._away_from.is_at(*reading.place_m[:2]):
            self._away_from = None
        low_m = -math.inf if self._contact_m is None else self._contact_m + DOWN_M
        down_m = math.inf if self.begun is None or self._contact_m is None else low_m
        was, now = (_Magnet.of(one, down_m) for one in (last, reading))
        lowered = last.hoist_m > low_m >= reading.hoist_m
        kinds = {
            "release": was.is_on and not now.is_on,
            "on": now.is_on and not was.is_on and not now.grips,
            "grip": now.grips and not was.grips,
            "contact": not (was.is_on or now.is_on) and (
                lowered or (now.is_slack and not was.is_slack)
            ),
        }  # fmt: skip
        for kind in (name for name, is_told in kinds.items() if is_told):
            self._touches.append(Touch(kind, *reading.place_m))
            self._away_from = None  # the store judges by the touches
        return ""

    def reading(self, found: dict[str, int]) -> PlcReading:
        """Form the PLC's reading of the crane from a telegram."""
        flags, now_ns = found["flags"], time.time_ns()
        return PlcReading(
            self.name, now_ns, (found["clock_ns"] - now_ns) / 1e9, found["bridge"] / 1e4,
            found["trolley"] / 1e4, found["hoist"] / 1e4, found["load"] / 10 if flags & _WEIGHED else None,
            bool(flags & _MAGNET_ON), bool(flags & _SLACK), bool(flags & _REACHED),
        )  # fmt: skip

    def seen(self, state: PlantState, *, is_second: bool = False) -> PlantState:
        """Return the state that this PLC may act on; it is invalid if the PLC's life counter stands still.

        is_second: whether another PLC with the same name is alive; the state is invalid then too.
        """
        lift = state.lift
        is_own = lift is not None and lift.lift_id in (self.begun, self._claimed)
        self._shown = lift
        self._contact_m = lift.hoist_height_m if lift is not None and is_own else None
        if self.is_alive and not is_second:
            return state
        reason = "partner-silent: the PLC's life counter stands still"
        if is_second:
            reason = "partner-twice: another connection from the same address is alive"
        return replace(state, is_valid=False, reasons=(*state.reasons, reason))

    def execute(self) -> None:
        """Note the touches, then execute the command on the store; `answer` holds its outcome.

        If the store can't be reached there is no answer: the command is tried again with the next telegram. A
        command that was answered before isn't.
        """
        command = self._command
        try:
            self.note_touches()
            if command is None:
                return
            answer, token = self._step(command)
        except BarsightError:
            if command is not None:
                self._number = None
            return
        self._answered = command["command"], command["lift_id"]
        self._answer = {"answer_number": command["command_number"], "answer": answer, "token": token}

    def note_touches(self) -> None:
        """Hand the touches over. Raises BarsightError if one can't be noted yet; `LiftSteps` keeps it."""
        with self._noting:
            while self._touches:
                self._steps.touched(self.name, self._touches.popleft())

    def _step(self, found: dict[str, int]) -> tuple[int, int]:
        lift = (found["lift_id"], found["checksum"])
        if found["command"] == CLAIM:
            claim = self._steps.claim(self.name, *lift)
            if isinstance(claim, Failed):
                return REFUSED, 0
            if self._shown is not None and self._shown.handshake == "offered":
                self._away_from = self._shown if self._shown.lift_id == claim.lift_id else None
            self._claimed, self.begun = claim.lift_id, self.begun if self.begun == claim.lift_id else None
            return DONE, claim.token
        token, flags = found["token"], found["flags"]
        answer: str | int | Failed
        if found["command"] == EXECUTING:
            answer = self._steps.executing(token, *lift)
            self.begun = None if isinstance(answer, Failed) else found["lift_id"]
        elif found["command"] == EXECUTED:
            load_kg = found["load"] / 10 if flags & _WEIGHED else None
            is_away = self._away_from is not None and self._away_from.lift_id == found["lift_id"]
            is_reached = bool(flags & _REACHED) and not is_away
            report = LiftReport(is_reached, bool(flags & _SLACK), load_kg)
            answer = self._steps.executed(token, report, found["lift_id"])
        else:
            answer = self._steps.failed(token, f"the PLC says so, flags {flags}", found["lift_id"])
        if isinstance(answer, Failed):
            return REFUSED, 0 if answer.code in ("unknown", "checksum", "token") else token
        return (CONTRADICTED if answer == "contradicted" else DONE), token
