"""Encoders with late stamps: the delay is found by the IMU and taken off; live, it is named as a doubt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64, Int64
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.records.trajectory import Trajectory
from barsight.evaluation.trajectory_error import Drift, trajectory_drift
from barsight.inertial.model import ORDINARY_NOISE
from barsight.motion.batch import fusion
from barsight.motion.batch.camera_offset import camera_doubts
from barsight.motion.crane.encoder_delay import find_delay
from barsight.motion.fixed_lag import estimator as live
from barsight.motion.fixed_lag.delay_watch import DelayWatch
from barsight.motion.fixed_lag.sensor_buffer import SensorBuffer
from barsight.motion.frontend.sightings import Sighting
from barsight.recording.formats.ground_truth import GroundTruth
from drawn_cranes import drawn_crane, drawn_senses
from motion_recordings import MemoryRecording, tell_sightings
from spoiled_recording import late
from test_motion_live import ESTIMATORS


def drawn(
    name: str, seed: int, late_s: float, patch: pytest.MonkeyPatch, factor: float = 1.0,
    spoil: Callable[[CraneSamples], CraneSamples] = lambda crane: crane, cameras_late_s: float = 0.0,
) -> tuple[Trajectory, Drift]:  # fmt: skip
    """A drawn crane that oscillates, its encoders stamped `late_s` late and its bridge read `factor` times as
    far, by all sensors.
    """
    crane = drawn_crane(seed)
    senses = drawn_senses(crane, seed, points=600)
    seen = cameras_late(senses.sightings[:40], cameras_late_s)
    tell_sightings(patch, {"fused": fusion, "live": live}[name], seen)
    read = crane.readings
    place = read.position_m[:1] + (read.position_m - read.position_m[:1]) * [factor, 1.0, 1.0]
    recording = MemoryRecording(
        senses.rig, stamps_ns=tuple(one.stamp_ns for one in seen), imu_samples=senses.imu,
        crane_samples=spoil(late(replace(read, position_m=place), late_s)),
    )  # fmt: skip
    found = ESTIMATORS[name]("stereo,imu,crane")(recording, Rectifier(senses.rig), lambda: None)
    drift = trajectory_drift(found, GroundTruth(np.array(recording.stamps_ns), senses.poses[:40]), 0)
    assert drift is not None
    return found, drift


@pytest.mark.parametrize("seed", [20000, 20001])
def test_late_encoders_of_a_crane_that_oscillates_are_put_right(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They seemed to jump 80 to 180 times, and places were 40 to 60 mm off."""
    found, drift = drawn("fused", seed, 0.2, monkeypatch)
    assert not found.doubts and "the encoders are " in " ".join(found.warnings)
    assert drift.reference_rmse_mm < 2 and drift.nees_position < 3


@pytest.mark.parametrize("late_s", [0.5, -0.5])
def test_a_delay_that_no_encoder_has_is_a_wrong_clock(late_s: float) -> None:
    """It was taken off without a word: what the crane tells of its lifts is off by it too."""
    for seed in range(20020, 20024):
        crane = drawn_crane(seed)
        (told,) = find_delay(late(crane.readings, late_s), drawn_senses(crane, seed).imu).doubts
        assert f"{'late' if late_s > 0 else 'early'} against the IMU: a wrong clock" in told


