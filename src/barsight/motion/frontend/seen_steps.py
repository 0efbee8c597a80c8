"""Convert the front end's motions to steps of the body, for comparison with other sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.records.sensor_samples import ImuSamples
from barsight.motion.crane.known_motion import KnownMotion, SeenSteps
from barsight.motion.frontend.sightings import Sighting


def seen_steps(
    sightings: Sequence[Sighting], steps: Sequence[int], rectifier: Rectifier, shift_ns: int
) -> SeenSteps:
    """Convert the motions of the sightings `steps`, each since the previous sighting, to the body's.

    shift_ns: `timeshift_cam_imu`.
    """
    mount = rectifier.body_from_rect0
    turns, ways, sigmas = [], [], []
    for k in steps:
        motion = sightings[k].motion
        assert motion is not None
        old_from_new = motion.rotation.T
        rotation = mount.rotation @ old_from_new @ mount.rotation.T
        move = mount.rotation @ (-old_from_new @ motion.translation)
        turns.append(Rotation.from_matrix(rotation).as_rotvec())
        ways.append(move + mount.translation - rotation @ mount.translation)
        sigmas.append(np.sqrt(np.diag(motion.covariance)[3:].max()))
    stamps = np.array([s.stamp_ns for s in sightings], np.int64) + shift_ns
    new = np.array(steps, np.int64)
    return SeenSteps(
        stamps[new - 1], stamps[new], np.array(turns).reshape(-1, 3), np.array(ways).reshape(-1, 3),
        np.array(sigmas, np.float64),
    )  # fmt: skip


def known_motion(
    sightings: Sequence[Sighting], imu: ImuSamples | None, rectifier: Rectifier, shift_ns: int
) -> KnownMotion:
    """Gather the travel known from the sightings' motions and the IMU."""
    numbers = [k for k in range(1, len(sightings)) if sightings[k].motion is not None]
    return KnownMotion(seen_steps(sightings, numbers, rectifier, shift_ns) if numbers else None, imu)
