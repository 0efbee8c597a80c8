"""Check the MQTT publisher as a subscriber of its broker."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import socket
import time

from barsight.core.errors import Failed
from barsight.plant.link_settings import MqttSettings
from barsight.plant.links.link_check import LinkCheck
from barsight.plant.mqtt import MqttError, mqtt_clients, mqtt_problem

STATES = 20
WAIT_S = 5.0


def check_mqtt(settings: MqttSettings) -> LinkCheck | Failed:
    """Read the retained topics and some states; return readable lines and whether the link passed."""
    try:
        return asyncio.run(_read(settings))
    except TimeoutError:
        return Failed("mqtt-silent", f"{settings.host}:{settings.port}: no state came within {WAIT_S:g} s")
    except (MqttError, OSError) as error:
        return Failed("mqtt-link", f"{settings.host}:{settings.port}: {mqtt_problem(error, settings)}")


async def _read(settings: MqttSettings) -> LinkCheck:
    online, stamps, lives, last, retained = "", list[float](), list[int](), "", False
    async with asyncio.timeout(WAIT_S), mqtt_clients(settings)() as client:
        await client.subscribe(f"{settings.prefix}/#", qos=1)
        async for message in client.messages:
            text = bytes(message.payload).decode() if isinstance(message.payload, bytes | bytearray) else ""
            topic = str(message.topic).removeprefix(f"{settings.prefix}/")
            if topic == "online":
                online = text
            elif topic == "state":
                retained = retained or bool(message.retain)
                stamps.append(time.monotonic())
                lives.append(int(json.loads(text)["life_counter"]))
                last = text
            if len(lives) >= STATES:
                break
    gaps_s = [later - before for before, later in itertools.pairwise(stamps[1:])]
    is_alive = all(later > before for before, later in itertools.pairwise(lives))
    lines = (
        f"{settings.prefix}/online: {online or 'nothing'} (retained; the last will sets it to false)",
        f"{settings.prefix}/state: {'' if retained else 'NOT '}retained, {len(last)} characters",
        last[:300],
        f"interval {min(gaps_s):.3f}...{max(gaps_s):.3f} s, at least {settings.state_every_s:g} s",
        "life counter: " + ("goes up in each state" if is_alive else "stands still"),
    )
    tells = await _tells_wills(settings)
    will = "the broker tells the last will of a client that is lost: " + ("yes" if tells else "NO")
    return LinkCheck("mqtt", (*lines, will), online == "true" and retained and is_alive and tells)


async def _tells_wills(settings: MqttSettings) -> bool:
    """Drop the connection of a test client, and check that the broker publishes its last will."""
    topic = f"{settings.prefix}/check"
    async with mqtt_clients(settings)() as client:
        await client.subscribe(topic, qos=1)
        with contextlib.suppress(MqttError):
            async with mqtt_clients(settings, "check")() as lost:
                lost._client.socket().shutdown(socket.SHUT_RDWR)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(WAIT_S):
                async for message in client.messages:
                    if message.payload == b"false":
                        await client.publish(topic, b"", qos=1, retain=True)
                        return True
    return False
