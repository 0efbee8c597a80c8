"""A crane's own readings tell of a lift where its magnet came down, took a load and put it down."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("sqlalchemy")

from barsight.core.errors import Failed
from barsight.plant import serving
from barsight.plant.feed import read_state
from barsight.plant.link_settings import S7Settings
from barsight.plant.links.running import _watch
from barsight.plant.links.s7_link import serve_s7
from barsight.plant.partner import PlcPartner
from barsight.plant.serving import TelegramServer
from barsight.plant.settings import TelegramSettings
from barsight.plant.state import PlantState, PlcReading
from barsight.plant.steps import LiftSteps, take_named_step
from barsight.plant.telegram import IN_MAGIC, pack, unpack
from barsight.store import confirmation
from barsight.store.tables import LIFT_STATES
from barsight.store.touches import Touch
from handshake_plant import CLAIM, DONE, EXECUTED, EXECUTING, FAILED, REFUSED, Plant, make_template

FIRST, SECOND = (109.0, 0.0), (118.0, 0.0)
"""Targets of the first two lifts; their tolerance is 10 mm."""
FREE = (50.0, 40.0)
ON, SLACK, REACHED = 1, 4, 8
HIGH, DOWN = 6.0, 0.5


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    one = Plant(make_template(tmp_path), tmp_path / "plant")
    yield one
    one.close()


class Driver:
    """A crane's PLC that follows its lift's handshake and sends where its magnet is."""

    def __init__(self, plant: Plant, name: str = "plc a") -> None:
        self.plant, self.name = plant, name
        self.partner = PlcPartner(name, plant.steps, 0.3)
        self.life = self.number = 0
        self.at, self.flags, self.z_m = FREE, 0, HIGH
        self.lift = {"lift_id": 0, "checksum": 0, "token": 0}

    def connect(self) -> None:
        self.partner = PlcPartner(self.name, self.plant.steps, 0.3, self.partner.begun)

    def turn(self, command: int = 0) -> int:
        """Exchange telegrams once; return the answer to the command."""
        self.plant.now_s += 0.1
        self.life, self.number = self.life + 1, self.number + bool(command)
        state = self.partner.seen(read_state(self.plant.store, self.plant.settings))
        if command == CLAIM:
            assert state.is_valid and state.lift is not None
            self.lift |= {"lift_id": state.lift.lift_id, "checksum": int(state.lift.sha256[:8], 16)}
        values = {
            "magic": IN_MAGIC, "version": 1, "life": self.life, "flags": self.flags | REACHED,
            "bridge": round(1e4 * self.at[0]), "trolley": round(1e4 * self.at[1]),
            "hoist": round(1e4 * self.z_m), "command": command, "command_number": self.number, **self.lift,
        }  # fmt: skip
        found = unpack("in", pack("in", values))
        assert not isinstance(found, Failed)
        self.partner.watch(self.partner.reading(found))
        if self.partner.receive(found):
            self.partner.execute()
        self.lift["token"] = self.partner.answer.get("token") or self.lift["token"]
        return self.partner.answer.get("answer", 0) if command else 0

    def go(self, at: tuple[float, float], z_m: float = HIGH, flags: int | None = None) -> None:
        self.travel(at, z_m)
        self.at, self.z_m = at, z_m
        self.flags = self.flags if flags is None else flags
        self.turn()

    def travel(self, at: tuple[float, float], z_m: float) -> None:
        """Send the places on the way, unless the position is lost or found again."""
        start, end = (*self.at, self.z_m), (*at, z_m)
        if not any(start) or not any(end):
            return
        flags, names = (
            {"flags": self.flags | REACHED, "clock_ns": 0, "load": 0},
            ("bridge", "trolley", "hoist"),
        )
        for part in np.linspace(0, 1, math.ceil(math.dist(start, end)), endpoint=False)[1:]:
            self.plant.now_s += 0.01
            place = (round(1e4 * (a + (b - a) * part)) for a, b in zip(start, end, strict=True))
            self.partner.watch(self.partner.reading(flags | dict(zip(names, place, strict=True))))

    def begin(self) -> int:
        assert (self.turn(), self.turn(CLAIM), self.turn(EXECUTING)) == (0, DONE, DONE)
        self.turn()
        return self.lift["lift_id"]

    def take(self, at: tuple[float, float]) -> None:
        """Travel there, lower, take the load and raise it."""
        self.go(at)
        self.go(at, DOWN, SLACK)
        self.go(at, DOWN, SLACK | ON)
        self.go(at, HIGH, ON)

    def put(self, at: tuple[float, float]) -> None:
        self.go(at)
        self.go(at, DOWN, SLACK | ON)
        self.go(at, DOWN, SLACK)
        self.go(at, HIGH, 0)


def offers(plant: Plant) -> list[int]:
    with plant.store.reading() as connection:
        lifts, newest = confirmation.open_lifts(connection), confirmation.newest_survey(connection)
    assert newest is not None
    offered = (one for one in lifts if one.survey_id == newest.id and one.state == "offered")
    return [one.record["rank"] for one in offered]


def alarms(plant: Plant) -> list[tuple[str, int, str]]:
    state = read_state(plant.store, plant.settings)
    return [(one.code, one.priority, one.text) for one in state.alarms]


def note_of(plant: Plant, lift_id: int) -> str:
    with plant.store.reading() as connection:
        rows = connection.execute(LIFT_STATES.select().where(LIFT_STATES.c.lift_id == lift_id)).all()
    return str(rows[-1].note)


def test_a_crane_that_takes_a_load_beside_its_target_has_not_made_the_lift(plant: Plant) -> None:
    """The place where it was and the planned one offer nothing, by a map begun before either."""
    crane = Driver(plant)
    lift_id = crane.begin()
    crane.take(SECOND)
    ((code, priority, text),) = alarms(plant)
    assert (code, priority) == ("lift-beside", 1) and "x 118.000" in text and "9000 mm beside" in text
    assert plant.states_of(lift_id)[-1] == "executing" and offers(plant) == [3, 4, 5, 6]
    crane.put(FREE)
    assert [crane.turn(EXECUTED), crane.turn(EXECUTED)] == [REFUSED] * 2, "again, the same"
    assert plant.states_of(lift_id) == ["offered", "claimed", "executing", "failed"]
    assert [one[0] for one in alarms(plant)] == ["lift-beside"]
    plant.survey(begun_s=0.0, offset_m=100.0)
    assert offers(plant) == [3, 4, 5, 6]
    plant.survey(offset_m=100.0)
    assert offers(plant) == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("off_m", [0.0, 0.0100, 0.0102])
def test_the_lifts_tolerance_is_what_may_be_beside(plant: Plant, off_m: float) -> None:
    crane = Driver(plant)
    lift_id = crane.begin()
    crane.take((FIRST[0], FIRST[1] - off_m))
    crane.put(FREE)
    is_made = off_m <= 0.01
    assert crane.turn(EXECUTED) == (DONE if is_made else REFUSED)
    assert [one[0] for one in alarms(plant)] == ([] if is_made else ["lift-beside"])
    assert not is_made or note_of(plant, lift_id).startswith("at its target")
    assert offers(plant) == [2, 3, 4, 5, 6]


def test_a_position_that_is_not_sent_is_unknown(plant: Plant) -> None:
    """All zeros: the lift is taken as made, as its crane says, and the store says what isn't known."""
    crane = Driver(plant)
    lift_id = crane.begin()
    for flags in (SLACK, SLACK | ON, ON, 0):
        crane.go((0.0, 0.0), 0.0, flags)
    assert crane.turn(EXECUTED) == DONE and alarms(plant) == []
    assert note_of(plant, lift_id) == "no reading of the crane told where"


