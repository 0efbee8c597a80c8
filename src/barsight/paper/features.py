"""Detect, match and filter features as the paper does [Figures 4, 5, 8, 9; Tables 2, 3], on two views."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from barsight.benchmarks.motion.matching import stereo_places
from barsight.benchmarks.motion.matching_truth import TrueStep, reproject, true_steps
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import InputError
from barsight.core.records.pairs import RectifiedPair
from barsight.core.records.trajectory import PosedFrame
from barsight.features.detectors import DETECTORS, DetectorName, make_detector
from barsight.features.guided_matching import project_stereo, triangulate_stereo
from barsight.features.matching import homography_inliers, is_mutual, motion_inliers, nearest_neighbours
from barsight.features.patch_alignment import PatchPair, patch_pair
from barsight.motion.frame_to_frame.motion_trend import MotionTrend
from barsight.motion.frame_to_frame.stitching import StitchingSettings
from barsight.motion.settings import MotionSettings, make_estimator
from barsight.paper.pictures import BLUE, GREEN, ORANGE, WIDTH_PX, PaperPicture, draw_lines, picture_of
from barsight.recording.base import Recording
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.recording.sensor_selection import SelectedSensors
from barsight.report.match_images import canvas_of

TRUE_PX = 2.0
COUNT = 2000


@dataclass(frozen=True, eq=False)
class TwoViews:
    """Two successive views, and the trend's new_from_old of rect0: rotation, translation (None: unknown).

    reproject: gives the features' true new positions, NaN if unknown; None without truth. true_depth_m: (H,
    W) of the old rectified view, None without truth.
    """

    old: PatchPair
    new: PatchPair
    trend: tuple[Float64, Float64] | None
    reproject: Callable[[Float64], Float64] | None
    true_depth_m: Float64 | None


@dataclass(frozen=True, eq=False)
class FilteredMatches:
    """One detector on two views. places, target, expected: (N, 2) px: old position, match, and prediction
    by the trend (NaN if unknown). initial, on_plane, kept: (N,), matches left after each filter.
    detect_ms, total_ms: times. true_before, true_plane, true_after: true matches among those left after
    each filter, %; kept_true: share of the true initial matches that is left at the end, % (NaN without
    truth).
    """

    detector: str
    places: Float64
    target: Float64
    expected: Float64
    initial: Bool
    on_plane: Bool
    kept: Bool
    detect_ms: float
    total_ms: float
    true_before: float
    true_plane: float
    true_after: float
    kept_true: float


def two_views(recording: Recording) -> TwoViews:
    """Choose the first two views with true depth, else the middle two, and predict the motion by the IMU."""
    step = None
    if (recording.path / "truth").is_dir():
        try:
            step = true_steps(recording.path)[0]
        except InputError:
            step = None
    rectifier = Rectifier(recording.rig)
    if step is not None:
        old, new = step.old, step.new
    else:
        pairs = [
            pair
            for pair in RectifiedPairs(recording, rectifier)(_middle(recording))
            if isinstance(pair, RectifiedPair)
        ]
        if len(pairs) < 2:
            raise InputError(recording.path, "its middle frames aren't whole", "give another recording")
        old, new = patch_pair(pairs[0]), patch_pair(pairs[1])
    trend = _trend(recording, rectifier, old.pair.stamp_ns, new.pair.stamp_ns)
    if step is None:
        return TwoViews(old, new, trend, None, None)
    return TwoViews(old, new, trend, lambda places: reproject(step, places), _rectified_depth(step))


def _rectified_depth(step: TrueStep) -> Float64:
    """Resample the raw camera's true depth to the rectified view (H, W)."""
    camera, rig = step.rectifier.camera, step.recording.rig
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y = (column - camera.cx_px) / camera.focal_px, (row - camera.cy_px) / camera.focal_px
    rays = np.dstack([x, y, np.ones_like(x)]).reshape(-1, 3)
    raw = (rig.body_from_cam0.inverse() @ step.rectifier.body_from_rect0).apply(rays * 1e6) / 1e6
    pixels = rig.cam0.project(raw)
    depth = map_coordinates(step.depth_m, [pixels[:, 1], pixels[:, 0]], order=0, cval=np.nan)
    true: Float64 = (depth / raw[:, 2]).reshape(column.shape)
    return np.where(np.isfinite(true), true, np.nan)


