"""Reproduce the paper's Tables 2 and 3 (`bench features`, `bench matching`) with precision and recall.

The reference is the true depth of a view and the true poses: a match is true if it lies within 2 px of the
reprojection of the feature's true point. Needs a recording with encoders, IMU and stored true depth.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table
from scipy.spatial import cKDTree

from barsight.benchmarks.motion.matching_truth import TrueStep, reproject, true_steps
from barsight.benchmarks.provenance import Provenance, Timing, provenance, summarise_times, time_repeats
from barsight.core.arrays import Bool, Float64, UInt8
from barsight.core.errors import Failed, InputError
from barsight.core.pose import Pose
from barsight.core.stamps import seconds_to_ns
from barsight.features.detectors import DETECTORS, DetectorName, Keypoints, make_detector
from barsight.features.guided_matching import (
    PredictedMotion,
    match_across,
    match_left,
    predict_projections,
    triangulate_stereo,
)
from barsight.features.matching import (
    homography_inliers,
    is_mutual,
    motion_inliers,
    nearest_neighbours,
    ratio_test,
)
from barsight.features.patch_alignment import PatchPair
from barsight.features.self_similarity import texture_period_px
from barsight.features.tracks import Tracks
from barsight.inertial.model import GRAVITY_MPS2, ORDINARY_NOISE, BodyState, ImuBias
from barsight.inertial.preintegration import Preintegrator
from barsight.motion.crane.encoder_trajectory import fit_position
from barsight.motion.frontend.motion_consensus import motion_consensus
from barsight.motion.frontend.motion_prediction import CranePredictor
from barsight.motion.frontend.settings import FrontEndSettings
from barsight.stereo.search_range import coarse_disparity

TRUE_PX = 2.0
TREND_PX = 5.0
"""Largest distance, px, of a match from the position that the paper's motion trend predicts."""
NEIGHBOURS = 5
GUESSED_PX = 2.0
"""Standard deviation, px, of a disparity interpolated from neighbours, and the largest spread of those
neighbours' disparities at which they count as agreeing.
"""


@dataclass(frozen=True)
class FeatureRow:
    """Features of one detector in one image."""

    recording: str
    detector: str
    features: int
    time: Timing


@dataclass(frozen=True)
class MatchRow:
    """One filter after one detector on one recording. precision: share of its matches that are true. kept:
    share of the true initial matches that it keeps (NaN if there are none).
    """

    recording: str
    detector: str
    step: str
    pairs: int
    precision: float
    kept: float
    ms: float


@dataclass(frozen=True)
class MatchingBench:
    """The rows, and the machine and commit that they were measured with."""

    made: Provenance
    features: tuple[FeatureRow, ...]
    matches: tuple[MatchRow, ...]


def bench_features(
    paths: tuple[Path, ...], detectors: tuple[DetectorName, ...] = DETECTORS, count: int = 2000,
    repeats: int = 5,
) -> MatchingBench:  # fmt: skip
    """Count and time the features in each recording's first view with true depth [paper Table 2]."""
    rows = []
    for path in paths:
        image = true_steps(path)[0].old.pair.left
        for name in detectors:
            found, seconds = time_repeats(_detecting(name, image, count), repeats)
            rows.append(FeatureRow(path.name, name, len(found), summarise_times(seconds)))
    return MatchingBench(provenance(), tuple(rows), ())


def _detecting(name: DetectorName, image: UInt8, count: int) -> Callable[[], Keypoints]:
    return lambda: make_detector(name)(image, count)


def bench_matching(
    paths: tuple[Path, ...], detectors: tuple[DetectorName, ...] = DETECTORS, count: int = 2000
) -> MatchingBench:
    """Measure precision and recall of the matching [paper Table 3], pooled over each recording's steps."""
    rows: list[MatchRow] = []
    for path in paths:
        steps = true_steps(path)
        for name in detectors:
            tables = [_match(step, name, count) for step in steps]
            for k, first in enumerate(tables[0]):
                parts = [table[k] for table in tables]
                pairs, right = sum(part[1] for part in parts), sum(part[2] for part in parts)
                true = sum(part[3] for part in parts)
                rows.append(
                    MatchRow(
                        path.name, name, first[0], pairs, right / pairs if pairs else float("nan"),
                        sum(part[4] for part in parts) / true if true else float("nan"),
                        1e3 * sum(part[5] for part in parts) / len(parts),
                    )
                )  # fmt: skip
    return MatchingBench(provenance(), (), tuple(rows))