def lower_only(crane: Driver) -> None:
    """The PLC sends neither magnet nor rope."""
    crane.go(SECOND)
    crane.go(SECOND, DOWN)
    crane.go(SECOND)


def slack_only(crane: Driver) -> None:
    crane.go(SECOND, HIGH, SLACK)
    crane.go(SECOND, HIGH, 0)


def on_before_lowering(crane: Driver) -> None:
    crane.go(FREE, HIGH, ON)
    crane.go(SECOND, HIGH, ON)
    crane.go(SECOND, DOWN, ON)
    crane.go(SECOND, HIGH, ON)


def after_a_vain_try(crane: Driver) -> None:
    """Nothing stuck at the target, so it was tried beside."""
    crane.take(FIRST)
    crane.put(FIRST)
    crane.take(SECOND)


@pytest.mark.parametrize("way", [lower_only, slack_only, on_before_lowering, after_a_vain_try])
def test_whatever_tells_that_the_magnet_came_down_beside(plant: Plant, way: Callable[[Driver], None]) -> None:
    crane = Driver(plant)
    crane.begin()
    way(crane)
    assert 2 not in offers(plant)
    assert crane.turn(EXECUTED) == REFUSED and [one[0] for one in alarms(plant)] == ["lift-beside"]


def stays_away(crane: Driver) -> None:
    for _ in range(3):
        crane.go(FREE, 0.0)


