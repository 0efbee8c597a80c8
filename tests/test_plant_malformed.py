"""Bytes that are no telegram, and telegrams without sense, over TCP: no error, and nothing is changed."""

from __future__ import annotations

import asyncio
import random
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("sqlalchemy")

from sqlalchemy import func, select

from barsight.plant.feed import StateFeed
from barsight.plant.serving import TelegramServer
from barsight.plant.settings import PlantSettings, StoreSource, TelegramSettings
from barsight.plant.steps import LiftSteps
from barsight.store.opening import Store, open_store
from barsight.store.tables import AUDIT
from plant_commands import IN, yard_store

AT_ONCE = 20


def senseless(draw: random.Random) -> bytes:
    """A telegram of the right form, whose command names what isn't offered, or a token that isn't given."""
    return IN.pack(
        0xB51B, 1, draw.randrange(65536), draw.randrange(16), draw.randrange(-(2**63), 2**63),
        *(draw.randrange(-(2**31), 2**31) for _ in range(3)), draw.randrange(2**32), draw.randrange(1, 5),
        draw.randrange(65536), draw.choice((draw.randrange(2**32), 1, 2, 3)), draw.randrange(2**32),
        draw.randrange(2**32),
    )  # fmt: skip


def malformed(draw: random.Random) -> bytes:
    """Bytes that can't be a telegram, or its first part."""
    good = senseless(draw)
    kind = draw.randrange(6)
    if kind == 0:
        return draw.randbytes(48 * draw.randrange(1, 4))
    if kind == 1:
        return good[: draw.randrange(1, 48)]
    if kind == 2:
        return struct.pack(">HH", 0xB51B, draw.choice((0, 2, 65535))) + good[4:]
    if kind == 3:
        return good[:6] + struct.pack(">H", draw.randrange(16, 65536)) + good[8:]
    if kind == 4:
        return good[:32] + struct.pack(">H", draw.randrange(5, 65536)) + good[34:]
    return struct.pack("<HH", 0xB51B, 1) + good[4:]


async def sent(port: int, content: bytes) -> None:
    """Send, end the sending side, and wait until the server has closed."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(content)
    writer.write_eof()
    try:
        async with asyncio.timeout(20):
            while await reader.read(4096):
                pass
    except ConnectionResetError:
        pass
    writer.close()


async def attack(server: TelegramServer, seed: int, count: int) -> list[dict[str, Any]]:
    """Send so many, a twentieth of them of the right form; return what the event loop complained of."""
    draw, errors, loop = random.Random(seed), list[dict[str, Any]](), asyncio.get_running_loop()
    loop.set_exception_handler(lambda _, context: errors.append(context))
    port = loop.create_future()
    running = asyncio.create_task(server.run(port.set_result))
    address = await port
    for first in range(0, count, AT_ONCE):
        batch = [malformed(draw) for _ in range(min(AT_ONCE, count - first) - 1)]
        await asyncio.gather(*(sent(address, one) for one in [*batch, senseless(draw)]))
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    return errors


def rows(store: Store) -> int:
    with store.reading() as connection:
        return int(connection.execute(select(func.count()).select_from(AUDIT)).scalar_one())


@pytest.mark.parametrize("count", [200, pytest.param(100_000, marks=pytest.mark.slow)])
def test_malformed_telegrams_change_nothing(
    count: int, tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    url = yard_store(tmp_path)
    telegram = TelegramSettings(port=0, cycle_s=0.05)
    settings = replace(PlantSettings(), telegram=telegram, store=StoreSource(url=url, allow_simulated=True))
    with open_store(url) as store, StateFeed(store, settings) as feed:
        server, before = TelegramServer(feed, LiftSteps(store, settings), telegram), rows(store)
        assert asyncio.run(attack(server, 2211, count)) == []
        assert feed.newest(1).is_valid and rows(store) == before
    assert server.refused > 0.7 * count  # all but those that were cut off or of the right form
    assert "Traceback" not in caplog.text + "".join(capsys.readouterr())
