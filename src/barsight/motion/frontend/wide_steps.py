"""Tie two views that tracking can't, by features at several scales: long steps, and places seen again.

Bars repeat, and here no sensor tells how long the step is. So a tie must explain most of the tracked points,
and clearly more of them than the same motion plus or minus some bar pitches does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.features.guided_matching import PredictedMotion, predict_projections, triangulate_stereo
from barsight.features.orb import detect_orb
from barsight.features.patch_alignment import PatchPair
from barsight.features.self_similarity import texture_period_px
from barsight.features.tracks import Tracks, TrackSettings, match_tracks
from barsight.motion.frontend.relative_pose import RelativePose, estimate_step
from barsight.motion.frontend.stereo_features import FeatureView, OdometrySettings, match_coarsely

FEATURES = 3000
MIN_WIDE_RATIO = 0.3
"""Minimum share of the points found where nothing repeats; after a step of 3 m by car it is a third to a
half.
"""
MIN_INSIDE, MIN_INSIDE_UNDISPUTED = 0.65, 0.35
"""Minimum share of the tracked points that the new pair must contain, in general and for an undisputed
motion: what lies at the edge of a view may be found elsewhere too.
"""
UNDISPUTED = 0.8
"""Share of the matching features that agree from which no other motion competes (at look-alike places up to
0.7 agree).
"""
REPEATING = 0.1
"""Share of points next to which the picture repeats, from which as many points must agree as after a short
step.
"""
MAX_RIVAL_RATIO = 0.7
"""Maximum ratio of the points found some bars off to those found with the motion itself. One bar off, up to
half as many are found as at the true place.
"""
BARS_OFF = (-2, -1, 1, 2)


def wide_view(pair: PatchPair, settings: OdometrySettings) -> FeatureView | Failed:
    """Detect and describe features at several scales."""
    return match_coarsely(pair, detect_orb(pair.pair.left, max(settings.features, FEATURES)), settings)


@dataclass(frozen=True, eq=False)
class DescribedMotion:
    """Motion with fourfold covariance, and the share of the matched features that agree on it."""

    motion: PredictedMotion
    agreeing: float

    @classmethod
    def of(cls, step: RelativePose) -> DescribedMotion:
        """Build from a step between two views."""
        motion = PredictedMotion(step.rotation, step.translation, 4 * step.covariance)
        return cls(motion, float(step.kept.mean()))


def wide_motion(
    old: FeatureView | Failed, new: FeatureView | Failed, settings: OdometrySettings
) -> DescribedMotion | Failed:
    """Estimate the motion between two views that `wide_view` described."""
    if isinstance(old, Failed):
        return old
    if isinstance(new, Failed):
        return new
    step = estimate_step(old, new, settings)
    return step if isinstance(step, Failed) else DescribedMotion.of(step)


@dataclass(frozen=True, eq=False)
class Repeats:
    """Repetitions in the last tracked view. share: of the points next to which it repeats; pitches_m: (P, 3)
    shifts in the camera's axes that map it onto itself.
    """

    share: float
    pitches_m: Float64

    @classmethod
    def of(cls, tracks: Tracks) -> Repeats:
        """Find the periods along the picture's rows and columns."""
        assert tracks.last is not None
        image, places = tracks.last.left, tracks.stereo[:, :2]
        depth = triangulate_stereo(tracks.stereo, tracks.last.camera)[:, 2]
        along = texture_period_px(image, places)
        across = texture_period_px(np.ascontiguousarray(image.T), np.ascontiguousarray(places[:, ::-1]))
        pitches = []
        for axis, period in enumerate((along, across)):
            metres = period * depth / tracks.last.camera.focal_px
            found = _alike(metres[np.isfinite(metres)], 0.1 * REPEATING * len(places))
            pitches += [pitch * np.eye(3)[axis] for pitch in found]
        share = float((np.isfinite(along) | np.isfinite(across)).mean()) if len(places) else 0.0
        return cls(share, np.array(pitches).reshape(-1, 3))


def check_overlap(
    tracks: Tracks, pair: PatchPair, wide: DescribedMotion, settings: TrackSettings
) -> Failed | None:
    """Fail `ambiguous` where the new pair contains too few tracked points to rule out a look-alike place."""
    points = triangulate_stereo(tracks.stereo, pair.pair.camera)
    inside = predict_projections(points, settings.sigma_px, wide.motion, pair.pair.camera).inside
    least = MIN_INSIDE if wide.agreeing < UNDISPUTED else MIN_INSIDE_UNDISPUTED
    if inside.mean() >= least:
        return None
    return Failed(
        "ambiguous", f"only {inside.sum()} of {len(points)} points can be seen again: elsewhere may be alike"
    )


def check_next_bars(
    tracks: Tracks, pair: PatchPair, motion: PredictedMotion, repeats: Repeats, found: int,
    settings: TrackSettings,
) -> Failed | None:  # fmt: skip
    """Fail `ambiguous` where a motion some bars off explains nearly as many points as the one found."""
    camera = pair.pair.camera
    points = triangulate_stereo(tracks.stereo, camera)
    inside = int(predict_projections(points, settings.sigma_px, motion, camera).inside.sum())
    for pitch in repeats.pitches_m:
        for bars in BARS_OFF:
            moved = replace(motion, translation=motion.translation + bars * pitch)
            places = predict_projections(points, settings.sigma_px, moved, camera)
            matched = int(match_tracks(tracks, pair, places, settings).found.sum())
            if matched * inside > MAX_RIVAL_RATIO * found * max(1, int(places.inside.sum())):
                return Failed(
                    "ambiguous",
                    f"{bars} bars further {matched} points are found, here {found}: another bar may be",
                )
    return None


def _alike(values: Float64, min_count: float) -> list[float]:
    """Group values whose neighbours differ by less than a tenth; return the medians of the large enough
    groups.
    """
    ordered = np.sort(values)
    parts = (
        np.split(ordered, np.flatnonzero(np.diff(ordered) > 0.1 * ordered[:-1]) + 1) if len(values) else []
    )
    return [float(np.median(part)) for part in parts if len(part) >= min_count]
