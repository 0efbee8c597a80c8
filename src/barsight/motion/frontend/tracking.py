"""Track points from pair to pair, each frame's motion checked by consensus."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.errors import Failed
from barsight.core.motion_detail import NormalisedResiduals
from barsight.core.types import RectifiedCamera, RectifiedPair, RefusedFrame
from barsight.features.guided_matching import (
    GuidedMatches,
    PredictedMotion,
    predict_projections,
    triangulate_stereo,
)
from barsight.features.orb import describe_upright
from barsight.features.patch_alignment import PatchPair, patch_pair
from barsight.features.self_similarity import texture_period_px
from barsight.features.tracks import Tracks, TrackSettings, detect_corners, match_tracks, update_tracks
from barsight.motion.frontend.relative_pose import RelativePose, estimate_step, ransac, refine_pose
from barsight.motion.frontend.stereo_features import FeatureView, OdometrySettings, match_coarsely
from barsight.motion.frontend.wide_steps import (
    MIN_WIDE_RATIO,
    REPEATING,
    DescribedMotion,
    Repeats,
    check_next_bars,
    check_overlap,
    wide_motion,
    wide_view,
)
from barsight.stereo.search_range import coarse_disparity

MIN_RATIO = 0.45
"""One bar off, a twentieth of the points find one alike and agree, on dull bars a third; at the true place
most do (six in ten from a car, eight over a yard)."""
MIN_KNOWN = 200
SPAN = 1.6
"""New points are sought up to this much nearer and further than the known ones."""

MAX_LOST = 3
"""Ends of chains that are held."""

Consensus = tuple[Bool, GuidedMatches, PredictedMotion]
"""Which tracked points (N,) agree, all their matches, and the motion on which they do."""

Predictor = Callable[[int, int], PredictedMotion | None]
"""From two frames' stamps to the motion of `rect0` between them as the other sensors know it, or None."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """Tracked points of one frame. track: (N,) names of points; stereo: (N, 3) u, v and right u, px;
    sigma_px: (N,) of each as the patches show it.

    motion: of `rect0` since the sighting before; None for the first of a chain, which nothing ties to the
    one before. again: another one that it is tied to, by points that both name. ambiguous: how many points
    were refused since the prediction was too coarse for the bars. innovation: (6,) turn and way of `motion`
    minus the predicted ones in sigma, None without a prediction.
    """

    stamp_ns: int
    track: Int64
    stereo: Float64
    sigma_px: Float64
    motion: PredictedMotion | None
    ambiguous: int
    innovation: Float64 | None = None
    again: SeenAgain | None = None


@dataclass(frozen=True, eq=False)
class SeenAgain:
    """A place seen again: the stamp of the sighting before a loss, and the motion of `rect0` since it."""

    stamp_ns: int
    motion: PredictedMotion


@dataclass(frozen=True)
class FrontEndSettings:
    """Settings of the front end."""

    tracks: TrackSettings = field(default_factory=TrackSettings)
    rough: OdometrySettings = field(default_factory=lambda: OdometrySettings(features=900))
    """The motion from corners' descriptors where no other sensor predicts it."""


@dataclass(frozen=True, eq=False)
class _State:
    """tracks: None to begin anew with unused names from next_track on."""

    tracks: Tracks | None
    next_track: int
    stamp_ns: int
    view: FeatureView | None


@dataclass(frozen=True, eq=False)
class _Lost:
    """The end of a chain: number of the chain, its last state, and its last view."""

    chain: int
    state: _State
    view: FeatureView | Failed


