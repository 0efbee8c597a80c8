"""Serve the cyclic telegram over TCP: one telegram to each partner per cycle."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable

from barsight.core.errors import BarsightError, Failed
from barsight.plant.crane_names import plc_name
from barsight.plant.feed import StateReader
from barsight.plant.partner import PlcPartner
from barsight.plant.settings import TelegramSettings
from barsight.plant.steps import LiftSteps
from barsight.plant.telegram import layout, out_values, pack, unpack

MIN_GAP_RATIO = 0.8
"""Shortest gap between a late telegram and the next, as a share of the cycle."""
MAX_PARTNERS = 32
"""Maximum number of connections at a time; any further one is closed."""
MAX_TOLD = 100
"""Maximum number of PLCs of whose telegrams it is told what is wrong."""
MAX_QUIET_S = 10.0
"""Time in seconds after which a connection is closed if the partner's life counter stands still."""


class TelegramServer:
    """Serve the newest state while `run` runs. refused: number of invalid telegrams received."""

    def __init__(
        self, feed: StateReader, steps: LiftSteps, settings: TelegramSettings,
        say: Callable[[str], None] | None = None,
    ) -> None:  # fmt: skip
        """say: called with what is wrong with a PLC's telegrams, once until something else is."""
        self._feed, self._steps, self._settings = feed, steps, settings
        self._say, self._said = say, dict[str, str]()
        self._counter = 0
        self._partners: list[PlcPartner] = []
        self._begun: dict[str, int | None] = {}
        self.refused = 0

    async def run(self, ready: Callable[[int], None]) -> None:
        """Listen until cancelled. ready: called with the port."""
        server = await asyncio.start_server(self._serve, self._settings.host, self._settings.port)
        async with server:
            ready(server.sockets[0].getsockname()[1])
            await server.serve_forever()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        name = plc_name(writer.get_extra_info("peername")[0])  # the same after a reconnection
        partner = PlcPartner(name, self._steps, self._settings.silent_s, self._begun.get(name))
        self._partners.append(partner)
        try:
            if len(self._partners) <= MAX_PARTNERS:
                await self._exchange(reader, writer, partner)
                with contextlib.suppress(BarsightError):
                    await asyncio.to_thread(partner.note_touches)  # those that came during the last step
        except asyncio.CancelledError:
            return  # the server is ending; asyncio's streams would log a cancelled task as an error
        finally:
            self._partners.remove(partner)
            self._begun[name] = partner.begun
            writer.close()

    async def _exchange(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, partner: PlcPartner
    ) -> None:
        settings = self._settings
        writer.transport.set_write_buffer_limits(high=0)  # what isn't sent at once becomes outdated
        listening = asyncio.create_task(self._listen(reader, partner))
        due_s = time.monotonic()
        try:
            while not listening.done() and partner.quiet_s < MAX_QUIET_S:
                self._counter += 1
                sent_s = time.monotonic()
                state = partner.seen(self._feed.newest(self._counter), is_second=self._is_second(partner))
                writer.write(pack("out", out_values(state, partner.answer), settings.byte_order))
                await asyncio.wait_for(writer.drain(), settings.silent_s)
                due_s = max(due_s + settings.cycle_s, time.monotonic() - settings.cycle_s)
                wait_s = max(due_s, sent_s + MIN_GAP_RATIO * settings.cycle_s) - time.monotonic()
                await asyncio.wait({listening}, timeout=max(0.0, wait_s))
        except (OSError, TimeoutError):
            return
        finally:
            listening.cancel()
            with contextlib.suppress(OSError, asyncio.CancelledError):
                await listening

    async def _listen(self, reader: asyncio.StreamReader, partner: PlcPartner) -> None:
        """Receive telegrams; an invalid one ends the connection, since the telegram boundaries are lost.

        While a command is being executed, the following ones are ignored: a PLC repeats them until answered.
        All that a second partner sends is ignored.
        """
        size = layout("in").size
        step: asyncio.Task[None] | None = None
        with contextlib.suppress(asyncio.IncompleteReadError, OSError):
            while True:
                found = unpack("in", await reader.readexactly(size), self._settings.byte_order)
                if isinstance(found, Failed):
                    self.refused += 1
                    self._tell(partner.name, "connection closed, what came is no telegram", found.reason)
                    return
                is_second = self._is_second(partner)
                if not is_second:
                    reading = partner.reading(found)
                    self._feed.take_reading(reading)
                    if problem := partner.watch(reading):
                        self._tell(partner.name, "where its magnet is isn't known", problem)
                is_busy = (step is not None and not step.done()) or is_second
                if partner.receive(found, is_busy=is_busy):
                    step = asyncio.create_task(asyncio.to_thread(partner.execute))
                    step.add_done_callback(self._refresh)

    def _tell(self, name: str, what: str, why: str) -> None:
        is_listed = name in self._said or len(self._said) < MAX_TOLD
        if self._say is not None and self._said.get(name) != what and is_listed:
            self._said[name] = what  # not why: its figures change from telegram to telegram
            self._say(f"{name}: {what}: {why}")

    def _is_second(self, partner: PlcPartner) -> bool:
        """Check whether another PLC at the same address is served: claims are by address, so that two cranes
        behind one address would end each other's lifts.
        """
        return any(partner.is_second_to(one) for one in self._partners)

    def _refresh(self, _: asyncio.Task[None]) -> None:
        """Have the state read at once after a step; the telegrams don't wait for it."""
        asyncio.get_running_loop().run_in_executor(None, self._feed.refresh)
