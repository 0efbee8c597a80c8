"""Recordings without pictures: sightings, IMU and encoders of a body that stands or travels evenly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.features.guided_matching import project_stereo
from barsight.inertial.model import GRAVITY_MPS2
from barsight.motion.frontend.sightings import Sighting
from barsight.recording.formats.ground_truth import GroundTruth
from motion_recordings import MemoryRecording, ideal_rig

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
NOISE = ImuNoise(2e-4, 2e-5, 2e-3, 4e-4, 200.0)
FIRST_NS, STEP_NS = 10_000_000_000, 500_000_000


class KnownNoise(MemoryRecording):
    def imu_noise(self) -> ImuNoise:
        return NOISE


def steady(
    speed_mps: float, seed: int, frames: int = 12
) -> tuple[KnownNoise, tuple[Sighting, ...], GroundTruth]:
    """Even travel along x at `speed_mps`, from before the first sample on; 0 stands."""
    rng = np.random.default_rng(seed)
    rig = ideal_rig(1280, 1024)
    mount = Pose("body", "cam0", np.eye(3), np.array([0.06, -0.09, 0.04]))
    camera = replace(rig.cam0, fx_px=1250, fy_px=1250)
    rig = replace(
        rig, body_from_cam0=mount, body_from_cam1=mount @ rig.cam0_from_cam1, cam0=camera, cam1=camera
    )  # fmt: skip
    stamps = FIRST_NS + np.arange(frames) * STEP_NS
    last = int(stamps[-1])

    def place(stamp_ns: np.ndarray) -> np.ndarray:
        x = (stamp_ns - FIRST_NS) / 1e9 * speed_mps
        return np.column_stack([x, 0 * x, 0 * x + 8.0])

    poses = [Pose("yard", "body", DOWN, p) for p in place(stamps)]
    points = np.column_stack([rng.uniform(-4, 8, 900), rng.uniform(-4, 4, 900), rng.uniform(0, 1.5, 900)])
    rectifier, sightings = Rectifier(rig), []
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        stereo = project_stereo((pose @ rectifier.body_from_rect0).inverse().apply(points), rectifier.camera)
        shown = (stereo[:, [0, 2]] > 0).all(1) & (stereo[:, [0, 2]] < 1280).all(1)
        shown &= (stereo[:, 1] > 0) & (stereo[:, 1] < 1024)
        seen = stereo[shown] + rng.normal(0, 0.1, (shown.sum(), 3))
        sightings.append(Sighting(stamp, np.flatnonzero(shown), seen, np.full(len(seen), 0.1), None, 0))
    imu_ns = np.arange(FIRST_NS - 2_000_000_000, last + 500_000_000, 5_000_000)
    gyro = np.array([0.003, -0.002, 0.004]) + rng.normal(0, NOISE.gyro_density * 200**0.5, (len(imu_ns), 3))
    force = DOWN.T @ np.array([0, 0, GRAVITY_MPS2]) + [0.02, -0.01, 0.03]
    accel = force + rng.normal(0, NOISE.accel_density * 200**0.5, (len(imu_ns), 3))
    crane_ns = np.arange(FIRST_NS - 1_000_000_000, last + 1_000_000_000, 50_000_000)
    encoders = place(crane_ns) + rng.normal(0, 0.002, (len(crane_ns), 3))
    recording = KnownNoise(
        rig, stamps_ns=tuple(stamps.tolist()), imu_samples=ImuSamples(imu_ns, gyro, accel),
        crane_samples=CraneSamples(crane_ns, encoders, np.zeros(3), DOWN, 0.002),
    )  # fmt: skip
    return recording, with_motion(sightings, poses, rectifier), GroundTruth(stamps, tuple(poses))


def with_motion(sightings: list[Sighting], poses: list[Pose], rectifier: Rectifier) -> tuple[Sighting, ...]:
    """As the front end tells the motion since the sighting before."""
    from barsight.features.guided_matching import PredictedMotion

    told = [sightings[0]]
    for k in range(1, len(sightings)):
        old, new = (pose @ rectifier.body_from_rect0 for pose in poses[k - 1 : k + 1])
        step = new.inverse() @ old
        motion = PredictedMotion(step.rotation, step.translation, np.eye(6) * 1e-6)
        told.append(replace(sightings[k], motion=motion))
    return tuple(told)