@pytest.mark.parametrize(("seed", "late_s"), [(20000, 0.2), (20009, 0.2), (20003, -0.2)])
def test_live_says_that_encoders_are_late(seed: int, late_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """With those that are early, most frames were refused."""
    found, drift = drawn("live", seed, late_s, monkeypatch)
    (told,) = found.doubts
    assert drift.nees_position < 2  # those from before are wide: it was 15 to 90
    assert f"the encoders are 200 ms {'late' if late_s > 0 else 'early'}" in told and not found.refused
    late_on = found.frames[len(found.frames) // 2 :]
    crane = drawn_crane(seed)
    off = [f.reference_from_body.translation - crane.path(f.stamp_ns / 1e9 - 1) for f in late_on]
    assert np.linalg.norm(off, axis=1).max() < 0.02


def test_live_widens_what_it_placed_before_it_knew_a_scale_again_after_a_delay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The scale is known at 3.9 s, the delay at 5.2 s, and the scale anew at 8.1 s: places between were up to
    68 mm off, with an NEES of 80.
    """
    found, drift = drawn("live", 20009, 0.1, monkeypatch, 1.02)
    assert len(found.doubts) >= 2 and drift.nees_position < 1.5


def test_live_takes_what_is_not_late_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    for late_s in (0.0, 0.04):
        found, drift = drawn("live", 20003, late_s, monkeypatch)
        assert not found.doubts and drift.nees_position < 2


@pytest.mark.parametrize("fault", [{}, {"jump_m": 0.1}, {"frozen_s": 1.0}])
def test_a_delay_is_found_and_none_invented(fault: dict[str, float]) -> None:
    """Other faults neither make a delay nor hide it: with a freeze, 2 of 24 were found."""
    found = []
    for seed in range(20020, 20032):
        crane = drawn_crane(seed, **fault)
        imu = drawn_senses(crane, seed).imu
        assert find_delay(crane.readings, imu).late_s == 0
        taken_s = [find_delay(late(crane.readings, s), imu).late_s for s in (-0.2, 0.2)]
        found += [abs(taken_s[0] + 0.2) < 0.03, abs(taken_s[1] - 0.2) < 0.03]
    assert sum(found) >= 0.9 * len(found)


@pytest.mark.parametrize(
    ("speed_mps", "swing_m", "noise_mps2"), [(0, 0.005, 0.02), (0.3, 0, 0.2), (0, 0, 0.2)]
)
def test_encoders_that_show_no_acceleration_are_not_late(
    speed_mps: float, swing_m: float, noise_mps2: float
) -> None:
    """A crane that stands or goes on evenly, its body swinging or the IMU noisy: live said 0.4 to 0.58 s late
    or early, since some delay always fits the IMU's own errors best.
    """
    for seed in range(8):
        rng, felt_s, read_s = np.random.default_rng(seed), np.arange(0, 14, 1 / 200), np.arange(0, 14, 1 / 20)
        force = rng.normal(0, noise_mps2, (len(felt_s), 3)) + np.array([0, 0, 9.80665])
        force[:, 0] -= swing_m * np.pi**2 * np.sin(np.pi * felt_s)
        place = np.outer(read_s, [speed_mps, 0, 0]) + rng.normal(0, 5e-4, (len(read_s), 3))
        imu = ImuSamples(in_ns(felt_s), rng.normal(0, 2e-3, force.shape), force)
        crane = CraneSamples(in_ns(read_s), place, np.zeros(3), np.eye(3), 1e-3)
        watch = DelayWatch()
        for end in range(6, 15):
            assert not watch.check(SensorBuffer(crane, imu, ORDINARY_NOISE).between(0, end * 10**9))


def arrived(crane: CraneSamples, seed: int, first_s: float = 0.05, last_s: float = 0.3) -> CraneSamples:
    """Readings stamped when they arrive, each with another delay, in order."""
    delay_s = np.random.default_rng(seed).uniform(first_s, last_s, len(crane.stamp_ns))
    stamps = np.maximum.accumulate(crane.stamp_ns + (1e9 * delay_s).astype(np.int64))
    return replace(crane, stamp_ns=stamps + 1000 * np.arange(len(stamps)))


@pytest.mark.parametrize("name", ["fused", "live"])
@pytest.mark.parametrize("seed", [20000, 20009])
def test_times_of_arrival_are_doubted(name: str, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Crane 20009 was told to be 189 ms late and no more: 39 mm off, with an NEES of 23."""
    found, _ = drawn(name, seed, 0.0, monkeypatch, spoil=lambda crane: arrived(crane, seed))
    assert any("stamp them when they are taken" in doubt for doubt in found.doubts)


@pytest.mark.parametrize("fault", [{}, {"jump_m": 0.1}, {"frozen_s": 1.0}])
def test_stamps_of_measurement_are_not_doubted(fault: dict[str, float]) -> None:
    """Nor are those that scatter by less than a crane moves noticeably in."""
    for seed in range(20040, 20048):
        crane = drawn_crane(seed, **fault)
        imu = drawn_senses(crane, seed).imu
        assert not find_delay(late(crane.readings, 0.2), imu).doubts
        assert not find_delay(arrived(crane.readings, seed, 0.0, 0.02), imu).doubts


def cameras_late(seen: Sequence[Sighting], late_s: float) -> tuple[Sighting, ...]:
    return tuple(replace(one, stamp_ns=one.stamp_ns + round(1e9 * late_s)) for one in seen)


@pytest.mark.parametrize("name", ["fused", "live"])
def test_cameras_on_another_clock_are_doubted(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Live said nothing at 22 to 28 mm off, with an NEES of 5 to 7."""
    found, _ = drawn(name, 20003, 0.0, monkeypatch, cameras_late_s=0.06)
    (told,) = [doubt for doubt in found.doubts if "timeshift_cam_imu" in doubt]
    late_ms = int(told.split(" ms late")[0].split()[-1])
    assert 45 < late_ms < 75


@pytest.mark.parametrize("crane_late_s", [0.0, 0.15])
def test_cameras_are_doubted_where_they_are_late_alone(crane_late_s: float) -> None:
    told: dict[float, int] = {0.0: 0, 0.06: 0, -0.1: 0}
    for seed in range(20060, 20072):
        crane = drawn_crane(seed)
        senses = drawn_senses(crane, seed)
        read, rectifier = late(crane.readings, crane_late_s), Rectifier(senses.rig)
        search = find_delay(read, senses.imu)
        for late_s in told:
            seen = cameras_late(senses.sightings[:40], late_s)
            told[late_s] += bool(camera_doubts(seen, rectifier, 0, read, search))
            assert camera_doubts(seen[:5], rectifier, 0, read, search) == ()
            assert camera_doubts(seen, rectifier, 0, read, find_delay(read, None)) == ()
    assert told[0.0] == 0 and told[0.06] >= 8 and told[-0.1] >= 10


def in_ns(seconds: Float64) -> Int64:
    return (1e9 * (seconds + 1)).astype(np.int64)


def test_without_an_imu_nothing_is_told() -> None:
    readings = drawn_crane(20000).readings
    assert find_delay(readings, None).late_s == 0
    for count in (0, 1):
        few = replace(readings, stamp_ns=readings.stamp_ns[:count], position_m=readings.position_m[:count])
        assert find_delay(few, drawn_senses(drawn_crane(20000), 20000).imu).late_s == 0


def test_live_goes_on_where_encoders_have_not_begun_or_have_ended() -> None:
    """The frame ended the whole run."""
    crane = drawn_crane(20000)
    watch, stamps = DelayWatch(), crane.readings.stamp_ns
    buffer = SensorBuffer(crane.readings, drawn_senses(crane, 20000).imu, ORDINARY_NOISE)
    for begin_ns, end_ns in ((0, stamps[0]), (stamps[-1] + 1, stamps[-1] + 10**9)):
        assert not watch.check(buffer.between(int(begin_ns), int(end_ns)))
