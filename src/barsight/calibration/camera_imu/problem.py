"""Linearise the residuals of a camera-IMU calibration [Furgale 2013; paper Eq. 8].

The unknowns are the body's trajectory as a spline, the IMU's biases, and the common parameters: each camera's
mounting and time shift, the direction of gravity in the board's frame and, optionally, the IMU's scales and
misalignments. All corners of a picture share one pose, so they are condensed to six whitened rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.camera_imu.arrowhead_system import RandomWalks, Samples
from barsight.calibration.camera_imu.pose_spline import PoseSpline, locate
from barsight.calibration.camera_imu.residual_kernels import (
    InertialReadings,
    frame_rows,
    imu_rows,
    sum_corners,
)
from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.projection import Lens, project_lens
from barsight.core.arrays import Float64, Int64

NEAREST_Z_M = 1e-3
MOUNT = 7
"""Parameters per camera: rotation (rad) and shift (m) of body_from_cam in body axes, and time shift (s)."""


@dataclass(frozen=True, eq=False)
class CornerObservations:
    """One camera's corners.

    stamp_s: (F,) on the camera's clock, since the spline's start. frame: (N,) ascending indices into stamp_s.
    ids: (N,). points_m: (N, 3) on the board. pixels: (N, 2).
    """

    camera: Camera
    stamp_s: Float64
    frame: Int64
    ids: Int64
    points_m: Float64
    pixels: Float64


@dataclass(frozen=True, eq=False)
class ImuTrack:
    """The IMU's readings. time_s: (S,) since the spline's start. gyro_radps, accel_mps2: (S, 3) as measured.

    gyro_loose, accel_loose: (S,) factors on the sigmas of readings that vibrate more than the spline can
    follow.
    """

    time_s: Float64
    gyro_radps: Float64
    accel_mps2: Float64
    gyro_loose: Float64
    accel_loose: Float64


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations of one corner coordinate, of one gyro and one accelerometer reading per axis, and
    of the random walk of their biases over one second.
    """

    corner_px: float
    gyro_radps: float
    accel_mps2: float
    gyro_walk: float
    accel_walk: float


@dataclass(frozen=True, eq=False)
class Mount:
    """Mounting of a camera on the body. rotation (3, 3), place_m (3,): body_from_cam. shift_s: t_imu =
    t_cam + shift.
    """

    rotation: Float64
    place_m: Float64
    shift_s: float


@dataclass(frozen=True, eq=False)
class CameraImuState:
    """The unknowns.

    mounts: one per camera. gravity_mps2: (3,) in the board's frame, pointing down. gyro_matrix, accel_matrix:
    (3, 3), where reading = matrix @ truth + bias.
    """

    spline: PoseSpline
    mounts: tuple[Mount, ...]
    gravity_mps2: Float64
    gyro_matrix: Float64
    accel_matrix: Float64


