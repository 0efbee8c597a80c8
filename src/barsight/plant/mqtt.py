"""Publish the plant state to an MQTT broker: plain JSON, retained, with last wills.

Topics below the prefix: `online` (retained; `true`, or `false` by the last will), `state` (retained for
`STATE_LASTS_S`, the newest snapshot, or `OFFLINE` by the last will), `events` (not retained, in order). A
connection has one last will, so that there are two. While the broker is unreachable, only the newest state
and at most `max_waiting` events are kept; the oldest are dropped, and the next event that gets through
carries their number (`lost`).
"""

from __future__ import annotations

import asyncio
import json
import math
import ssl
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.core.json_values import json_value
from barsight.core.reading.bounded_reading import read_text
from barsight.plant.link_settings import MqttSettings
from barsight.plant.state import PlantState

with extra("mqtt"):
    import aiomqtt
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

OFFLINE = PlantState("idle", False, ("offline: Barsight's connection to the broker ended",), 0, 0, "none")
"""State that the broker shows once Barsight is gone."""
STATE_LASTS_S = 1
"""Time in seconds after which the broker drops a state that isn't renewed (MQTT 5)."""
MqttError = aiomqtt.MqttError
"""Raised if the broker can't be reached or refuses the connection."""


@dataclass(frozen=True)
class MqttCounts:
    """Numbers of states and events that reached the broker, of events dropped, and of connections."""

    states: int
    events: int
    lost: int
    connections: int


class MqttPublisher:
    """Queue what is to be sent to the broker, and publish it while `run` runs. All in one event loop."""

    def __init__(self, settings: MqttSettings) -> None:
        self._settings = settings
        self._client = mqtt_clients(settings, "state", state_json(OFFLINE))
        self._presence = mqtt_clients(settings, "online", "false")
        self._present_s = -math.inf
        self._state: str | None = None
        self._events: deque[dict[str, Any]] = deque()
        self._lost = 0
        self._unsaid = 0
        self._states_sent = 0
        self._events_sent = 0
        self._connections = 0
        self._problem: str | None = None
        self._changed = asyncio.Event()

    @property
    def counts(self) -> MqttCounts:
        """Return the counts of what was sent and lost."""
        return MqttCounts(self._states_sent, self._events_sent, self._lost, self._connections)

    @property
    def problem(self) -> str | None:
        """Return why the broker isn't connected; None before the first try ends, and while it is."""
        return self._problem

    @property
    def waiting(self) -> int:
        """Count the queued events."""
        return len(self._events)

    def show(self, snapshot: Any) -> None:
        """Set the state to publish next; it replaces one that is still waiting."""
        self._state = state_json(snapshot)
        self._changed.set()

    def tell(self, event: dict[str, Any]) -> None:
        """Queue an event; if the queue is full, the oldest is dropped."""
        if len(self._events) >= self._settings.max_waiting:
            self._events.popleft()
            self._lost += 1
            self._unsaid += 1
        self._events.append(event)
        self._changed.set()

    async def run(self) -> None:
        """Connect and publish until cancelled; reconnect whenever the broker is lost."""
        wait_s = 0.1
        latest: str | None = None
        while True:
            began = time.monotonic()
            try:
                async with self._client() as client, self._presence() as presence:
                    self._connections += 1
                    self._problem, self._present_s = None, -math.inf
                    latest = self._state = self._state or latest
                    self._changed.set()
                    try:
                        while True:
                            await self._tell_presence(presence)
                            latest = await self._publish(client) or latest
                    finally:
                        if _is_cancelled():
                            for topic, text in (("online", "false"), ("state", state_json(OFFLINE))):
                                await client.publish(self._topic(topic), text, qos=1, retain=True, timeout=1)
            except (aiomqtt.MqttError, OSError) as error:
                self._problem = mqtt_problem(error, self._settings)
            if _is_cancelled():  # a lost broker's error on the way out has replaced the cancellation
                raise asyncio.CancelledError
            wait_s = 0.1 if time.monotonic() - began > self._settings.max_retry_s else wait_s
            await asyncio.sleep(wait_s)
            wait_s = min(2 * wait_s, self._settings.max_retry_s)

    async def _tell_presence(self, presence: aiomqtt.Client) -> None:
        """Publish, now and then, that Barsight is there; a connection that was lost is noticed by this."""
        if time.monotonic() - self._present_s >= self._settings.keepalive_s:
            self._present_s = time.monotonic()
            await presence.publish(self._topic("online"), "true", qos=1, retain=True)

    async def _publish(self, client: aiomqtt.Client) -> str | None:
        """Publish what is waiting; return the state that was sent."""
        try:
            await asyncio.wait_for(self._changed.wait(), self._settings.keepalive_s)
        except TimeoutError:
            return None
        self._changed.clear()
        state, self._state = self._state, None
        began_s = time.monotonic()
        try:
            if state is not None:
                await client.publish(
                    self._topic("state"), state, qos=0, retain=True, properties=self._lasting()
                )
                self._states_sent += 1
            while self._events:
                if self._has_newer(began_s):
                    return state
                first, lost = self._events[0], self._unsaid
                await client.publish(self._topic("events"), self._event(), qos=1)
                self._events_sent += 1
                self._unsaid -= lost
                if self._events and self._events[0] is first:
                    self._events.popleft()
                else:  # it was dropped while being sent, so it isn't lost
                    self._lost, self._unsaid = self._lost - 1, self._unsaid - 1
        except BaseException:
            self._state = self._state or state
            raise
        await asyncio.sleep(self._settings.state_every_s)
        return state

    def _has_newer(self, since_s: float) -> bool:
        """Check whether a newer state is due; it doesn't wait for all events."""
        return self._state is not None and time.monotonic() - since_s > self._settings.state_every_s

    def _event(self) -> str:
        event = {**self._events[0], "lost": self._unsaid}
        return json.dumps(json_value(event), allow_nan=False)

    def _lasting(self) -> Properties | None:
        """Form the properties with which a state expires; None by a version that has none."""
        if self._settings.version != "5":
            return None
        properties = Properties(PacketTypes.PUBLISH)
        properties.MessageExpiryInterval = STATE_LASTS_S
        return properties

    def _topic(self, name: str) -> str:
        return f"{self._settings.prefix}/{name}"


