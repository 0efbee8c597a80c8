"""The telegram's server against bytes that are none, against a partner that stalls, and killed itself."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sqlalchemy")

from barsight.core.errors import Failed
from barsight.plant import serving
from barsight.plant.feed import StateFeed
from barsight.plant.serving import TelegramServer
from barsight.plant.settings import PlantSettings, TelegramSettings
from barsight.plant.steps import LiftSteps
from barsight.store.audit import AuditChain, verify_chain
from barsight.store.opening import Store
from handshake_plant import Plant, make_template
from opcua_servers import free_port
from page_yards import fill_store

IN = struct.Struct(">HHHHqiiiIHHIII")
STAY_S = 0.3


def telegram(life: int, command: int = 0, number: int = 0, *lift: int) -> bytes:
    return IN.pack(0xB51B, 1, life % 65536, 0, 0, 0, 0, 0, 0, command, number, *(*lift, 0, 0, 0)[:3])


def malformed(draw: random.Random) -> bytes:
    """Bytes that are no telegram, or one with a command that nobody may give."""
    kind = draw.random()
    if kind < 0.3:
        return draw.randbytes(draw.randrange(1, 200))
    if kind < 0.5:
        return telegram(1)[: draw.randrange(1, 48)]
    if kind < 0.8:
        content = bytearray(telegram(1, draw.randrange(5), 1, 1, 1, 1))
        for _ in range(draw.randrange(1, 6)):
            content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
        content[17 * draw.randrange(2) + draw.randrange(4)] = 0xFF
        return bytes(content)
    if kind < 0.98:
        return telegram(1, draw.randrange(5, 65536), 1)
    numbers = [draw.randrange(2**32) for _ in range(3)]
    return telegram(1, draw.randrange(1, 5), draw.randrange(1, 9), *numbers)


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
        yield told
        loop, task = running[0]
        assert task is not None
        loop.call_soon_threadsafe(task.cancel)
        thread.join(10)


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    one = Plant(make_template(tmp_path), tmp_path / "plant", is_drawn_time=False)
    yield one
    one.close()


def attack(plant: Plant, count: int, cycle_s: float) -> Served:
    """Send so many; meanwhile a PLC that does all right is served without a gap."""
    draw = random.Random(22)
    with plant.store.reading() as connection:
        before = verify_chain(connection)
    with (
        served(plant.store, plant.settings, TelegramSettings(port=0, cycle_s=cycle_s)) as one,
        socket.create_connection(("127.0.0.1", one.port)) as good,
    ):
        for life in range(count):
            with socket.create_connection(("127.0.0.1", one.port)) as link:
                link.sendall(malformed(draw))
                link.shutdown(socket.SHUT_WR)
                while link.recv(4096):
                    pass
            if life % 50 == 0:
                good.sendall(telegram(life))
                assert len(good.recv(96, socket.MSG_WAITALL)) == 96
        lives = []
        for life in range(100):
            good.sendall(telegram(life))
            content = good.recv(96, socket.MSG_WAITALL)
            lives.append(struct.unpack_from(">H", content, 4)[0])
            if content[7] & 1 and life > 5:
                break
        assert content[7] & 3 == 3, "a lift is still offered"
        assert lives == sorted(set(lives))
    assert one.wrong == []
    with plant.store.reading() as connection:
        after = verify_chain(connection)
    assert isinstance(before, AuditChain) and before == after
    return one


def test_what_is_no_telegram_changes_nothing(plant: Plant) -> None:
    assert attack(plant, 1000, 0.02).server.refused > 500


@pytest.mark.slow
def test_a_hundred_thousand_of_them(plant: Plant) -> None:
    assert attack(plant, 100_000, 0.02).server.refused > 50_000


def test_no_more_partners_than_can_be_served_and_none_that_is_silent(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "MAX_PARTNERS", 2)
    monkeypatch.setattr(serving, "MAX_QUIET_S", 0.3)
    with served(plant.store, plant.settings, TelegramSettings(port=0, cycle_s=0.02)) as one:
        links = [socket.create_connection(("127.0.0.1", one.port), timeout=5) for _ in range(3)]
        firsts = [link.recv(96, socket.MSG_WAITALL) for link in links]
        assert [len(first) for first in firsts] == [96, 96, 0]
        for link in links[:2]:
            while link.recv(4096):
                pass
        with socket.create_connection(("127.0.0.1", one.port), timeout=5) as late:
            assert len(late.recv(96, socket.MSG_WAITALL)) == 96
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
            valid.append(link.recv(96, socket.MSG_WAITALL)[7] & 1)
        held.set()
    assert all(valid[2:])
    assert one.wrong == []


@contextmanager
def plant_run(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """`barsight plant run` with the telegram alone, in a process."""
    port, config = free_port(), folder / "plant.toml"
    config.write_text(
        f'[store]\nurl = "{fill_store(folder)}"\nallow_simulated = true\n[telegram]\nport = {port}\n'
    )
    command = [sys.executable, "-m", "barsight", "plant", "run", "--config", str(config)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        for _ in range(600):
            with socket.socket() as one:
                if one.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        yield process, port
        process.kill()


def cycles(link: socket.socket, seconds: float) -> tuple[list[float], list[int]]:
    """Exchange; return when telegrams came and their life counters."""
    stamps, lives, ends_s = list[float](), list[int](), time.monotonic() + seconds
    while time.monotonic() < ends_s:
        link.sendall(telegram(len(stamps)))
        lives.append(struct.unpack_from(">H", link.recv(96, socket.MSG_WAITALL), 4)[0])
        stamps.append(time.monotonic())
    return stamps, lives


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGSTOP])
def test_a_server_that_dies_is_seen_by_the_plc_in_time(tmp_path: Path, kind: signal.Signals) -> None:
    with plant_run(tmp_path) as (process, port), socket.create_connection(("127.0.0.1", port)) as link:
        _, lives = cycles(link, 3)
        assert len(set(lives)) == len(lives)
        os.kill(process.pid, kind)
        killed_s = last_s = time.monotonic()
        link.settimeout(0.02)
        while time.monotonic() - last_s <= STAY_S:  # the PLC's own rule: invalid where `life` stands so long
            try:
                last_s = time.monotonic() if link.recv(96) else last_s
            except (TimeoutError, ConnectionError):
                continue
        took_s = time.monotonic() - max(killed_s, last_s)
        print(
            f"{kind.name}: last telegram {last_s - killed_s:+.3f} s after, invalid {took_s:.3f} s after that"
        )
        assert last_s - killed_s < 0.05 and took_s < STAY_S + 0.05
        if kind == signal.SIGSTOP:
            os.kill(process.pid, signal.SIGCONT)


@pytest.mark.slow
def test_the_cycle_is_kept_for_a_minute(tmp_path: Path) -> None:
    with plant_run(tmp_path) as (_, port), socket.create_connection(("127.0.0.1", port)) as link:
        cycles(link, 2)
        stamps, _ = cycles(link, 60)
    gaps_ms = 1e3 * np.diff(stamps)
    low, middle, high = np.percentile(gaps_ms, [1, 50, 99])
    print(f"p1 {low:.1f} p50 {middle:.1f} p99 {high:.1f} ms; {gaps_ms.min():.1f}...{gaps_ms.max():.1f} ms")
    assert low >= 80 and high <= 120 and abs(gaps_ms.mean() - 100) < 0.5
