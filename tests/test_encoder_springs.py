"""Test encoders beside which the crane's body oscillates, and whose stamps jitter, as in drawn worlds."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barsight.core.records.sensor_samples import ImuSamples
from barsight.motion.crane.encoder_trajectory import reestimate_noise
from barsight.motion.crane.known_motion import KnownMotion
from barsight.motion.fixed_lag.encoder_watch import EncoderWatch
from drawn_cranes import drawn_crane, drawn_senses

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from drawn_crane_jumps import recorded_crane, told_jumps

SPRINGY = (1440, 1441, 1449, 1475)
"""Worlds whose body oscillates by 4 to 5 mm beside the encoders."""


@pytest.mark.parametrize("seed", SPRINGY)
def test_a_body_that_oscillates_beside_its_encoders_is_no_jump(seed: int) -> None:
    assert told_jumps(*recorded_crane(seed)) == ()


@pytest.mark.parametrize("seed", SPRINGY)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_jump_shows_beside_an_oscillation(seed: int, axis: int) -> None:
    crane, imu = recorded_crane(seed)
    place, middle = crane.position_m.copy(), len(crane.stamp_ns) // 2
    place[middle:, axis] += 0.03
    (jump,) = told_jumps(replace(crane, position_m=place), imu)
    assert (jump.axis, jump.kind) == (axis, "sure")
    assert abs(jump.stamp_ns - int(crane.stamp_ns[middle])) < 150_000_000
    assert jump.size_m == pytest.approx(0.03, abs=0.01)


@pytest.mark.parametrize(
    ("seed", "rate_hz", "at_s"), [(30001, 10, 12.2), (30002, 5, 3.0), (30007, 10, 17.4), (30013, 5, 3.8)]
)
def test_a_wild_reading_of_slow_encoders_is_no_jump_beside_an_oscillation(
    seed: int, rate_hz: int, at_s: float
) -> None:
    """Live, few windows took it for an oscillation of centimetres, and the rest of it for a jump of 32 to
    105 mm: five of 28 drawn cranes.
    """
    crane = drawn_crane(seed)
    imu, readings = drawn_senses(crane, seed, points=20).imu, crane.readings
    every = round(1e9 / float(np.median(np.diff(readings.stamp_ns))) / rate_hz)
    stamps, place = readings.stamp_ns[::every], readings.position_m[::every]
    now = int(stamps[0]) + round(at_s * 1e9)
    come, felt = (stamps > now - 8e9) & (stamps <= now), (imu.stamp_ns > now - 8e9) & (imu.stamp_ns <= now)
    known = KnownMotion(None, ImuSamples(imu.stamp_ns[felt], imu.gyro_radps[felt], imu.accel_mps2[felt]))
    watch = EncoderWatch()
    watch.check(reestimate_noise(replace(readings, stamp_ns=stamps[come], position_m=place[come])), known)
    assert watch.told == []
