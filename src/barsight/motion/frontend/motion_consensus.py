"""Find the points that agree on one motion, and that motion."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.features.guided_matching import (
    GuidedMatches,
    PredictedMotion,
    predict_projections,
    triangulate_stereo,
)
from barsight.features.patch_alignment import PatchPair
from barsight.features.self_similarity import texture_period_px
from barsight.features.tracks import Tracks, match_tracks
from barsight.motion.frontend.relative_pose import check_sides, ransac, refine_pose
from barsight.motion.frontend.settings import FrontEndSettings
from barsight.motion.frontend.wide_steps import (
    MIN_WIDE_RATIO,
    REPEATING,
    DescribedMotion,
    Repeats,
    check_next_bars,
    check_overlap,
)

MIN_RATIO = 0.45
"""Minimum share of the unambiguous points in view that must agree. With a motion one bar off, a twentieth of
the points match and agree, on dull bars a third; at the true place most do (six in ten from a car, eight
over a yard).
"""

Consensus = tuple[Bool, GuidedMatches, PredictedMotion]
"""Mask (N,) of the tracked points that agree, the matches of all, and the motion on which they agree."""


def wide_consensus(
    tracks: Tracks, pair: PatchPair, wide: DescribedMotion, settings: FrontEndSettings
) -> Consensus | Failed:
    """Select the points that agree on a motion found by `wide_motion`, unless a motion some bars off fits
    almost as well.
    """
    if failed := check_overlap(tracks, pair, wide, settings.tracks):
        return failed
    repeats = Repeats.of(tracks)
    min_ratio = MIN_RATIO if repeats.share >= REPEATING else MIN_WIDE_RATIO
    found = motion_consensus(tracks, pair, wide.motion, settings, min_ratio)
    if isinstance(found, Failed):
        return found
    kept, _, motion = found
    return check_next_bars(tracks, pair, motion, repeats, int(kept.sum()), settings.tracks) or found


def motion_consensus(
    tracks: Tracks, pair: PatchPair, prediction: PredictedMotion, settings: FrontEndSettings,
    min_ratio: float = MIN_RATIO,
) -> Consensus | Failed:  # fmt: skip
    """Select the points that are found again in their predicted ellipses and agree on one motion in 3D; also
    return that motion.
    """
    assert tracks.last is not None
    repeats = texture_period_px(tracks.last.left, tracks.stereo[:, :2])
    camera = pair.pair.camera
    predicted = predict_projections(
        triangulate_stereo(tracks.stereo, camera), settings.tracks.sigma_px, prediction, camera
    )
    matches = match_tracks(tracks, pair, predicted, settings.tracks, repeats)
    index = np.flatnonzero(matches.found)
    least = settings.rough.min_inliers
    if index.size < least:
        alike = int(matches.ambiguous.sum())
        why = f", {alike} can't be told from the next bar's" if alike else ""
        return Failed("no-matches", f"only {index.size} of {len(tracks.track)} points are found again{why}")
    points, target = triangulate_stereo(tracks.stereo[index], camera), matches.stereo[index]
    start = ransac(points, target[:, :2], camera, settings.rough)
    if isinstance(start, Failed):
        return start
    failed = check_sides(points, target, *start, camera, settings.rough)
    step = failed or refine_pose(points, target, *start, camera, settings.rough)
    if isinstance(step, Failed):
        return step
    kept = np.zeros(len(tracks.track), np.bool_)
    kept[index[step.kept]] = True
    share = kept.sum() / max(1, int((predicted.inside & ~matches.ambiguous).sum()))
    if share < min_ratio:
        return Failed(
            "ambiguous",
            f"only {100 * share:.0f} % of the points are found where they are expected: another bar may be",
        )
    motion = PredictedMotion(step.rotation, step.translation, step.covariance)
    return *_with_ambiguous(tracks, pair, motion, matches, kept, repeats, settings), motion


def _with_ambiguous(
    tracks: Tracks, pair: PatchPair, motion: PredictedMotion, matches: GuidedMatches, kept: Bool,
    repeats: Float64, settings: FrontEndSettings,
) -> tuple[Bool, GuidedMatches]:  # fmt: skip
    """Match the points that were too ambiguous for the prediction again, by the motion found from the
    others.
    """
    left = np.flatnonzero(matches.ambiguous)
    if left.size == 0:
        return kept, matches
    some, camera = tracks.chosen(matches.ambiguous), pair.pair.camera
    places = predict_projections(
        triangulate_stereo(some.stereo, camera), settings.tracks.sigma_px, motion, camera
    )
    again = match_tracks(some, pair, places, settings.tracks, repeats[left])
    stereo, sigma = matches.stereo.copy(), matches.sigma_px.copy()
    kept, ambiguous = kept.copy(), matches.ambiguous.copy()
    stereo[left], sigma[left], kept[left] = again.stereo, again.sigma_px, again.found
    ambiguous[left] = again.ambiguous
    return kept, GuidedMatches(stereo, sigma, matches.found | kept, ambiguous)
