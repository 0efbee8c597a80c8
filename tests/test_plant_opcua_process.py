"""The OPC UA server in its own process: Bad as soon as nobody vouches for it, and bounded."""

from __future__ import annotations

import asyncio
import datetime
import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

asyncua = pytest.importorskip("asyncua")

from barsight.core.errors import Failed  # noqa: E402
from barsight.plant.link_settings import OpcUaSettings  # noqa: E402
from barsight.plant.opcua.process import OpcUaProcess  # noqa: E402
from barsight.plant.opcua.recipes import Recipes  # noqa: E402
from barsight.plant.opcua.surveys import Told  # noqa: E402
from opcua_plant import DrawnState  # noqa: E402
from opcua_servers import free_port, opcua_plant  # noqa: E402

pytestmark = pytest.mark.slow  # each server takes some ten seconds to start


def handshake(step: str, who: str, arguments: Mapping[str, Any]) -> str | Failed:
    return f"{step} by {who}"


def test_a_state_that_nobody_renews_goes_bad_at_once(tmp_path: Path) -> None:
    settings = OpcUaSettings(port=free_port(), folder=tmp_path, allow_unsecured=True, state_every_s=0.05)
    at = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    process = OpcUaProcess(settings, DrawnState, Recipes((), "", at), handshake)

    async def walk() -> tuple[list[str], float]:
        async with asyncio.timeout(60):
            while True:
                try:
                    client = asyncua.Client(f"opc.tcp://127.0.0.1:{settings.port}/barsight", timeout=10)
                    await client.connect()
                    break
                except OSError:
                    await asyncio.sleep(0.2)
        node = client.get_node("ns=1;s=State.mode")
        seen: list[str] = []

        async def until(name: str) -> float:
            began = time.monotonic()
            async with asyncio.timeout(10):
                while (await node.read_data_value(raise_on_bad_status=False)).StatusCode.name != name:
                    if name == "Good":
                        process.show(Told(DrawnState("surveyed", True, 1, (0.0, 0.0, 0.0), None)))
                    await asyncio.sleep(0.02)
            seen.append(name)
            return time.monotonic() - began

        try:
            await until("Good")
            assert process.is_serving
            took = await until("BadNoCommunication")
        finally:
            await client.disconnect()
        return seen, took

    try:
        seen, took = asyncio.run(walk())
        assert seen == ["Good", "BadNoCommunication"]
        assert took < 1.5
    finally:
        process.stop()
    assert not process.is_alive


@pytest.mark.slow
def test_clients_that_stall_and_subscriptions_left_behind_cost_bounded_memory(tmp_path: Path) -> None:
    """20 clients, one stopped; then as in asyncua's issue 1982: sessions closed, subscriptions kept."""
    limits = {"max_subscriptions": 40, "max_subscription_cycles": 60, "allow_unsecured": True}
    seconds = float(os.environ.get("BARSIGHT_OPCUA_SECONDS", "30"))
    with opcua_plant(tmp_path, **limits) as plant:
        stalled = os.fork()
        if stalled == 0:
            asyncio.run(_subscribe(plant.url, 3600))
            os._exit(0)
        time.sleep(3)
        os.kill(stalled, signal.SIGSTOP)
        try:
            asyncio.run(_many(plant.url, 19, 5))
            before = int(plant.say("memory"))
            asyncio.run(_many(plant.url, 19, seconds))
            left = asyncio.run(_leave_behind(plant.url, 100))
            after = int(plant.say("memory"))
        finally:
            os.kill(stalled, signal.SIGKILL)
            os.waitpid(stalled, 0)
    assert left <= 40
    assert after - before < 15_000, (before, after)


CLOSING_S = 0.5
"""A transport closes its socket in a later round of the loop."""


async def _subscribe(url: str, seconds: float) -> None:
    class Seen:
        def datachange_notification(self, node: Any, value: Any, data: Any) -> None: ...

    async with asyncua.Client(url, timeout=20) as client:
        subscription = await client.create_subscription(50, Seen())
        await subscription.subscribe_data_change(client.get_node("ns=1;s=State.life_counter"))
        await asyncio.sleep(seconds)


async def _many(url: str, count: int, seconds: float) -> None:
    await asyncio.gather(*(_subscribe(url, seconds) for _ in range(count)))
    await asyncio.sleep(CLOSING_S)


async def _leave_behind(url: str, count: int) -> int:
    """Close sessions without their subscriptions, as often; return how many subscriptions were let in."""
    made = 0
    for _ in range(count):
        client = asyncua.Client(url, timeout=20)
        await client.connect()
        try:
            parameters = asyncua.ua.CreateSubscriptionParameters(
                RequestedPublishingInterval=1000, RequestedLifetimeCount=100000,
                RequestedMaxKeepAliveCount=1000,
            )  # fmt: skip
            await client.uaclient.create_subscription(parameters, lambda result: None)
            made += 1
        except asyncua.ua.UaError:
            pass
        client._closing = True
        await client.uaclient.close_session(False)
        client.disconnect_socket()
    await asyncio.sleep(CLOSING_S)
    return made
