"""Cranes' motion and encoders drawn from a seed, apart from anything that judges them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.features.guided_matching import PredictedMotion, project_stereo
from barsight.inertial.model import GRAVITY_MPS2
from barsight.motion.frontend.sightings import Sighting
from motion_recordings import ideal_rig

UP = np.array([0, 0, GRAVITY_MPS2])
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])


@dataclass(frozen=True, eq=False)
class DrawnCrane:
    """readings: as given. true_m: (N, 3) where the crane was; path: the same at any time, s since stamp 1 s.
    fault: index of the first wrong reading; axis: on which it jumps.
    """

    readings: CraneSamples
    true_m: NDArray[np.float64]
    rate_hz: float
    fault: int | None
    path: CubicSpline
    axis: int


def drawn_crane(seed: int, jump_m: float = 0.0, frozen_s: float = 0.0) -> DrawnCrane:
    """20 to 40 s of bridge, trolley and hoist; with a slip of jump_m or a freeze while it moves."""
    rng = np.random.default_rng([20261123, seed])
    rate = float(rng.choice([20, 25, 50, 100, 200]))
    time = np.arange(0, rng.uniform(20, 40), 1 / rate)
    true = np.column_stack([_travel(rng, time), _travel(rng, time), np.full(time.size, 8.0)])
    for axis in (0, 1):
        true[:, axis] += sum(_oscillation(rng, time) for _ in range(rng.integers(1, 4)))
    read = np.column_stack([_backlash(true[:, axis], rng.uniform(0, 0.002)) for axis in range(3)])
    fault = int(rng.uniform(0.2, 0.8) * time.size)
    axis = int(rng.integers(2))
    read[fault:, axis] += jump_m * rng.choice([-1, 1])
    sigma = float(np.exp(rng.uniform(np.log(3e-4), np.log(3e-3))))
    quantum = float(rng.choice([1e-4, 5e-4, 1e-3, 2e-3]))
    read = np.round((read + rng.normal(0, sigma, read.shape)) / quantum) * quantum
    wild = rng.random(time.size) < rng.choice([0, 0.005, 0.02])
    read[wild] += rng.normal(0, 0.05, (int(wild.sum()), 3))
    found = fault if jump_m else None
    if frozen_s:
        found, length = _moving(true, rate, frozen_s, rng), round(frozen_s * rate)
        if found is not None:
            read[found : found + length] = read[found]
    stamped = time + rng.normal(0, rng.choice([0, 5e-4, 1e-3]), time.size).clip(-0.2 / rate, 0.2 / rate)
    kept = rng.random(time.size) > rng.choice([0, 0.02, 0.05])
    if found is not None:
        found = int(kept[:found].sum())
    stamps = (1e9 * (stamped + 1)).astype(np.int64)
    stated = float(np.hypot(sigma, quantum / 12**0.5))
    readings = CraneSamples(stamps[kept], read[kept], np.zeros(3), np.eye(3), stated)
    return DrawnCrane(readings, true[kept], rate, found, CubicSpline(time, true), axis)


@dataclass(frozen=True, eq=False)
class DrawnSenses:
    """Sensors of a rig that hangs from a drawn crane: frames' sightings, the IMU, and each frame's pose."""

    rig: StereoRig
    imu: ImuSamples
    sightings: tuple[Sighting, ...]
    poses: tuple[Pose, ...]


def drawn_senses(crane: DrawnCrane, seed: int, points: int = 0) -> DrawnSenses:
    """Frames 0.3 to 0.8 s apart, each motion 0.8 to 5 mm wrong (1 sigma), one of thirty untied; an IMU with
    biases; a body that hangs 0.1 degrees askew and sways by up to 0.15. points: the yard's for each frame's
    sightings, 0 for motions alone.
    """
    rng = np.random.default_rng([20261124, seed])
    attitude = _sway(rng)
    end = float(crane.path.x[-1])
    sampled = np.arange(0, end, 1 / 200)
    turned = attitude(sampled)
    force = np.einsum("nij,ni->nj", turned.as_matrix(), crane.path(sampled, 2) + UP)
    apart = (turned[:-1].inv() * turned[1:]).as_rotvec() * 200
    gyro = (
        np.vstack([apart, apart[-1:]]) + rng.normal(0, 3e-3, 3) + rng.normal(0, 2e-4 * 200**0.5, force.shape)
    )
    accel = force + rng.normal(0, 0.05, 3) + rng.normal(0, 2e-3 * 200**0.5, force.shape)
    imu = ImuSamples((1e9 * (sampled + 1)).astype(np.int64), gyro, accel)
    rig = ideal_rig(1280, 1024)
    mount = Pose("body", "cam0", DOWN, np.array([0.06, -0.09, 0.04]))
    camera = replace(rig.cam0, fx_px=1250, fy_px=1250)
    rig = replace(
        rig, body_from_cam0=mount, body_from_cam1=mount @ rig.cam0_from_cam1, cam0=camera, cam1=camera
    )  # fmt: skip
    times = np.arange(rng.uniform(0.5, 1.5), end - 0.6, rng.uniform(0.3, 0.8))
    rotations = attitude(times).as_matrix()
    poses = tuple(Pose("yard", "body", r, p) for r, p in zip(rotations, crane.path(times), strict=True))
    stamps = (1e9 * (times + 1)).astype(np.int64).tolist()
    return DrawnSenses(rig, imu, _sightings(rng, rig, stamps, poses, points), poses)


def _sway(rng: np.random.Generator) -> Callable[[NDArray[np.float64]], Rotation]:
    """yard_from_body over time: askew, and swaying slowly on each axis."""
    askew = rng.normal(0, np.deg2rad(0.1), 3)
    size, hz, phase = rng.uniform(0, np.deg2rad(0.15), 3), rng.uniform(0.15, 0.8, 3), rng.uniform(0, 6, 3)
    return lambda time: Rotation.from_rotvec(askew + size * np.sin(2 * np.pi * hz * time[:, None] + phase))


def _sightings(
    rng: np.random.Generator, rig: StereoRig, stamps: list[int], poses: tuple[Pose, ...], points: int
) -> tuple[Sighting, ...]:
    rectifier = Rectifier(rig)
    cameras = [pose @ rectifier.body_from_rect0 for pose in poses]
    sigma_m, sigma_rad = float(np.exp(rng.uniform(np.log(8e-4), np.log(5e-3)))), 1e-4
    way = np.array([pose.translation for pose in poses])
    low, high = way.min(axis=0) - 4, way.max(axis=0) + 4
    yard = np.column_stack([rng.uniform(low[:2], high[:2], (points, 2)), rng.uniform(0, 1.5, points)])
    sigma_px = float(rng.uniform(0.08, 0.25))
    told = []
    for k, camera in enumerate(cameras):
        stereo = project_stereo(camera.inverse().apply(yard), rectifier.camera)
        inside = ((stereo > 0) & (stereo < [1280, 1024, 1280])).all(axis=1)
        seen = stereo[inside] + rng.normal(0, sigma_px, (int(inside.sum()), 3))
        motion = None
        if k and rng.random() > 1 / 30:
            step = camera.inverse() @ cameras[k - 1]
            turn = Rotation.from_rotvec(rng.normal(0, sigma_rad, 3)).as_matrix()
            moved = turn @ step.translation + rng.normal(0, sigma_m, 3)
            spread = np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)
            motion = PredictedMotion(turn @ step.rotation, moved, spread)
        told.append(
            Sighting(stamps[k], np.flatnonzero(inside), seen, np.full(len(seen), sigma_px), motion, 0)
        )
    return tuple(told)


def _travel(rng: np.random.Generator, time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Speeds held, stops and returns, with ramps of 0.15 to 0.5 m/s2."""
    changes = np.sort(rng.uniform(0, time[-1], rng.integers(2, 7)))
    wanted = rng.choice([0, 0.3, 0.6, 0.9, -0.3, -0.6], changes.size + 1)[np.searchsorted(changes, time)]
    step = time[1] - time[0]
    most, speed = rng.uniform(0.15, 0.5) * step, np.zeros(time.size)
    for k in range(1, time.size):
        speed[k] = speed[k - 1] + np.clip(wanted[k] - speed[k - 1], -most, most)
    return np.asarray(np.cumsum(speed) * step)


