"""Stitch point clouds, draw maps and contours, and score them [paper Figures 10-12, Table 4]."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.heights import Contour
from barsight.core.records.pairs import RectifiedPair
from barsight.core.records.sensor_samples import LaserProfile
from barsight.core.records.trajectory import Trajectory
from barsight.evaluation.trajectory_error import trajectory_drift
from barsight.mapping.surface.contours import smooth_contour
from barsight.paper.pictures import BLUE, RED, WIDTH_PX, PaperPicture, line_picture, picture_of
from barsight.paper.published import RELATIVE_TO_M
from barsight.recording.base import Recording
from barsight.recording.formats.ground_truth import truth_of
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.report.map_images import paint_height, read_raster, robust_range
from barsight.result_folder import read_contours, read_laser
from barsight.stereo.search_range import find_disparity_range
from barsight.stereo.settings import StereoSettings, make_method

_CELL_M = 0.02


@dataclass(frozen=True)
class DriftRow:
    """One trajectory: frames placed and in total, aligned RMSE (mm), drift (%), attitude RMSE (deg)."""

    what: str
    placed: int
    frames: int
    rmse_mm: float
    drift_pct: float
    turn_deg: float


@dataclass(frozen=True)
class ContourScore:
    """Vision minus laser over a folder's contours, both filtered. relative_pct: MAE relative to the
    paper's 3.77 m and to the stack's height; max_relative_pct: largest error relative to the same lengths.
    """

    samples: int
    mae_mm: float
    max_mm: float
    relative_pct: tuple[float, float]
    max_relative_pct: tuple[float, float]
    stack_m: float


def drift_row(what: str, trajectory: Trajectory, recording: Recording) -> DriftRow:
    """Compare a trajectory with the true one; NaN without truth."""
    truth, nan = truth_of(recording), float("nan")
    drift = None
    if truth is not None and len(trajectory.frames) > 2:
        drift = trajectory_drift(trajectory, truth, recording.rig.timeshift_cam_imu_ns, 5.0)
    total, placed = len(recording.index.stamps_ns), len(trajectory.frames)
    if drift is None:
        return DriftRow(what, placed, total, nan, nan, nan)
    return DriftRow(what, placed, total, drift.aligned_rmse_mm, drift.drift_percent, drift.aligned_rmse_deg)


def view_clouds(recording: Recording, trajectory: Trajectory, apart: int) -> list[tuple[Float64, Pose]]:
    """Triangulate two views `apart` frames from each other by the paper's stereo: for each, points (N, 3)
    in rect0 and reference_from_rect0.
    """
    rectifier, frames = Rectifier(recording.rig), trajectory.frames
    first = max(0, len(frames) // 2 - apart)
    chosen = {frames[k].stamp_ns: frames[k] for k in (first, min(first + apart, len(frames) - 1))}
    clouds = []
    for pair in RectifiedPairs(recording, rectifier)(set(chosen)):
        if not isinstance(pair, RectifiedPair) or pair.stamp_ns not in chosen:
            continue
        points = cloud_of(pair)
        pose = chosen[pair.stamp_ns].reference_from_body @ rectifier.body_from_rect0
        clouds.append((points, pose))
    return clouds


def cloud_of(pair: RectifiedPair) -> Float64:
    """Triangulate a pair by the paper's stereo: points (N, 3) in rect0, m."""
    candidates = find_disparity_range(pair)
    if isinstance(candidates, Failed):
        return np.empty((0, 3))
    disparity = make_method(StereoSettings(method="paper"))(pair, candidates).disparity_px
    row, column = np.nonzero(np.isfinite(disparity))
    camera = pair.camera
    depth = (
        camera.focal_px * camera.baseline_m / (disparity[row, column].astype(np.float64) + camera.doffs_px)
    )
    x, y = (column - camera.cx_px) / camera.focal_px, (row - camera.cy_px) / camera.focal_px
    points: Float64 = np.column_stack([x, y, np.ones_like(x)]) * depth[:, None]
    return points[(depth > 0.5) & (depth < 40)]


def stitched_pair(clouds: list[tuple[Float64, Pose]]) -> tuple[PaperPicture, ...]:
    """Draw two clouds from above in two colours, before and after stitching [paper Figure 10]."""
    if len(clouds) < 2:
        return ()
    start = clouds[0][1]
    before = [start.apply(points) for points, _ in clouds]
    after = [pose.apply(points) for points, pose in clouds]
    return (
        _two_colours(
            before, "Before: the first view red, the second blue-green, as if both were taken from one place"
        ),
        _two_colours(
            after, "After: each where the paper's stitching has it; gray to white, by height, where both are"
        ),
    )


