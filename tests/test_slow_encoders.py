"""Encoders that read 4 to 5 times a second place a crane; slower ones are refused by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import Failed, MeasurementError
from barsight.core.records.trajectory import Trajectory
from barsight.evaluation.trajectory_error import Drift, trajectory_drift
from barsight.motion.batch import fusion
from barsight.motion.crane.encoder_trajectory import CraneSettings, EncoderOdometry, fit_position
from barsight.motion.fixed_lag import estimator as live
from barsight.recording.formats.ground_truth import GroundTruth
from drawn_cranes import drawn_crane, drawn_senses
from motion_recordings import MemoryRecording, tell_sightings
from test_motion_live import ESTIMATORS

ROOMS = {"fused": fusion, "live": live, "crane": fusion}
MADE = {**ESTIMATORS, "crane": lambda _: EncoderOdometry(CraneSettings())}


def drawn(
    name: str, use: str, seed: int, rate_hz: float, patch: pytest.MonkeyPatch
) -> tuple[Trajectory, Drift]:
    """A drawn crane's first 30 frames, its encoders read at `rate_hz`."""
    crane = drawn_crane(seed)
    senses, read = drawn_senses(crane, seed, points=600), crane.readings
    seen, step = senses.sightings[:30], round(crane.rate_hz / rate_hz)
    tell_sightings(patch, ROOMS[name], seen)
    recording = MemoryRecording(
        senses.rig, stamps_ns=tuple(one.stamp_ns for one in seen), imu_samples=senses.imu,
        crane_samples=replace(read, stamp_ns=read.stamp_ns[::step], position_m=read.position_m[::step]),
    )  # fmt: skip
    found = MADE[name](use)(recording, Rectifier(senses.rig), lambda: None)
    drift = trajectory_drift(found, GroundTruth(np.array(recording.stamps_ns), senses.poses[:30]), 0)
    assert drift is not None
    return found, drift


@pytest.mark.parametrize("use", ["stereo,imu,crane", "stereo,crane"])
@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("seed", [20003, 20009])
def test_five_readings_a_second_place_a_crane(
    name: str, use: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, drift = drawn(name, use, seed, 5.0, monkeypatch)
    assert len(found.frames) >= 22 and not found.doubts
    most_mm = {"fused": 6, "live": 60}[
        name
    ]  # live, the first frames come before any position of the encoders
    assert drift.reference_rmse_mm < most_mm and drift.nees_position < 3


@pytest.mark.parametrize("rate_hz", [8.0, 10.0])
def test_live_waits_for_a_reading_beyond_the_frame(rate_hz: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first frames were refused: it waited for 0.06 s, and the readings come 0.1 s apart."""
    for seed in (20005, 20006, 20014, 20019):
        found, _ = drawn("live", "stereo,imu,crane", seed, rate_hz, monkeypatch)
        assert len(found.refused) <= 1 and not found.doubts  # one reading in twenty may be lost


@pytest.mark.parametrize("name", ROOMS)
def test_encoders_that_are_too_slow_are_refused_by_name(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = "apart: give at least four a second"
    if name == "fused":
        with pytest.raises(MeasurementError, match=words):
            drawn(name, "stereo,imu,crane", 20003, 2.0, monkeypatch)
        return
    crane = drawn_crane(20003)
    monkeypatch.setattr("test_slow_encoders.trajectory_drift", lambda *_: "none")
    found, _ = drawn(name, "stereo,imu,crane", 20003, 2.0, monkeypatch)
    assert not found.frames and all(words in frame.reason for frame in found.refused) and crane.fault is None


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "0 encoder readings around the frame"), (2, "2 encoder readings around"), (9, "on one side of the")],
)
def test_why_readings_place_no_frame(count: int, words: str) -> None:
    read = drawn_crane(20003).readings
    read = replace(read, stamp_ns=read.stamp_ns[:count], position_m=read.position_m[:count])
    after_ns = int(read.stamp_ns[-1]) + 1 if count else 0
    found = fit_position(read, after_ns, 350_000_000)
    assert isinstance(found, Failed) and words in found.reason and len(found.reason) < 80
