"""Poses between pictures: the last estimate carried on by IMU and encoders, against truth."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64
from barsight.core.records.trajectory import PosedFrame
from barsight.inertial.model import ORDINARY_NOISE
from barsight.motion.fixed_lag.propagation import ROW_NUMBERS, NavigationState, Propagator
from barsight.recording.base import Recording
from test_motion_fusion import simulated
from test_motion_live import estimator_of

LATE_NS = 150_000_000
"""A state is known so long after its picture."""


def propagated(state: NavigationState, recording: Recording, use: str, stamp_ns: int) -> PosedFrame:
    """Carry a state on to a stamp by the readings that lie between, as they come in three calls."""
    crane = recording.crane() if "crane" in use else None
    imu = recording.imu() if "imu" in use else None
    known = None
    if crane is not None:
        first, last = np.searchsorted(
            crane.stamp_ns, (state.stamp_ns - 3_000_000_000, state.stamp_ns + LATE_NS)
        )
        known = replace(
            crane, stamp_ns=crane.stamp_ns[first:last], position_m=crane.position_m[first:last]
        )  # fmt: skip
    found = Propagator(state, recording.imu_noise() or ORDINARY_NOISE, known, has_imu=imu is not None)
    edges = np.linspace(state.stamp_ns, stamp_ns, 4).astype(np.int64)
    for begin, end in pairwise(edges):
        parts: list[tuple[np.ndarray, Float64]] = []
        for samples, width in ((imu, 6), (crane, 3)):
            if samples is None:
                parts.append((np.empty(0, np.int64), np.empty((0, width))))
                continue
            inside = (samples.stamp_ns > begin) & (samples.stamp_ns <= end)
            values = samples.position_m if width == 3 else np.hstack([samples.gyro_radps, samples.accel_mps2])
            parts.append((samples.stamp_ns[inside], values[inside]))
        (imu_ns, measured), (crane_ns, places) = parts
        found.take(imu_ns, measured, crane_ns, places)
    return found.at(stamp_ns)


@pytest.mark.parametrize(
    ("use", "max_mm", "max_nees"),
    [("stereo,imu,crane", 2.5, 1.3), ("stereo,crane", 4.0, 1.3), ("stereo,imu", 6.0, 1.3)],
)
def test_the_pose_at_the_next_picture_before_it_comes(use: str, max_mm: float, max_nees: float) -> None:
    places, nees = [], []
    for seed in range(40, 46):
        recording, seen, truth = simulated(seed)
        estimator = estimator_of(recording, use, 8)
        last = None
        for sighting, true in zip(seen, truth.poses, strict=True):
            window = estimator.window
            if window is not None and window.newest is not None and last is not None:
                state = NavigationState.of(window.navigation.stamp_ns, window.navigation.row)
                posed = propagated(state, recording, use, sighting.stamp_ns)
                pose = posed.reference_from_body
                # Without encoders the frame is the first body's: what is compared is the motion since.
                step = (last[0].inverse() @ pose).translation - (last[1].inverse() @ true).translation
                places.append(step)
                off = pose.translation - true.translation
                nees.append(off @ np.linalg.solve(posed.covariance[3:, 3:], off) / 3)
            estimator.take(sighting)
            window = estimator.window
            if window is not None:
                last = (window.pose(len(window.problem.start) - 1), true)
    assert len(places) > 60
    assert 1000 * np.sqrt(np.mean(np.square(places))) < max_mm
    if "crane" in use:
        assert 0.1 < np.mean(nees) < max_nees


def test_a_state_comes_back_from_its_numbers() -> None:
    recording, seen, _ = simulated(46)
    estimator = estimator_of(recording, "stereo,imu,crane", 8)
    for sighting in seen[:4]:
        estimator.take(sighting)
    assert estimator.window is not None
    state = estimator.window.navigation
    again = NavigationState.of(state.stamp_ns, state.row)
    assert len(state.row) == ROW_NUMBERS and again.target == "yard"
    np.testing.assert_array_equal(again.row, state.row)
    assert np.linalg.eigvalsh(state.covariance).min() > 0


def test_a_jumped_encoder_moves_no_pose_and_an_attitude_turns_with_the_gyro() -> None:
    state = NavigationState.of(0, np.zeros(ROW_NUMBERS))
    body = replace(state.body, rotation=np.diag([1.0, -1, -1]))
    state = replace(state, body=body, covariance=np.eye(15) * 1e-6)
    stamps = np.arange(-20, 21) * 50_000_000
    recording = simulated(47)[0].crane()
    assert recording is not None
    crane = replace(
        recording, stamp_ns=stamps, position_m=np.random.default_rng(1).normal(0, 0.002, (41, 3)), jumps=()
    )  # fmt: skip
    moved = []
    for jump_m in (0.0, 0.5):
        found = Propagator(state, ORDINARY_NOISE, crane, has_imu=True)
        imu_ns = np.arange(1, 101) * 10_000_000
        reading = np.tile([0.0, 0, 0.2, 0, 0, -9.80665], (100, 1))
        places = np.full((10, 3), jump_m)
        found.take(imu_ns, reading, np.arange(1, 11) * 100_000_000, places)
        moved.append(found.at(1_000_000_000))
    assert np.abs(moved[0].reference_from_body.translation).max() < 0.003
    assert np.abs(moved[1].reference_from_body.translation).max() < 0.01
    turned = state.body.rotation.T @ moved[0].reference_from_body.rotation
    np.testing.assert_allclose(Rotation.from_matrix(turned).as_rotvec(), [0, 0, 0.2], atol=2e-3)


def test_encoders_lead_where_the_imu_falls_silent() -> None:
    """At 0.5 m/s the IMU's last reading is at 0.1 s; from then on the crane brakes by 0.4 m/s2."""
    state = NavigationState.of(0, np.zeros(ROW_NUMBERS))
    body = replace(state.body, rotation=np.diag([1.0, -1, -1]), velocity_mps=np.array([0.5, 0.0, 0.0]))
    state = replace(state, body=body, covariance=np.eye(15) * 1e-6)
    stamps = np.arange(-20, 21) * 50_000_000
    t = stamps / 1e9
    way = 0.5 * t - 0.2 * np.clip(t - 0.1, 0, None) ** 2
    places = np.column_stack([way, 0 * way, 0 * way]) + np.random.default_rng(1).normal(0, 0.002, (41, 3))
    crane = simulated(47)[0].crane()
    assert crane is not None
    crane = replace(crane, stamp_ns=stamps, position_m=places, jumps=())
    found = Propagator(state, ORDINARY_NOISE, crane, has_imu=True)
    imu_ns, later = np.arange(1, 11) * 10_000_000, stamps > 0
    # What it read last was a jerk: no turn and no push that would go on.
    reading = np.tile([0.0, 0.02, 0, 0.3, 0, -9.80665], (10, 1))
    found.take(imu_ns, reading, stamps[later], places[later])
    posed = found.at(1_000_000_000)
    pose, sigma = posed.reference_from_body, np.sqrt(np.diag(posed.covariance))
    assert abs(pose.translation[0] - way[-1]) < 0.01
    turned = Rotation.from_matrix(state.body.rotation.T @ pose.rotation).magnitude()
    assert turned < 0.01 and (sigma[:2] > 0.004).all()
