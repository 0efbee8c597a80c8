"""Serve the cyclic telegram by TCP: one telegram out to each partner a cycle."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable

from barsight.core.errors import Failed
from barsight.plant.feed import TellsState
from barsight.plant.partner import PlcPartner
from barsight.plant.settings import TelegramSettings
from barsight.plant.steps import LiftSteps
from barsight.plant.telegram import layout, out_values, pack, unpack


class TelegramServer:
    """Serve the newest state while `run` runs. refused: telegrams that couldn't be one."""

    def __init__(self, feed: TellsState, steps: LiftSteps, settings: TelegramSettings) -> None:
        self._feed, self._steps, self._settings = feed, steps, settings
        self._counter = 0
        self.refused = 0

    async def run(self, ready: Callable[[int], None]) -> None:
        """Listen until cancelled. ready: told the port."""
        server = await asyncio.start_server(self._serve, self._settings.host, self._settings.port)
        async with server:
            ready(server.sockets[0].getsockname()[1])
            await server.serve_forever()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        one = self._settings
        name = "plc {}".format(writer.get_extra_info("peername")[0])  # as it is after a new connection
        partner = PlcPartner(name, self._steps, one.silent_s)
        listening = asyncio.create_task(self._listen(reader, partner))
        due = time.monotonic()
        try:
            while not listening.done():
                self._counter += 1
                state = partner.seen(self._feed.newest(self._counter))
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

    async def _listen(self, reader: asyncio.StreamReader, partner: PlcPartner) -> None:
        """Take telegrams; one that can't be one ends the connection, since its length is lost."""
        size = layout("in").size
        with contextlib.suppress(asyncio.IncompleteReadError, OSError):
            while True:
                found = unpack("in", await reader.readexactly(size), self._settings.byte_order)
                if isinstance(found, Failed):
                    self.refused += 1
                    return
                if partner.hears(found):
                    await asyncio.to_thread(partner.obey, found)
                    await asyncio.to_thread(self._feed.refresh)
