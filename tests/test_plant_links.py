"""`barsight plant run` and `plant check`, every link at once, against mosquitto, snap7 and openssl."""

import asyncio
import multiprocessing
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

import pytest

pytest.importorskip("sqlalchemy")

from barsight.cli.main import run
from barsight.core.errors import ConfigError, Failed, InputError, OutputError
from barsight.plant import feed as feed_module
from barsight.plant.feed import StateFeed
from barsight.plant.link_settings import MqttSettings, OpcUaSettings, S7Settings, WebhookSettings
from barsight.plant.links import opcua_link
from barsight.plant.links.changes import changes_between
from barsight.plant.links.running import _followed, _serve_mqtt, _serve_webhooks, serve_plant
from barsight.plant.links.s7_link import serve_s7
from barsight.plant.links.telegram_process import serve_telegram
from barsight.plant.live_folder import with_live_run
from barsight.plant.settings import PlantSettings, StoreSource, TelegramSettings, read_plant
from barsight.plant.state import MAX_ALARMS, MAX_CODES, PlantAlarm, PlantState, state_of_store, told_alarms
from barsight.plant.steps import LiftSteps, take_named_step
from barsight.report.signing import sign_file
from barsight.store.opening import open_store
from live_folders import live_folder
from opcua_servers import free_port
from page_yards import fill_store
from plant_commands import Hooks, plant_run, write_config

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
QUIET = PlantState("surveyed", True, (), 1, 5, "done")


class Plc:
    """snap7's server with both data blocks; its life counter goes up twenty times a second."""

    def __init__(self) -> None:
        snap7 = pytest.importorskip("snap7")
        self.port = free_port()
        self.mine, self.theirs = bytearray(48), bytearray(98)
        self.mine[:4] = struct.pack(">HH", 0xB51B, 1)
        self._server = snap7.Server(log=False)
        self._server.register_area(snap7.SrvArea.DB, 100, self.mine)
        self._server.register_area(snap7.SrvArea.DB, 101, self.theirs)
        self._server.start(self.port)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._live)
        self._thread.start()

    def _live(self) -> None:
        life = 0
        while not self._stop.wait(0.05):
            life = life % 65535 + 1
            self.mine[4:6] = struct.pack(">H", life)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._server.stop()
        self._server.destroy()


@pytest.fixture
def plc() -> Iterator[Plc]:
    one = Plc()
    yield one
    one.close()


@pytest.fixture
def hooks() -> Iterator[Hooks]:
    one = Hooks()
    yield one
    one.close()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[int]:
    if MOSQUITTO is None:
        pytest.skip("mosquitto is not installed (run .ci/servers)")
    port = free_port()
    config = tmp_path / "mosquitto.conf"
    config.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\npersistence false\n")
    with subprocess.Popen([str(MOSQUITTO), "-c", str(config)], stderr=subprocess.DEVNULL) as process:
        yield port
        process.kill()


def listens(port: int) -> bool:
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


def wait_for(port: int) -> None:
    for _ in range(600):
        if listens(port):
            return
        time.sleep(0.1)
    raise AssertionError(f"nothing listens at {port}")