def _middle(recording: Recording) -> set[int]:
    stamps = recording.index.stamps_ns
    return set(stamps[len(stamps) // 2 : len(stamps) // 2 + 2])


def _trend(
    recording: Recording, rectifier: Rectifier, old_ns: int, new_ns: int
) -> tuple[Float64, Float64] | None:
    """Predict the motion by [paper Eq. 11] from the poses of the paper's stitching up to the old view."""
    alone = SelectedSensors(recording, ("stereo", "imu"))
    imu = alone.imu()
    if imu is None:
        return None
    trend = MotionTrend(imu, alone)
    poses = make_estimator(MotionSettings(estimator="paper")).begin(alone, rectifier)
    wanted = {stamp for stamp in recording.index.stamps_ns if stamp <= old_ns}
    for seen in RectifiedPairs(recording, rectifier)(wanted):
        placed = poses.push(seen)
        if isinstance(placed, PosedFrame):
            trend.predict(placed.stamp_ns)
            trend.correct(placed.stamp_ns, placed.reference_from_body)
    moved = trend.predict(new_ns)
    if moved is None:
        return None
    body = rectifier.body_from_rect0
    step = body.inverse() @ moved.inverse() @ body
    return step.rotation, step.translation


def feature_rows(views: TwoViews) -> tuple[FilteredMatches, ...]:
    """Detect, match and filter by each detector [paper Tables 2, 3]."""
    return tuple(_match(views, name) for name in DETECTORS)


def _match(views: TwoViews, name: DetectorName) -> FilteredMatches:
    detector = make_detector(name)
    begin = time.perf_counter()
    first = detector(views.old.pair.left, COUNT)
    detect = time.perf_counter() - begin
    second = detector(views.new.pair.left, COUNT)
    places = first.pixels.astype(np.float64)
    forward = nearest_neighbours(first.descriptors, second.descriptors)
    backward = nearest_neighbours(second.descriptors, first.descriptors)
    initial = is_mutual(forward, backward)
    target = np.full_like(places, np.nan)
    if len(second):
        target = np.where(initial[:, None], second.pixels[forward.index], np.nan).astype(np.float64)
    plane = np.zeros(len(places), np.bool_)
    plane[initial] = homography_inliers(places[initial], target[initial])
    kept, expected = plane.copy(), np.full_like(places, np.nan)
    if views.trend is not None and len(places):
        camera = views.old.pair.camera
        stereo, _, known = stereo_places(views.old, places)
        points = triangulate_stereo(np.where(known[:, None], stereo, [1e3, 0, 0]), camera)
        rotation, translation = views.trend
        kept &= known & motion_inliers(
            points, target, rotation, translation, camera, StitchingSettings().trend_px
        )
        moved = project_stereo(points @ rotation.T + translation, camera)[:, :2]
        expected = np.where(known[:, None], moved, np.nan)
    total = time.perf_counter() - begin
    shares = _true_shares(views, places, target, (initial, plane, kept))
    return FilteredMatches(
        name, places, target, expected, initial, plane, kept, 1e3 * detect, 1e3 * total, *shares
    )


def _true_shares(
    views: TwoViews, places: Float64, target: Float64, chosen: tuple[Bool, Bool, Bool]
) -> tuple[float, float, float, float]:
    """Compute each selection's share of true matches, and that of the first's true ones in the last, %."""
    if views.reproject is None:
        return (np.nan,) * 4
    off = np.linalg.norm(target - views.reproject(places), axis=1)
    true, known = off < TRUE_PX, np.isfinite(off)
    before, plane, after = (_pct(true[one & known]) for one in chosen)
    return before, plane, after, _pct(chosen[2][chosen[0] & true])


def _pct(flags: Bool) -> float:
    return 100 * float(flags.mean()) if flags.size else float("nan")


def draw_features(views: TwoViews, row: FilteredMatches, where: str) -> PaperPicture:
    """Draw the features on the old image [paper Figure 4]."""
    image = views.old.pair.left
    scale = WIDTH_PX / image.shape[1]
    canvas = canvas_of(image, scale)
    for x, y in row.places * scale:
        cv2.circle(canvas, (round(x), round(y)), 2, BLUE, 1, cv2.LINE_AA)
    return picture_of(canvas, f"{row.detector.upper()}, {where}: {len(row.places)} features")


def draw_pairs(views: TwoViews, row: FilteredMatches, where: str, *, filtered: bool) -> PaperPicture:
    """Draw the initial matches [paper Figure 5], or those left after filtering [Figures 8, 9]."""
    image = views.new.pair.left
    scale = WIDTH_PX / image.shape[1]
    canvas = canvas_of(image, scale)
    old, new = row.places * scale, row.target * scale
    if not filtered:
        draw_lines(canvas, old, new, row.initial, ORANGE)
        return picture_of(
            canvas, f"{row.detector.upper()}, {where}: {int(row.initial.sum())} initial matches"
        )
    foreseen = row.initial & np.isfinite(row.expected).all(axis=1)
    draw_lines(canvas, old, row.expected * scale, foreseen, BLUE)
    draw_lines(canvas, old, new, row.kept, GREEN)
    return picture_of(
        canvas, f"{row.detector.upper()}, {where}: {int(row.kept.sum())} of {int(row.initial.sum())} conform"
    )
