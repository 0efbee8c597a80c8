"""The MQTT publisher against Debian's mosquitto: retained, last will, broker killed, buffer."""

from __future__ import annotations

import asyncio
import json
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from opcua_servers import free_port

aiomqtt = pytest.importorskip("aiomqtt")

from barsight.core.errors import ConfigError  # noqa: E402
from barsight.plant.link_settings import MqttSettings  # noqa: E402
from barsight.plant.mqtt import MqttPublisher  # noqa: E402

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")


@dataclass(frozen=True)
class DrawnMode:
    mode: str
    life_counter: int
    mass_kg: float | None = None


class Broker:
    """A mosquitto on a free port, that can be killed and started again."""

    def __init__(self, folder: Path) -> None:
        if MOSQUITTO is None:
            pytest.skip("mosquitto is not installed (run .ci/servers)")
        self.port = free_port()
        self.config = folder / "mosquitto.conf"
        self.config.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence false\n")
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [str(MOSQUITTO), "-c", str(self.config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )  # fmt: skip
        time.sleep(0.3)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    async def until(self, topic: str, test: Callable[[str], bool], timeout_s: float = 10) -> str:
        """The first message that passes the test."""
        async with asyncio.timeout(timeout_s), aiomqtt.Client("127.0.0.1", self.port) as client:
            await client.subscribe(topic, qos=1)
            async for message in client.messages:
                if test(message.payload.decode()):
                    return str(message.payload.decode())
        raise AssertionError(topic)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    one = Broker(tmp_path)
    yield one
    one.kill()


def run_with(publisher: MqttPublisher, body: Callable[[], Awaitable[Any]]) -> Any:
    async def both() -> Any:
        running = asyncio.create_task(publisher.run())
        try:
            return await body()
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    return asyncio.run(both())


async def until(test: Callable[[], bool]) -> None:
    async with asyncio.timeout(10):
        while not test():
            await asyncio.sleep(0.02)


def test_a_late_client_gets_the_state_and_knows_who_is_there(broker: Broker) -> None:
    publisher = MqttPublisher(MqttSettings(port=broker.port, state_every_s=0.02))

    async def body() -> tuple[dict[str, Any], str]:
        publisher.show(DrawnMode("surveyed", 7, float("nan")))
        await until(lambda: publisher.counts.states == 1)
        state = await broker.until("barsight/crane/state", lambda text: True)
        return json.loads(state), await broker.until("barsight/crane/online", lambda text: True)

    assert run_with(publisher, body) == ({"mode": "surveyed", "life_counter": 7, "mass_kg": None}, "true")
    assert asyncio.run(broker.until("barsight/crane/online", lambda text: True)) == "false"


def test_the_last_will_tells_a_process_that_died(broker: Broker) -> None:
    """Not taken leave of: os._exit in the middle."""
    program = textwrap.dedent(f"""
        import asyncio, os
        from barsight.plant.link_settings import MqttSettings
        from barsight.plant.mqtt import MqttPublisher
        async def main():
            publisher = MqttPublisher(MqttSettings(port={broker.port}))
            running = asyncio.create_task(publisher.run())
            while publisher.counts.connections == 0:
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.3)
            print("up", flush=True)
            await asyncio.sleep(1)
            os._exit(1)
        asyncio.run(main())
    """)

    async def watch() -> list[str]:
        with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            await asyncio.to_thread(process.stdout.readline)
            return [
                await broker.until("barsight/crane/online", lambda text, w=w: text == w)
                for w in ("true", "false")
            ]

    assert asyncio.run(watch()) == ["true", "false"]


@pytest.mark.parametrize(
    ("how", "version", "left"),
    [
        ("KILL", "5", [False]),
        ("KILL", "3.1.1", [False]),
        pytest.param("STOP", "5", [], marks=pytest.mark.slow),
        ("leave", "5", [False]),
    ],
)
def test_a_state_does_not_stay_valid_without_its_process(
    how: str, version: str, left: list[bool], broker: Broker
) -> None:
    """For whoever subscribes 1.6 s after it was killed, hung or ended; a hung one's last will comes later."""
    program = textwrap.dedent(f"""
        import asyncio, sys
        from barsight.plant.link_settings import MqttSettings
        from barsight.plant.mqtt import OFFLINE, MqttPublisher
        from dataclasses import replace
        async def main():
            publisher = MqttPublisher(MqttSettings(port={broker.port}, version="{version}"))
            running = asyncio.create_task(publisher.run())
            for _ in range(600):
                publisher.show(replace(OFFLINE, is_valid=True))
                await asyncio.sleep(0.05)
                if publisher.counts.states == 5:
                    print("up", flush=True)
                if {how == "leave"} and publisher.counts.states > 30:
                    break
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
        asyncio.run(main())
    """)

    async def retained(wait_s: float) -> list[bool]:
        found = []
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            await client.subscribe("barsight/crane/state", qos=1)
            try:
                async with asyncio.timeout(wait_s):
                    async for message in client.messages:
                        found.append(json.loads(bytes(message.payload).decode())["is_valid"])  # noqa: PERF401
            except TimeoutError:
                return found
        return found

    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert True in asyncio.run(retained(0.5))
        try:
            if how == "leave":
                process.wait(20)
            else:
                process.send_signal(getattr(signal, f"SIG{how}"))
            time.sleep(1.6)
            assert asyncio.run(retained(0.3)) == left
            if how == "STOP":
                ended = '"is_valid": false'
                asyncio.run(broker.until("barsight/crane/state", lambda text: ended in text, 20))
        finally:
            process.kill()


def test_a_broker_that_knows_only_the_older_version_is_told_with_the_remedy() -> None:
    """It refuses the connection as MQTT 3.1.1 says, as Mosquitto before 1.6."""

    async def told() -> str:
        async def refuse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.read(200)
            writer.write(bytes([0x20, 2, 0, 1]))
            writer.close()

        old = await asyncio.start_server(refuse, "127.0.0.1", 0)
        publisher = MqttPublisher(MqttSettings(port=old.sockets[0].getsockname()[1]))
        running = asyncio.create_task(publisher.run())
        async with asyncio.timeout(10):
            while publisher.problem is None:
                await asyncio.sleep(0.02)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        old.close()
        return publisher.problem

    assert 'Unsupported protocol version 5: set mqtt.version = "3.1.1"' in asyncio.run(told())


def test_a_broker_that_is_away_costs_bounded_memory_and_the_newest_survives(broker: Broker) -> None:
    settings = MqttSettings(port=broker.port, max_waiting=10, max_retry_s=0.2, state_every_s=0.02)
    publisher = MqttPublisher(settings)
    told: list[dict[str, Any]] = []

    async def listen() -> None:
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            await client.subscribe("barsight/crane/events", qos=1)
            listening.set()
            async for message in client.messages:
                told.append(json.loads(message.payload))  # noqa: PERF401

    listening: asyncio.Event

    async def body() -> str:
        nonlocal listening
        listening = asyncio.Event()
        publisher.show(DrawnMode("surveyed", 1))
        await until(lambda: publisher.counts.states == 1)
        broker.kill()
        for number in range(1000):
            publisher.tell({"number": number})
            publisher.show(DrawnMode("surveyed", number))
            if number % 100 == 0:
                await asyncio.sleep(0.05)
            assert publisher.waiting <= 10
        broker.start()
        listener = asyncio.create_task(listen())
        try:
            await until(lambda: publisher.counts.connections >= 2)
            state = await broker.until("barsight/crane/state", lambda text: '"life_counter": 999' in text)
            await listening.wait()
            publisher.tell({"number": 1000})
            await until(lambda: bool(told) and told[-1]["number"] == 1000)
        finally:
            listener.cancel()
            await asyncio.gather(listener, return_exceptions=True)
        return state

    assert json.loads(run_with(publisher, body))["life_counter"] == 999
    assert publisher.counts.lost >= 985
    assert [event["number"] for event in told] == sorted({event["number"] for event in told})


def test_what_is_dropped_while_an_event_goes_out_is_told() -> None:
    """Ten events come during one publishing, with room for two: the newest two follow."""

    class SlowClient:
        def __init__(self) -> None:
            self.told: list[dict[str, Any]] = []

        async def publish(self, topic: str, text: str, **_: Any) -> None:
            if topic.endswith("events"):
                self.told.append(json.loads(text))
                if len(self.told) == 1:
                    for number in range(1, 11):
                        publisher.tell({"number": number})

    client = SlowClient()

    async def body() -> None:
        nonlocal publisher
        publisher = MqttPublisher(MqttSettings(max_waiting=2, state_every_s=0.01))
        publisher.tell({"number": 0})
        await publisher._publish(client)  # type: ignore[arg-type]

    publisher: MqttPublisher
    asyncio.run(body())
    numbers = [(one["number"], one["lost"]) for one in client.told]
    assert numbers == [(0, 0), (9, 8), (10, 0)]
    assert publisher.counts.lost == 8 and publisher.counts.events == 3 and publisher.waiting == 0


def test_a_newer_state_does_not_wait_for_the_events(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred events that waited for the broker take 5 s; the state becomes another after 0.3 s."""
    sent: list[str] = []

    class SlowClient:
        async def __aenter__(self) -> SlowClient:
            return self

        async def __aexit__(self, *_: object) -> None:
            return

        async def publish(self, topic: str, text: str, **_: Any) -> None:
            sent.append(text if topic.endswith("state") else topic)
            await asyncio.sleep(0.05 if topic.endswith("events") else 0)

    async def body() -> float:
        publisher = MqttPublisher(MqttSettings(state_every_s=0.02))
        monkeypatch.setattr(publisher, "_client", SlowClient)
        monkeypatch.setattr(publisher, "_presence", SlowClient)
        for number in range(100):
            publisher.tell({"number": number})
        running = asyncio.create_task(publisher.run())
        await asyncio.sleep(0.3)
        began_s = time.monotonic()
        publisher.show(DrawnMode("blind", 2))
        await until(lambda: any('"blind"' in text for text in sent))
        took_s = time.monotonic() - began_s
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        return took_s

    assert asyncio.run(body()) < 0.5


def test_a_publisher_ends_though_its_broker_is_gone(broker: Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    """The farewell fails as the broker is away: that must not stand in the place of the cancellation."""
    publisher = MqttPublisher(MqttSettings(port=broker.port, state_every_s=0.02))

    async def body() -> None:
        publish = aiomqtt.Client.publish

        async def failing(client: aiomqtt.Client, topic: str, *args: Any, **kwargs: Any) -> None:
            if topic.endswith("online"):
                raise aiomqtt.MqttError("gone")
            await publish(client, topic, *args, **kwargs)

        publisher.show(DrawnMode("surveyed", 1))
        await until(lambda: publisher.counts.states == 1)
        monkeypatch.setattr(aiomqtt.Client, "publish", failing)

    async def bounded() -> None:
        running = asyncio.create_task(publisher.run())
        await body()
        running.cancel()
        _, pending = await asyncio.wait({running}, timeout=5)
        assert not pending and running.cancelled()

    asyncio.run(bounded())


def test_topics_with_wildcards_are_refused() -> None:
    with pytest.raises(ConfigError, match="not a topic"):
        MqttSettings(prefix="yard/#")