@pytest.mark.slow  # OPC UA's server takes some ten seconds to start
def test_all_links_are_served_and_checked(
    tmp_path: Path, plc: Plc, broker: int, hooks: Hooks, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("asyncua")
    telegram, opcua = free_port(), free_port()
    config = tmp_path / "plant.toml"
    config.write_text(
        f'[store]\nurl = "{fill_store(tmp_path)}"\nallow_simulated = true\n[telegram]\nport = {telegram}\n'
        f'[opcua]\nport = {opcua}\nfolder = "opcua"\n[mqtt]\nport = {broker}\n[s7]\nport = {plc.port}\n'
        f'[webhooks]\nurls = ["{hooks.url}"]\n'
    )
    key, public = tmp_path / "key.pem", tmp_path / "public.pem"
    subprocess.run(["openssl", "genpkey", "-algorithm", "ed25519", "-out", str(key)], check=True)
    subprocess.run(["openssl", "pkey", "-in", str(key), "-pubout", "-out", str(public)], check=True)
    command = [sys.executable, "-m", "barsight", "plant", "run", "--config", str(config)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        wait_for(telegram)
        wait_for(opcua)
        protocol = tmp_path / "protocol.txt"
        arguments = ["plant", "check", "--config", str(config), "--protocol", str(protocol)]
        checked = run([*arguments, "--key", str(key)])
        seen = capsys.readouterr()
        lift = struct.unpack_from(">HHHH8xI", plc.theirs)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130, process.communicate()
    assert checked == 0, seen
    assert "check" in [post["event"] for post in hooks.posts], "among what the run itself tells"
    for link in ("telegram", "opcua", "mqtt", "s7", "webhooks"):
        assert f"{link}: holds" in seen.out
    assert "SignAndEncrypt" in seen.out and "without certificate and encryption: refused" in seen.out
    assert lift[0] == 0xB51A and lift[3] & 1 and lift[4] > 0, (
        "the PLC's data block holds the lift that is offered"
    )
    verify = [
        "openssl",
        "pkeyutl",
        "-verify",
        "-pubin",
        "-inkey",
        str(public),
        "-rawin",
        "-in",
        str(protocol),
    ]
    assert subprocess.run([*verify, "-sigfile", f"{protocol}.sig"], stdout=subprocess.DEVNULL).returncode == 0
    protocol.write_text(protocol.read_text() + " ")
    assert subprocess.run([*verify, "-sigfile", f"{protocol}.sig"], stdout=subprocess.DEVNULL).returncode != 0
    assert run(arguments) == 5
    assert "telegram, opcua, mqtt, s7: does not hold" in capsys.readouterr().err


@pytest.mark.slow  # OPC UA's server takes some ten seconds to start
def test_no_link_outlives_a_run_that_is_killed(tmp_path: Path, plc: Plc, broker: int) -> None:
    """OPC UA's process ends with it, the last will is told, the PLC's data block stands. And before that: a
    server that lets clients in unsecured isn't what its check was told.
    """
    pytest.importorskip("asyncua")
    from barsight.plant.links.opcua_check import check_opcua

    aiomqtt = pytest.importorskip("aiomqtt")
    ports = {"telegram": free_port(), "opcua": free_port()}
    config = write_config(
        tmp_path, telegram={"port": ports["telegram"]}, s7={"port": plc.port},
        mqtt={"port": broker, "keepalive_s": 1}, opcua={"port": ports["opcua"], "allow_unsecured": True},
    )  # fmt: skip

    async def online(wanted: bytes) -> None:
        async with asyncio.timeout(20), aiomqtt.Client("127.0.0.1", broker) as client:
            await client.subscribe("barsight/crane/online", qos=1)
            async for message in client.messages:
                if message.payload == wanted:
                    return

    with plant_run(config, 1) as process:
        for port in ports.values():
            wait_for(port)
        asyncio.run(online(b"true"))
        found = check_opcua(OpcUaSettings(port=ports["opcua"], folder=tmp_path / "opcua"))
        assert not isinstance(found, Failed) and "LET IN" in found.lines[-1] and not found.is_good
        process.kill()
        killed_s = time.monotonic()
        while any(listens(port) for port in ports.values()):
            assert time.monotonic() - killed_s < 2
        asyncio.run(online(b"false"))
        left = bytes(plc.theirs)
        time.sleep(0.35)
        assert bytes(plc.theirs) == left and left[:2] == b"\xb5\x1a"


def test_steps_by_name_claim_and_end_a_lift_once(tmp_path: Path) -> None:
    url = fill_store(tmp_path)
    settings = PlantSettings(store=StoreSource(url=url, allow_simulated=True))
    with open_store(url) as store:
        steps = LiftSteps(store, settings)
        lift = state_of_store(store, 1, allow_simulated=True).lift
        assert lift is not None
        token = take_named_step(steps, "claim", "crane", {"lift": str(lift.lift_id)})
        assert isinstance(token, str) and token.isdigit()
        for number in ("x", "-1", "9" * 20, str(lift.lift_id + 100)):
            assert isinstance(take_named_step(steps, "claim", "other", {"lift": number}), Failed)
        assert isinstance(take_named_step(steps, "claim", "other", {"lift": str(lift.lift_id)}), Failed)
        done = {"token": token, "mass_kg": 0.0, "slack_rope": False, "position_reached": True}
        assert isinstance(take_named_step(steps, "executed", "crane", done | {"slack_rope": True}), Failed)
        assert isinstance(
            take_named_step(steps, "executed", "crane", done | {"position_reached": False}), Failed
        )
        assert take_named_step(steps, "executing", "crane", {"token": token}) == token
        heavy = done | {"mass_kg": 10 * lift.mass_kg}
        assert take_named_step(steps, "executed", "crane", heavy) == token
        assert take_named_step(steps, "executed", "crane", heavy) == token, "told again, it is answered again"
        alarms = state_of_store(store, 1).alarms
    assert [(one.code, one.priority, one.is_active) for one in alarms] == [("load-contradicts", 1, True)]


def test_a_store_that_is_gone_makes_the_state_invalid(tmp_path: Path) -> None:
    url = fill_store(tmp_path)
    settings = PlantSettings(store=StoreSource(url=url, allow_simulated=True))
    with open_store(url) as store, StateFeed(store, settings) as feed:
        assert feed.newest(7).is_valid and feed.newest(7).life_counter == 7
        feed._stop.set()
        feed._thread.join()
        state, read_s = feed.read()
        feed._read = state, read_s - 1.0
        old = feed.newest(8)
        assert not old.is_valid and "state-too-old" in old.reasons[-1]


def test_a_store_that_is_away_for_a_moment_ends_no_alarm_and_brings_no_survey(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alarm = PlantAlarm("load-contradicts", 1, "lift 3", True, False)
    known, looks = replace(QUIET, alarms=(alarm,), map_id="m"), iter((True, True, False, False, True))

    def read(*_: object, **__: object) -> PlantState:
        if next(looks):
            return known
        raise InputError("store", "is locked", "wait")

    monkeypatch.setattr(feed_module, "state_of_store", read)
    feed, told = StateFeed(cast(Any, None), PlantSettings()), []
    for _ in range(4):
        before, _ = feed.read()
        feed.refresh()
        told.append([one["event"] for one in changes_between(before, feed.read()[0])])
    assert told == [[], ["validity"], [], ["validity"]]


def test_a_feed_that_ends_ends_the_plants_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error that nobody expects ended it: else a state that is too old would be served for ever."""
    looks = iter([QUIET])

    def read(*_: object, **__: object) -> PlantState:
        return next(looks)

    monkeypatch.setattr(feed_module, "read_state", read)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)

    async def serve() -> None:
        one: Any = None
        await asyncio.wait_for(serve_plant(one, PlantSettings(webhooks=WebhookSettings()), print), 10)

    with pytest.raises(OutputError, match="read no more"):
        asyncio.run(serve())


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_telegram_whose_commands_nobody_answers_any_more_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error that nobody foresaw ended the thread alone; no command would ever be answered again."""
    pipes, kept = [multiprocessing.Pipe() for _ in range(2)], list[Connection]()

    def start() -> None:
        kept.extend(Connection(os.dup(there.fileno())) for _, there in pipes)
        for word in (2000, ("claim", ())):
            kept[1].send(word)

    process = SimpleNamespace(start=start, is_alive=lambda: True, kill=lambda: None, join=lambda: None)
    given = iter(pipes)
    context = SimpleNamespace(Pipe=lambda: next(given), Process=lambda **_: process)
    monkeypatch.setattr(multiprocessing, "get_context", lambda _: context)
    feed: Any = SimpleNamespace(read=lambda: (QUIET, 0.0))

    class Steps:
        def claim(self) -> None:
            raise KeyError("what nobody foresaw")

    async def served() -> None:
        async with asyncio.timeout(5):
            await serve_telegram(TelegramSettings(), feed, cast(Any, Steps()), lambda _: None)

    with pytest.raises(OutputError, match="what answers it ended"):
        asyncio.run(served())
    for each in kept:
        each.close()


def test_a_live_run_gives_the_pose_and_may_forbid(tmp_path: Path) -> None:
    seen = with_live_run(QUIET, live_folder(tmp_path / "live"))
    assert seen.is_valid and seen.mode == "full" and seen.survey == "measuring"
    assert seen.pose is not None and seen.pose.yaw_deg == pytest.approx(90)
    newer = with_live_run(QUIET, live_folder(tmp_path / "live", stamp_ns=10_090_000_000)).pose
    assert newer is not None, "written since state.json was"
    blind = with_live_run(
        QUIET, live_folder(tmp_path / "live", may_stand=False, mode="blind", reasons=["dark"])
    )
    assert not blind.is_valid and blind.reasons == ("live-state: blind: dark",)
    assert newer.magnet_m is None
    hung = with_live_run(QUIET, live_folder(tmp_path / "live", crane_m=[2.4, 1.1, 7.0])).pose
    assert hung is not None and hung.magnet_m == (2.4, 1.1)
    for change in (
        {"frame": "world"},
        {"crane_m": [2.4]},
        {"stamp_ns": 1},
        {"stamp_ns": 11_100_000_000},
        {"sigma_m": [float("nan")] * 3},
    ):
        assert with_live_run(QUIET, live_folder(tmp_path / "live", **change)).pose is None
    for phase in ("done", "failed"):
        assert not with_live_run(QUIET, live_folder(tmp_path / "live", phase=phase)).is_valid
    (tmp_path / "live/state.json").write_text("{")
    assert "live-stopped" in with_live_run(QUIET, tmp_path / "live").reasons[0]


@pytest.mark.parametrize("ago_s", [2.0, -3600.0])
def test_a_run_that_ended_stays_so_though_the_clock_is_set_back(ago_s: float, tmp_path: Path) -> None:
    folder = live_folder(tmp_path / "live")
    assert with_live_run(QUIET, folder).is_valid
    written_s = time.time() - ago_s
    os.utime(folder / "state.json", (written_s, written_s))
    assert "live-stopped" in with_live_run(QUIET, folder).reasons[0]


def test_changes_are_told_once() -> None:
    alarm = PlantAlarm("live-stopped", 2, "no word", True, False)
    raised = replace(QUIET, alarms=(alarm,), is_valid=False, reasons=("why",), map_id="m")
    assert changes_between(QUIET, QUIET) == [] == changes_between(raised, raised)
    assert [one["event"] for one in changes_between(QUIET, raised)] == ["validity", "survey", "alarm-raised"]
    assert [one["event"] for one in changes_between(raised, QUIET)] == ["validity", "alarm-ended"]


def test_what_stands_is_told_at_the_start_as_it_may_have_changed_while_nobody_told() -> None:
    """A receiver that holds an offer from before learns that there is none."""
    alarm = PlantAlarm("live-stopped", 2, "no word", True, False)
    told = changes_between(
        None, replace(QUIET, alarms=(alarm,), is_valid=False, reasons=("why",), map_id="m")
    )
    assert [one["event"] for one in told] == ["started", "validity", "survey", "lift", "alarm-raised"]
    assert (told[1]["is_valid"], told[3]["is"]) == (False, None)


def test_no_id_of_an_earlier_process_comes_again() -> None:
    """A receiver that drops what comes twice would else drop the first changes after each start."""
    feed = SimpleNamespace(newest=lambda _: QUIET)

    async def ids() -> list[int]:
        async for _, changes in _followed(feed):  # type: ignore[arg-type]
            return [one["id"] for one in changes]
        return []

    first = asyncio.run(ids())
    time.sleep(0.02)
    both = [*first, *asyncio.run(ids())]
    assert len(both) > 2 and both == sorted(set(both)) and both[-1] < 2**53


def test_each_alarm_is_told_though_others_of_its_code_stand() -> None:
    first, second = (PlantAlarm("load-contradicts", 1, f"lift {k}", True, False) for k in (3, 5))
    one, both = replace(QUIET, alarms=(first,)), replace(QUIET, alarms=(second, first))
    (told,) = changes_between(one, both)
    assert (told["event"], told["text"]) == ("alarm-raised", "lift 5")
    acknowledged = replace(QUIET, alarms=(second, replace(first, is_acknowledged=True)))
    assert changes_between(both, acknowledged) == []
    (told,) = changes_between(acknowledged, one)
    assert (told["event"], told["text"]) == ("alarm-ended", "lift 5")
    again = replace(QUIET, alarms=(first, replace(first, is_active=False)))
    assert [one["event"] for one in changes_between(one, again)] == ["alarm-raised"]


def test_alarms_that_no_longer_fit_have_not_ended() -> None:
    alarms = tuple(PlantAlarm("bundle-gone", 2, f"B{k}", True, False) for k in range(25, 0, -1))
    full, more = replace(QUIET, alarms=alarms[1:21]), replace(QUIET, alarms=alarms[:20])
    assert [(one["event"], one["text"]) for one in changes_between(full, more)] == [("alarm-raised", "B25")]
    cleared = replace(QUIET, alarms=alarms[:3] + alarms[4:21])
    assert [(one["event"], one["text"]) for one in changes_between(more, cleared)] == [
        ("alarm-raised", "B5"), ("alarm-ended", "B22"),
    ]  # fmt: skip


def test_no_crowd_of_lesser_alarms_hides_another_or_tells_its_end() -> None:
    urgent, live = (PlantAlarm(code, k, "why", True, False) for code, k in (("store-broken", 1), ("live", 2)))
    moved = tuple(PlantAlarm("bundle-moved", 2, f"B{k}", True, False) for k in range(30, 0, -1))
    few, crowd = (replace(QUIET, alarms=told_alarms((*newer, live, urgent))) for newer in (moved[25:], moved))
    assert {urgent, live, moved[0]} <= set(crowd.alarms)
    assert {one["event"] for one in changes_between(few, crowd)} == {"alarm-raised"}
    ended = replace(QUIET, alarms=told_alarms((*moved, urgent)))
    told = [(one["event"], one["code"]) for one in changes_between(crowd, ended)]
    assert [one for one in told if one[0] == "alarm-ended"] == [("alarm-ended", "live")]


def test_active_alarms_come_before_returned_ones_of_their_priority() -> None:
    returned = [PlantAlarm("live-stopped", 2, f"crane {k}", False, False) for k in range(25)]
    active = PlantAlarm("live-stopped", 2, "crane 99", True, False)
    urgent = PlantAlarm("lift-failed", 1, "lift 3", False, False)
    assert told_alarms((*returned, active, urgent))[:3] == (urgent, active, returned[0])


def test_the_state_holds_a_limited_number_of_codes_and_those_beyond_have_not_ended() -> None:
    codes = [PlantAlarm(f"code-{k}", 2, "why", True, False) for k in range(60)]
    full = replace(QUIET, alarms=told_alarms(codes))
    assert len(full.alarms) == MAX_ALARMS + MAX_CODES
    more = replace(QUIET, alarms=told_alarms((PlantAlarm("new", 2, "why", True, False), *codes)))
    assert [(one["event"], one["code"]) for one in changes_between(full, more)] == [("alarm-raised", "new")]


def test_a_step_whose_client_was_told_that_nobody_answers_begins_nothing() -> None:
    """The process was held up; what a crane did is recorded all the same."""
    pytest.importorskip("asyncua")
    from barsight.plant.opcua.process import OpcUaProcess

    process, taken = OpcUaProcess.__new__(OpcUaProcess), list[str]()
    process._handshake = lambda step, *_: taken.append(step) or step  # type: ignore[func-returns-value]
    now_s = time.monotonic()
    for until_s in (now_s - 0.1, now_s + 60):
        for step in ("claim", "executing", "executed", "failed"):
            process._answer_one((step, "crane", {}), until_s)
    assert taken == ["executed", "failed", "claim", "executing", "executed", "failed"]


def test_another_alarm_of_a_code_is_raised_though_the_first_was_acknowledged() -> None:
    pytest.importorskip("asyncua")
    from barsight.plant.opcua.alarms import Conditions
    from barsight.plant.opcua.surveys import AlarmLine

    class Sent:
        """An emitter that keeps what it is to send, and the parent of all conditions."""

        def __init__(self) -> None:
            self.events: list[tuple[str, bool]] = []

        def make(self, _: str, text: str, severity: int, fields: dict[str, Any]) -> SimpleNamespace:
            return SimpleNamespace(EventId=b"1", said=(text, fields["AckedState/Id"].Value))

        async def send(self, event: SimpleNamespace) -> None:
            self.events.append(event.said)

        async def add_object(self, *_: object) -> SimpleNamespace:
            return SimpleNamespace(nodeid=None)

    async def shown() -> list[tuple[str, bool]]:
        sent: Any = Sent()
        conditions = Conditions(cast(Any, None), sent, sent, None, 2)
        first, second = (AlarmLine("load-contradicts", f"lift {k}", "error") for k in (3, 5))
        await conditions.show((first,))
        known = conditions._by_code["load-contradicts"]
        conditions._by_code["load-contradicts"] = replace(known, is_acknowledged=True)
        for alarms in ((first,), (second, first), (second, first)):
            await conditions.show(alarms)
        return list(sent.events)

    assert asyncio.run(shown()) == [("lift 3", False), ("lift 5", False)]


def test_a_store_that_goes_away_as_a_survey_came_ends_no_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state was read, the survey's folder can't be: that is told once the store is back."""
    pytest.importorskip("asyncua")
    from barsight.plant.links.opcua_link import serve_opcua
    from barsight.plant.opcua import process

    shown: list[Any] = []
    said: list[str] = []
    shower = SimpleNamespace(is_alive=True, is_serving=False, show=shown.append, stop=lambda: None)
    monkeypatch.setattr(process, "OpcUaProcess", lambda *_: shower)

    class Store:
        """Away for two looks."""

        def reading(self) -> Any:
            if len(shown) < 2:
                raise InputError("store", "is away", "wait")
            return nullcontext()

    monkeypatch.setattr(opcua_link, "survey_folder", lambda _, name: tmp_path / name)
    feed: Any = SimpleNamespace(newest=lambda _: replace(QUIET, map_id="m"))

    async def serve() -> None:
        store, steps = cast(Any, Store()), cast(Any, None)
        serving = asyncio.create_task(
            serve_opcua(store, OpcUaSettings(folder=tmp_path), feed, steps, said.append)
        )
        while len(shown) < 3 and not serving.done():
            await asyncio.sleep(0.05)
        assert not said  # its address is told once it listens
        shower.is_serving = True
        while not said and not serving.done():
            await asyncio.sleep(0.05)
        serving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await serving

    asyncio.run(serve())
    assert [None if one.survey is None else one.survey.folder for one in shown[:3]] == [
        None, None, tmp_path / "m",
    ]  # fmt: skip


def test_a_handshake_that_waits_for_the_store_makes_the_state_unknown() -> None:
    """Three steps that nobody answers for a second each: the state is unknown within 0.3 s, not after 3 s."""
    pytest.importorskip("asyncua")
    from barsight.plant.opcua.process import _AskedPlant

    here, there = multiprocessing.Pipe()

    async def ask() -> float:
        source = _AskedPlant(there, 0.3)
        steps = [asyncio.create_task(source.handshake("claim", "crane", {})) for _ in range(3)]
        await asyncio.sleep(0.05)
        began_s = time.monotonic()
        assert await source.told() is None
        took_s = time.monotonic() - began_s
        assert await asyncio.gather(*steps) == [None] * 3
        return took_s

    assert asyncio.run(ask()) < 0.6
    here.close()
    there.close()


def test_bad_configurations_and_keys_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "plant.toml"
    config.write_text("[store]\n")
    with pytest.raises(ConfigError, match="names no link"):
        read_plant(config)
    config.write_text("[telegram]\nport = 1\n")
    assert run(["plant", "user", "crane", "--config", str(config)]) == 2
    assert "users.json" in capsys.readouterr().err
    assert run(["plant", "check", "--config", str(config), "--key", str(config)]) == 2
    assert "--protocol" in capsys.readouterr().err
    pytest.importorskip("cryptography")
    with pytest.raises(InputError, match="not a readable private key"):
        sign_file(config, config)
    config.write_text('[mqtt]\npassword_file = "secret"\n[opcua]\nfolder = "pki"\n')
    told = read_plant(config)
    assert told.links == ("opcua", "mqtt") and told.opcua is not None and told.mqtt is not None
    assert told.opcua.folder == tmp_path / "pki" and told.mqtt.password_file == tmp_path / "secret"


@pytest.mark.parametrize("table", ["opcua", "mqtt"])
def test_no_link_may_show_a_state_for_longer_than_it_may_be_old(table: str, tmp_path: Path) -> None:
    config = tmp_path / "plant.toml"
    config.write_text(f"[{table}]\nstate_every_s = 0.31\n")
    with pytest.raises(ConfigError, match=rf"{table}\.state_every_s must lie in 0\.01\.\.\.0\.3, not 0\.31"):
        read_plant(config)


def test_files_of_secrets_that_cannot_be_are_told_at_the_start(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    pytest.importorskip("asyncua")
    from barsight.plant.link_settings import MqttSettings
    from barsight.plant.mqtt import MqttPublisher
    from barsight.plant.opcua.security.access import read_users

    (tmp_path / "empty").touch()
    MqttPublisher(MqttSettings(password_file=tmp_path / "empty"))
    for names in (
        {"password_file": tmp_path / "none"},
        {"authority": tmp_path / "none"},
        {"authority": tmp_path / "empty"},
    ):
        with pytest.raises(InputError, match=r"none|empty"):
            MqttPublisher(MqttSettings(**names))
    (tmp_path / "users.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match="deep"):
        read_users(tmp_path / "users.json")


def test_a_plc_that_was_never_reached_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    s7 = pytest.importorskip("barsight.plant.s7")
    said: list[str] = []

    def exchange(_: Any, __: int, ___: Any, take: Any, stop: Any) -> None:
        take(Failed("unreachable", "connection refused"))
        take(Failed("unreachable", "connection refused"))
        stop.wait()

    async def serve() -> None:
        feed: Any = SimpleNamespace(newest=lambda _: QUIET)
        with suppress(TimeoutError):
            await asyncio.wait_for(serve_s7(S7Settings(), feed, cast(Any, None), said.append), 0.5)

    monkeypatch.setattr(s7, "run_s7", exchange)
    asyncio.run(serve())
    assert said == ["S7 with 127.0.0.1:102: connection refused"]


def test_a_broker_that_is_away_is_told_and_a_hook_takes_nothing_before_a_post() -> None:
    said: list[str] = []
    url = f"http://127.0.0.1:{free_port()}/hook"
    states = StateFeed.__new__(StateFeed)

    async def serve() -> None:
        links = (
            _serve_mqtt(MqttSettings(port=free_port()), states, said.append),
            _serve_webhooks(WebhookSettings(urls=(url,)), states, said.append),
        )
        with suppress(TimeoutError):
            await asyncio.wait_for(asyncio.gather(*links), 3)

    with patch.object(StateFeed, "newest", lambda *_: QUIET):
        asyncio.run(serve())
    assert said.count(f"webhook {url}: each change is posted") == 1
    assert any(line.startswith("MQTT to 127.0.0.1:") and "refused" in line for line in said)
    assert not any("takes posts" in line for line in said)
