"""Calibrate cameras against an IMU from a recording of a board [Furgale 2013; paper Eq. 8-10].

Corners, gyro and accelerometer are weighted by their own scatter. The corners of one picture share errors
(board, lens, blur), so a picture is weighted by the scatter of whole pictures, not of single corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.board import Board
from barsight.calibration.boards.board_views import BoardView
from barsight.calibration.camera_imu.problem import (
    MOUNT,
    CameraImuProblem,
    CameraImuState,
    CornerObservations,
)
from barsight.calibration.camera_imu.setup import prepare
from barsight.calibration.camera_imu.solver import ResidualSpread, Solution, sensor_spreads, solve_camera_imu
from barsight.calibration.camera_imu.uncertainty import Uncertainty, uncertainty
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64
from barsight.core.errors import CalibrationError
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import seconds_to_ns

HUBER = 3.0
CORNER_SIGMAS = 4.5
KNOCK_SAMPLES, KNOCK_FACTOR = 15, 2.0
WEIGHT_ROUNDS = 5
SETTLED = 0.03
MIN_INFLATION = 1.02


@dataclass(frozen=True, eq=False)
class CameraImuCalibration:
    """A calibrated rig, whose body is the IMU, and its uncertainty.

    problem: the measurements used, with the estimated sigmas. stated: the IMU noise as given. solution: the
    body's trajectory and the residuals. corner_px: noise of single corners, whereas problem.sigmas.corner_px
    is the scatter of whole pictures. spreads: scatter of corners, gyro and accelerometer relative to their
    sigmas. removed_corners: number of outliers. lenses: (L, L) covariance of the lens parameters, which were
    held fixed, by `uncertainty.lens_names`; None if unknown.
    """

    source: Path
    board: Board
    rig: StereoRig
    stated: ImuNoise
    problem: CameraImuProblem
    solution: Solution
    spreads: tuple[ResidualSpread, ResidualSpread, ResidualSpread]
    uncertainty: Uncertainty
    corner_px: float
    removed_corners: int
    notes: tuple[str, ...]
    lenses: Float64 | None = None

    @property
    def covariance(self) -> Float64:
        """Return the covariance (P, P) of the common parameters, all causes together: what lenses are off by,
        the mountings take up.
        """
        known = self.uncertainty
        if self.lenses is None:
            return known.covariance
        return np.asarray(known.covariance + known.by_lens @ self.lenses @ known.by_lens.T)

    @property
    def sigma(self) -> Float64:
        """Return the standard deviation (P,) of each common parameter from all error sources together."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def baseline_sigma_m(self) -> float:
        """Return the standard deviation of the distance between the cameras."""
        first, second = self.solution.state.mounts
        direction = (second.place_m - first.place_m) / np.linalg.norm(second.place_m - first.place_m)
        row = np.zeros(self.sigma.size)
        row[3:6], row[MOUNT + 3 : MOUNT + 6] = -direction, direction
        return float(np.sqrt(row @ self.covariance @ row))

    def with_lenses(self, names: Sequence[str], covariance: Float64) -> CameraImuCalibration:
        """Add the covariance of the lens parameters from a rig file: names (C,) and values (C, C).

        Returns the same calibration if one of its lens parameters is missing there.
        """
        wanted = self.uncertainty.lens_names
        if not set(wanted) <= set(names):
            return self
        at = [tuple(names).index(name) for name in wanted]
        return replace(self, lenses=covariance[np.ix_(at, at)])


def calibrate_camera_imu(
    views: Sequence[BoardView], imu: ImuSamples, rig: StereoRig, board: Board, noise: ImuNoise, source: Path,
    *, scales: bool = False,
) -> CameraImuCalibration:  # fmt: skip
    """Calibrate from detections. Only the lenses are taken from `rig`; a view's name is its stamp in ns.

    scales: estimate the IMU's scales and misalignments too. Raises CalibrationError that names the remedy.
    """
    setup = prepare(views, imu, rig, board, noise, source)
    problem = replace(setup.problem, scales=scales)
    try:
        solution = solve_camera_imu(problem, setup.start, HUBER)
        problem, corner_px, removed = _without_outliers(problem, solution)
        problem, knocks = _without_knocks(problem, solution)
        problem, solution, spreads = _weighted(problem, solution.state, corner_px)
        known = uncertainty(problem, solution)
        solved = _rig(rig, solution.state)
    except np.linalg.LinAlgError:
        raise CalibrationError(
            source, "the body's way can't be determined from this recording",
            "keep the board in sight of both cameras while the rig moves",
        ) from None  # fmt: skip
    except ValueError as error:
        raise CalibrationError(source, str(error), "check that the cameras aren't exchanged") from None
    if not solution.converged:
        raise CalibrationError(
            source, "the calibration doesn't converge", "record again with the board in sight throughout"
        )
    return CameraImuCalibration(
        source,
        board,
        solved,
        noise,
        problem,
        solution,
        spreads,
        known,
        corner_px,
        removed,
        (*setup.notes, *knocks),
    )


