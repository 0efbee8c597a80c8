"""Freezes of single encoders: what is one, and how long it lasts."""

from dataclasses import replace

import numpy as np
import pytest

from barsight.core.records.sensor_samples import CraneSamples
from barsight.live.modes import FreezeWatch
from barsight.motion.batch.fault_detection import frozen_now, frozen_stretches, merge_stretches
from barsight.motion.crane.known_motion import KnownMotion
from barsight.motion.fixed_lag.encoder_watch import EncoderWatch
from drawn_cranes import drawn_crane


@pytest.mark.parametrize(("rate_hz", "accel"), [(5, 0.7), (8, 1.0), (10, 1.5), (20, 2.0)])
def test_a_trolley_that_stops_while_the_bridge_travels_on_froze_nothing(rate_hz: float, accel: float) -> None:
    for phase in range(16):
        time = np.arange(0, 30, 1 / rate_hz) + 0.013 * phase
        bridge = np.clip(np.minimum(time - 1, 29 - time) * 0.3, 0, 0.6)
        ways = ((3, 8 + 0.1 * phase, 1), (12, 17, -1), (20, 26, 1))
        trolley = sum(np.clip(np.minimum(time - a, b - time) * accel, 0, 0.5) * sign for a, b, sign in ways)
        place = np.column_stack([*np.cumsum([bridge, trolley], axis=1) / rate_hz, 0 * time + 8]).round(3)
        crane = CraneSamples((time * 1e9).astype(np.int64), place, np.zeros(3), np.eye(3), 0.001)
        assert frozen_stretches(crane) == [] and not frozen_now(crane).any()
        watch = FreezeWatch(crane)
        ends = np.searchsorted(time, np.arange(9, 20, 0.5))
        assert not any(watch.check(crane.stamp_ns[:end], place[:end]) for end in ends.tolist())


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("rate_hz", [5, 20, 100])
def test_one_encoder_alone_that_is_still_frozen_is_found(axis: int, rate_hz: float) -> None:
    """At a fair speed, and the bridge, which brakes gently, at a slow one too."""
    for speed_mps in (0.2, 0.4) if axis == 0 else (0.4,):
        for seed in range(4):
            time = np.arange(0, 13, 1 / rate_hz)
            place = 0.1 * time[:, None] * [1, 1, 1]
            place[:, axis] = speed_mps * time
            place = (place + np.random.default_rng(seed).normal(0, 0.001, place.shape)).round(4)
            place[time > 10 + 0.1 * seed, axis] = place[np.searchsorted(time, 10 + 0.1 * seed), axis]
            crane = CraneSamples((time * 1e9).astype(np.int64), place, np.zeros(3), np.eye(3), 0.001)
            assert frozen_now(crane).tolist() == [one == axis for one in range(3)]


@pytest.mark.parametrize("seed", [20061, 20095, 20154])
def test_two_wild_readings_beside_a_stand_are_no_freeze(seed: int) -> None:
    assert frozen_stretches(drawn_crane(seed).readings) == []


@pytest.mark.parametrize("speed_mps", [0.25, 0.6])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_freeze_goes_on_where_an_axis_that_stood_starts(axis: int, speed_mps: float) -> None:
    """One axis is frozen from 8 to 14 s, the other stands until 10.5 s: told once, and one gap."""
    time, rng = np.arange(0, 20, 0.05), np.random.default_rng(0)
    going = np.cumsum(np.clip((time - 1) * 0.4, 0, speed_mps)) * 0.05 + rng.normal(0, 0.0005, time.size)
    going[(time >= 8) & (time < 14)] = going[time >= 8][0]
    starting = np.cumsum(np.clip((time - 10.5) * 0.4, 0, 0.3)) * 0.05
    place = np.column_stack([*((going, starting) if axis == 0 else (starting, going)), 0 * time + 8]).round(4)
    crane = CraneSamples((time * 1e9).astype(np.int64), place, np.zeros(3), np.eye(3), 0.001)
    watch = EncoderWatch()
    for now in np.arange(7, 19, 0.1):
        part = (time <= now) & (time > now - 7)
        watch.check(replace(crane, stamp_ns=crane.stamp_ns[part], position_m=place[part]), KnownMotion())
    ((begin, end),) = watch.frozen
    assert 8.0e9 <= begin < 8.1e9 and 13.9e9 < end <= 14.0e9
    assert not any(jump.kind == "sure" and jump.stamp_ns > 13e9 for jump in watch.told)
    freezes = [(jump.stamp_ns, jump.axis) for jump in watch.told if jump.kind == "freeze"]
    assert len(freezes) == len(set(freezes))


def test_freezes_that_overlap_are_one() -> None:
    parts = [(5, 9, (0,)), (3, 6, (1,)), (9, 12, (0, 1, 2)), (9, 12, (2,)), (14, 15, (1,))]
    assert merge_stretches(parts) == [(3, 12, (2,)), (14, 15, (1,))]
