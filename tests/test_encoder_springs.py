"""Test encoders beside which the crane's body oscillates, and whose stamps jitter, as in drawn worlds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.motion.batch.fault_detection import check_crane
from barsight.motion.crane.known_motion import KnownMotion
from barsight.simulation.optics import mount_rig
from barsight.simulation.sensors import record_encoders, record_imu
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import stream
from barsight.simulation.trajectory import CRANE_TO_BODY_M, SimulatedTrajectory
from barsight.simulation.worlds.conditions import draw_conditions

SPRINGY = (1440, 1441, 1449, 1475)
"""Worlds whose body oscillates by 4 to 5 mm beside the encoders."""


def recorded(seed: int) -> tuple[CraneSamples, ImuSamples]:
    """A drawn world's encoders, less their latency, and IMU."""
    settings = draw_conditions(seed, SimulationSettings(), hides=False)
    sensors, nominal = settings.sensors, mount_rig(settings, stream(settings, 2)).nominal_yard_from_body
    rng, girder = stream(settings, 3), settings.girder
    path = SimulatedTrajectory.plan(6.0, settings.camera, settings.motion, nominal, rng, None, girder)
    imu = record_imu(path, sensors, stream(settings, 4))
    lever = np.array(CRANE_TO_BODY_M)
    stamps, place = record_encoders(path, sensors, lever, stream(settings, 5))
    late_s = sensors.encoder_latency_s + sensors.encoder_jitter_s / 2
    std_m = float(np.hypot(sensors.encoder_std_m, sensors.encoder_step_m / 12**0.5))
    crane = CraneSamples(stamps - round(1e9 * late_s), place, lever, nominal, std_m)
    return crane, ImuSamples(imu.stamp_ns, imu.gyro_radps, imu.accel_mps2)


@pytest.mark.parametrize("seed", SPRINGY)
def test_a_body_that_oscillates_beside_its_encoders_is_no_jump(seed: int) -> None:
    crane, imu = recorded(seed)
    assert check_crane(crane, KnownMotion(None, imu)).samples.jumps == ()


@pytest.mark.parametrize("seed", SPRINGY)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_jump_shows_beside_an_oscillation(seed: int, axis: int) -> None:
    crane, imu = recorded(seed)
    place, middle = crane.position_m.copy(), len(crane.stamp_ns) // 2
    place[middle:, axis] += 0.03
    (jump,) = check_crane(replace(crane, position_m=place), KnownMotion(None, imu)).samples.jumps
    assert (jump.axis, jump.kind) == (axis, "sure")
    assert abs(jump.stamp_ns - int(crane.stamp_ns[middle])) < 150_000_000
    assert jump.size_m == pytest.approx(0.03, abs=0.01)