def _match(step: TrueStep, name: DetectorName, count: int) -> list[tuple[str, int, int, int, int, float]]:
    """Match one step with every filter.

    Returns for each filter: name, counts of judged matches, true ones, true initial ones and true initial
    ones kept, and time, s.
    """
    detector = make_detector(name)
    begin = time.perf_counter()
    first, second = detector(step.old.pair.left, count), detector(step.new.pair.left, count)
    places = first.pixels.astype(np.float64)
    forward = nearest_neighbours(first.descriptors, second.descriptors)
    backward = nearest_neighbours(second.descriptors, first.descriptors)
    start = time.perf_counter() - begin
    target = second.pixels[forward.index].astype(np.float64)
    true_place = reproject(step, places)
    judged = np.isfinite(true_place).all(axis=1)
    initial_true = judged & (np.linalg.norm(target - true_place, axis=1) < TRUE_PX)

    rows: list[tuple[str, int, int, int, int, float]] = []

    def row(label: str, kept: Bool, found: Float64, seconds: float) -> None:
        kept = kept & judged
        with np.errstate(invalid="ignore"):
            right = kept & (np.linalg.norm(found - true_place, axis=1) < TRUE_PX)
        both = right & initial_true
        rows.append(
            (label, int(kept.sum()), int(right.sum()), int(initial_true.sum()), int(both.sum()), seconds)
        )

    everything = forward.index >= 0
    row("initial", everything, target, start)
    mutual = is_mutual(forward, backward)
    row("mutual", mutual, target, start)
    clear = mutual & ratio_test(forward)
    row("ratio, mutual", clear, target, start)
    begin = time.perf_counter()
    plane = np.zeros(len(places), np.bool_)
    plane[mutual] = homography_inliers(places[mutual], target[mutual])
    plane_s = time.perf_counter() - begin
    row("homography", plane, target, start + plane_s)
    begin = time.perf_counter()
    stereo, sigma, known = stereo_places(step.old, places)
    points = triangulate_stereo(np.where(known[:, None], stereo, [1e3, 0, 0]), step.rectifier.camera)
    moved = _trend(step)
    trend = plane & known & motion_inliers(points, target, *moved, step.rectifier.camera, TREND_PX)
    row("homography, trend", trend, target, start + plane_s + time.perf_counter() - begin)
    begin = time.perf_counter()
    kept, found = _ours(step, stereo, sigma, known)
    row("ours", kept, found, start / 2 + time.perf_counter() - begin)
    return rows


def stereo_places(pair: PatchPair, places: Float64) -> tuple[Float64, Float64, Bool]:
    """Match left to right: u, v, right u (N, 3), px; sigma (N,), px; and which features have a depth (N,)."""
    camera = pair.pair.camera
    coarse = coarse_disparity(pair.pair.left, pair.pair.right, camera.doffs_px)
    row = (places[:, 1] * coarse.shape[0] / camera.height).astype(int)
    column = (places[:, 0] * coarse.shape[1] / camera.width).astype(int)
    guess = coarse[row, column].astype(np.float64)
    right = match_across(pair, places, np.where(np.isfinite(guess), guess, 0.0))
    known = right.found & np.isfinite(guess)
    return np.column_stack([places, right.pixels[:, 0]]), right.sigma_px, known


def _trend(step: TrueStep) -> tuple[Float64, Float64]:
    """Predict new_from_old of rect0 by [paper Eq. 11], from IMU, nominal attitude and encoder velocity."""
    recording, shift = step.recording, step.recording.rig.timeshift_cam_imu_ns
    imu, crane = recording.imu(), recording.crane()
    if imu is None or crane is None:
        raise InputError(
            recording.path, "the motion trend needs IMU and encoders", "choose another recording"
        )
    old_ns, new_ns = step.old.pair.stamp_ns + shift, step.new.pair.stamp_ns + shift
    noise = recording.imu_noise() or ORDINARY_NOISE
    # A run begins and ends at rest, so the means over it are the biases (the paper calibrates them).
    up_in_body = crane.yard_from_body_nominal.T @ np.array([0.0, 0.0, GRAVITY_MPS2])
    bias = ImuBias(imu.gyro_radps.mean(axis=0), imu.accel_mps2.mean(axis=0) - up_in_body)
    place = fit_position(crane, old_ns, seconds_to_ns(0.35))
    motion = Preintegrator(imu, noise).between(old_ns, new_ns, bias)
    if isinstance(place, Failed) or isinstance(motion, Failed):
        raise InputError(
            recording.path, "IMU or encoders don't cover a view with true depth", "choose another"
        )
    start = BodyState(crane.yard_from_body_nominal, place.position_m, place.velocity_mps)
    end = motion.predict(start)
    body_from_rect0 = step.rectifier.body_from_rect0
    yard_from_old = Pose("yard", "body", start.rotation, start.position_m) @ body_from_rect0
    yard_from_new = Pose("yard", "body", end.rotation, end.position_m) @ body_from_rect0
    moved = yard_from_new.inverse() @ yard_from_old
    return moved.rotation, moved.translation


