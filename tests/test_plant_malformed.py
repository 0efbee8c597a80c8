"""Bytes that are no telegram, data blocks and arguments without sense: no error, and nothing is changed."""

from __future__ import annotations

import asyncio
import os
import random
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("sqlalchemy")

from sqlalchemy import func, select

from barsight.core.errors import Failed
from barsight.plant.feed import StateFeed
from barsight.plant.serving import TelegramServer
from barsight.plant.settings import PlantSettings, StoreSource, TelegramSettings
from barsight.plant.steps import LiftReport, LiftSteps
from barsight.store.opening import Store, open_store
from barsight.store.tables import AUDIT
from opcua_servers import PASSWORD, node_package, opcua_plant
from plant_commands import IN, yard_store

AT_ONCE = 20


def test_a_number_beyond_the_store_s_ids_names_no_lift(store: Store) -> None:
    """PostgreSQL fails on it: it would end all links."""
    steps, report = LiftSteps(store, PlantSettings()), LiftReport(True, False, None)
    for told in (steps.executed(1, report, 2**32 - 1), steps.failed(1, "no", 2**31)):
        assert isinstance(told, Failed) and told.code == "token"


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


@pytest.mark.parametrize("count", [500, pytest.param(100_000, marks=pytest.mark.slow)])
def test_malformed_data_blocks_change_nothing(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All of the S7 link but snap7 itself: what comes out of the PLC's block is drawn, 48 bytes of it."""
    s7 = pytest.importorskip("barsight.plant.s7")
    from barsight.plant.link_settings import S7Settings
    from barsight.plant.links.s7_link import serve_s7

    draw, valid = random.Random(2212), list[int]()

    def exchange(_: Any, size: int, outputs: Any, take: Any, stop: Any) -> None:
        for number in range(count):
            valid.append(outputs()[7] & 1)
            content = senseless(draw) if number % 20 == 0 else malformed(draw)
            take(s7.S7Exchange((content + bytes(size))[:size], 0.0, 0.0))
        stop.wait()

    monkeypatch.setattr(s7, "run_s7", exchange)
    url, said = yard_store(tmp_path), list[str]()
    settings = replace(PlantSettings(), store=StoreSource(url=url, allow_simulated=True))

    async def run(feed: StateFeed, steps: LiftSteps) -> None:
        link = asyncio.create_task(serve_s7(S7Settings(), feed, steps, said.append))
        while len(valid) < count and not link.done():
            await asyncio.sleep(0.05)
        link.cancel()
        assert isinstance((await asyncio.gather(link, return_exceptions=True))[0], asyncio.CancelledError)

    with open_store(url) as store, StateFeed(store, settings) as feed:
        before = rows(store)
        asyncio.run(run(feed, LiftSteps(store, settings)))
        assert feed.newest(1).is_valid and rows(store) == before
    assert any(valid) and any("magic" in one for one in said)
    assert "Traceback" not in "".join(capsys.readouterr())


def drawn_variant(draw: random.Random, ua: Any) -> Any:
    """A value of any type, that fits what a method declares only by chance."""
    kind = ua.VariantType
    text = draw.choice(("", "lift-1", "9" * 40, "\0\n\x1b[2J", "ä" * 5000, "../../x", "bars/magnet-1", "NaN"))
    plain = draw.choice((
        (kind.Boolean, draw.random() < 0.5), (kind.Int32, draw.randrange(-(2**31), 2**31)),
        (kind.UInt32, draw.choice((0, 1, 2**32 - 1))), (kind.Int64, -(2**63)), (kind.Byte, 255),
        (kind.Double, draw.choice((float("nan"), float("inf"), -1e308, 0.0, 1700.0))), (kind.Float, -0.0),
        (kind.String, text), (kind.String, None), (kind.ByteString, draw.randbytes(draw.choice((0, 5000)))),
        (kind.NodeId, ua.NodeId(draw.randrange(2**32), draw.randrange(4))),
        (kind.LocalizedText, ua.LocalizedText(text, None)), (kind.QualifiedName, ua.QualifiedName(text, 9)),
        (kind.StatusCode, ua.StatusCode(ua.StatusCodes.BadOutOfMemory)),
        (kind.ExtensionObject, ua.Argument(Name=text)), (kind.ExtensionObject, ua.EUInformation()),
    ))  # fmt: skip
    if draw.random() < 0.05:
        return ua.Variant()
    if draw.random() < 0.2:
        return ua.Variant([plain[1]] * draw.choice((0, 1, 50)), plain[0], is_array=True)
    return ua.Variant(plain[1], plain[0])


async def methods_under(node: Any, ua: Any, seen: set[Any]) -> list[tuple[Any, Any]]:
    """All methods below a node, each with its object."""
    found = []
    for child in await node.get_children():
        if child.nodeid in seen:
            continue
        if await child.read_node_class() == ua.NodeClass.Method:
            found.append((node.nodeid, child.nodeid))
        elif await child.read_node_class() == ua.NodeClass.Object:
            found += await methods_under(child, ua, seen | {child.nodeid})
    return found


async def call_without_sense(plant: Any, user: str | None, seed: int, count: int) -> tuple[set[str], int]:
    """Call as often; return what was answered, and the number of methods."""
    asyncua = pytest.importorskip("asyncua")
    ua, draw, answers = asyncua.ua, random.Random(seed), set[str]()
    client = asyncua.Client(plant.url, timeout=60)
    if user is not None:
        client.set_user(user)
        client.set_password(PASSWORD)
    async with client:
        objects = client.nodes.objects
        known = await methods_under(objects, ua, {client.nodes.server.nodeid})
        known += [(ua.NodeId(2782), ua.NodeId(number)) for number in (3875, 9029, 9111)]  # of conditions
        for first in range(0, count, AT_ONCE):
            calls = []
            for _ in range(min(AT_ONCE, count - first)):
                place, method = draw.choice(known)
                if draw.random() < 0.05:
                    place = draw.choice(known)[0]
                arguments = [drawn_variant(draw, ua) for _ in range(draw.choice((0, 1, 1, 2, 2, 4, 5, 9)))]
                calls.append(ua.CallMethodRequest(place, method, arguments))
            answers |= {one.StatusCode.name for one in await client.uaclient.call(calls)}
        state = client.get_node("ns=1;s=State.mode")
        assert (await state.read_data_value()).StatusCode.is_good()
    return answers, len(known)


@pytest.mark.slow
@pytest.mark.parametrize("user", [None, "crane"])
def test_method_arguments_without_sense_are_refused(user: str | None, tmp_path: Path) -> None:
    """Without a role nothing reaches the plant; with one the server stands, whatever it is given."""
    count = int(os.environ.get("BARSIGHT_OPCUA_CALLS", "2000"))
    nodesets = node_package("node-opcua-nodesets") / "nodesets"
    with opcua_plant(tmp_path, nodesets=str(nodesets), allow_unsecured=True) as plant:
        answers, methods = asyncio.run(call_without_sense(plant, user, 2213, count))
        steps = int(plant.say("steps"))
    print(user, methods, "methods,", count, "calls,", steps, "steps,", sorted(answers))
    assert methods > 20
    assert not answers & {"BadUnexpectedError", "BadInternalError", "BadDecodingError", "BadEncodingError"}
    assert "Traceback" not in plant.log
    assert "BadUserAccessDenied" in answers
    assert "BadInvalidArgument" in answers and (user is not None or steps == 0)