def stops_beside(crane: Driver) -> None:
    """The PLC sends neither magnet nor rope, nor the hoist."""
    for at in (FREE, (FIRST[0] + 0.5, FIRST[1]), FREE):
        crane.go(at, 0.0)


@pytest.mark.parametrize("begins", [True, False])
@pytest.mark.parametrize("way", [stays_away, stops_beside])
def test_a_crane_that_was_never_at_its_target_has_not_lifted(
    plant: Plant, way: Callable[[Driver], None], *, begins: bool
) -> None:
    crane = Driver(plant)
    crane.z_m = 0.0
    crane.turn()
    assert crane.turn(CLAIM) == DONE
    assert not begins or crane.turn(EXECUTING) == DONE
    way(crane)
    assert crane.turn(EXECUTED) == REFUSED
    assert plant.states_of(crane.lift["lift_id"])[-1] == ("executing" if begins else "claimed")
    assert crane.turn(FAILED) == DONE


@pytest.mark.parametrize("lost", [None, "position", "telegrams", "connection"])
def test_a_crane_that_was_at_its_target_has_lifted_whatever_was_lost(plant: Plant, lost: str | None) -> None:
    """Neither magnet nor rope are sent, nor the hoist."""
    crane = Driver(plant)
    crane.z_m = 0.0
    crane.begin()
    if lost == "telegrams":
        plant.now_s += 5
    elif lost == "connection":
        crane.connect()
        crane.turn()
        crane.turn(CLAIM)
    crane.go((0.0, 0.0) if lost == "position" else FREE, 0.0)
    if lost is None:
        crane.go(FIRST, 0.0)
    crane.go(FREE, 0.0)
    assert crane.turn(EXECUTED) == DONE and alarms(plant) == []


def on_early(crane: Driver) -> None:
    crane.go(FREE, HIGH, ON)
    crane.take(FIRST)
    crane.put(FREE)


def falters_at_set_down(crane: Driver) -> None:
    """The magnet is reversed to let go, and the rope was slack for a moment on the way."""
    crane.go((80.0, 30.0), HIGH, SLACK)
    crane.take(FIRST)
    for _ in range(3):
        crane.put(FREE)
        crane.go(FREE, DOWN, SLACK | ON)
    crane.go(FREE, HIGH, 0)


def connects_anew(crane: Driver) -> None:
    crane.take(FIRST)
    crane.connect()
    crane.put(FREE)
    crane.go(FREE, DOWN, SLACK | ON)
    crane.go(FREE, HIGH, 0)


def connects_anew_and_is_on_early(crane: Driver) -> None:
    crane.connect()
    crane.go((80.0, 20.0))
    on_early(crane)


def is_not_heard_and_is_on_early(crane: Driver) -> None:
    crane.plant.now_s += 5
    crane.go((80.0, 20.0))
    on_early(crane)


def is_not_heard_for_a_while(crane: Driver) -> None:
    crane.plant.now_s += 5
    crane.go(FIRST, HIGH, ON)
    crane.put(FREE)


def loses_its_encoders_for_a_moment(crane: Driver) -> None:
    crane.go(FIRST)
    crane.go((0.0, 0.0), 0.0, ON)
    crane.go(FIRST, HIGH, ON)
    crane.put(FREE)


def finds_the_load_higher(crane: Driver, flags: int = SLACK) -> None:
    """The magnet touches 0.2 m above the height that was told, and lays the load down lower."""
    for at, z_m in ((FIRST, DOWN + 0.2), (FREE, DOWN)):
        crane.go(at)
        crane.go(at, z_m, crane.flags | flags)
        crane.go(at, z_m, flags | (ON if at == FIRST else 0))
        crane.go(at, HIGH, crane.flags & ON)


