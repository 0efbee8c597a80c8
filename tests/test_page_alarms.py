"""The alarms of the page's server: what raises and ends them, with several servers, threads and faults."""

from __future__ import annotations

import asyncio
import shutil
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import event, select

import page_yards
from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.page import watch as watching
from barsight.page.conditions import _lifted_since_seen, find_conditions, settle_alarms
from barsight.page.documents import alarm_records
from barsight.page.live import LiveFolder
from barsight.page.watch import StoreWatch
from barsight.plant.state import state_of_store
from barsight.store import confirmation, opening
from barsight.store.adding import add_survey, read_survey
from barsight.store.audit import Entry, entry
from barsight.store.confirmation import open_lifts
from barsight.store.opening import Store, open_store
from barsight.store.states import (
    acknowledge_alarm,
    alarm_state,
    raise_alarm,
    standing_alarms,
    step_alarm,
    step_lift,
)  # fmt: skip
from barsight.store.tables import ALARMS, BUNDLES, LIFT_BUNDLES, LIFT_STATES, LIFTS
from page_yards import SECOND, survey
from result_folders import summary
from yard_folders import write_folder


def wait_for(holds: Callable[[], bool], timeout_s: float = 10.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def raised(store: Store) -> Counter[str]:
    """Count how often each code was raised, whatever became of it."""
    with store.reading() as connection:
        return Counter(connection.execute(select(ALARMS.c.code)).scalars())


def test_two_servers_of_two_live_runs_do_not_alarm_by_turns(url: str, tmp_path: Path) -> None:
    with open_store(url) as store:
        servers = [StoreWatch(store, LiveFolder(tmp_path / name)) for name in ("one", "other")]
        for _ in range(5):
            for server in servers:
                server.judge()
        with store.reading() as connection:
            active = [state for code, _, state in standing_alarms(connection) if code == "live-stopped"]
    assert raised(store)["live-stopped"] == 3, "the second one's start ended the first one's alarm, once"
    assert active == ["raised", "raised", "returned"]


def test_a_server_that_lacks_the_share_ends_no_alarm_of_one_that_has_it(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_store(url) as store:
        with_share, without = StoreWatch(store), StoreWatch(store)
        for _ in range(5):
            with_share.judge()
            with monkeypatch.context() as patch:
                patch.setattr("barsight.page.conditions.is_there", lambda _: False)
                without.judge()
        assert raised(store)["survey-files"] == 1
        without.judge()
        with store.reading() as connection:
            assert ("survey-files", "returned") in {(one[0], one[2]) for one in standing_alarms(connection)}


def test_what_an_earlier_server_left_ends_though_the_first_look_failed(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opening, "WAIT_S", 0.2)
    with open_store(url) as store:
        with entry(store, watching.WHO, "alarms") as opened:
            left = [raise_alarm(opened, "live-stopped", "/old"), raise_alarm(opened, "store-broken", "row 3")]
        watch = StoreWatch(store)
        with store.writing(), pytest.raises(InputError, match="locked"):
            watch.judge()
        watch.judge()
        watch.verify()
        with store.reading() as connection:
            assert [alarm_state(connection, one) for one in left] == ["returned"] * 2


def test_a_store_that_was_changed_by_hand_offers_nothing(url: str, tmp_path: Path) -> None:
    with open_store(url) as store:
        watch = StoreWatch(store)
        watch.verify()
        with closing(sqlite3.connect(url.removeprefix("sqlite:///"))) as hand, hand:
            hand.execute("DROP TRIGGER lifts_no_update")
            hand.execute("UPDATE lifts SET record = replace(record, '\"count\": 1', '\"count\": 2')")
        with store.reading() as connection:
            assert open_lifts(connection)
        watch.verify()
        with store.reading() as connection:
            assert open_lifts(connection) == ()
        add_survey(store, read_survey(survey(tmp_path / "next", SECOND, 0.0)), "ann")
        watch.judge()
        with store.reading() as connection:
            assert open_lifts(connection) == ()


def test_alarms_alike_end_together(url: str) -> None:
    with open_store(url) as store:
        with entry(store, "plc", "alarms") as opened:
            numbers = [raise_alarm(opened, "bundle-gone", "B9") for _ in range(2)]
            acknowledge_alarm(opened, numbers[0])
        assert settle_alarms(store, set(), {"bundle-gone"}, {"bundle-gone": {"B9"}})
        with store.reading() as connection:
            assert [alarm_state(connection, one) for one in numbers] == ["cleared", "returned"]


def test_one_thread_at_a_time_judges(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The watch, and each confirmation on the page: what one has seen is noted before another one looks."""
    inside, most = 0, 0

    def slow(*arguments: object) -> object:
        nonlocal inside, most
        inside += 1
        most = max(most, inside)
        time.sleep(0.05)
        inside -= 1
        return find_conditions(*arguments)

    monkeypatch.setattr(watching, "find_conditions", slow)
    with open_store(url) as store:
        watch = StoreWatch(store)
        threads = [threading.Thread(target=watch.judge) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert most == 1


def test_a_bug_in_a_condition_ends_no_watch_and_is_told(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    is_broken = True

    def broken(*arguments: object) -> object:
        if is_broken:
            raise KeyError("passes")
        return find_conditions(*arguments)

    monkeypatch.setattr(watching, "find_conditions", broken)
    with open_store(url) as store:
        watch = StoreWatch(store)
        loop = asyncio.new_event_loop()
        watch.start(loop)
        try:
            wait_for(lambda: watch.problem == "KeyError: 'passes'")
            is_broken = False
            wait_for(lambda: watch.problem is None and "bundle-gone" in raised(store))
        finally:
            watch.stop()
            loop.close()


def test_page_and_plant_give_alarms_the_same_priority(url: str) -> None:
    wanted = {"calibration-changed": 1, "lift-failed": 1, "lift-unrecorded": 1, "survey-files": 3, "rig": 2}
    with open_store(url) as store:
        with entry(store, "ann", "alarms") as opened:
            for code in wanted:
                raise_alarm(opened, code, "why")
        with store.reading() as connection:
            page = {one["code"]: one["priority"] for one in alarm_records(connection)}
        plant = {one.code: one.priority for one in state_of_store(store, 1).alarms}
    assert page == plant == wanted


def test_alarms_alike_are_listed_once_and_acknowledged_together(url: str) -> None:
    with open_store(url) as store:
        with entry(store, "ann", "alarms") as opened:
            numbers = [raise_alarm(opened, "rig", reason) for reason in ("loose", "loose", "bent", "loose")]
            for number in numbers[:3]:
                step_alarm(opened, number, "returned")

        def listed() -> list[tuple[int, str]]:
            with store.reading() as connection:
                alarms = alarm_records(connection)
            return sorted((one["id"], one["state"]) for one in alarms if one["code"] == "rig")

        assert listed() == [(numbers[2], "returned"), (numbers[3], "raised")]
        with entry(store, "ann", "alarm acknowledged") as opened:
            acknowledge_alarm(opened, numbers[3], "tightened")
        states = ["cleared", "cleared", "returned", "acknowledged"]
        assert listed() == list(zip(numbers, states, strict=True))
        with pytest.raises(InputError, match="is cleared"), entry(store, "ann", "again") as opened:
            acknowledge_alarm(opened, numbers[0])


def test_more_alarms_may_stand_than_a_statement_has_parameters(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("barsight.page.documents.IDS_PER_QUERY", 20)
    with open_store(url) as store:

        def limit(connection: sqlite3.Connection, _: object) -> None:
            connection.setlimit(sqlite3.SQLITE_LIMIT_VARIABLE_NUMBER, 50)

        with entry(store, "ann", "alarms") as opened:
            numbers = {raise_alarm(opened, "rig", f"{k}") for k in range(60)}
        event.listen(store.engine, "connect", limit)
        store.engine.dispose()
        with store.reading() as connection:
            assert numbers <= {one["id"] for one in alarm_records(connection) if one["steps"]}


def test_only_bundles_asked_about_are_looked_up_among_the_lifted(url: str) -> None:
    with open_store(url) as store, store.writing() as connection:
        newest = confirmation.newest_survey(connection)
        assert newest is not None
        opened = Entry(connection, "ann", newest.captured_to_ns)
        lift = opened.add(LIFTS, survey_id=1, rank=1, record='{"set_down": null}')
        for number in (3, 4):
            opened.add(LIFT_BUNDLES, lift_id=lift, bundle_id=number)
        for state in ("offered", "claimed", "executed"):
            step_lift(opened, lift, state)
        gone, none = (select(BUNDLES.c.id).where(BUNDLES.c.id == number) for number in (4, 99))
        assert _lifted_since_seen(connection, newest.captured_to_ns, gone.union(none)) == {4}


def test_a_clock_that_was_set_back_behind_the_newest_survey_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A survey made then counts as older and offers nothing: page, plant and `store add` say why."""
    url = f"sqlite:///{tmp_path / 'yard.db'}"
    first = write_folder(tmp_path / "first", is_simulated=False)
    second = write_folder(tmp_path / "second", is_simulated=False, age_s=3600.0)
    assert run(["store", "add", url, str(first)]) == 0 and "isn't the newest" not in capsys.readouterr().out
    now_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() - 3000 * 10**9)
    assert run(["store", "add", url, str(second)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "it isn't the newest, so nothing of it is offered: the newest survey's frames, until 20" in told
    with open_store(url) as store:
        state = state_of_store(store, 0)
        assert state.reasons[0].startswith("map-from-the-future: ") and not state.is_valid
        StoreWatch(store).judge()
        assert raised(store)["map-from-the-future"] == 1
        monkeypatch.setattr(time, "time_ns", now_ns)
        assert not any("future" in reason for reason in state_of_store(store, 0).reasons)


def test_nothing_is_offered_while_the_newest_frames_are_ahead_of_the_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lifts whose first frames the clock had passed were offered and confirmed beside that alarm."""
    monkeypatch.setattr(page_yards, "summary", lambda: summary() | {"is_simulated": False})
    read = read_survey(survey(tmp_path / "first", SECOND, 0.0))
    url = f"sqlite:///{tmp_path / 'yard.db'}"
    with open_store(url, create=True) as store:
        add_survey(store, read, "me")
    monkeypatch.setattr(time, "time_ns", lambda: read.to_ns - 3 * 10**9 // 2)
    with open_store(url) as store:
        assert state_of_store(store, 0).lift is None
        StoreWatch(store).judge()
        with store.reading() as connection:
            assert not open_lifts(connection)
            notes = connection.execute(select(LIFT_STATES.c.note).where(LIFT_STATES.c.state == "expired"))
            assert all(note.startswith("expired: map-from-the-future") for note in notes.scalars())
        assert raised(store)["map-from-the-future"] == 1


def test_a_backup_that_is_put_back_while_nothing_runs_offers_nothing(url: str, tmp_path: Path) -> None:
    """A lift that was made since would be offered again; a store that is made anew is another one."""
    path = Path(url.removeprefix("sqlite:///"))
    backup = shutil.copy(path, tmp_path / "backup.db")

    def judge() -> list[str]:
        with open_store(url) as store:
            StoreWatch(store).judge()
            with store.reading() as connection:
                return [one.state for one in open_lifts(connection)]

    assert judge() == ["offered"] * 3
    with open_store(url) as store:
        lift = state_of_store(store, 0, allow_simulated=True).lift
        assert lift is not None
        confirmation.confirm_lift(store, lift.lift_id, lift.map_id, "ann")
        confirmation.take_lift(store, lift.lift_id, "ann")
    assert "offered" in judge()
    shutil.copy(backup, path)
    assert judge() == judge() == []
    with open_store(url) as store:
        assert raised(store)["lift-unrecorded"] == 1
    path.unlink()
    assert run(["store", "add", url, str(survey(tmp_path / "anew", SECOND, 1.0))]) == 0
    assert judge() == ["offered"] * 3
    path.with_name("yard.db.seen").write_text("no number")
    assert judge() == ["offered"] * 3