def _without_outliers(problem: CameraImuProblem, solution: Solution) -> tuple[CameraImuProblem, float, int]:
    """Remove corners beyond 4.5 robust sigma; also return that sigma (px) and the number of corners
    removed.
    """
    lengths = [np.linalg.norm(residual, axis=1) for residual in solution.linearised.residuals_px]
    sigma = float(np.median(np.concatenate(lengths)) / np.sqrt(2 * np.log(2)))
    kept, removed = [], 0
    for sightings, length in zip(problem.sightings, lengths, strict=True):
        good = length <= CORNER_SIGMAS * sigma
        removed += int((~good).sum())
        kept.append(_chosen(sightings, good))
    sigmas = replace(problem.sigmas, corner_px=sigma)
    return replace(problem, sightings=tuple(kept), sigmas=sigmas), sigma, removed


def _without_knocks(
    problem: CameraImuProblem, solution: Solution
) -> tuple[CameraImuProblem, tuple[str, ...]]:
    """Down-weight IMU readings that scatter more than twice as much as usual; also return a sentence on
    where.
    """
    track = problem.imu
    rows = solution.linearised.samples.residual[-track.time_s.size :]
    window = np.ones(KNOCK_SAMPLES) / KNOCK_SAMPLES
    factors = []
    for axes in (slice(0, 3), slice(3, 6)):
        scatter = np.sqrt(np.convolve((rows[:, axes] ** 2).mean(axis=1), window, mode="same"))
        ratio = scatter / np.median(scatter)
        factors.append(np.where(ratio > KNOCK_FACTOR, ratio, 1.0))
    problem = replace(problem, imu=replace(track, gyro_loose=factors[0], accel_loose=factors[1]))
    shaken = np.maximum(*factors) > 1
    if not shaken.any():
        return problem, ()
    seconds = sorted({int(time) for time in track.time_s[shaken]})
    places = ", ".join(f"{second} s" for second in seconds[:6]) + (" ..." if len(seconds) > 6 else "")
    note = f"knocks or vibration near {places}: {int(shaken.sum())} readings of the IMU count less"
    return problem, (note,)


def _chosen(sightings: CornerObservations, good: np.typing.NDArray[np.bool_]) -> CornerObservations:
    return replace(
        sightings, frame=sightings.frame[good], ids=sightings.ids[good], points_m=sightings.points_m[good],
        pixels=sightings.pixels[good],
    )  # fmt: skip


def _weighted(
    problem: CameraImuProblem, state: CameraImuState, corner_px: float
) -> tuple[CameraImuProblem, Solution, tuple[ResidualSpread, ResidualSpread, ResidualSpread]]:
    """Solve repeatedly, re-estimating each sensor's sigma from its residuals, until the sigmas settle.

    The sigmas of the IMU are only ever raised above the stated noise, and no picture is weighted more
    strongly than the noise of its corners allows.
    """
    stated = problem.sigmas
    for _ in range(WEIGHT_ROUNDS):
        solution = solve_camera_imu(problem, state, None)
        spreads = sensor_spreads(problem, solution)
        sigmas = problem.sigmas
        wanted = replace(
            sigmas,
            corner_px=max(corner_px, sigmas.corner_px * spreads[0].factor),
            gyro_radps=_raised(stated.gyro_radps, sigmas.gyro_radps * spreads[1].factor),
            accel_mps2=_raised(stated.accel_mps2, sigmas.accel_mps2 * spreads[2].factor),
        )
        pairs = (
            (wanted.corner_px, sigmas.corner_px), (wanted.gyro_radps, sigmas.gyro_radps),
            (wanted.accel_mps2, sigmas.accel_mps2),
        )  # fmt: skip
        if all(abs(new / old - 1) < SETTLED for new, old in pairs):
            break
        problem, state = replace(problem, sigmas=wanted), solution.state
    return problem, solution, spreads


def _raised(stated: float, shown: float) -> float:
    """Raise the stated noise where the residuals clearly exceed it."""
    return shown if shown > MIN_INFLATION * stated else stated


def _rig(rig: StereoRig, state: CameraImuState) -> StereoRig:
    first, second = state.mounts
    poses = [
        Pose("body", name, mount.rotation, mount.place_m)
        for name, mount in (("cam0", first), ("cam1", second))
    ]
    return StereoRig(rig.cam0, rig.cam1, poses[0], poses[1], seconds_to_ns(first.shift_s))


def subtract_mounts(state: CameraImuState, other: CameraImuState) -> Float64:
    """Subtract the mountings of `other` from those of `state` (14,), in the order of the common
    parameters.
    """
    parts: list[Float64] = []
    for own, their in zip(state.mounts, other.mounts, strict=True):
        turn = Rotation.from_matrix(own.rotation @ their.rotation.T).as_rotvec()
        parts += [turn, own.place_m - their.place_m, np.array([own.shift_s - their.shift_s])]
    return np.concatenate(parts)