def finds_it_higher_and_tells_no_rope(crane: Driver) -> None:
    finds_the_load_higher(crane, 0)


def finds_it_higher_and_is_on_early(crane: Driver) -> None:
    crane.go(FREE, HIGH, ON)
    finds_the_load_higher(crane)


@pytest.mark.parametrize(
    "way",
    [
        on_early, falters_at_set_down, connects_anew, is_not_heard_for_a_while,
        connects_anew_and_is_on_early, is_not_heard_and_is_on_early,
        loses_its_encoders_for_a_moment, finds_the_load_higher,
        finds_it_higher_and_tells_no_rope, finds_it_higher_and_is_on_early,
    ],
)  # fmt: skip
def test_what_is_no_lift_beside(plant: Plant, way: Callable[[Driver], None]) -> None:
    crane = Driver(plant)
    crane.begin()
    way(crane)
    assert crane.turn(EXECUTED) == DONE and alarms(plant) == []
    assert offers(plant) == [2, 3, 4, 5, 6]


def holds_something_as_it_claims(crane: Driver) -> None:
    crane.put(FREE)
    crane.take(SECOND)


@pytest.mark.parametrize(
    "way", [lower_only, slack_only, lambda crane: crane.take(SECOND), holds_something_as_it_claims]
)
def test_a_lift_that_never_begins_is_not_made_beside_its_target(
    plant: Plant, way: Callable[[Driver], None]
) -> None:
    """The PLC's program never sends `executing`."""
    crane = Driver(plant)
    crane.turn()
    if way is holds_something_as_it_claims:
        crane.take((80.0, 30.0))
    assert crane.turn(CLAIM) == DONE
    crane.turn()
    way(crane)
    assert 2 not in offers(plant)
    assert [crane.turn(EXECUTED), crane.turn(EXECUTED)] == [REFUSED] * 2
    assert plant.states_of(crane.lift["lift_id"]) == ["offered", "claimed", "failed"]
    assert [one[0] for one in alarms(plant)] == ["lift-beside"] and offers(plant) == [3, 4, 5, 6]


@pytest.mark.parametrize("before", ["nothing", "a load", "a place"])
def test_a_lift_that_never_begins_is_made_at_its_target(plant: Plant, before: str) -> None:
    """Also if the crane put another load down in between, or its magnet came down there for a moment."""
    crane = Driver(plant)
    crane.turn()
    if before == "a load":
        crane.take(FREE)
    assert crane.turn(CLAIM) == DONE
    if before == "a load":
        crane.put((80.0, 30.0))
    if before == "a place":
        crane.go((80.0, 30.0), DOWN, SLACK)
    crane.go(FREE, HIGH, 0)
    crane.take(FIRST)
    crane.put(FREE)
    assert crane.turn(EXECUTED) == DONE and alarms(plant) == [] and offers(plant) == [2, 3, 4, 5, 6]
    assert note_of(plant, crane.lift["lift_id"]).startswith("at its target")


@pytest.mark.parametrize(("at", "begins"), [(FIRST, True), (SECOND, True), (SECOND, False), (None, True)])
def test_an_opc_ua_crane_tells_where_its_magnet_was(
    plant: Plant, at: tuple[float, float] | None, *, begins: bool
) -> None:
    def step(name: str, **arguments: object) -> str | Failed:
        return take_named_step(plant.steps, name, "ann by OPC UA", arguments)

    lift = read_state(plant.store, plant.settings).lift
    assert lift is not None
    token = step("claim", lift=str(lift.lift_id))
    assert not begins or step("executing", token=token) == token
    if at is not None:
        assert step("touched", kind="grip", x_m=at[0], y_m=at[1], z_m=DOWN) == ""
        assert [one[0] for one in alarms(plant)] == (["lift-beside"] if at == SECOND and begins else [])
        assert step("touched", kind="release", x_m=FREE[0], y_m=FREE[1], z_m=DOWN) == ""
    told = step("executed", token=token, mass_kg=0.0, slack_rope=False, position_reached=True)
    assert isinstance(told, Failed) if at == SECOND else told == token
    assert [one[0] for one in alarms(plant)] == (["lift-beside"] if at == SECOND else [])
    note = "no reading of the crane told where" if at is None else "at its target"
    assert at == SECOND or note_of(plant, lift.lift_id).startswith(note)


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "grab"}, {"x_m": 118_000.0}, {"x_m": 0.0, "z_m": 0.0}, {"x_m": math.nan}, {"y_m": math.nan},
        {"x_m": 2.1e-317}, {"x_m": 1e-38, "z_m": 1e-5},
    ],
)  # fmt: skip
def test_an_opc_ua_crane_tells_no_place_that_cannot_be(plant: Plant, wrong: dict[str, object]) -> None:
    touch = {"kind": "grip", "x_m": 118.0, "y_m": 0.0, "z_m": DOWN} | wrong
    told = take_named_step(plant.steps, "touched", "ann by OPC UA", touch)
    assert isinstance(told, Failed) and "grip, release, contact, on" in str(told)
    assert offers(plant) == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("off_m", [-6.5536, 6.5536, 1.6, 500.0])