def _two_colours(clouds: list[Float64], caption: str) -> PaperPicture:
    together = np.vstack(clouds)
    low, high = np.percentile(together[:, :2], 0.5, axis=0), np.percentile(together[:, :2], 99.5, axis=0)
    size = np.maximum(np.ceil((high - low) / (2 * _CELL_M)).astype(int), 1)
    canvas = np.zeros((size[1] + 1, size[0] + 1, 3), np.uint8)
    z_low, z_high = np.percentile(together[:, 2], (1, 99))
    for cloud, channels in zip(clouds, ((0,), (1, 2)), strict=True):
        inside = ((cloud[:, :2] >= low) & (cloud[:, :2] <= high)).all(axis=1)
        place = ((cloud[inside, :2] - low) / (2 * _CELL_M)).astype(int)
        light = 90 + 165 * np.clip((cloud[inside, 2] - z_low) / max(z_high - z_low, 1e-6), 0, 1)
        for channel in channels:
            np.maximum.at(canvas[..., channel], (size[1] - place[:, 1], place[:, 0]), light.astype(np.uint8))
    scale = WIDTH_PX / canvas.shape[1]
    return picture_of(cv2.resize(canvas, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST), caption)


def map_picture(out: Path, caption: str) -> PaperPicture:
    """Draw a measured folder's map from above [paper Figure 11]."""
    raster = read_raster(out / "height.tif")
    low, high = robust_range(raster.z_m, 1, 99)
    painted = paint_height(raster, low, high)[..., :3].copy()
    painted[~np.isfinite(raster.z_m)] = 25
    scale = 2 * WIDTH_PX / painted.shape[1]
    small = cv2.resize(painted, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return picture_of(
        small, f"{caption}: violet {low:.2f} m to yellow {high:.2f} m, dark where nothing was seen"
    )


def _filtered(laser: LaserProfile) -> Contour:
    """Filter a laser profile as the paper filters the contour from vision."""
    step = float(np.median(np.diff(laser.x_m)))
    count = round((laser.x_m[-1] - laser.x_m[0]) / step) + 1
    x, z = laser.x_m[0] + step * np.arange(count), np.full(count, np.nan)
    z[np.clip(np.round((laser.x_m - laser.x_m[0]) / step).astype(int), 0, count - 1)] = laser.z_m
    flat = np.full(count, float(np.median(laser.y_m)))
    return smooth_contour(Contour(laser.profile, x, flat, z, np.zeros(count), np.ones(count, np.uint8)))


def _met(out: Path) -> list[tuple[Float64, Float64, Float64]]:
    """Pair each contour with its laser profile, both filtered: x, vision, laser (N,) each, m."""
    lasers = {one.profile: one for one in read_laser(out)}
    met = []
    for contour in read_contours(out):
        if contour.profile in lasers and lasers[contour.profile].x_m.size > 1:
            reference, own = _filtered(lasers[contour.profile]), smooth_contour(contour)
            at = np.interp(own.x_m, reference.x_m, reference.z_m, left=np.nan, right=np.nan)
            met.append((own.x_m, own.z_m, at))
    return met


def contour_picture(out: Path, what: str) -> PaperPicture | None:
    """Draw the first contour and its laser profile, both filtered [paper Figure 12]; None without a laser."""
    met = _met(out)
    if not met:
        return None
    x, own, laser = met[0]
    caption = f"{what}: vision (blue) and laser (red), both through median, cubic interpolation and filter"
    return line_picture([(x, laser, RED), (x, own, BLUE)], ("m", "m"), caption)


def contour_scores(out: Path) -> ContourScore | None:
    """Score a folder's contours against the laser, both filtered [paper Table 4]; None without a laser."""
    met = _met(out)
    errors = np.concatenate([own - laser for _, own, laser in met]) if met else np.empty(0)
    error = np.abs(errors[np.isfinite(errors)])
    if error.size == 0:
        return None
    stack = float(np.nanpercentile(np.concatenate([laser for _, _, laser in met]), 99))
    mae, most = float(error.mean()), float(error.max())
    lengths = (RELATIVE_TO_M, stack)
    return ContourScore(
        int(error.size), 1e3 * mae, 1e3 * most, (100 * mae / lengths[0], 100 * mae / lengths[1]),
        (100 * most / lengths[0], 100 * most / lengths[1]), stack,
    )  # fmt: skip
