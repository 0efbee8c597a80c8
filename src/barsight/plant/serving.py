"""Serve the cyclic telegram by TCP: one state read per cycle, one telegram out to each partner."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from barsight.core.errors import BarsightError, Failed
from barsight.plant.handshake import LiftClaim, claim_lift, claim_of, report_executed, report_failed
from barsight.plant.settings import PlantSettings
from barsight.plant.state import OfferedLift, PlantState, state_of_store
from barsight.plant.telegram import layout, out_values, pack, unpack
from barsight.store.opening import Store

DONE, REFUSED, CONTRADICTED = 1, 2, 3
NOTHING, CLAIM, EXECUTING, EXECUTED = 0, 1, 2, 3
_WEIGHED, _SLACK, _REACHED = 2, 4, 8


@dataclass
class Partner:
    """A PLC that is connected. refused: telegrams that can't be one. answer: fields that go out."""

    name: str
    life: int | None = None
    alive_s: float = 0.0
    refused: int = 0
    number: int | None = None
    answer: dict[str, int] = field(default_factory=dict)


class TelegramServer:
    """Hold the newest state, and serve it while `run` runs. One event loop; the store in a thread."""

    def __init__(self, store: Store, settings: PlantSettings) -> None:
        self._store = store
        self._settings = settings
        self._counter = 0
        self.refused = 0
        self._turn = asyncio.Lock()

    async def run(self, ready: Callable[[int], None]) -> None:
        """Listen until cancelled. ready: told the port."""
        one = self._settings.telegram
        server = await asyncio.start_server(self._serve, one.host, one.port)
        async with server:
            ready(server.sockets[0].getsockname()[1])
            await server.serve_forever()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        partner = Partner("plc {}:{}".format(*writer.get_extra_info("peername")[:2]))
        listening = asyncio.create_task(self._listen(reader, partner))
        one = self._settings.telegram
        due = time.monotonic()
        try:
            while not listening.done():
                state = await self._state(partner)
                writer.write(pack("out", out_values(state, partner.answer), one.byte_order))
                await asyncio.wait_for(writer.drain(), one.silent_s)
                due = max(due + one.cycle_s, time.monotonic())
                await asyncio.wait({listening}, timeout=due - time.monotonic())
        except (OSError, TimeoutError):
            return
        finally:
            listening.cancel()
            with contextlib.suppress(OSError, asyncio.CancelledError):
                await listening
            writer.close()

    async def _state(self, partner: Partner) -> PlantState:
        """Read the state for one telegram; it isn't valid where the store or the partner is silent."""
        self._counter += 1
        source = self._settings.store
        try:
            async with self._turn:
                state = await asyncio.to_thread(
                    state_of_store, self._store, self._counter,
                    approach_height_m=source.approach_height_m, magnet_steps_kg=source.magnet_steps_kg,
                    allow_simulated=source.allow_simulated,
                )  # fmt: skip
        except BarsightError as error:
            return PlantState("idle", False, (f"store: {error}",), self._counter, time.time_ns(), "none")
        if time.monotonic() - partner.alive_s > self._settings.telegram.silent_s or partner.life is None:
            reasons = (*state.reasons, "partner-silent: the PLC's life counter stands still")
            return replace(state, is_valid=False, reasons=reasons)
        return state

    async def _listen(self, reader: asyncio.StreamReader, partner: Partner) -> None:
        """Take telegrams; one that can't be one ends the connection, since its length is lost."""
        order = self._settings.telegram.byte_order
        with contextlib.suppress(asyncio.IncompleteReadError, OSError):
            while True:
                found = unpack("in", await reader.readexactly(layout("in").size), order)
                if isinstance(found, Failed):
                    partner.refused += 1
                    self.refused += 1
                    return
                if found["life"] != partner.life:
                    partner.life, partner.alive_s = found["life"], time.monotonic()
                if found["command"] == NOTHING:
                    partner.number = found["command_number"]
                elif found["command_number"] != partner.number:
                    partner.number = found["command_number"]
                    async with self._turn:
                        partner.answer = await asyncio.to_thread(self._obey, partner.name, found)

    def _obey(self, who: str, found: dict[str, int]) -> dict[str, int]:
        """Take a command to the store, and form the answer's fields."""
        try:
            answer, token = self._step(who, found)
        except BarsightError:
            answer, token = REFUSED, 0
        return {"answer_number": found["command_number"], "answer": answer, "token": token}

    def _step(self, who: str, found: dict[str, int]) -> tuple[int, int]:
        source = self._settings.store
        state = state_of_store(
            self._store, 0, approach_height_m=source.approach_height_m,
            magnet_steps_kg=source.magnet_steps_kg, allow_simulated=source.allow_simulated,
        )  # fmt: skip
        lift = state.lift
        if found["command"] == CLAIM and not state.is_valid:
            return REFUSED, 0
        if lift is None or lift.lift_id != found["lift_id"] or int(lift.sha256[:8], 16) != found["checksum"]:
            return REFUSED, 0
        if found["command"] == CLAIM:
            claim = claim_lift(self._store, lift, who)
            return (REFUSED, 0) if isinstance(claim, Failed) else (DONE, claim.token)
        claim_now = claim_of(self._store, lift.lift_id)
        if claim_now is None or claim_now.token != found["token"]:
            return REFUSED, 0
        if found["command"] == EXECUTING:
            return DONE, claim_now.token
        return self._end(claim_now, lift, found), claim_now.token

    def _end(self, claim: LiftClaim, lift: OfferedLift, found: dict[str, int]) -> int:
        flags = found["flags"]
        if found["command"] != EXECUTED:
            told = report_failed(self._store, claim, f"the PLC says so, flags {flags}")
        elif not flags & _REACHED or flags & _SLACK:
            return REFUSED
        else:
            load_kg = found["load"] / 10 if flags & _WEIGHED else None
            told = report_executed(self._store, claim, lift, load_kg)
        if isinstance(told, Failed):
            return REFUSED
        return CONTRADICTED if told == "contradicted" else DONE
