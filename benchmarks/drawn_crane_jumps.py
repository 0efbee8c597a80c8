"""Count jumps told on the cranes of drawn worlds, whose bodies oscillate beside their encoders.

python benchmarks/drawn_crane_jumps.py 30000:30100 [--jump-m 0.008]

Each crane travels 6 m. Its encoders, less their latency, are compared with its IMU alone, without pictures.
With --jump-m one encoder of each jumps by that much in the middle third.
"""

from __future__ import annotations

import argparse

import numpy as np

from barsight.core.records.sensor_samples import CraneSamples, EncoderJump, ImuSamples
from barsight.motion.batch.fault_detection import check_crane
from barsight.motion.crane.known_motion import KnownMotion
from barsight.simulation.optics import mount_rig
from barsight.simulation.sensors import record_encoders, record_imu
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import stream
from barsight.simulation.trajectory import CRANE_TO_BODY_M, SimulatedTrajectory
from barsight.simulation.worlds.conditions import draw_conditions

LENGTH_M = 6.0
NEAR_NS = 300_000_000


def recorded_crane(seed: int) -> tuple[CraneSamples, ImuSamples]:
    """Record the encoders, less their latency, and the IMU of a drawn world's crane."""
    settings = draw_conditions(seed, SimulationSettings(), hides=False)
    sensors, nominal = settings.sensors, mount_rig(settings, stream(settings, 2)).nominal_yard_from_body
    rng, girder, lever = stream(settings, 3), settings.girder, np.array(CRANE_TO_BODY_M)
    path = SimulatedTrajectory.plan(LENGTH_M, settings.camera, settings.motion, nominal, rng, None, girder)
    imu = record_imu(path, sensors, stream(settings, 4))
    stamps, place = record_encoders(path, sensors, lever, stream(settings, 5))
    late_s = sensors.encoder_latency_s + sensors.encoder_jitter_s / 2
    std_m = float(np.hypot(sensors.encoder_std_m, sensors.encoder_step_m / 12**0.5))
    crane = CraneSamples(stamps - round(1e9 * late_s), place, lever, nominal, std_m)
    return crane, ImuSamples(imu.stamp_ns, imu.gyro_radps, imu.accel_mps2)


def told_jumps(crane: CraneSamples, imu: ImuSamples) -> tuple[EncoderJump, ...]:
    """Find the jumps in a crane's readings by its IMU alone."""
    return check_crane(crane, KnownMotion(None, imu)).samples.jumps


def main() -> None:
    """Print each crane's false jumps, and the totals."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds")
    parser.add_argument("--jump-m", type=float, default=0.0)
    asked = parser.parse_args()
    first, end = map(int, asked.seeds.split(":"))
    false = found = 0
    for seed in range(first, end):
        crane, imu = recorded_crane(seed)
        rng, count = np.random.default_rng([7, seed]), len(crane.stamp_ns)
        at, axis = int(rng.integers(count // 3, 2 * count // 3)), int(rng.integers(3))
        crane.position_m[at:, axis] += asked.jump_m
        jumps = told_jumps(crane, imu)
        if asked.jump_m:
            stamp = int(crane.stamp_ns[at])
            true = [jump for jump in jumps if jump.axis == axis and abs(jump.stamp_ns - stamp) < NEAR_NS]
            found += bool(true)
            jumps = tuple(jump for jump in jumps if jump not in true)
        if jumps:
            false += 1
            print(seed, [("xyz"[jump.axis], jump.kind, round(1e3 * jump.size_m, 1)) for jump in jumps])
    print(f"false jumps on {false} of {end - first} cranes")
    if asked.jump_m:
        print(f"jumps of {1e3 * asked.jump_m:g} mm found on {found}")


if __name__ == "__main__":
    main()
