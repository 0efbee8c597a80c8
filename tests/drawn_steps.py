"""Pictures' motion, gyro and encoders of a swaying rig under a drawn crane, with noise from a seed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.features.guided_matching import PredictedMotion
from barsight.motion.frontend.sightings import Sighting
from drawn_cranes import drawn_crane
from motion_recordings import ideal_rig
from simulated_ways import DOWN

GRAVITY_MPS2 = 9.81
NOTHING = np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class DrawnSteps:
    """Steps of one way, as a recording's front end and sensors tell them."""

    sightings: tuple[Sighting, ...]
    imu: ImuSamples
    crane: CraneSamples
    rectifier: Rectifier


def drawn_steps(seed: int) -> DrawnSteps:
    """20 to 40 s of a drawn crane, swaying by 0.05 to 0.4 degrees at 0.2 to 0.8 Hz."""
    rng = np.random.default_rng([20261124, seed])
    drawn = drawn_crane(seed)
    nominal = DOWN @ Rotation.from_euler("xyz", rng.normal(0, (0.05, 0.05, 1.5))).as_matrix()
    crane = replace(drawn.readings, yard_from_body_nominal=nominal)
    first, last = int(crane.stamp_ns[0]), int(crane.stamp_ns[-1])
    hz, amplitude = rng.uniform(0.2, 0.8, 3), np.radians(rng.uniform(0.05, 0.4, 3)) * [1, 1, 0.3]
    phase = rng.uniform(0, 2 * np.pi, 3)

    def sway(stamp_ns: np.ndarray) -> np.ndarray:
        return amplitude * np.sin(2 * np.pi * hz * (stamp_ns[:, None] / 1e9) + phase)

    imu_ns = np.arange(first - 300_000_000, last + 300_000_000, 5_000_000)
    rate = np.gradient(sway(imu_ns), imu_ns / 1e9, axis=0)
    noise = rng.uniform(1e-4, 5e-4) * 200**0.5
    gyro = rate + rng.normal(0, 0.01, 3) + rng.normal(0, noise, rate.shape)
    accel = np.tile([0, 0, GRAVITY_MPS2] @ nominal, (len(imu_ns), 1)) + rng.normal(0, 0.2, rate.shape)
    frames = np.arange(first + 200_000_000, last - 200_000_000, round(1e9 * rng.uniform(0.4, 1.0)))
    place = np.column_stack([np.interp(frames, crane.stamp_ns, axis) for axis in drawn.true_m.T])
    turns = Rotation.from_rotvec(sway(frames)).as_matrix()
    rectifier = Rectifier(ideal_rig())
    turn_sigma, way_sigma_m = rng.uniform(1e-4, 4e-4), rng.uniform(0.001, 0.006)
    sightings = [_sighting(int(frames[0]), None)]
    poses = [Pose("yard", "body", nominal @ turn, at) for turn, at in zip(turns, place, strict=True)]
    for stamp, old, new in zip(frames[1:].tolist(), poses[:-1], poses[1:], strict=True):
        step = (new @ rectifier.body_from_rect0).inverse() @ (old @ rectifier.body_from_rect0)
        off = Rotation.from_rotvec(rng.normal(0, turn_sigma, 3)).as_matrix()
        way = step.translation + rng.normal(0, way_sigma_m, 3)
        sightings.append(_sighting(stamp, PredictedMotion(off @ step.rotation, way, np.eye(6) * 1e-6)))
    return DrawnSteps(tuple(sightings), ImuSamples(imu_ns, gyro, accel), crane, rectifier)


def _sighting(stamp_ns: int, motion: PredictedMotion | None) -> Sighting:
    return Sighting(stamp_ns, NOTHING, np.empty((0, 3)), np.empty(0), motion, 0)