def _oscillation(rng: np.random.Generator, time: NDArray[np.float64]) -> NDArray[np.float64]:
    """0.3 to 3 Hz, up to 15 mm and 0.6 m/s2; lasting, or rung by something and dying away."""
    hz = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    amplitude = rng.uniform(0.2, 1) * min(0.015, 0.6 / (2 * np.pi * hz) ** 2)
    wave = amplitude * np.sin(2 * np.pi * hz * time + rng.uniform(0, 2 * np.pi))
    if rng.random() < 0.4:
        since = np.maximum(time - rng.uniform(0, time[-1]), 0)
        wave = wave * (1 - np.exp(-((since / 0.4) ** 2))) * np.exp(-since * rng.uniform(0.1, 0.6))
    return np.asarray(wave)


def _backlash(way: NDArray[np.float64], play_m: float) -> NDArray[np.float64]:
    """The encoder's wheel follows the crane once the play is taken up."""
    out = way.copy()
    for k in range(1, way.size):
        out[k] = min(max(out[k - 1], way[k] - play_m / 2), way[k] + play_m / 2)
    return out


def _moving(true: NDArray[np.float64], rate: float, frozen_s: float, rng: np.random.Generator) -> int | None:
    """A reading from which on the crane travels 50 mm or more within frozen_s; None where there is none."""
    length = round(frozen_s * rate)
    way = np.linalg.norm(true[length:] - true[:-length], axis=1)
    way[: round(2 * rate)] = way[-round(2 * rate) :] = 0
    moving = np.flatnonzero(way > 0.05)
    return int(rng.choice(moving)) if moving.size else None
