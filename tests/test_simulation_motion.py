"""The crane's way and what IMU and encoders make of it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.simulation.sensors import GRAVITY_MPS2, exact_imu, record_encoders, record_imu, seconds, stamps
from barsight.simulation.settings.rig import CameraSettings, SensorSettings
from barsight.simulation.settings.travel import TravelSettings
from barsight.simulation.trajectory import SimulatedTrajectory

NOMINAL = Rotation.from_euler("zyx", [86, 2, 179], degrees=True).as_matrix()


@pytest.fixture(scope="module")
def trajectory() -> SimulatedTrajectory:
    motion = TravelSettings(sway_deg=0.2)
    return SimulatedTrajectory.plan(4.0, CameraSettings(), motion, NOMINAL, np.random.default_rng(3))


def test_derivatives_are_those_of_the_position(trajectory: SimulatedTrajectory) -> None:
    t = np.linspace(0.1, trajectory.duration_s - 0.1, 700)
    h = 1e-4
    before, now, after = trajectory.at(t - h), trajectory.at(t), trajectory.at(t + h)
    velocity = (after.position_m - before.position_m) / (2 * h)
    np.testing.assert_allclose(now.velocity_mps, velocity, atol=2e-6)
    acceleration = (after.velocity_mps - before.velocity_mps) / (2 * h)
    np.testing.assert_allclose(now.acceleration_mps2, acceleration, atol=2e-4)
    turn = np.swapaxes(before.yard_from_body, 1, 2) @ after.yard_from_body
    np.testing.assert_allclose(
        now.body_rate_radps, Rotation.from_matrix(turn).as_rotvec() / (2 * h), atol=2e-6
    )


def test_it_rests_travels_and_rests(trajectory: SimulatedTrajectory) -> None:
    motion = trajectory.motion
    rest = trajectory.at(np.linspace(0, motion.standstill_s, 20))
    end = trajectory.at(np.linspace(trajectory.settled_s, trajectory.duration_s, 20))
    for still in (rest, end):
        assert np.abs(still.velocity_mps).max() == 0
        assert np.abs(still.body_rate_radps).max() == 0
        np.testing.assert_allclose(still.yard_from_body, np.tile(NOMINAL, (20, 1, 1)), atol=1e-15)
    assert rest.position_m[0, 0] == pytest.approx(-motion.overrun_m)
    assert end.position_m[-1, 0] == pytest.approx(4.0 + motion.overrun_m)
    way = trajectory.at(np.linspace(0, trajectory.duration_s, 5000))
    assert motion.speed_mps < way.velocity_mps[:, 0].max() < motion.speed_mps + 0.1
    tilt = Rotation.from_matrix(way.yard_from_body @ NOMINAL.T).magnitude()
    assert np.radians(0.15) < tilt.max() < np.radians(0.5)
    assert trajectory.time_at_x(1.3) == pytest.approx(
        np.interp(1.3, way.position_m[:, 0], np.linspace(0, trajectory.duration_s, 5000)), abs=0.05
    )


def test_exact_imu_integrates_to_the_trajectory(trajectory: SimulatedTrajectory) -> None:
    stamp_ns = stamps(trajectory, 2000)
    gyro, force = exact_imu(trajectory, stamp_ns)
    t = seconds(stamp_ns)
    truth = trajectory.at(t)
    rotation = Rotation.from_matrix(truth.yard_from_body[0])
    velocity, position = truth.velocity_mps[0].copy(), truth.position_m[0].copy()
    gravity = np.array([0, 0, -GRAVITY_MPS2])
    for k in range(len(t) - 1):
        dt = t[k + 1] - t[k]
        following = rotation * Rotation.from_rotvec((gyro[k] + gyro[k + 1]) / 2 * dt)
        mean = (rotation.apply(force[k]) + following.apply(force[k + 1])) / 2 + gravity
        position += velocity * dt + mean * dt**2 / 2
        velocity += mean * dt
        rotation = following
    assert np.abs(position - truth.position_m[-1]).max() < 1e-3
    assert (rotation.inv() * Rotation.from_matrix(truth.yard_from_body[-1])).magnitude() < 1e-5


def test_imu_noise_and_walk_have_the_stated_densities(trajectory: SimulatedTrajectory) -> None:
    quiet = replace(
        SensorSettings(),
        gyro_random_walk=0.0,
        accel_random_walk=0.0,
        gyro_bias_radps=0.0,
        accel_bias_mps2=0.0,
    )
    imu = record_imu(trajectory, quiet, np.random.default_rng(1))
    gyro, force = exact_imu(trajectory, imu.stamp_ns)
    assert (imu.gyro_radps - gyro).std() == pytest.approx(2.4e-4 * np.sqrt(200), rel=0.03)
    assert (imu.accel_mps2 - force).std() == pytest.approx(1.9e-3 * np.sqrt(200), rel=0.03)
    walking = replace(SensorSettings(), gyro_noise_density=0.0, gyro_random_walk=0.01)
    imu = record_imu(trajectory, walking, np.random.default_rng(1))
    bias = imu.gyro_radps - gyro
    np.testing.assert_allclose(bias[0], imu.gyro_bias_radps, atol=1e-12)
    assert np.diff(bias, axis=0).std() == pytest.approx(0.01 / np.sqrt(200), rel=0.03)


def test_encoders_plus_lever_are_the_truth(trajectory: SimulatedTrajectory) -> None:
    lever = np.array([0.35, -0.2, -0.55])
    settings = SensorSettings()
    stamp_ns, place = record_encoders(trajectory, settings, lever, np.random.default_rng(2))
    error = place + lever - trajectory.at(seconds(stamp_ns)).position_m
    assert np.abs(error.mean(axis=0)).max() < 3e-4
    assert error.std() == pytest.approx(np.hypot(0.0015, 0.001 / np.sqrt(12)), rel=0.06)
    np.testing.assert_allclose(place * 1000, np.round(place * 1000), atol=1e-6)
    late = replace(settings, encoder_latency_s=0.2, encoder_std_m=0.0, encoder_step_m=0.0)
    _, place = record_encoders(trajectory, late, lever, np.random.default_rng(2))
    truth = trajectory.at(seconds(stamp_ns) - 0.2).position_m
    np.testing.assert_allclose(place + lever, truth, atol=1e-12)


def spring_way() -> SimulatedTrajectory:
    motion = TravelSettings(
        stops=2, stop_s=3.0, trolley_m=0.4, oscillation_m=(0.004, 0.003, 0.002), rail_m=0.003, skew_deg=0.1
    )
    return SimulatedTrajectory.plan(6.0, CameraSettings(), motion, NOMINAL, np.random.default_rng(5))


def test_a_crane_on_springs_has_the_derivatives_of_its_position() -> None:
    test_derivatives_are_those_of_the_position(spring_way())


def test_a_crane_stops_under_way_and_arrives() -> None:
    way = spring_way()
    t = np.linspace(0, way.duration_s, 4000)
    wheels = way.wheels_m(t)
    legs = way.legs
    assert len(legs) == 3
    for before, after in pairwise(legs):
        assert after.start_s == pytest.approx(before.end_s + 3.0)
        still = (t > before.end_s) & (t < after.start_s)
        speed = np.gradient(wheels[still, 0], t[still])
        assert np.abs(speed).max() < 0.02  # sway alone
    assert wheels[-1] == pytest.approx([6.6, CameraSettings().trolley_y_m + 0.2, 8.0])
    assert wheels[0, 1] == pytest.approx(CameraSettings().trolley_y_m - 0.2)


def test_encoders_do_not_see_springs_and_rails() -> None:
    way = spring_way()
    exact = SensorSettings(encoder_std_m=0.0, encoder_step_m=0.0)
    stamp_ns, place = record_encoders(way, exact, np.zeros(3), np.random.default_rng(0))
    apart = way.at(seconds(stamp_ns)).position_m - place
    np.testing.assert_allclose(place, way.wheels_m(seconds(stamp_ns)), atol=1e-12)
    under_way = apart[(stamp_ns - stamp_ns[0]) / 1e9 > 6]
    assert (np.abs(under_way).max(axis=0) > 0.002).all() and np.abs(apart).max() < 0.009


def test_encoders_have_scale_play_and_late_readings() -> None:
    motion = replace(TravelSettings(), sway_deg=0.0, vibration_m=0.0)
    way = SimulatedTrajectory.plan(4.0, CameraSettings(), motion, NOMINAL, np.random.default_rng(1))
    off = SensorSettings(
        encoder_std_m=0.0, encoder_step_m=0.0, encoder_scale=1.001, encoder_backlash_m=0.004,
        encoder_latency_s=0.05, encoder_jitter_s=0.02,
    )  # fmt: skip
    stamp_ns, place = record_encoders(way, off, np.zeros(3), np.random.default_rng(0))
    end = way.wheels_m(seconds(stamp_ns[-1:]))[0, 0]
    assert place[-1, 0] == pytest.approx(1.001 * (end - 0.002))
    assert place[0, 0] == pytest.approx(-1.001 * motion.overrun_m)
    late = seconds(stamp_ns) - np.interp(
        place[:, 0] / 1.001 + 0.002, way.wheels_m(t := np.linspace(2.5, way.duration_s - 4, 20000))[:, 0], t
    )
    moving = (seconds(stamp_ns) > 3.5) & (seconds(stamp_ns) < way.duration_s - 6)
    assert late[moving].min() >= 0.05 and late[moving].max() <= 0.0701 and late[moving].std() > 0.003