def test_a_position_that_jumps_is_left_out_until_the_crane_is_back(plant: Plant, off_m: float) -> None:
    """An encoder slips, or 16 bits are sent of 32: the load that was taken at the target counts."""
    crane = Driver(plant)
    crane.begin()
    crane.go(FIRST)
    for flags in (SLACK, SLACK | ON):
        reading = PlcReading(
            "plc a", 1, 0.0, FIRST[0] + off_m, FIRST[1], DOWN, None, bool(flags & ON), True, True
        )
        plant.now_s += 0.05
        assert "jumped by" in crane.partner.watch(reading)
    crane.go(FIRST, DOWN, SLACK | ON)
    crane.go(FIRST, HIGH, ON)
    crane.put(FREE)
    assert crane.turn(EXECUTED) == DONE and alarms(plant) == [] and offers(plant) == [2, 3, 4, 5, 6]


def test_a_load_that_is_put_down_beside_an_offer_ends_it(plant: Plant) -> None:
    """Also after the lift was reported, as a PLC may do while the load still hangs."""
    crane = Driver(plant)
    crane.begin()
    crane.take(FIRST)
    assert crane.turn(EXECUTED) == DONE and offers(plant) == [2, 3, 4, 5, 6]
    crane.put((127.9, 0.5))
    assert offers(plant) == [2, 4, 5, 6] and alarms(plant) == []


def test_a_magnet_that_takes_something_without_a_lift_ends_the_offers_there(plant: Plant) -> None:
    """A person did it, or a program that ignores the handshake; another crane's lift stays."""
    other = Driver(plant, "plc b")
    lift_id = other.begin()
    crane = Driver(plant)
    crane.turn()
    crane.take(SECOND)
    assert offers(plant) == [3, 4, 5, 6] and alarms(plant) == []
    other.take(FIRST)
    assert other.turn(EXECUTED) == DONE and note_of(plant, lift_id).startswith("at its target")


def test_a_lift_that_a_person_confirmed_and_makes_by_hand_stays_theirs(plant: Plant) -> None:
    lift = read_state(plant.store, plant.settings).lift
    assert lift is not None
    confirmation.confirm_lift(plant.store, lift.lift_id, lift.map_id, "ann")
    crane = Driver(plant)
    crane.turn()
    crane.take(FIRST)
    crane.put(FREE)
    confirmation.take_lift(plant.store, lift.lift_id, "ann")
    assert alarms(plant) == [] and offers(plant) == [2, 3, 4, 5, 6]


def test_nobody_else_reports_a_lift_beside_as_executed(plant: Plant) -> None:
    """An operator ends it on the page, for a PLC that is away."""
    crane = Driver(plant)
    lift_id = crane.begin()
    crane.take(SECOND)
    for _ in range(2):
        with pytest.raises(confirmation.BesideError, match="9000 mm beside the target"):
            confirmation.take_lift(plant.store, lift_id, "ann")
    assert plant.states_of(lift_id)[-1] == "failed" and [one[0] for one in alarms(plant)] == ["lift-beside"]


