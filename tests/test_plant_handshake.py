"""The handshake of a lift against a model, with kills, delays, repeats and reordering on both sides."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from hypothesis.strategies import booleans, integers, sampled_from

pytest.importorskip("sqlalchemy")

from barsight.core import wall_clock
from barsight.core.errors import Failed, InputError, OutputError
from barsight.plant.feed import read_state
from barsight.plant.handshake import LiftClaim
from barsight.plant.settings import LiveSource
from barsight.plant.state import PlantState
from barsight.plant.steps import LiftReport, LiftSteps
from barsight.store.audit import Entry, entry
from barsight.store.confirmation import begin_lift, confirm_lift, expire_stale, newest_survey, open_lifts
from barsight.store.lift_records import add_lifts
from barsight.store.tables import FLEET_SURVEYS, PROMOTIONS, SURVEYS
from handshake_plant import LIFTS, Plant, make_template

CRANES = integers(0, 1)
FAULTS = sampled_from(["", "", "", "before", "after", "locked"])


class Handshakes(RuleBasedStateMachine):
    """Disturb the plant between its cycles; `Plant` judges each lift-off, `settle` what is left."""

    folder: Path
    template: Path
    counted: Counter[str]

    def __init__(self) -> None:
        super().__init__()
        self._place = tempfile.TemporaryDirectory(dir=self.folder)
        self.plant = Plant(self.template, Path(self._place.name))

    @rule(who=CRANES, count=integers(1, 8))
    def run_well(self, who: int, count: int) -> None:
        for _ in range(count):
            self.plant.cycle(self.plant.cranes[who])

    @rule(who=CRANES, fault=FAULTS)
    def cycle(self, who: int, fault: str) -> None:
        self.plant.cycle(self.plant.cranes[who], fault)

    @rule(who=CRANES)
    def send(self, who: int) -> None:
        self.plant.send(self.plant.wire_of(self.plant.cranes[who]))

    @rule(who=CRANES, count=integers(1, 3))
    def hear(self, who: int, count: int) -> None:
        crane = self.plant.cranes[who]
        wire = self.plant.wire_of(crane)
        for _ in range(min(count, len(wire.down))):
            crane.hear(wire.down.popleft())
        wire.up.append(crane.turn())

    @rule(who=CRANES, fault=FAULTS)
    def take(self, who: int, fault: str) -> None:
        self.plant.take(self.plant.wire_of(self.plant.cranes[who]), fault)

    @rule(who=CRANES)
    def repeat(self, who: int) -> None:
        wire = self.plant.wire_of(self.plant.cranes[who])
        wire.up.extend(list(wire.up)[-1:])

    @rule(who=CRANES)
    def connect_anew(self, who: int) -> None:
        self.plant.connect(self.plant.cranes[who])

    @rule(fault=FAULTS, is_last=booleans())
    def take_late(self, fault: str, is_last: bool) -> None:
        if self.plant.lost:
            self.plant.take(self.plant.lost[-1 if is_last else 0], fault)

    @rule(who=CRANES)
    def start_cold(self, who: int) -> None:
        self.plant.forget(self.plant.cranes[who])

    @rule()
    def kill_server(self) -> None:
        self.plant.start_server()

    @rule(wait_s=sampled_from([0.05, 0.2, 0.35, 4.0, 61.0]))
    def wait(self, wait_s: float) -> None:
        self.plant.now_s += wait_s

    @rule()
    def survey(self) -> None:
        self.plant.survey()

    @rule()
    def veto(self) -> None:
        self.plant.veto()

    @invariant()
    def judge(self) -> None:
        self.plant.judge()

    def teardown(self) -> None:
        try:
            self.plant.settle()
        finally:
            self.counted.update(handshakes=self.plant.handshakes, lifted=len(self.plant.began_s))
            self.counted.update(self.plant.answers)
            self.plant.close()
            self._place.cleanup()


def run_machine(folder: Path, examples: int, steps: int, *, is_same: bool) -> Counter[str]:
    """Return the numbers of handshakes, of loads that were lifted, and of answers by their kind."""
    folder.mkdir(exist_ok=True)
    counted = Counter[str]()
    known = {"folder": folder, "template": make_template(folder), "counted": counted}
    machine = type("Machine", (Handshakes,), known)
    quiet = settings(
        max_examples=examples, stateful_step_count=steps, deadline=None, derandomize=is_same, database=None,
        suppress_health_check=list(HealthCheck), phases=[Phase.generate],
    )  # fmt: skip
    run_state_machine_as_test(machine, settings=quiet)
    return counted


def test_no_lift_is_made_twice_or_late_or_lost(tmp_path: Path) -> None:
    assert run_machine(tmp_path, 4, 20, is_same=True)["lifted"] > 10


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    one = Plant(make_template(tmp_path), tmp_path / "plant")
    yield one
    one.close()


def claimed(plant: Plant, who: str = "crane") -> LiftClaim:
    lift = offered(plant).lift
    assert lift is not None
    claim = plant.steps.claim(who, lift.lift_id)
    assert isinstance(claim, LiftClaim)
    return claim


def offered(plant: Plant) -> PlantState:
    return read_state(plant.store, plant.settings)


DID = LiftReport(True, False, None)


@pytest.mark.parametrize("change", ["survey", "veto", "age"])
def test_a_lift_that_has_begun_stays_until_it_is_reported(plant: Plant, change: str) -> None:
    claim = claimed(plant)
    assert plant.steps.executing(claim.token) == claim.token
    assert isinstance(plant.steps.executing(claim.token), Failed), "it may not begin again"
    assert offered(plant).is_valid
    plant.now_s += 61 if change == "age" else 1
    plant.survey() if change == "survey" else plant.veto() if change == "veto" else None
    state = offered(plant)
    assert not state.is_valid and state.reasons[0].startswith(f"unfinished: lift {claim.lift_id} has begun")
    with plant.store.reading() as connection:
        others = [one.lift_id for one in open_lifts(connection) if one.lift_id != claim.lift_id]
    for lift_id in others:
        assert isinstance(plant.steps.claim("other", lift_id), Failed)
    assert plant.steps.executed(claim.token, DID) == "unweighed"
    assert plant.states_of(claim.lift_id)[1:] == ["claimed", "executing", "executed"]


def test_one_lift_at_a_time_has_begun(plant: Plant) -> None:
    claim, other = claimed(plant), offered(plant)
    assert other.lift is not None and plant.steps.executing(claim.token) == claim.token
    with plant.store.reading() as connection:
        second = next(one for one in open_lifts(connection) if one.state == "offered")
    confirm_lift(plant.store, second.lift_id, second.map_id, "ann")
    with pytest.raises(InputError, match=f"lift {claim.lift_id}.*has begun"):
        begin_lift(plant.store, second.lift_id, "ann")


def test_who_confirms_a_lift_too_late_reads_that_it_is_claimed_already(plant: Plant) -> None:
    claim = claimed(plant)
    with plant.store.reading() as connection:
        lift = next(one for one in open_lifts(connection) if one.lift_id == claim.lift_id)
    with pytest.raises(InputError, match=f"lift {claim.lift_id}: is claimed already"):
        confirm_lift(plant.store, lift.lift_id, lift.map_id, "ann")


def test_a_report_is_taken_once_and_answered_again(plant: Plant) -> None:
    claim = claimed(plant)
    heavy = LiftReport(True, False, 9000.0)
    assert [plant.steps.executed(claim.token, heavy) for _ in range(2)] == ["contradicted"] * 2
    assert [one.code for one in offered(plant).alarms] == ["load-contradicts"]
    assert isinstance(plant.steps.failed(claim.token, "no"), Failed)
    claim = claimed(plant)
    assert [plant.steps.failed(claim.token, "no") for _ in range(2)] == ["failed"] * 2
    assert isinstance(plant.steps.executed(claim.token ^ 1, DID), Failed)


def test_a_lift_that_was_made_after_its_end_ends_all_offers(plant: Plant) -> None:
    claim = claimed(plant)
    plant.survey()
    assert offered(plant).is_valid
    for _ in range(2):
        assert isinstance(plant.steps.executed(claim.token, DID), Failed)
    state = offered(plant)
    assert state.lift is None and not state.is_valid
    assert [(one.code, one.priority) for one in state.alarms] == [("lift-unrecorded", 1)]


@pytest.mark.parametrize("writes_before", [0, 1])
def test_a_late_report_is_not_lost_where_the_store_was_locked(plant: Plant, writes_before: int) -> None:
    """It is answered only once the alarm is committed; until then the crane sends it again."""
    claim = claimed(plant)
    plant.survey()
    plant.store.fault[:] = ["locked"] * 2 + [""] * writes_before
    with pytest.raises(InputError, match="locked"):
        plant.steps.executed(claim.token, DID)
    assert offered(plant).alarms == () and offered(plant).lift is not None
    plant.store.fault.clear()
    assert isinstance(plant.steps.executed(claim.token, DID), Failed)
    assert [one.code for one in offered(plant).alarms] == ["lift-unrecorded"]
    assert offered(plant).lift is None


def test_a_map_begun_before_an_unrecorded_lift_was_told_offers_nothing(plant: Plant) -> None:
    claim = claimed(plant)
    plant.survey()
    plant.now_s = 20.0
    assert isinstance(plant.steps.executed(claim.token, DID), Failed)
    plant.survey(begun_s=19.0)
    assert offered(plant).lift is None
    plant.survey(begun_s=20.1)
    assert offered(plant).lift is not None


def test_a_clock_that_is_set_back_makes_no_offer_last_longer(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    def set_to(ahead_s: float) -> int:
        clock = SimpleNamespace(time_ns=lambda: round((10_000 + ahead_s) * 1e9), monotonic_ns=lambda: 0)
        monkeypatch.setattr(wall_clock, "time", clock)
        return expire_stale(plant.store, "test")

    set_to(0.0)
    plant.survey()
    claim = claimed(plant)
    assert [set_to(at_s) for at_s in (-0.9, 3600.0, 3599.1)] == [0, 0, 0]
    assert set_to(3590.0) == LIFTS and offered(plant).lift is None
    assert isinstance(plant.steps.executing(claim.token), Failed)
    plant.survey()
    claim = claimed(plant)
    assert plant.steps.executing(claim.token) == claim.token
    set_to(-3600.0)
    assert plant.states_of(claim.lift_id)[-1] == "executing"
    assert plant.steps.executed(claim.token, DID) == "unweighed"


@pytest.mark.parametrize("put", [shutil.copyfile, os.replace])
def test_a_lift_is_not_offered_again_by_a_backup_from_before_it(
    plant: Plant, tmp_path: Path, put: Callable[[Path, Path], object]
) -> None:
    path = tmp_path / "plant" / "yard.db"
    backup = Path(shutil.copy(path, tmp_path / "backup.db"))
    claim = claimed(plant)
    assert plant.steps.executing(claim.token) == claim.token
    assert plant.steps.executed(claim.token, DID) == "unweighed"
    assert expire_stale(plant.store, "test") == 0
    put(backup, path)
    shown = offered(plant).lift
    assert shown is not None
    with contextlib.suppress(OutputError):  # of a file that isn't in its place any more
        assert isinstance(plant.steps.claim("crane", shown.lift_id), Failed)
    expire_stale(plant.store, "test")
    state = offered(plant)
    assert state.lift is None and [one.code for one in state.alarms] == ["lift-unrecorded"]
    plant.survey(begun_s=plant.now_s - 1.0)
    assert offered(plant).lift is None, "a map that was begun before offers nothing"
    plant.survey(begun_s=plant.now_s + 1.0)
    assert offered(plant).lift is not None


def promote_newest(plant: Plant) -> None:
    """Switch to a fleet's version that measured the newest survey's recording anew."""
    with entry(plant.store, "ann", "promote", plant.now_ns) as opened:
        old = newest_survey(opened.connection)
        assert old is not None
        columns = {name: value for name, value in old._mapping.items() if name != "id"}
        opened.add(SURVEYS, **columns | {"map_id": "anew", "heights": b""})
        opened.add(FLEET_SURVEYS, version="v", map_id="anew", is_own=True)
        opened.add(PROMOTIONS, version="v", who="ann", at_ns=opened.at_ns)


def test_a_lift_stays_begun_if_its_recording_is_measured_anew_and_promoted(plant: Plant) -> None:
    claim = claimed(plant)
    plant.now_s = 10.0
    plant.steps.executing(claim.token)
    promote_newest(plant)
    assert offered(plant).reasons[0].startswith(f"unfinished: lift {claim.lift_id} has begun")
    plant.survey(begun_s=9.0, offset_m=100.0)
    state = offered(plant)
    assert not state.is_valid and state.lift is not None and state.lift.lift_id == claim.lift_id
    assert ranks_offered(plant) == [2, 3, 4, 5, 6]
    assert plant.steps.executed(claim.token, DID) == "unweighed"


def test_a_claim_ends_if_its_recording_is_measured_anew_and_promoted(plant: Plant) -> None:
    claim = claimed(plant)
    promote_newest(plant)
    assert isinstance(plant.steps.executing(claim.token), Failed)
    assert isinstance(plant.steps.executed(claim.token, DID), Failed)
    assert [one.code for one in offered(plant).alarms] == ["lift-unrecorded"]


@pytest.mark.parametrize("end", ["executed", "failed"])
def test_a_map_from_before_a_lift_offers_nothing_beside_it(plant: Plant, end: str) -> None:
    claim = claimed(plant)
    plant.now_s = 10.0
    plant.steps.executing(claim.token)
    plant.now_s = 20.0
    told = (
        plant.steps.executed(claim.token, DID) if end == "executed" else plant.steps.failed(claim.token, "no")
    )
    assert not isinstance(told, Failed)
    plant.survey(begun_s=15.0, offset_m=100.0)  # lifts at the same places as the first survey's
    assert ranks_offered(plant) == [2, 3, 4, 5, 6]
    plant.survey(begun_s=20.1, offset_m=100.0)
    assert ranks_offered(plant) == [1, 2, 3, 4, 5, 6]


def test_a_place_that_a_load_was_put_on_is_told_to_no_other_lift(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = plant._lift
    there = {"x_m": 400.0, "y_m": 0.0, "z_m": 0.0, "yaw_deg": 0.0}
    put = {1: there, 4: there}
    monkeypatch.setattr(plant, "_lift", lambda rank, at_m: plain(rank, at_m) | {"set_down": put.get(rank)})
    plant.survey()
    claim = claimed(plant)
    plant.steps.executing(claim.token)
    assert plant.steps.executed(claim.token, DID) == "unweighed"
    assert ranks_offered(plant) == [2, 3, 5, 6]


def test_poles_beside_the_beam_end_the_lifts_that_they_come_near(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lift 2 is 2.5 m beside lift 1: the beams are 1 m wide, the poles reach 1.05 m to either side."""
    plain = plant._lift
    near = plain(1, 0.0)["target"] | {"x_m": 11.5}  # type: ignore[operator]
    monkeypatch.setattr(
        plant, "_lift", lambda rank, _: plain(rank, 0.0) | ({"target": near} if rank == 2 else {})
    )
    poles = [{"along_m": 0.0, "across_m": side, "length_m": 0.1, "width_m": 0.1} for side in (-1.0, 1.0)]

    def add(
        opened: Entry, survey_id: int, content: dict[str, Any], *ids: dict[int, int], **more: bool
    ) -> None:
        content["magnet"]["poles"] = poles
        add_lifts(opened, survey_id, content, *ids, **more)

    monkeypatch.setattr("handshake_plant.add_lifts", add)
    plant.survey()
    claim = claimed(plant)
    plant.steps.executing(claim.token)
    assert plant.steps.executed(claim.token, DID) == "unweighed"
    assert ranks_offered(plant) == [3, 4, 5, 6]


