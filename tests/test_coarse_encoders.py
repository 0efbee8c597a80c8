"""Clean cranes whose encoders count coarsely or read slowly: neither frozen, nor mounted wrongly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import InputError
from barsight.core.records.sensor_samples import CraneSamples
from barsight.motion.batch.fault_detection import frozen_stretches
from barsight.motion.batch.sensor_agreement import refuse_contradictions
from barsight.motion.crane.encoder_jumps import find_jumps
from barsight.motion.crane.encoder_trajectory import reestimate_noise
from barsight.motion.crane.known_motion import KnownMotion
from drawn_cranes import drawn_crane, drawn_senses


def coarse(crane: CraneSamples, step_m: float, *, stated: bool = True) -> CraneSamples:
    """Readings in whole steps, whose sigma is stated or not."""
    sigma_m = float(np.hypot(crane.position_std_m, step_m / 12**0.5)) if stated else crane.position_std_m
    return replace(
        crane, position_m=np.round(crane.position_m / step_m) * step_m, position_std_m=sigma_m
    )  # fmt: skip


def slow(crane: CraneSamples, rate_hz: float) -> CraneSamples:
    every = round(1e9 / rate_hz / crane.interval_ns)
    return replace(crane, stamp_ns=crane.stamp_ns[::every], position_m=crane.position_m[::every])


@pytest.mark.parametrize("stated", [True, False])
def test_coarse_encoders_froze_nothing(stated: bool) -> None:
    """A step of 20 mm between two of 200 readings a second passed for a speed: frozen in 7 of 60 cranes, and
    in 52 where the stated sigma is finer than the steps.
    """
    for seed in (20001, 20003, 20004, 20018, 20027, 20033):
        whole = coarse(drawn_crane(seed).readings, 0.02, stated=stated)
        assert whole.resolution_m == pytest.approx(0.02)
        assert reestimate_noise(whole).position_std_m >= 0.0057
        assert frozen_stretches(whole) == []


def test_counts_of_100_mm_froze_nothing_and_a_freeze_is_found() -> None:
    """The speed before 20 of 60 standstills of a count was taken as known to 3 sigma of a reading, though two
    of them may be a count off.
    """
    for seed in (20001, 20003, 20004, 20007, 20010, 20013):
        assert frozen_stretches(coarse(drawn_crane(seed).readings, 0.1)) == []
        assert frozen_stretches(coarse(drawn_crane(seed, frozen_s=2.0).readings, 0.1))


@pytest.mark.parametrize("seed", [20004, 20014])
def test_less_than_a_count_is_no_jump(seed: int) -> None:
    """Oscillating cranes with counts of 10 mm were told to jump by 5 to 8 mm; two counts are found."""
    imu = drawn_senses(drawn_crane(seed), seed).imu
    for jump_m in (0.0, 0.02):
        read = reestimate_noise(coarse(drawn_crane(seed, jump_m=jump_m).readings, 0.01))
        jumps = find_jumps(read, KnownMotion(None, imu))
        assert [jump.kind for jump in jumps] == (["sure"] if jump_m else [])


def test_noise_shows_no_resolution() -> None:
    rng = np.random.default_rng(0)
    stamps, place = np.arange(0, 500) * 50_000_000, rng.normal(0, 1e-3, (500, 3))
    place[rng.random(500) < 0.05, 2] += 0.3
    crane = CraneSamples(stamps, place, np.zeros(3), np.eye(3), 1e-3)
    assert crane.resolution_m == 0 and reestimate_noise(crane).position_std_m < 1.2e-3
    even = np.outer(np.arange(500), [0.02, 0.02, 0])
    for place in (np.ones((500, 3)), even, (even * 5.013).round(3)):  # at rest, or at one speed in whole mm
        assert replace(crane, position_m=place).resolution_m < 0.002


@pytest.mark.parametrize("seed", [20004, 20006])
@pytest.mark.parametrize("kind", ["5 Hz", "20 mm"])
def test_slow_or_coarse_encoders_are_mounted_as_stated(seed: int, kind: str) -> None:
    """A median over five readings, a second of travel, cut off each turn by centimetres: 5 and 9 degrees."""
    crane = drawn_crane(seed)
    senses = drawn_senses(crane, seed)
    read = slow(crane.readings, 5) if kind == "5 Hz" else coarse(crane.readings, 0.02)
    given = Path("memory"), senses.sightings[:40], senses.imu
    refuse_contradictions(*given, read, Rectifier(senses.rig), 0)
    turn = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    with pytest.raises(InputError, match="wrong mounting"):
        refuse_contradictions(
            *given, replace(read, position_m=read.position_m @ turn.T), Rectifier(senses.rig), 0
        )