def test_a_touch_that_the_store_could_not_take_is_noted_before_the_next_step(plant: Plant) -> None:
    crane = Driver(plant)
    crane.begin()
    crane.go(SECOND)
    plant.store.fault[:] = ["locked"]
    crane.go(SECOND, DOWN, ON)
    assert alarms(plant) == []
    crane.go(SECOND, HIGH, ON)
    assert crane.turn(EXECUTED) == REFUSED and [one[0] for one in alarms(plant)] == ["lift-beside"]


def test_a_touch_that_the_store_could_not_take_lets_no_answered_command_count_again(plant: Plant) -> None:
    """The PLC leaves its command until the next one; the lift that it began was refused in mid-air."""
    crane = Driver(plant)
    crane.begin()
    plant.store.fault[:] = ["locked"]
    crane.at, crane.z_m, crane.flags = FIRST, DOWN, ON
    for _ in range(2):
        crane.number -= 1
        assert crane.turn(EXECUTING) == DONE


@pytest.mark.parametrize("pauses", [False, True])
def test_an_answer_counts_for_its_own_command_only(plant: Plant, *, pauses: bool) -> None:
    """The PLC never raises its number, or changes the command in another cycle than the number: it must not
    take the answer to its claim for that to `executing`, as the lift has not begun.
    """
    crane = Driver(plant)
    crane.turn()
    assert crane.turn(CLAIM) == DONE
    if pauses:
        crane.turn()
    crane.number -= 1
    assert crane.turn(EXECUTING) == 0
    assert plant.states_of(crane.lift["lift_id"])[-1] == "claimed"
    assert crane.turn(EXECUTING) == DONE
    assert plant.states_of(crane.lift["lift_id"])[-1] == "executing"


def test_a_touch_that_the_store_could_not_take_is_noted_without_another_step(plant: Plant) -> None:
    """Nobody claims anything, and the page offers what it ends."""
    crane = Driver(plant)
    crane.turn()
    crane.go(SECOND)
    plant.store.fault[:] = ["locked"]
    crane.go(SECOND, DOWN, SLACK)

    async def watch() -> None:
        feed = SimpleNamespace(is_alive=True)
        watching = asyncio.create_task(_watch(feed, plant.steps))  # type: ignore[arg-type]
        await asyncio.sleep(0.3)
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)

    assert 2 in offers(plant)
    asyncio.run(watch())
    assert offers(plant) == [1, 3, 4, 5, 6]


def telegrams() -> list[bytes]:
    """A magnet that is turned on at x 118 m and off 0.8 m farther."""
    steps = ((118.0, 0), (118.0, ON), (118.8, ON), (118.8, 0))
    values = [
        {"magic": IN_MAGIC, "version": 1, "life": k, "flags": flags, "bridge": round(1e4 * x_m)}
        for k, (x_m, flags) in enumerate(steps, start=1)
    ]
    return [pack("in", one) for one in values]


TOUCHED = [Touch("grip", 118.0, 0.0, 0.0), Touch("release", 118.8, 0.0, 0.0)]


class Seen:
    """State and steps for a link, that keep what it tells."""

    def __init__(self) -> None:
        self.touches: list[Touch] = []
        state = PlantState("idle", False, (), 1, 0, "none")
        self.feed = SimpleNamespace(newest=lambda _: state, refresh=lambda: None, take_reading=lambda _: None)

    def touched(self, who: str, touch: Touch) -> None:
        self.touches.append(touch)

    def executing(self, token: int, *_: object) -> int:
        return token


class SlowClaim(Seen):
    def claim(self, *_: object) -> Failed:
        time.sleep(0.5)
        return Failed("invalid", "no lift is offered")


CLAIMING = {"magic": IN_MAGIC, "version": 1, "life": 9, "command": CLAIM, "command_number": 1}
CLAIMING |= {"bridge": 1_180_000}


def test_the_telegram_tells_touches() -> None:
    seen = Seen()
    settings = TelegramSettings(port=0, cycle_s=0.02)

    async def talk() -> None:
        port = asyncio.get_running_loop().create_future()
        server = TelegramServer(seen.feed, seen, settings)  # type: ignore[arg-type]
        running = asyncio.create_task(server.run(port.set_result))
        reader, writer = await asyncio.open_connection("127.0.0.1", await port)
        for one in telegrams():
            writer.write(one)
        end_s = time.monotonic() + 20
        while len(seen.touches) < len(TOUCHED) and time.monotonic() < end_s:
            writer.write(telegrams()[-1])
            await asyncio.wait_for(reader.readexactly(98), 5)
        writer.close()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(talk())
    assert seen.touches == TOUCHED


