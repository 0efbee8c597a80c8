"""Jumps of the encoders that come in a gap of pictures, before a delay is known or before a window begins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import Trajectory
from barsight.motion.crane.encoder_jumps import find_jumps
from barsight.motion.crane.encoder_trajectory import reestimate_noise
from barsight.motion.crane.known_motion import KnownMotion
from barsight.motion.fixed_lag import estimator as live
from drawn_cranes import drawn_crane, drawn_senses
from motion_recordings import MemoryRecording, tell_sightings
from spoiled_recording import late
from test_motion_live import ESTIMATORS

Gap = tuple[float, float]


def with_jump(crane: CraneSamples, at_s: float, size_m: float) -> CraneSamples:
    """The bridge's readings are off by size_m from a time on."""
    beyond = (crane.stamp_ns >= 1e9 * (at_s + 1))[:, None]
    return replace(crane, position_m=crane.position_m + np.where(beyond, [size_m, 0, 0], 0))


def live_places(
    seed: int, readings: CraneSamples, gap: Gap, patch: pytest.MonkeyPatch
) -> tuple[Trajectory, np.ndarray]:
    """A drawn crane live, without the pictures between two times: what is told, and the places' NEES (F,)."""
    senses = drawn_senses(drawn_crane(seed), seed, points=900)
    seen, poses = [], []
    for sighting, pose in zip(senses.sightings, senses.poses, strict=True):
        if not gap[0] <= sighting.stamp_ns / 1e9 - 1 <= gap[1]:
            begins = bool(seen) and sighting.stamp_ns / 1e9 - 1 > gap[1] > seen[-1].stamp_ns / 1e9 - 1
            seen.append(replace(sighting, motion=None) if begins else sighting)
            poses.append(pose)
    tell_sightings(patch, live, tuple(seen))
    recording = MemoryRecording(
        senses.rig, stamps_ns=tuple(one.stamp_ns for one in seen), imu_samples=senses.imu,
        crane_samples=readings,
    )  # fmt: skip
    found = ESTIMATORS["live"]("stereo,imu,crane")(recording, Rectifier(senses.rig), lambda: None)
    true = dict(zip(recording.stamps_ns, poses, strict=True))
    nees = []
    for frame in found.frames:
        off = frame.reference_from_body.translation - true[frame.stamp_ns].translation
        nees.append(off @ np.linalg.solve(frame.covariance[3:, 3:], off) / 3)
    return found, np.array(nees)


@pytest.mark.parametrize("seed", [20001, 20003])
def test_live_finds_a_jump_early_in_a_gap_of_pictures(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the last 2.5 s were searched: nothing was told, or a wrong scale, and NEES was 147 and 228."""
    readings = with_jump(drawn_crane(seed).readings, 7.0, 0.3)
    found, nees = live_places(seed, readings, (6.0, 11.0), monkeypatch)
    (told,) = found.doubts
    assert told.startswith("the bridge's encoder jumps by") and nees.mean() < 2


@pytest.mark.parametrize("seed", [20000, 20003])
def test_live_keeps_a_jump_when_a_delay_is_found(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was forgotten as the delay was taken off: places 85 mm off at sigmas of 2 mm, NEES 255 and 3300."""
    readings = late(with_jump(drawn_crane(seed).readings, 3.0, 0.1), 0.2)
    found, nees = live_places(seed, readings, (0.0, 0.0), monkeypatch)
    delay, jump = found.doubts
    assert "are 200 ms late" in delay and jump.startswith("the bridge's encoder jumps by")
    assert nees.mean() < 2


def test_after_a_long_gap_a_jump_is_as_known_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its size was taken as open, with no reading from before it left: sigma was 10 m from then on."""
    for seed in (20004, 20009):
        readings = with_jump(drawn_crane(seed).readings, 4.0, 0.1)
        found, nees = live_places(seed, readings, (9.0, 25.5), monkeypatch)
        sigma = [np.sqrt(np.trace(frame.covariance[3:, 3:])) for frame in found.frames[-3:]]
        assert max(sigma) < 0.03 and nees[-3:].max() < 4


@pytest.mark.parametrize("seed", [20003, 20022, 20046, 20056])
def test_a_large_jump_is_told_once_and_where_it_is(seed: int) -> None:
    """A metre showed in windows beside it too: it was told twice, or up to 0.4 s off."""
    crane = drawn_crane(seed, jump_m=1.0)
    imu = drawn_senses(crane, seed).imu
    (jump,) = find_jumps(reestimate_noise(crane.readings), KnownMotion(None, imu))
    assert crane.fault is not None
    assert abs(jump.stamp_ns - int(crane.readings.stamp_ns[crane.fault])) < 60_000_000
    assert abs(abs(jump.size_m) - 1.0) < 4 * jump.found_sigma_m < 0.01
