"""Prepare a camera-IMU problem with start values from views and IMU samples, or explain why it isn't
possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import make_lsq_spline

from barsight.calibration.boards.board import Board
from barsight.calibration.boards.board_views import BoardView, Corners
from barsight.calibration.camera_imu.initialization import (
    CameraPoses,
    GyroAlignment,
    align_gyro,
    body_poses,
    camera_poses,
)
from barsight.calibration.camera_imu.pose_spline import fit_spline
from barsight.calibration.camera_imu.problem import (
    CameraImuProblem,
    CameraImuState,
    CornerObservations,
    ImuTrack,
    Mount,
    Sigmas,
)
from barsight.calibration.camera_imu.spline_kernels import DEGREE
from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64, Int64
from barsight.core.errors import CalibrationError, Failed
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import NS_PER_S

GRAVITY_MPS2 = 9.80665
MARGIN_S = 0.1
EDGE_S = 0.02
SHORTEST_S = 3.0
FEWEST_CORNERS = 8
GAP_STEPS = 5.0
START_CORNER_PX = 0.5
KNOT_RATES_HZ = (20.0, 30.0, 40.0, 60.0, 80.0, 100.0, 150.0, 200.0)
NOISE_MARGIN = 1.1
MAX_PNP_PX = 4.0
MAX_RIG_RAD, MAX_RIG_RATIO = 0.05, 0.15
MIN_WALK = 1e-3
REMEDIES = {
    "too-few": "keep the board in sight; check its description (board)",
    "still": "turn the rig about all three axes in front of the board",
    "no-overlap": "give the IMU's log of the same recording",
    "no-match": "give the IMU of the same recording, on one rigid body with the cameras",
    "degrees": "the gyroscope is in degrees/s; give gyro_unit deg/s or convert it to rad/s",
    "ratio": "check the gyroscope's unit and the cameras' stamps",
}


@dataclass(frozen=True, eq=False)
class Setup:
    """The problem and its start values. notes: sentences on what was left out."""

    problem: CameraImuProblem
    start: CameraImuState
    notes: tuple[str, ...]


def prepare(
    views: Sequence[BoardView], imu: ImuSamples, rig: StereoRig, board: Board, noise: ImuNoise, source: Path
) -> Setup:
    """Check the recording and find start values. A view's name is its stamp (ns, on the cameras' clock).

    Raises CalibrationError that names the remedy where the recording can't be used.
    """
    imu, notes = _checked_imu(imu, source)
    rate = NS_PER_S / float(np.median(np.diff(imu.stamp_ns)))
    seen = [_seen(views, camera) for camera in (0, 1)]
    if min(len(own[1]) for own in seen) == 0:
        bare = 0 if not seen[0][1] else 1
        raise CalibrationError(
            source, f"cam{bare} never sees the board", "check its description (board) and the pictures"
        )
    first, last = max(s[0][0] for s in seen), min(s[0][-1] for s in seen)
    margin = int(MARGIN_S * NS_PER_S)
    start_ns = max(int(first) - margin, int(imu.stamp_ns[0]))
    end_s = (min(int(last) + margin, int(imu.stamp_ns[-1])) - start_ns) / NS_PER_S
    if end_s <= 0:
        apart = max(int(first) - int(imu.stamp_ns[-1]), int(imu.stamp_ns[0]) - int(last)) / NS_PER_S
        raise CalibrationError(
            source, f"the IMU's log and the pictures don't overlap ({apart:.1f} s apart)",
            "give the IMU's log of the same recording, on the same clock",
        )  # fmt: skip
    if end_s < SHORTEST_S:
        raise CalibrationError(
            source, f"IMU and pictures share only {end_s:.1f} s, {SHORTEST_S:g} are needed",
            "record a minute in front of the board",
        )  # fmt: skip
    time_s = (imu.stamp_ns - start_ns) / NS_PER_S
    ways, kept = [], []
    for camera, (stamps, corners) in zip((rig.cam0, rig.cam1), seen, strict=True):
        at = (stamps - start_ns) / NS_PER_S
        inside = (at > -MARGIN_S) & (at < end_s + MARGIN_S)
        corners = [own for own, good in zip(corners, inside, strict=True) if good]
        ways.append(camera_poses(camera, at[inside], corners, board.points_m))
        kept.append(corners)
    _expect_lenses(ways, source)
    _expect_rig(ways, rig, source)
    aligned = [_aligned(way, time_s, imu.gyro_radps, camera, source) for camera, way in enumerate(ways)]
    within = (time_s >= 0) & (time_s <= end_s)
    even = np.ones(int(within.sum()))
    track = ImuTrack(time_s[within], imu.gyro_radps[within], imu.accel_mps2[within], even, even)
    sigmas = _sigmas(noise, rate)
    step_s = 1 / knot_rate(track, sigmas, rate)
    sightings = tuple(
        _sightings(camera, way, corners, board, found.shift_s, end_s)
        for camera, way, corners, found in zip((rig.cam0, rig.cam1), ways, kept, aligned, strict=True)
    )
    state = _start(ways[0], aligned, time_s, imu, start_ns, end_s, step_s, track)
    return Setup(CameraImuProblem(sightings, track, sigmas), state, notes)


def knot_rate(track: ImuTrack, sigmas: Sigmas, rate_hz: float) -> float:
    """Choose the knot rate (Hz): the lowest one at which a spline fits gyro and accelerometer about as well
    as at a high rate.

    That means a residual scatter, corrected for the degrees of freedom of the fit, of at most 1.1 times the
    stated noise or the lowest scatter at any rate, whichever is larger.
    """
    values = np.column_stack([track.gyro_radps, track.accel_mps2])
    span = track.time_s[-1] - track.time_s[0]
    tried: list[float] = []
    scatter: list[Float64] = []
    for rate in KNOT_RATES_HZ:
        inner = np.linspace(track.time_s[0], track.time_s[-1], max(int(span * rate), 1) + 1)[1:-1]
        knots = np.concatenate([[track.time_s[0]] * (DEGREE + 1), inner, [track.time_s[-1]] * (DEGREE + 1)])
        if rate > 0.5 * rate_hz + 1e-6 and tried:
            break
        rest = values - make_lsq_spline(track.time_s, values, knots, DEGREE)(track.time_s)
        free = len(values) - inner.size - DEGREE - 1
        square = (rest**2).sum(axis=0) / max(free, 1)
        tried.append(rate)
        scatter.append(np.sqrt([square[:3].mean(), square[3:].mean()]))
    limit = NOISE_MARGIN * np.maximum(np.min(scatter, axis=0), [sigmas.gyro_radps, sigmas.accel_mps2])
    return next(rate for rate, own in zip(tried, scatter, strict=True) if (own <= limit).all())


def _checked_imu(imu: ImuSamples, source: Path) -> tuple[ImuSamples, tuple[str, ...]]:
    """Check the log and select its longest stretch without a gap, in SI units and in order of time."""
    if imu.stamp_ns.size < 2:
        raise CalibrationError(source, "the IMU's log is empty", "record the IMU too")
    steps = np.diff(imu.stamp_ns)
    if (steps <= 0).any():
        raise CalibrationError(source, "the IMU's stamps repeat or go back", "sort the log by time")
    if not (np.isfinite(imu.gyro_radps).all() and np.isfinite(imu.accel_mps2).all()):
        raise CalibrationError(source, "the IMU's log holds NaN", "leave those samples out")
    gravity = float(np.median(np.linalg.norm(imu.accel_mps2, axis=1)))
    if not 8.0 < gravity < 12.0:
        unit = "they are probably in g: give accel_unit g" if 0.8 < gravity < 1.25 else "check the unit"
        raise CalibrationError(source, f"the accelerations' median is {gravity:.2f} m/s^2, not 9.8", unit)
    gaps = np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1
    edges = np.concatenate([[0], gaps, [imu.stamp_ns.size]])
    if not gaps.size:
        return imu, ()
    longest = int(np.diff(edges).argmax())
    part = slice(edges[longest], edges[longest + 1])
    note = f"the IMU's log has {gaps.size} gaps; only its longest stretch is used"
    return ImuSamples(imu.stamp_ns[part], imu.gyro_radps[part], imu.accel_mps2[part]), (note,)


def _seen(views: Sequence[BoardView], camera: int) -> tuple[Int64, list[Corners]]:
    found = sorted(
        (int(view.name), corners)
        for view in views
        if (corners := view.cameras[camera]) is not None and corners.ids.size >= FEWEST_CORNERS
    )
    return np.array([stamp for stamp, _ in found], dtype=np.int64), [corners for _, corners in found]


def _expect_lenses(ways: Sequence[CameraPoses], source: Path) -> None:
    for camera, way in enumerate(ways):
        error = float(np.median(way.error_px))
        if not error <= MAX_PNP_PX:
            raise CalibrationError(
                source, f"cam{camera}'s lens doesn't fit the corners (they lie {error:.1f} px off)",
                "give the rig and board that these pictures were taken with, cam0 the left camera",
            )  # fmt: skip


def _expect_rig(ways: Sequence[CameraPoses], rig: StereoRig, source: Path) -> None:
    """Compare the stereo extrinsics that the views imply with the rig file's, to detect swapped cameras or
    another rig.
    """
    _, left, right = np.intersect1d(ways[0].stamp_s, ways[1].stamp_s, return_indices=True)
    if left.size == 0:
        return
    turns = ways[0].rotation[left].transpose(0, 2, 1) @ ways[1].rotation[right]
    apart = ways[1].place_m[right] - ways[0].place_m[left]
    place = np.median(np.einsum("nji,nj->ni", ways[0].rotation[left], apart), axis=0)
    if place[0] < 0 and abs(place[0]) > np.abs(place[1:]).max():
        raise CalibrationError(
            source, f"left and right are swapped: cam1 lies {-place[0] * 1e3:.0f} mm to the left of cam0",
            "exchange the two cameras",
        )  # fmt: skip
    stated = rig.cam0_from_cam1
    angle = np.arccos(np.clip((np.einsum("nij,ij->n", turns, stated.rotation) - 1) / 2, -1, 1))
    off = float(np.linalg.norm(place - stated.translation))
    if float(np.median(angle)) > MAX_RIG_RAD or off > MAX_RIG_RATIO * rig.baseline_m:
        raise CalibrationError(
            source,
            f"the views place cam1 {off * 1e3:.0f} mm and {np.degrees(np.median(angle)):.1f} degrees from "
            "where the rig file does",
            "give the rig file of these cameras",
        )


def _aligned(
    way: CameraPoses, time_s: Float64, gyro_radps: Float64, camera: int, source: Path
) -> GyroAlignment:
    found = align_gyro(way, time_s, gyro_radps)
    if isinstance(found, Failed):
        raise CalibrationError(source, f"cam{camera}: {found.reason}", REMEDIES[found.code])
    return found


def _sigmas(noise: ImuNoise, rate_hz: float) -> Sigmas:
    """Convert noise densities to sigmas per reading.

    A random walk of zero is replaced, as it would tie the biases too rigidly for floating-point arithmetic.
    """
    root = np.sqrt(rate_hz)
    return Sigmas(
        START_CORNER_PX, float(noise.gyro_density * root), float(noise.accel_density * root),
        max(noise.gyro_walk, MIN_WALK * noise.gyro_density),
        max(noise.accel_walk, MIN_WALK * noise.accel_density),
    )  # fmt: skip


def _sightings(
    camera: Camera, way: CameraPoses, corners: Sequence[Corners], board: Board, shift_s: float, end_s: float
) -> CornerObservations:
    """Select the corners of frames that are within the shifted spline and have a credible board pose."""
    at = way.stamp_s + shift_s
    usual = float(np.median(way.error_px))
    good = (at > EDGE_S) & (at < end_s - EDGE_S) & (way.error_px < max(5 * usual, MAX_PNP_PX))
    chosen = np.flatnonzero(good).tolist()
    frame = np.concatenate([np.full(corners[k].ids.size, n) for n, k in enumerate(chosen)])
    ids = np.concatenate([corners[k].ids for k in chosen])
    pixels = np.concatenate([corners[k].pixels for k in chosen])
    return CornerObservations(camera, way.stamp_s[chosen], frame, ids, board.points_m[ids], pixels)


def _start(
    way: CameraPoses, aligned: Sequence[GyroAlignment], time_s: Float64, imu: ImuSamples, start_ns: int,
    end_s: float, step_s: float, track: ImuTrack,
) -> CameraImuState:  # fmt: skip
    spline = fit_spline(start_ns, end_s, step_s, *body_poses(way, aligned[0], time_s, imu.gyro_radps))
    bias = np.tile(aligned[0].gyro_bias_radps, (len(spline.places_m), 1))
    spline = replace(spline, gyro_bias_radps=bias)
    motion = spline.at(track.time_s)
    gravity = -np.einsum("nij,nj->i", motion.rotation, track.accel_mps2)
    mounts = tuple(Mount(found.rotation, np.zeros(3), found.shift_s) for found in aligned)
    return CameraImuState(
        spline, mounts, gravity * GRAVITY_MPS2 / np.linalg.norm(gravity), np.eye(3), np.eye(3)
    )
