"""The telegram over TCP with a store behind it: a PLC written here by the table of bytes claims and lifts."""

import asyncio
import struct
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("sqlalchemy")

from barsight.plant.feed import StateFeed
from barsight.plant.serving import TelegramServer
from barsight.plant.settings import PlantSettings, StoreSource, TelegramSettings
from barsight.plant.state import state_of_store
from barsight.plant.steps import LiftSteps
from barsight.store.confirmation import open_lifts
from barsight.store.opening import Store, open_store
from page_yards import fill_store

IN = struct.Struct(">HHHHqiiiIHHIII")
WEIGHED, REACHED = 2, 8


class Plc:
    """Sends 48 bytes, takes 98; knows nothing of Barsight but the table."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer, self._life = reader, writer, 0

    async def turn(
        self, command: int = 0, number: int = 0, load: int = 0, flags: int = 0, **lift: int
    ) -> dict[str, int]:
        self._life = self._life % 65535 + 1
        self._writer.write(IN.pack(
            0xB51B, 1, self._life, flags, 0, 0, 0, 0, load, command, number,
            lift.get("lift_id", 0), lift.get("token", 0), lift.get("checksum", 0),
        ))  # fmt: skip
        answer = {}
        for _ in range(30):
            content = await asyncio.wait_for(self._reader.readexactly(98), 5)
            status, lift_id, checksum, mass = (
                *struct.unpack_from(">H", content, 6), *struct.unpack_from(">II", content, 16),
                *struct.unpack_from(">I", content, 60),
            )  # fmt: skip
            done, told, _, token = struct.unpack_from(">HHHI", content, 70)
            answer = {
                "status": status, "lift_id": lift_id, "checksum": checksum, "mass": mass, "number": done,
                "answer": told, "token": token,
            }  # fmt: skip
            if done == number if command else status & 1:
                break
        return answer


def serve(store: Store, url: str, talk: Callable[[Plc, Plc], Awaitable[None]]) -> None:
    """Run a server on a store, with two PLCs."""
    telegram = TelegramSettings(host="127.0.0.1", port=0, cycle_s=0.02)
    settings = replace(PlantSettings(), telegram=telegram, store=StoreSource(url=url, allow_simulated=True))

    async def both() -> None:
        port = asyncio.get_running_loop().create_future()
        server = TelegramServer(feed, LiftSteps(store, settings), telegram)
        running = asyncio.create_task(server.run(port.set_result))
        to = ("127.0.0.1", await port)
        streams = [
            await asyncio.open_connection(*to, local_addr=(host, 0)) for host in ("127.0.0.1", "127.0.0.2")
        ]
        try:
            await talk(*(Plc(*one) for one in streams))
        finally:
            for _, writer in streams:
                writer.close()
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    with StateFeed(store, settings) as feed:
        asyncio.run(both())


def test_one_plc_claims_and_executes_and_another_can_not(tmp_path: Path) -> None:
    async def talk(first: Plc, second: Plc) -> None:
        state = await first.turn()
        assert state["status"] & 1 and state["lift_id"]
        lift = {"lift_id": state["lift_id"], "checksum": state["checksum"]}
        claim = await first.turn(1, 11, **lift)
        assert claim["answer"] == 1 and claim["token"]
        assert (await second.turn(1, 12, **lift))["answer"] == 2
        assert (await second.turn(3, 13, flags=REACHED, token=claim["token"] ^ 1, **lift))["answer"] == 2
        heavy = await first.turn(3, 14, 10 * state["mass"], WEIGHED | REACHED, token=claim["token"], **lift)
        assert heavy["answer"] == 3
        assert (await first.turn(3, 15, flags=REACHED, token=claim["token"], **lift))["answer"] == 1
        assert (await first.turn(4, 16, token=claim["token"], **lift))["answer"] == 2

    url = fill_store(tmp_path)
    with open_store(url) as store:
        serve(store, url, talk)
        with store.reading() as connection:
            assert {one.state for one in open_lifts(connection)} <= {"offered"}


def test_a_simulated_yard_offers_nothing_to_a_plc(tmp_path: Path) -> None:
    with open_store(fill_store(tmp_path)) as store:
        told = state_of_store(store, 1)
        tried = state_of_store(store, 1, allow_simulated=True)
        heavy = state_of_store(store, 1, allow_simulated=True, magnet_steps_kg=(1.0,))
    assert told.mode == "simulated" and not told.is_valid and "simulated" in told.reasons[0]
    assert tried.is_valid and not heavy.is_valid and "too-heavy" in heavy.reasons[0]
