"""Apply steps of a lift's handshake to the store, whichever link they come from."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from barsight.core.errors import BarsightError, Failed
from barsight.plant.feed import read_state
from barsight.plant.handshake import (
    LiftClaim,
    begin_claimed,
    claim_by_token,
    claim_lift,
    claim_of,
    report_executed,
    report_failed,
)
from barsight.plant.settings import PlantSettings
from barsight.plant.state import OfferedLift, is_place
from barsight.store.opening import Store
from barsight.store.touches import TOUCH_KINDS, Touch, note_touch


@dataclass(frozen=True)
class LiftReport:
    """A crane's report on a lift that it has made. load_kg: None if the load wasn't weighed."""

    is_reached: bool
    is_slack: bool
    load_kg: float | None


class LiftSteps:
    """Check each step against the state in the store, and apply it. Steps are applied one at a time."""

    def __init__(self, store: Store, settings: PlantSettings) -> None:
        self._store, self._settings = store, settings
        self._turn = threading.Lock()
        self._touches: deque[tuple[str, Touch]] = deque()

    def touched(self, who: str, touch: Touch) -> None:
        """Note where a crane's magnet touched something; see `note_touch`. If the store can't be written, it
        is noted before the next step, or by `note_touches`.
        """
        with self._turn:
            self._touches.append((who, touch))
            self._note_touches()

    def note_touches(self) -> None:
        """Note the touches that the store couldn't take. Raises BarsightError if it still can't."""
        with self._turn:
            self._note_touches()

    def claim(self, who: str, lift_id: int, checksum: int | None = None) -> LiftClaim | Failed:
        """Claim the offered lift. checksum: first four bytes of its SHA-256, if known."""
        with self._turn:
            self._note_touches()
            lift = self._valid_lift(lift_id, checksum)
            return lift if isinstance(lift, Failed) else claim_lift(self._store, lift, who)

    def executing(self, token: int, lift_id: int | None = None, checksum: int | None = None) -> int | Failed:
        """Begin the claimed lift, once, while the state is valid; return its token."""
        with self._turn:
            self._note_touches()
            lift = self._valid_lift(lift_id, checksum)
            claim = lift if isinstance(lift, Failed) else self._claimed(token, lift.lift_id)
            begun = claim if isinstance(claim, Failed) else begin_claimed(self._store, claim)
            return begun if isinstance(begun, Failed) else begun.token

    def executed(self, token: int, report: LiftReport, lift_id: int | None = None) -> str | Failed:
        """Record an executed lift: `confirmed`, `contradicted` or `unweighed`; see `report_executed`."""
        with self._turn:
            self._note_touches()
            claim = self._claimed(token, lift_id)
            if isinstance(claim, Failed):
                return claim
            if not report.is_reached or report.is_slack:
                return Failed("not-lifted", "position not reached, or slack rope: report the lift as failed")
            return report_executed(self._store, claim, report.load_kg)

    def failed(self, token: int, note: str, lift_id: int | None = None) -> str | Failed:
        """Record a failed lift."""
        with self._turn:
            self._note_touches()
            claim = self._claimed(token, lift_id)
            return claim if isinstance(claim, Failed) else report_failed(self._store, claim, note)

    def _note_touches(self) -> None:
        while self._touches:
            note_touch(self._store, *self._touches[0])
            self._touches.popleft()

    def _valid_lift(self, lift_id: int | None, checksum: int | None) -> OfferedLift | Failed:
        state = read_state(self._store, self._settings)
        if not state.is_valid:
            return Failed("invalid", "; ".join(state.reasons))
        if state.lift is None or lift_id not in (None, state.lift.lift_id):
            return Failed("unknown", "that lift isn't offered or claimed (any more)")
        if checksum not in (None, int(state.lift.sha256[:8], 16)):
            return Failed("checksum", "the lift isn't as it was read")
        return state.lift

    def _claimed(self, token: int, lift_id: int | None) -> LiftClaim | Failed:
        store = self._store
        claim = claim_by_token(store, token) if lift_id is None else claim_of(store, lift_id)
        if claim is None or claim.token != token:
            return Failed("token", "no lift was claimed with this token")
        return claim


def take_named_step(steps: LiftSteps, step: str, who: str, arguments: Mapping[str, Any]) -> str | Failed:
    """Apply a step given by name, with the arguments of the OPC UA methods; return the token as text, or none
    for `touched`.

    mass_kg: 0 or less if the load wasn't weighed.
    """
    try:
        if step == "claim":
            claim = steps.claim(who, _number(arguments["lift"]))
            return claim if isinstance(claim, Failed) else str(claim.token)
        if step == "touched":
            touch = Touch(*(arguments[name] for name in ("kind", "x_m", "y_m", "z_m")))
            if touch.kind not in TOUCH_KINDS or not is_place(touch.x_m, touch.y_m, touch.z_m):
                kinds = ", ".join(TOUCH_KINDS)
                return Failed("no-touch", f"give a kind ({kinds}) and the readings in metres, not all 0")
            steps.touched(who, touch)
            return ""
        token = _number(arguments["token"])
        answer: str | int | Failed
        if step == "executing":
            answer = steps.executing(token)
        elif step == "executed":
            mass_kg = arguments["mass_kg"]
            load_kg = mass_kg if mass_kg > 0 else None
            report = LiftReport(arguments["position_reached"], arguments["slack_rope"], load_kg)
            answer = steps.executed(token, report)
        else:
            answer = steps.failed(token, arguments["reason"] or "the crane says so")
    except (BarsightError, ValueError) as error:
        return Failed("refused", str(error))
    return answer if isinstance(answer, Failed) else str(token)


def _number(text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 10:
        raise ValueError(f"{text[:20]!r} is not a number")
    return int(text)
