"""Record IMU, encoders and laser from the exact motion and the exact surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.simulation.rays import cast_rays
from barsight.simulation.scene import Scene
from barsight.simulation.settings.rig import SensorSettings
from barsight.simulation.trajectory import SimulatedTrajectory

GRAVITY_MPS2 = 9.80665
EPOCH_NS = 1_700_000_000_000_000_000
"""Stamp of the IMU's first sample, ns."""
SKY_M = 100.0


@dataclass(frozen=True, eq=False)
class ImuRecord:
    """Samples of the IMU. stamp_ns: (N,) on the IMU's clock. gyro_radps, accel_mps2: (N, 3) in `body`.
    gyro_bias_radps, accel_bias_mps2: (3,) biases at the start.
    """

    stamp_ns: Int64
    gyro_radps: Float64
    accel_mps2: Float64
    gyro_bias_radps: Float64
    accel_bias_mps2: Float64


def stamps(trajectory: SimulatedTrajectory, rate_hz: int) -> Int64:
    """Compute stamps (N,), evenly spaced to the nanosecond, over the recording."""
    begin_s = trajectory.motion.begin_s
    count = int((trajectory.duration_s - begin_s) * rate_hz) + 1
    return EPOCH_NS + seconds_to_ns(begin_s) + np.arange(count, dtype=np.int64) * NS_PER_S // rate_hz


def seconds(stamp_ns: Int64) -> Float64:
    """Convert stamps to seconds since the IMU's first sample."""
    return (stamp_ns - EPOCH_NS) / NS_PER_S


def exact_imu(trajectory: SimulatedTrajectory, stamp_ns: Int64) -> tuple[Float64, Float64]:
    """Compute angular rate (rad/s) and specific force (m/s^2) in `body`, each (N, 3), without errors."""
    motion = trajectory.at(seconds(stamp_ns))
    force = motion.acceleration_mps2 + np.array([0.0, 0.0, GRAVITY_MPS2])
    return motion.body_rate_radps, np.einsum("nij,ni->nj", motion.yard_from_body, force)


def record_imu(
    trajectory: SimulatedTrajectory, settings: SensorSettings, rng: np.random.Generator
) -> ImuRecord:
    """Record the IMU with white noise and random-walk biases of the densities in the settings."""
    stamp_ns = stamps(trajectory, settings.imu_rate_hz)
    gyro, accel = exact_imu(trajectory, stamp_ns)
    gyro_bias = _walk(rng, len(stamp_ns), settings.gyro_bias_radps, settings.gyro_random_walk, settings)
    accel_bias = _walk(rng, len(stamp_ns), settings.accel_bias_mps2, settings.accel_random_walk, settings)
    root_rate = np.sqrt(settings.imu_rate_hz)
    gyro = gyro + gyro_bias + rng.normal(0, 1, gyro.shape) * settings.gyro_noise_density * root_rate
    accel = accel + accel_bias + rng.normal(0, 1, accel.shape) * settings.accel_noise_density * root_rate
    return ImuRecord(stamp_ns, gyro, accel, gyro_bias[0], accel_bias[0])


def _walk(
    rng: np.random.Generator, count: int, start: float, density: float, settings: SensorSettings
) -> Float64:
    steps = rng.normal(0, 1, (count, 3)) * density / np.sqrt(settings.imu_rate_hz)
    steps[0] = rng.normal(0, 1, 3) * start
    walk: Float64 = np.cumsum(steps, axis=0)
    return walk


def record_encoders(
    trajectory: SimulatedTrajectory, settings: SensorSettings, lever_m: Float64, rng: np.random.Generator
) -> tuple[Int64, Float64]:
    """Record stamps (N,) and readings (N, 3) of the crane point's position: delayed, noisy and quantised.

    The encoders read the wheels and the drum; they don't see movements by springs and rails.
    """
    stamp_ns = stamps(trajectory, settings.encoder_rate_hz)
    latency = np.full(len(stamp_ns), settings.encoder_latency_s)
    if settings.encoder_jitter_s > 0:
        latency += rng.uniform(0, settings.encoder_jitter_s, len(latency))
    place = trajectory.wheels_m(seconds(stamp_ns) - latency) - lever_m
    place[:, 0] = settings.encoder_scale * _with_play(place[:, 0], settings.encoder_backlash_m)
    place = place + rng.normal(0, 1, place.shape) * settings.encoder_std_m
    if settings.encoder_step_m > 0:
        place = np.round(place / settings.encoder_step_m) * settings.encoder_step_m
    return stamp_ns, place


def _with_play(x: Float64, play: float) -> Float64:
    """Apply backlash: drag a follower along x (N,) within the play, starting from its centre."""
    out, at = np.empty_like(x), float(x[0])
    for k, now in enumerate(x.tolist()):
        at = min(max(at, now - play / 2), now + play / 2)
        out[k] = at
    return out


def heights(scene: Scene, x_m: Float64, y_m: Float64) -> Float64:
    """Compute the exact height (N,), m, of the highest surface at each position (x, y) with vertical rays."""
    origins = np.column_stack([x_m, y_m, np.full(len(x_m), SKY_M)])
    distance, _ = cast_rays(scene, origins, np.tile([0.0, 0.0, -1.0], (len(x_m), 1)))
    return SKY_M - distance