def test_touches_at_the_end_of_a_connection_are_told() -> None:
    """They came while the store took a command, and no telegram followed."""

    seen = SlowClaim()

    async def talk() -> None:
        port = asyncio.get_running_loop().create_future()
        server = TelegramServer(seen.feed, seen, TelegramSettings(port=0))  # type: ignore[arg-type]
        running = asyncio.create_task(server.run(port.set_result))
        _, writer = await asyncio.open_connection("127.0.0.1", await port)
        for part in (pack("in", CLAIMING), b"".join(telegrams())):
            writer.write(part)
            await asyncio.sleep(0.1)
        writer.close()
        end_s = time.monotonic() + 5
        while len(seen.touches) < len(TOUCHED) and time.monotonic() < end_s:
            await asyncio.sleep(0.02)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(talk())
    assert seen.touches == TOUCHED


def test_a_crane_that_moves_by_floats_is_told_of_once() -> None:
    """Each telegram has another impossible position: ten lines a second hid all others."""
    seen, said = Seen(), list[str]()
    floats = [0x42DA0000 + 5000 * number for number in range(20)]
    moving = [pack("in", CLAIMING | {"command": 0, "life": n, "bridge": at}) for n, at in enumerate(floats)]

    async def talk() -> None:
        port = asyncio.get_running_loop().create_future()
        server = TelegramServer(seen.feed, seen, TelegramSettings(port=0), said.append)  # type: ignore[arg-type]
        running = asyncio.create_task(server.run(port.set_result))
        reader, writer = await asyncio.open_connection("127.0.0.1", await port)
        writer.write(b"".join(moving) + bytes(len(moving[0])))
        with contextlib.suppress(OSError):
            while await asyncio.wait_for(reader.read(98), 5):
                pass
        writer.close()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(talk())
    assert len(said) == 2 and "112158 m, is in no yard" in said[0] and "magic 0x0000" in said[1]


def test_a_plc_that_connects_anew_has_still_begun_its_lift(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int | None] = []

    class Partner(PlcPartner):
        def __init__(self, name: str, steps: LiftSteps, silent_s: float, lift_id: int | None = None) -> None:
            super().__init__(name, steps, silent_s, lift_id)
            begun.append(lift_id)

    monkeypatch.setattr(serving, "PlcPartner", Partner)
    seen = Seen()
    told = {
        "magic": IN_MAGIC,
        "version": 1,
        "life": 9,
        "command": EXECUTING,
        "command_number": 1,
        "lift_id": 7,
    }

    async def talk() -> None:
        port = asyncio.get_running_loop().create_future()
        server = TelegramServer(seen.feed, seen, TelegramSettings(port=0))  # type: ignore[arg-type]
        running = asyncio.create_task(server.run(port.set_result))
        for _ in range(2):
            _, writer = await asyncio.open_connection("127.0.0.1", await port)
            writer.write(pack("in", told))
            await asyncio.sleep(0.2)
            writer.close()
            await asyncio.sleep(0.3)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(talk())
    assert begun == [None, 7]


@pytest.mark.parametrize("is_slow", [False, True])
def test_s7_tells_touches(monkeypatch: pytest.MonkeyPatch, *, is_slow: bool) -> None:
    """A slow step doesn't keep the PLC from being read: after a gap nothing is known of its magnet."""
    s7 = pytest.importorskip("barsight.plant.s7")
    seen = SlowClaim() if is_slow else Seen()
    claim = [pack("in", CLAIMING)] if is_slow else []
    taken_s = []

    def run(*arguments: Callable[[object], None]) -> None:
        for one in [*claim, *telegrams()]:
            began_s = time.monotonic()
            arguments[3](s7.S7Exchange(one, 0.0, 0.0))
            taken_s.append(time.monotonic() - began_s)

    monkeypatch.setattr(s7, "run_s7", run)
    asyncio.run(serve_s7(S7Settings(), seen.feed, seen, lambda _: None))  # type: ignore[arg-type]
    assert seen.touches == TOUCHED and max(taken_s) < 0.3
