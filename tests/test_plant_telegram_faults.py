"""The telegram's server against too many partners, silent ones, and a store that waits."""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

pytest.importorskip("sqlalchemy")

from barsight.core.errors import Failed
from barsight.plant import serving
from barsight.plant.feed import StateFeed
from barsight.plant.serving import TelegramServer
from barsight.plant.settings import PlantSettings, TelegramSettings
from barsight.plant.steps import LiftSteps
from barsight.store.opening import Store
from handshake_plant import Plant, make_template

IN = struct.Struct(">HHHHqiiiIHHIII")
STAY_S = 0.3


def telegram(life: int, command: int = 0, number: int = 0, *lift: int) -> bytes:
    return IN.pack(0xB51B, 1, life % 65536, 0, 0, 0, 0, 0, 0, command, number, *(*lift, 0, 0, 0)[:3])


@dataclass
class Served:
    """A server in a thread. wrong: what its loop told of errors that nobody caught."""

    port: int
    server: TelegramServer
    wrong: list[object]


@contextmanager
def served(store: Store, settings: PlantSettings, telegrams: TelegramSettings) -> Iterator[Served]:
    ready, wrong = threading.Event(), list[object]()
    with StateFeed(store, settings) as feed:
        server = TelegramServer(feed, LiftSteps(store, settings), telegrams)
        told = Served(0, server, wrong)

        async def main() -> None:
            told_port = lambda port: (setattr(told, "port", port), ready.set())  # noqa: E731
            asyncio.get_running_loop().set_exception_handler(lambda _, found: wrong.append(found))
            running.append((asyncio.get_running_loop(), asyncio.current_task()))
            await server.run(told_port)

        running: list[tuple[asyncio.AbstractEventLoop, asyncio.Task[None] | None]] = []

        def work() -> None:
            with pytest.raises(asyncio.CancelledError):
                asyncio.run(main())

        thread = threading.Thread(target=work)
        thread.start()
        assert ready.wait(10)
        try:
            yield told
        finally:
            loop, task = running[0]
            assert task is not None
            loop.call_soon_threadsafe(task.cancel)
            thread.join(10)


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    one = Plant(make_template(tmp_path), tmp_path / "plant", is_drawn_time=False)
    yield one
    one.close()


def test_no_more_partners_than_can_be_served_and_none_that_is_silent(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "MAX_PARTNERS", 2)
    monkeypatch.setattr(serving, "MAX_QUIET_S", 0.3)
    with served(plant.store, plant.settings, TelegramSettings(port=0, cycle_s=0.02)) as one:
        links = [socket.create_connection(("127.0.0.1", one.port), timeout=5) for _ in range(3)]
        firsts = [link.recv(98, socket.MSG_WAITALL) for link in links]
        assert [len(first) for first in firsts] == [98, 98, 0]
        for link in links[:2]:
            while link.recv(4096):
                pass
        with socket.create_connection(("127.0.0.1", one.port), timeout=5) as late:
            assert len(late.recv(98, socket.MSG_WAITALL)) == 98
        for link in links:
            link.close()


def test_a_store_that_waits_stops_neither_life_counter(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    held = threading.Event()
    monkeypatch.setattr(LiftSteps, "claim", lambda *_: Failed("late", str(held.wait(10))))
    with (
        served(plant.store, plant.settings, TelegramSettings(port=0, cycle_s=0.02)) as one,
        socket.create_connection(("127.0.0.1", one.port), timeout=5) as link,
    ):
        valid = []
        for life in range(40):
            link.sendall(telegram(life, 1, 7, 1))
            valid.append(link.recv(98, socket.MSG_WAITALL)[7] & 1)
        held.set()
    assert all(valid[2:])
    assert one.wrong == []


def test_telegrams_that_waited_for_a_late_plc_are_told_by_the_echo(plant: Plant) -> None:
    """Those whose stamp is over 0.2 s old, by the rule that docs/how-to/connect-a-plant.md gives a PLC."""
    ages, fresh, life, resumed = [], [], 0, 0
    with (
        served(plant.store, plant.settings, TelegramSettings(port=0, cycle_s=0.02)) as one,
        socket.create_connection(("127.0.0.1", one.port), timeout=5) as link,
    ):
        for turn in range(80):
            if turn == 20:
                time.sleep(0.8)
                resumed = life
            life += 1
            link.sendall(telegram(life))
            content = link.recv(98, socket.MSG_WAITALL)
            ages.append(time.time_ns() - struct.unpack_from(">q", content, 8)[0])
            echo = struct.unpack_from(">H", content, 96)[0]
            fresh.append(life - echo <= 3 and echo > resumed)
    old = [age - min(ages) > 200_000_000 for age in ages]
    assert sum(old) >= 20 and not any(
        is_old and is_fresh for is_old, is_fresh in zip(old, fresh, strict=True)
    )
    assert all(fresh[5:20]) and all(fresh[-5:])
    assert not one.wrong


def test_readings_of_a_second_plc_at_one_address_are_not_the_cranes(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    bridges_m = list[float]()
    monkeypatch.setattr(StateFeed, "take_reading", lambda _, reading: bridges_m.append(reading.bridge_m))
    with (
        served(plant.store, plant.settings, TelegramSettings(port=0, cycle_s=0.02)) as one,
        socket.create_connection(("127.0.0.1", one.port), timeout=5) as first,
        socket.create_connection(("127.0.0.1", one.port), timeout=5) as second,
    ):
        for life in range(1, 20):
            first.sendall(telegram(life))
            first.recv(98, socket.MSG_WAITALL)
            if life > 3:
                second.sendall(IN.pack(0xB51B, 1, life, 0, 0, 10_000, *[0] * 8))
                second.recv(98, socket.MSG_WAITALL)
    assert len(bridges_m) > 10 and set(bridges_m) == {0.0}