class Tracker:
    """Tracks points from pair to pair; only the last few views are held.

    A pair that nothing ties to the one before begins a chain anew. As long as no sensor predicts and it isn't
    tied to those before, it is held against their ends. `predictor` is asked when a frame's turn comes, so it
    may know what was made of the frames before.
    """

    def __init__(self, predictor: Predictor, settings: FrontEndSettings) -> None:
        self._predictor, self._settings = predictor, settings
        self._state: _State | None = None
        self._lost: list[_Lost] = []
        self._joined = [0]
        """Of each chain, the first one that it is tied to."""

    def push(self, pair: RectifiedPair) -> Sighting | RefusedFrame:
        """Track the next pair, or refuse it where it shows too little."""
        state, settings, patches = self._state, self._settings, patch_pair(pair)
        prediction = self._predictor(state.stamp_ns, pair.stamp_ns) if state else None
        result = _see(state, patches, prediction, settings)
        if isinstance(result, Failed) and state is not None:
            anew = _see(replace(state, tracks=None), patches, prediction, settings)
            if not isinstance(anew, Failed):
                result = anew
                if prediction is None:
                    self._lose(state)
        if isinstance(result, Failed):
            return RefusedFrame(pair.stamp_ns, result.reason)
        self._state, sighting = result
        return sighting if prediction is not None else self._tied(sighting, patches)

    def _lose(self, state: _State) -> None:
        """Keep the end of the chain so far, and begin the next."""
        assert state.tracks is not None and state.tracks.last is not None
        view = wide_view(patch_pair(state.tracks.last), self._settings.rough)
        self._lost = [*self._lost, _Lost(len(self._joined) - 1, state, view)][-MAX_LOST:]
        self._joined.append(len(self._joined))

    def _tied(self, sighting: Sighting, pair: PatchPair) -> Sighting:
        """Tie a sighting to the ends of chains that its own isn't tied to, if it shows their points again."""
        joined, settings = self._joined, self._settings
        open_ends = [lost for lost in self._lost if joined[lost.chain] != joined[-1]]
        if sighting.motion is None and open_ends:
            open_ends = open_ends[:-1]  # to the last of them it has just failed
        view = wide_view(pair, settings.rough) if open_ends else None
        for lost in reversed(open_ends):
            assert view is not None and lost.state.tracks is not None
            tracks, found = lost.state.tracks, wide_motion(lost.view, view, settings.rough)
            if isinstance(found, Failed):
                continue
            tied = wide_consensus(tracks, pair, found, settings)
            if isinstance(tied, Failed):
                continue
            kept, matches, motion = tied
            old, new = joined[lost.chain], joined[-1]
            self._joined = [min(old, new) if one in (old, new) else one for one in joined]
            return replace(
                sighting, track=np.append(sighting.track, tracks.track[kept]),
                stereo=np.vstack([sighting.stereo, matches.stereo[kept]]),
                sigma_px=np.append(sighting.sigma_px, matches.sigma_px[kept]),
                again=SeenAgain(lost.state.stamp_ns, motion),
            )  # fmt: skip
        return sighting


def _see(
    state: _State | None, pair: PatchPair, prediction: PredictedMotion | None, settings: FrontEndSettings
) -> tuple[_State, Sighting] | Failed:
    view: FeatureView | None = None
    if state is None or state.tracks is None:
        kept = np.zeros(0, np.bool_)
        matches = GuidedMatches(np.empty((0, 3)), np.empty(0), kept, kept)
        tracks = Tracks(next_track=0 if state is None else state.next_track)
        motion, innovation = None, None
    else:
        tracks = state.tracks
        found = None if prediction is None else motion_consensus(tracks, pair, prediction, settings)
        if found is None or isinstance(found, Failed):
            found, view = _by_pictures(state, tracks, pair, settings)
            if isinstance(found, Failed) and prediction is None:
                found = _by_wide_step(tracks, pair, settings)
            if isinstance(found, Failed):
                return found
        kept, matches, motion = found
        innovation = None if prediction is None else _innovation(prediction, motion)
    camera = pair.pair.camera
    if view is None:
        span = _span(matches.stereo[kept], camera)
        left, right = pair.pair.left, pair.pair.right
        coarse = coarse_disparity(left, right, camera.doffs_px, known=span, both_ways=False)
    else:
        coarse = view.coarse
    tracks = update_tracks(tracks, pair, matches, kept, coarse, settings.tracks)
    if len(tracks.track) < settings.rough.min_inliers:
        return Failed("no-features", f"only {len(tracks.track)} points have a depth")
    ambiguous = int(matches.ambiguous.sum())
    sighting = Sighting(
        pair.pair.stamp_ns, tracks.track, tracks.stereo, tracks.sigma_px, motion, ambiguous, innovation
    )
    return _State(tracks, tracks.next_track, pair.pair.stamp_ns, view), sighting


