"""Measure the live estimator's time per keyframe, and its memory, over a long run."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from rich.table import Table

from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Bool, Float64, Int64, rms
from barsight.core.errors import ConfigError
from barsight.core.memory import peak_memory_mib, resident_bytes
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.records.trajectory import PosedFrame
from barsight.features.guided_matching import project_stereo
from barsight.inertial.model import ORDINARY_NOISE
from barsight.motion.batch.fusion import FusionSettings
from barsight.motion.crane.encoder_trajectory import CraneSettings
from barsight.motion.fixed_lag.sensor_buffer import SensorBuffer
from barsight.motion.fixed_lag.smoother import FixedLagEstimator
from barsight.motion.frontend.sightings import Sighting
from barsight.simulation.sensors import EPOCH_NS, record_encoders, record_imu
from barsight.simulation.settings.rig import CameraSettings, SensorSettings
from barsight.simulation.settings.travel import TravelSettings
from barsight.simulation.trajectory import SimulatedTrajectory

STEP_S = 0.4
SIGMA_PX = 0.1
POINTS_PER_M2 = 20.0
MAX_POINTS = 900
DOWN = np.diag([1.0, -1.0, -1.0])
LEVER_M = np.array([0.35, -0.2, -0.55])


@dataclass(frozen=True)
class LiveSpeed:
    """Cost of each tenth of the run: wall and CPU ms per keyframe, and MiB grown since the first tenth.

    rmse_mm: error of the positions against the truth. nees: NEES of the positions per degree of freedom.
    """

    keyframes: int
    points: float
    wall_ms: tuple[float, ...]
    cpu_ms: tuple[float, ...]
    grown_mib: tuple[float, ...]
    peak_mib: float
    rmse_mm: float
    nees: float


def bench_live(keyframes: int = 1000, held: int = 8, seed: int = 1) -> LiveSpeed:
    """Simulate a crane's run over points without rendering images: 0.1 px of image noise, simulated IMU
    and encoders. The front end is left out. keyframes: a multiple of ten.
    """
    if keyframes < 20 or keyframes % 10:
        raise ConfigError("keyframes must be a multiple of ten, at least 20")
    rng = np.random.default_rng(seed)
    camera, motion = CameraSettings(), TravelSettings()
    way = SimulatedTrajectory.plan(keyframes * STEP_S * motion.speed_mps, camera, motion, DOWN, rng)
    rig = _rig()
    imu = record_imu(way, SensorSettings(), rng)
    crane_ns, place = record_encoders(way, SensorSettings(), LEVER_M, rng)
    crane = CraneSamples(crane_ns, place, LEVER_M, DOWN, 0.002)
    times: Float64 = np.asarray(0.6 + STEP_S * np.arange(keyframes), np.float64)
    true = way.at(times)
    stamps = EPOCH_NS + (times * 1e9).round().astype(np.int64)
    poses = [Pose("yard", "body", r, p) for r, p in zip(true.yard_from_body, true.position_m, strict=True)]
    rectifier = Rectifier(rig)
    samples = ImuSamples(imu.stamp_ns, imu.gyro_radps, imu.accel_mps2)
    readings = SensorBuffer(crane, samples, ORDINARY_NOISE)
    estimator = FixedLagEstimator(FusionSettings(), CraneSettings(), held, rectifier, 0, readings, None)
    clocks, memory, seen, found = [], [], [], []
    for sighting in _sightings(poses, stamps, rectifier, rng):
        begin = time.perf_counter(), time.process_time()
        frame = estimator.take(sighting)
        clocks.append((time.perf_counter() - begin[0], time.process_time() - begin[1]))
        memory.append(resident_bytes() / 2**20)
        seen.append(len(sighting.track))
        assert isinstance(frame, PosedFrame)
        found.append((frame.reference_from_body.translation, frame.covariance[3:, 3:]))
    off = np.array([p for p, _ in found]) - true.position_m
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv([c for _, c in found]), off) / 3
    tenths = 1e3 * np.array(clocks).reshape(10, -1, 2).mean(axis=1)
    held_mib = np.array(memory).reshape(10, -1).max(axis=1)
    return LiveSpeed(
        keyframes, float(np.mean(seen)), tuple(tenths[:, 0].tolist()), tuple(tenths[:, 1].tolist()),
        tuple((held_mib - held_mib[0]).tolist()),
        peak_memory_mib(),
        1e3 * rms(off), float(nees.mean()),
    )  # fmt: skip


def live_table(bench: LiveSpeed) -> Table:
    """Tabulate the results for the terminal."""
    table = Table(
        title=f"{bench.keyframes} keyframes of {bench.points:.0f} points; {bench.rmse_mm:.2f} mm RMSE, "
        f"NEES {bench.nees:.2f}; peak {bench.peak_mib:.0f} MiB"
    )
    for name in ("keyframes", "ms", "CPU ms", "MiB grown"):
        table.add_column(name, justify="right")
    each = bench.keyframes // 10
    rows = zip(bench.wall_ms, bench.cpu_ms, bench.grown_mib, strict=True)
    for k, (wall, cpu, grown) in enumerate(rows):
        table.add_row(f"{k * each}-{(k + 1) * each}", f"{wall:.1f}", f"{cpu:.1f}", f"{grown:.1f}")
    return table


def _sightings(
    poses: list[Pose], stamps: Int64, rectifier: Rectifier, rng: np.random.Generator
) -> Iterator[Sighting]:
    """Project points on a strip of floor and stacks below the run; `MAX_POINTS` of those in view at most."""
    camera = rectifier.camera
    x = np.array([pose.translation[0] for pose in poses])
    low, high = x.min() - 5, x.max() + 5
    count = int(POINTS_PER_M2 * 8 * (high - low))
    middle = float(poses[0].translation[1])
    points = np.column_stack(
        [
            np.sort(rng.uniform(low, high, count)),
            middle + rng.uniform(-4, 4, count),
            rng.uniform(0, 1.5, count),
        ]
    )
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        near = slice(*np.searchsorted(points[:, 0], pose.translation[0] + np.array([-5.0, 5.0])))
        in_left = (pose @ rectifier.body_from_rect0).inverse().apply(points[near])
        stereo = project_stereo(in_left, camera)
        kept = _inside(stereo, camera.width, camera.height)
        index = np.flatnonzero(kept)[:MAX_POINTS]
        noisy = stereo[index] + rng.normal(0, SIGMA_PX, (len(index), 3))
        yield Sighting(stamp, near.start + index, noisy, np.full(len(index), SIGMA_PX), None, 0)


def _inside(stereo: Float64, width: int, height: int) -> Bool:
    across = (stereo[:, [0, 2]] > 0).all(1) & (stereo[:, [0, 2]] < width).all(1)
    return np.asarray(across & (stereo[:, 1] > 0) & (stereo[:, 1] < height), np.bool_)


def _rig() -> StereoRig:
    lens = Camera(1280, 1024, 1250.0, 1250.0, 640.0, 512.0)
    body_from_cam0 = Pose("body", "cam0", np.eye(3), np.array([0.06, -0.09, 0.04]))
    cam0_from_cam1 = Pose("cam0", "cam1", np.eye(3), np.array([0.5, 0.0, 0.0]))
    return StereoRig(lens, replace(lens), body_from_cam0, body_from_cam0 @ cam0_from_cam1, 0)
