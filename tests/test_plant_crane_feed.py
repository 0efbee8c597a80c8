"""Readings of a crane's PLC reach the state, and a claim that isn't begun in time ends."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("sqlalchemy")

from barsight.core.errors import Failed
from barsight.plant import feed as feed_module
from barsight.plant.crane_names import is_crane
from barsight.plant.feed import StateFeed
from barsight.plant.handshake import LiftClaim, expire_claims
from barsight.plant.partner import PlcPartner
from barsight.plant.settings import LiveSource, PlantCrane, PlantSettings, StoreSource
from barsight.plant.steps import LiftSteps
from barsight.plant.telegram import out_values, unpack
from barsight.store import confirmation
from barsight.store.opening import Store, open_store
from barsight.store.states import lift_state
from plant_commands import IN, yard_store

FLAGS = 1 | 2 | 8  # magnet on, load weighed, position reached


def settings_of(url: str) -> PlantSettings:
    return PlantSettings(store=StoreSource(url=url, allow_simulated=True), crane=PlantCrane(0.002))


def test_encoders_load_and_clock_of_the_plc_are_in_the_state(tmp_path: Path) -> None:
    url = yard_store(tmp_path)
    settings = settings_of(url)
    content = IN.pack(
        0xB51B, 1, 1, FLAGS, time.time_ns() + 10**9, 125000, -25000, 30000, 17374, 0, 0, 0, 0, 0
    )
    found = unpack("in", content)
    assert not isinstance(found, Failed)
    with open_store(url) as store:
        feed = StateFeed(store, settings)
        feed.take_reading(PlcPartner("plc a", LiftSteps(store, settings), 0.3).reading(found))
        feed.refresh()
        state = feed.newest(1)
        assert state.plc is not None and state.pose is not None
        assert state.plc.clock_offset_s == pytest.approx(1, abs=0.5)
        assert (state.plc.load_kg, state.plc.is_magnet_on, state.plc.is_rope_slack) == (1737.4, True, False)
        pose = state.pose
        assert (pose.x_m, pose.y_m, pose.z_m, pose.yaw_deg, pose.sigma_m) == (
            12.5,
            -2.5,
            3.0,
            None,
            (0.002,) * 3,
        )
        feed.take_reading(replace(state.plc, bridge_m=0.0, trolley_m=0.0, hoist_m=0.0))
        feed.refresh()
        assert feed.newest(1).plc is not None and feed.newest(1).pose is None  # no position was sent
        with_live = StateFeed(store, replace(settings, live=LiveSource(tmp_path)))
        with_live.take_reading(state.plc)
        with_live.refresh()
        assert with_live.newest(1).pose is None  # the live run tells the pose, and tells none
        feed._plc = time.monotonic() - 2, state.plc
        feed.refresh()
        assert feed.newest(1).plc is None and feed.newest(1).pose is None


def test_a_cranes_claim_that_is_not_begun_in_time_ends(tmp_path: Path) -> None:
    """Its token is dead then; a person's confirmation stays, and so does a lift that has begun."""
    url = yard_store(tmp_path)
    settings = settings_of(url)
    with open_store(url) as store:
        steps = LiftSteps(store, settings)

        def claim(who: str) -> LiftClaim:
            feed = StateFeed(store, settings).newest(1)
            assert feed.lift is not None and out_values(feed, {})["alarms"] == 0
            made = steps.claim(who, feed.lift.lift_id)
            assert isinstance(made, LiftClaim)
            return made

        first = claim("plc a")
        assert expire_claims(store, "test", 3600, is_crane) == 0
        assert expire_claims(store, "test", -1, is_crane) == 1
        assert isinstance(steps.executing(first.token), Failed)
        second = claim("crane by OPC UA")
        assert steps.executing(second.token) == second.token
        assert expire_claims(store, "test", -1, is_crane) == 0
        assert steps.failed(second.token, "tried") == "failed"
        assert not is_crane("ann (operator)")
        with store.reading() as connection:
            assert lift_state(connection, first.lift_id) == "expired"


def test_the_feed_ends_overdue_claims_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feed_module, "JUDGE_EVERY_S", 0.05)
    url = yard_store(tmp_path)
    settings = replace(settings_of(url), store=StoreSource(url=url, allow_simulated=True, claim_s=1))
    with open_store(url) as store, StateFeed(store, settings) as feed:
        lift = feed.newest(1).lift
        assert lift is not None
        assert isinstance(LiftSteps(store, settings).claim("plc a", lift.lift_id), LiftClaim)
        end_s = time.monotonic() + 20
        while (told := feed.newest(1).lift) is None or told.lift_id == lift.lift_id:
            assert time.monotonic() < end_s
            time.sleep(0.05)


def test_an_offer_whose_time_is_over_stays_so_though_the_clock_is_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed_module, "JUDGE_EVERY_S", 0.05)
    url = yard_store(tmp_path)
    with open_store(url) as store, StateFeed(store, settings_of(url)) as feed:
        assert feed.newest(1).is_valid
        with monkeypatch.context() as later:
            clock = SimpleNamespace(time_ns=lambda: time.time_ns() + 86400 * 10**9)
            later.setattr(confirmation, "time", clock)
            end_s = time.monotonic() + 20
            while offers(store):
                assert time.monotonic() < end_s
                time.sleep(0.05)
        feed.refresh()
        assert feed.newest(1).lift is None


def offers(store: Store) -> int:
    with store.reading() as connection:
        return len(confirmation.open_lifts(connection))