def _innovation(predicted: PredictedMotion, found: PredictedMotion) -> Float64:
    """Compute the innovation (6,): turn and way found minus predicted, each over its sigma."""
    turn = Rotation.from_matrix(found.rotation @ predicted.rotation.T)
    way = found.translation - turn.as_matrix() @ predicted.translation
    sigma = np.sqrt(np.diag(predicted.covariance + found.covariance))
    return np.asarray(np.concatenate([turn.as_rotvec(), way]) / sigma, np.float64)


def innovations(sightings: tuple[Sighting, ...]) -> NormalisedResiduals | None:
    """Collect the innovations of all frames whose motion was predicted, None if there are none."""
    told = [(s.stamp_ns, s.innovation) for s in sightings if s.innovation is not None]
    if not told:
        return None
    names = tuple(f"{part} {axis}" for part in ("turn", "way") for axis in "xyz")
    stamps = np.array([stamp for stamp, _ in told], np.int64)
    return NormalisedResiduals(names, stamps, np.array([values for _, values in told]))


def _span(known: Float64, camera: RectifiedCamera) -> tuple[float, float] | None:
    """Predict the disparity range (px) from the known points (N, 3); None for too few."""
    if len(known) < MIN_KNOWN:
        return None
    low, high = np.percentile(known[:, 0] - known[:, 2] + camera.doffs_px, (1, 99))
    return float(low / SPAN - camera.doffs_px), float(high * SPAN - camera.doffs_px)


def _rough(
    state: _State, tracks: Tracks, pair: PatchPair, settings: FrontEndSettings
) -> tuple[RelativePose, FeatureView] | Failed:
    """Estimate the motion by both pairs' corners, without any prediction."""
    assert tracks.last is not None
    span = _span(tracks.stereo, pair.pair.camera)
    old = state.view or describe_corners(patch_pair(tracks.last), settings, span)
    new = describe_corners(pair, settings, span)
    if isinstance(old, Failed):
        return old
    if isinstance(new, Failed):
        return new
    step = estimate_step(old, new, settings.rough)
    return step if isinstance(step, Failed) else (step, new)


def describe_corners(
    pair: PatchPair, settings: FrontEndSettings, span: tuple[float, float] | None = None
) -> FeatureView | Failed:
    """Detect and describe the corners of a pair; `match_coarsely` says the rest."""
    chosen, image = replace(settings.tracks, points=settings.rough.features), pair.pair.left
    corners = detect_corners(image, chosen, np.empty((0, 2)))
    return match_coarsely(pair, describe_upright(image, corners), settings.rough, span)


def _by_pictures(
    state: _State, tracks: Tracks, pair: PatchPair, settings: FrontEndSettings
) -> tuple[Consensus | Failed, FeatureView | None]:
    """Find the motion by the corners' descriptors, and what they agree on; also the new view."""
    rough_motion = _rough(state, tracks, pair, settings)
    if isinstance(rough_motion, Failed):
        return rough_motion, None
    step, view = rough_motion
    found = DescribedMotion.of(step)
    failed = check_overlap(tracks, pair, found, settings.tracks)
    return failed or motion_consensus(tracks, pair, found.motion, settings), view


def _by_wide_step(tracks: Tracks, pair: PatchPair, settings: FrontEndSettings) -> Consensus | Failed:
    """Find the motion since the last view of tracks by features at several scales."""
    assert tracks.last is not None
    views = [wide_view(one, settings.rough) for one in (patch_pair(tracks.last), pair)]
    motion = wide_motion(views[0], views[1], settings.rough)
    return motion if isinstance(motion, Failed) else wide_consensus(tracks, pair, motion, settings)


def wide_consensus(
    tracks: Tracks, pair: PatchPair, wide: DescribedMotion, settings: FrontEndSettings
) -> Consensus | Failed:
    """Select points that agree on a motion which `wide_motion` found, unless the next bars agree too."""
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
    """Select points found again in their ellipses that agree on one motion in 3D, and that motion."""
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
    step = refine_pose(points, target, *start, camera, settings.rough)
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
    """Match points too ambiguous for the prediction anew by the motion on which the others agree."""
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