def mqtt_problem(error: Exception, settings: MqttSettings) -> str:
    """Describe why a broker can't be used, with the remedy where it doesn't know the version."""
    problem = str(error).strip() or type(error).__name__
    other = "3.1.1" if settings.version == "5" else "5"
    remedy = f' {settings.version}: set mqtt.version = "{other}"'
    return problem + remedy if problem.lower().endswith("protocol version") else problem


def mqtt_clients(
    one: MqttSettings, will: str | None = None, text: str = "false"
) -> Callable[[], aiomqtt.Client]:
    """Read password and authority, and return a factory of clients for the broker.

    will: topic below the prefix on which the broker publishes `text` if a client is lost. Raises InputError.
    """
    password = None if one.password_file is None else read_text(one.password_file).partition("\n")[0]
    context = None if one.authority is None else _context(one.authority)
    last = aiomqtt.Will(f"{one.prefix}/{will}", text, qos=1, retain=True) if will else None
    version = aiomqtt.ProtocolVersion.V5 if one.version == "5" else aiomqtt.ProtocolVersion.V311

    def client() -> aiomqtt.Client:
        return aiomqtt.Client(
            one.host, one.port, username=one.user, password=password, keepalive=one.keepalive_s, will=last,
            timeout=5, tls_context=context, protocol=version, max_queued_outgoing_messages=20,
            max_inflight_messages=20,
        )  # fmt: skip

    return client


def _context(authority: Path) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=authority)
    except OSError as error:
        raise InputError(
            authority, f"isn't a certificate authority ({error})", "give its PEM file"
        ) from error


def _is_cancelled() -> bool:
    """Check whether the running task was asked to end."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


def state_json(snapshot: Any) -> str:
    """Write a frozen snapshot as JSON: its fields by name, unknown values as null."""
    return json.dumps(json_value(snapshot), allow_nan=False)
