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
from opcua_servers import PASSWORD, free_port, opcua_plant  # noqa: E402
from plant_commands import plant_run, write_config  # noqa: E402

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


@pytest.mark.parametrize("tells_place", [True, False])
def test_an_opc_ua_crane_that_lifts_beside_is_told_so_if_it_tells_where(
    tmp_path: Path, *, tells_place: bool
) -> None:
    """asyncua's client makes the lift, through the server's process, on a store."""
    pytest.importorskip("sqlalchemy")
    from barsight.plant.opcua.security.access import add_user

    add_user(tmp_path / "users.json", "crane", "operator", PASSWORD)
    opcua = {"port": free_port(), "folder": "opcua", "users": "users.json", "allow_unsecured": True}
    config = write_config(tmp_path, opcua=opcua)

    async def lift() -> tuple[list[Any], str]:
        client = asyncua.Client(f"opc.tcp://127.0.0.1:{opcua['port']}/barsight", timeout=20)
        client.set_user("crane")
        client.set_password(PASSWORD)
        async with client:
            node = client.get_node("ns=1;s=Handshake")

            async def read(name: str) -> Any:
                return await client.get_node(f"ns=1;s=State.{name}").read_value()

            async with asyncio.timeout(20):
                while not await read("is_valid"):
                    await asyncio.sleep(0.1)
            at = [await read(f"lift.{name}_m") for name in ("x", "y", "z")]
            token, *_ = await node.call_method("1:claim", str(await read("lift.lift_id")))
            assert (await node.call_method("1:executing", token))[1]
            if tells_place:
                told = await node.call_method("1:touched", "grip", at[0] + 9.0, at[1], at[2])
                assert told == [True, ""]
            answer = await node.call_method("1:executed", token, 0.0, False, True)
            await asyncio.sleep(1.0)
            return answer, str(await read("alarms"))

    with plant_run(config):
        answer, alarms = asyncio.run(lift())
    assert answer[1] is not tells_place
    assert ("9000 mm beside" in answer[2] and "lift-beside" in alarms) is tells_place