def ranks_offered(plant: Plant) -> list[int]:
    with plant.store.reading() as connection:
        newest = max(one.survey_id for one in open_lifts(connection))
        return [one.record["rank"] for one in open_lifts(connection) if one.survey_id == newest]


def test_a_live_run_that_forbids_lifts_lets_none_begin(plant: Plant, tmp_path: Path) -> None:
    claim = claimed(plant)
    live = replace(plant.settings, live=LiveSource(tmp_path / "live"))
    assert isinstance(LiftSteps(plant.store, live).executing(claim.token), Failed)
    assert plant.states_of(claim.lift_id)[-1] == "claimed"


def test_a_command_is_taken_again_where_the_store_was_locked(plant: Plant) -> None:
    crane = plant.cranes[0]
    while crane.phase != "lifting":
        plant.cycle(crane)
    plant.cycle(crane, "locked")
    assert crane.phase == "executed" and plant.states_of(crane.lift["lift_id"])[-1] == "executing"
    plant.cycle(crane)
    assert plant.states_of(crane.lift["lift_id"])[-1] == "executed"


@pytest.mark.slow
def test_ten_thousand_handshakes(tmp_path: Path) -> None:
    counted = Counter[str]()
    while counted["handshakes"] < 10_000:
        counted += run_machine(tmp_path / str(counted["handshakes"]), 50, 60, is_same=False)
        print(dict(counted), flush=True)