def _ours(step: TrueStep, stereo: Float64, sigma: Float64, known: Bool) -> tuple[Bool, Float64]:
    """Match features within their predicted ellipses with 3D consensus: kept (N,), positions (N, 2)."""
    recording, settings = step.recording, FrontEndSettings()
    crane, imu = recording.crane(), recording.imu()
    assert crane is not None and imu is not None
    bias = imu.gyro_radps.mean(axis=0)
    shift = recording.rig.timeshift_cam_imu_ns
    predictor = CranePredictor(crane, imu, bias, step.rectifier, shift)
    prediction = predictor(step.old.pair.stamp_ns, step.new.pair.stamp_ns)
    kept, found = np.zeros(len(stereo), np.bool_), np.full((len(stereo), 2), np.nan)
    if prediction is None:
        return kept, found
    index = np.flatnonzero(known)
    depth = triangulate_stereo(stereo[index], step.rectifier.camera)[:, 2]
    tracks = Tracks(
        (step.old.left,), step.old.pair, index, stereo[index], sigma[index], np.zeros(len(index), np.int64),
        stereo[index, :2], depth,
    )  # fmt: skip
    agreed = motion_consensus(tracks, step.new, prediction, settings)
    if isinstance(agreed, Failed):
        return kept, found
    kept[index[agreed[0]]] = True
    found[index] = agreed[1].stereo[:, :2]
    _alone(step, stereo, known, agreed[2], kept, found)
    return kept, found


def _alone(
    step: TrueStep, stereo: Float64, known: Bool, motion: PredictedMotion, kept: Bool, found: Float64
) -> None:
    """Add to `kept` and `found` the matches seen in the left images only: features without a match in the
    new right image, and those without one in the old right image, at the disparity on which their
    neighbours agree.
    """
    camera, sigma_px = step.rectifier.camera, FrontEndSettings().tracks.sigma_px
    nearest_known = cKDTree(stereo[known, :2]).query(stereo[:, :2], k=NEIGHBOURS)[1]
    around = (stereo[known, 0] - stereo[known, 2])[nearest_known]
    disparity = np.where(known, stereo[:, 0] - stereo[:, 2], np.median(around, axis=1))
    points = triangulate_stereo(np.column_stack([stereo[:, :2], stereo[:, 0] - disparity]), camera)
    sigmas = np.where(known[:, None], sigma_px, [sigma_px, sigma_px, GUESSED_PX])
    predicted = predict_projections(points, sigmas, motion, camera)
    repeats = texture_period_px(step.old.pair.left, stereo[:, :2])
    pixels, seen = match_left(
        step.old.left, stereo[:, :2], points[:, 2], step.new, predicted, sigma_px, repeats
    )
    seen &= ~kept & (known | (np.ptp(around, axis=1) < GUESSED_PX))
    kept |= seen
    found[seen] = pixels[seen]


def feature_table(bench: MatchingBench) -> Table:
    """Tabulate the features for the terminal."""
    table = Table(title="Features (paper, Table 2)", title_justify="left")
    for column in ("recording", "detector", "features", "ms"):
        table.add_column(column)
    for row in bench.features:
        t = row.time
        table.add_row(
            row.recording, row.detector, str(row.features),
            f"{t.median_ms:.0f} ({t.fastest_ms:.0f}-{t.slowest_ms:.0f})",
        )  # fmt: skip
    return table


def match_table(bench: MatchingBench) -> Table:
    """Tabulate the matches for the terminal."""
    table = Table(title="Matches (paper, Table 3); true within 2 px", title_justify="left")
    for column in ("recording", "detector", "step", "pairs", "precision %", "true kept %", "ms"):
        table.add_column(column)
    for row in bench.matches:
        table.add_row(
            row.recording, row.detector, row.step, str(row.pairs), f"{100 * row.precision:.1f}",
            f"{100 * row.kept:.1f}", f"{row.ms:.0f}",
        )  # fmt: skip
    return table