@dataclass(frozen=True, eq=False)
class CameraImuProblem:
    """Measurements of a camera-IMU calibration.

    scales: estimate the IMU's scales and misalignments too. lenses: estimate the cameras' lenses too.
    """

    sightings: tuple[CornerObservations, ...]
    imu: ImuTrack
    sigmas: Sigmas
    scales: bool = False
    lenses: bool = False

    @property
    def lens_at(self) -> tuple[int, ...]:
        """Return the index of each camera's lens among the common parameters."""
        begin = MOUNT * len(self.sightings) + 2 + (15 if self.scales else 0)
        sizes = [len(lens_of(sightings.camera)[1]) for sightings in self.sightings]
        return tuple(begin + sum(sizes[:n]) for n in range(len(sizes)))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Return the names of the common parameters in order."""
        parts = ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m", "timeshift_s")
        names = [f"body_from_cam{c}.{part}" for c in range(len(self.sightings)) for part in parts]
        names += ["gravity.a_rad", "gravity.b_rad"]
        if self.scales:
            names += [f"accel.m{i}{j}" for i, j in LOWER]
            names += [f"gyro.m{i}{j}" for i in range(3) for j in range(3)]
        if self.lenses:
            for c, sightings in enumerate(self.sightings):
                names += [f"cam{c}.{name}" for name in lens_of(sightings.camera)[0].parameter_names]
        return tuple(names)


LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
"""Entries of the accelerometer's scale and misalignment matrix. Its axes define those of the body, so the
matrix is lower triangular.
"""


@dataclass(frozen=True, eq=False)
class Linearised:
    """The linearised problem.

    residuals_px: (N, 2) per camera. samples: the frames of each camera, then the IMU readings. cost: the
    robust cost.
    """

    residuals_px: tuple[Float64, ...]
    samples: Samples
    walks: RandomWalks
    cost: float


def linearise_camera_imu(problem: CameraImuProblem, state: CameraImuState, huber: float | None) -> Linearised:
    """Compute residuals and Jacobians at a state.

    huber: residual length, in sigmas, above which a corner is down-weighted.
    """
    spline, sigmas = state.spline, problem.sigmas
    width = len(problem.parameter_names)
    points = spline.control_points()
    parts, residuals = [], []
    cost = 0.0
    for number, (sightings, mount) in enumerate(zip(problem.sightings, state.mounts, strict=True)):
        corners, residual = corner_residuals(sightings, mount, spline)
        lens, parameters = lens_of(sightings.camera)
        seen = project_lens(lens, parameters, corners)
        by_lens = seen.by_lens if problem.lenses else seen.by_lens[:, :, :0]
        length = np.linalg.norm(residual, axis=1) / sigmas.corner_px
        weight = np.ones_like(length) if huber is None else np.minimum(1, huber / np.maximum(length, 1e-9))
        outer = 0.0 if huber is None else float((huber * (2 * length - huber))[length > huber].sum())
        inner = length if huber is None else length[length <= huber]
        cost += float((inner**2).sum()) + outer
        frames = sightings.stamp_s.size
        whole, pull = sum_corners(
            sightings.frame, corners, seen.by_point, by_lens, residual, weight / sigmas.corner_px**2, frames
        )
        segment, u = locate(sightings.stamp_s + mount.shift_s, spline.step_s, spline.segments)
        parts.append(frame_rows(
            segment, u, points, whole, pull, mount.rotation, mount.place_m, number * MOUNT,
            problem.lens_at[number], width,
        ))  # fmt: skip
        residuals.append(residual)
    imu = problem.imu
    segment, u = locate(imu.time_s, spline.step_s, spline.segments)
    rows = imu_rows(
        segment, u, points,
        InertialReadings(
            imu.gyro_radps, spline.gyro_bias_radps, state.gyro_matrix, sigmas.gyro_radps * imu.gyro_loose
        ),
        InertialReadings(
            imu.accel_mps2, spline.accel_bias_mps2, state.accel_matrix, sigmas.accel_mps2 * imu.accel_loose
        ),
        state.gravity_mps2, tangent_basis(state.gravity_mps2), MOUNT * len(problem.sightings), problem.scales,
        width,
    )  # fmt: skip
    parts.append(rows)
    samples = Samples(*(np.concatenate([part[k] for part in parts]) for k in range(4)))
    bias = np.hstack([spline.gyro_bias_radps, spline.accel_bias_mps2])
    walk = np.repeat([sigmas.gyro_walk, sigmas.accel_walk], 3) * np.sqrt(spline.step_s)
    walks = RandomWalks(np.diff(bias, axis=0), walk)
    cost += float((rows[1] ** 2).sum()) + float(((walks.difference / walk) ** 2).sum())
    return Linearised(tuple(residuals), samples, walks, cost)


def corner_residuals(
    sightings: CornerObservations, mount: Mount, spline: PoseSpline
) -> tuple[Float64, Float64]:
    """Compute the corners (N, 3) in the camera's frame and the residuals (N, 2) px, observed minus
    projected.
    """
    motion = spline.at(sightings.stamp_s + mount.shift_s)
    body = np.einsum(
        "nji,nj->ni", motion.rotation[sightings.frame], sightings.points_m - motion.place_m[sightings.frame]
    )
    points = (body - mount.place_m) @ mount.rotation
    points[:, 2] = np.maximum(points[:, 2], NEAREST_Z_M)
    lens, parameters = lens_of(sightings.camera)
    return points, sightings.pixels - project_lens(lens, parameters, points).pixels


def retract_state(state: CameraImuState, chain: Float64, common: Float64) -> CameraImuState:
    """Retract a step, chain (M, 12) and common (P,), onto `state`."""
    mounts = []
    for number, mount in enumerate(state.mounts):
        step = common[number * MOUNT : (number + 1) * MOUNT]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        mounts.append(Mount(turn @ mount.rotation, mount.place_m + step[3:6], mount.shift_s + float(step[6])))
    rest = common[MOUNT * len(mounts) :]
    turn = Rotation.from_rotvec(tangent_basis(state.gravity_mps2) @ rest[:2]).as_matrix()
    state = replace(
        state, spline=state.spline.moved(chain), mounts=tuple(mounts), gravity_mps2=turn @ state.gravity_mps2
    )
    if rest.size > 2:
        accel = state.accel_matrix.copy()
        for k, (i, j) in enumerate(LOWER):
            accel[i, j] += rest[2 + k]
        gyro = state.gyro_matrix + rest[8:17].reshape(3, 3)
        state = replace(state, accel_matrix=accel, gyro_matrix=gyro)
    return state


def tangent_basis(direction: Float64) -> Float64:
    """Compute two unit axes (3, 2) orthogonal to a direction, about which it can be rotated."""
    least = np.eye(3)[int(np.abs(direction).argmin())]
    first = np.cross(direction, least)
    first /= np.linalg.norm(first)
    second = np.cross(direction, first)
    return np.column_stack([first, second / np.linalg.norm(second)])


def lens_of(camera: Camera) -> tuple[Lens, Float64]:
    """Convert a camera to its lens model and the parameters that `project_lens` takes."""
    coefficients = camera.coefficients or (0.0,) * 4
    lens = (
        Lens.EQUIDISTANT
        if camera.distortion is Distortion.EQUIDISTANT
        else Lens(f"radtan{len(coefficients)}")
    )
    return lens, np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *coefficients])
