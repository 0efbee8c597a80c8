"""Track points from pair to pair, checking each frame's motion by consensus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair, RefusedFrame
from barsight.features.guided_matching import GuidedMatches, PredictedMotion
from barsight.features.orb import describe_upright
from barsight.features.patch_alignment import PatchPair, patch_pair
from barsight.features.tracks import Tracks, detect_corners, update_tracks
from barsight.motion.frontend.motion_consensus import Consensus, motion_consensus, wide_consensus
from barsight.motion.frontend.relative_pose import SIDES_APART, RelativePose, estimate_step
from barsight.motion.frontend.settings import FrontEndSettings
from barsight.motion.frontend.sightings import SeenAgain, Sighting, disparity_step, normalised_innovation
from barsight.motion.frontend.stereo_features import FeatureView, match_coarsely
from barsight.motion.frontend.wide_steps import DescribedMotion, check_overlap, wide_motion, wide_view
from barsight.stereo.search_range import coarse_disparity

MIN_KNOWN = 200
SPAN = 1.6
"""Factor by which new points may be nearer or further than the known ones."""

REPEATED_M = 0.05
"""Distance in metres that the crane may travel while a camera repeats one picture, to the last pixel."""
REPEATED_SIGMAS = 5.0
"""The same in sigma of the predicted travel."""

MAX_LOST = 3
"""Maximum number of chain ends that are kept."""

Predictor = Callable[[int, int], PredictedMotion | None]
"""Maps two frames' stamps to the motion of `rect0` between them as the other sensors know it, or None."""


@dataclass(frozen=True, eq=False)
class _State:
    """tracks: None to begin anew, with unused names from `next_track` on."""

    tracks: Tracks | None
    next_track: int
    stamp_ns: int
    view: FeatureView | None


@dataclass(frozen=True, eq=False)
class _Lost:
    """End of a chain: number of the chain, its last state, and its last view."""

    chain: int
    state: _State
    view: FeatureView | Failed


class Tracker:
    """Tracks points from pair to pair; only the last few views are kept.

    A pair that nothing ties to the previous one begins a new chain. As long as no sensor predicts the motion
    and a chain isn't tied to the earlier ones, its pairs are compared with their ends. `predictor` is called
    only when a frame's turn comes, so it may use the estimate of the frames before.
    """

    def __init__(self, predictor: Predictor, settings: FrontEndSettings) -> None:
        self._predictor, self._settings = predictor, settings
        self._state: _State | None = None
        self._lost: list[_Lost] = []
        self._joined = [0]
        """For each chain the first chain that it is tied to."""

    def push(self, pair: RectifiedPair) -> Sighting | RefusedFrame:
        """Track the next pair, or refuse it where it shows too little."""
        state, settings = self._state, self._settings
        prediction = self._predictor(state.stamp_ns, pair.stamp_ns) if state else None
        if state is not None and (repeated := _repeated(state, pair, prediction)):
            return RefusedFrame(pair.stamp_ns, repeated_sentence(repeated), is_stale=True)
        patches = patch_pair(pair)
        result, apart = _see(state, patches, prediction, settings), False
        if isinstance(result, Failed) and state is not None:
            apart = result.code == SIDES_APART
            anew = _see(replace(state, tracks=None), patches, prediction, settings)
            if not isinstance(anew, Failed):
                result = anew
                if prediction is None:
                    self._lose(state)
        if isinstance(result, Failed):
            return RefusedFrame(pair.stamp_ns, result.reason)
        self._state, sighting = result
        sighting = replace(sighting, sides_apart=apart)
        return sighting if prediction is not None else self._tied(sighting, patches)

    def _lose(self, state: _State) -> None:
        """Keep the end of the present chain, and begin the next."""
        assert state.tracks is not None and state.tracks.last is not None
        view = wide_view(patch_pair(state.tracks.last), self._settings.rough)
        self._lost = [*self._lost, _Lost(len(self._joined) - 1, state, view)][-MAX_LOST:]
        self._joined.append(len(self._joined))

    def _tied(self, sighting: Sighting, pair: PatchPair) -> Sighting:
        """Tie a sighting to the ends of chains that its own isn't tied to yet, if it shows their points
        again.
        """
        joined, settings = self._joined, self._settings
        open_ends = [lost for lost in self._lost if joined[lost.chain] != joined[-1]]
        if sighting.motion is None and open_ends:
            open_ends = open_ends[:-1]  # tying it to the last of them has just failed
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


def repeated_sentence(cameras: Sequence[str]) -> str:
    """Describe that these cameras repeat a picture."""
    return f"the same picture comes again and again from {' and '.join(cameras)} while the crane moves"


def _repeated(state: _State, pair: RectifiedPair, prediction: PredictedMotion | None) -> list[str]:
    """List the cameras that repeat their last picture although the crane has moved."""
    if prediction is None or state.tracks is None or state.tracks.last is None:
        return []
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(prediction.covariance[3:, 3:])[-1]))
    if np.linalg.norm(prediction.translation) < max(REPEATED_M, REPEATED_SIGMAS * sigma_m):
        return []
    last = state.tracks.last
    both = (("cam0", pair.left, last.left), ("cam1", pair.right, last.right))
    return [name for name, now, before in both if np.array_equal(now, before)]


def _see(
    state: _State | None, pair: PatchPair, prediction: PredictedMotion | None, settings: FrontEndSettings
) -> tuple[_State, Sighting] | Failed:
    view: FeatureView | None = None
    if state is None or state.tracks is None:
        kept = np.zeros(0, np.bool_)
        matches = GuidedMatches(np.empty((0, 3)), np.empty(0), kept, kept)
        tracks = Tracks(next_track=0 if state is None else state.next_track)
        motion, innovation, step = None, None, None
    else:
        tracks = state.tracks
        found = None if prediction is None else motion_consensus(tracks, pair, prediction, settings)
        if found is None or isinstance(found, Failed):
            found, view = _by_pictures(state, tracks, pair, settings)
            if isinstance(found, Failed) and prediction is None and found.code != SIDES_APART:
                found = _by_wide_step(tracks, pair, settings)
            if isinstance(found, Failed):
                return found
        kept, matches, motion = found
        innovation = None if prediction is None else normalised_innovation(prediction, motion)
        old, new = tracks.stereo[kept], matches.stereo[kept]
        step = disparity_step(pair.pair.stamp_ns, old, new, motion, pair.pair.camera)
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
        pair.pair.stamp_ns, tracks.track, tracks.stereo, tracks.sigma_px, motion, ambiguous, innovation,
        step=step,
    )  # fmt: skip
    return _State(tracks, tracks.next_track, pair.pair.stamp_ns, view), sighting


def _span(known: Float64, camera: RectifiedCamera) -> tuple[float, float] | None:
    """Predict the disparity range (px) from the known points (N, 3); None where they are too few."""
    if len(known) < MIN_KNOWN:
        return None
    low, high = np.percentile(known[:, 0] - known[:, 2] + camera.doffs_px, (1, 99))
    return float(low / SPAN - camera.doffs_px), float(high * SPAN - camera.doffs_px)


def _rough(
    state: _State, tracks: Tracks, pair: PatchPair, settings: FrontEndSettings
) -> tuple[RelativePose, FeatureView] | Failed:
    """Estimate the motion from both pairs' corners, without any prediction."""
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
    """Detect and describe a pair's corners; see `match_coarsely`."""
    chosen, image = replace(settings.tracks, points=settings.rough.features), pair.pair.left
    corners = detect_corners(image, chosen, np.empty((0, 2)))
    return match_coarsely(pair, describe_upright(image, corners), settings.rough, span)


def _by_pictures(
    state: _State, tracks: Tracks, pair: PatchPair, settings: FrontEndSettings
) -> tuple[Consensus | Failed, FeatureView | None]:
    """Find the motion from the corners' descriptors and the points that agree on it; also return the new
    view.
    """
    rough_motion = _rough(state, tracks, pair, settings)
    if isinstance(rough_motion, Failed):
        return rough_motion, None
    step, view = rough_motion
    found = DescribedMotion.of(step)
    failed = check_overlap(tracks, pair, found, settings.tracks)
    return failed or motion_consensus(tracks, pair, found.motion, settings), view


def _by_wide_step(tracks: Tracks, pair: PatchPair, settings: FrontEndSettings) -> Consensus | Failed:
    """Find the motion since the last tracked view from features at several scales."""
    assert tracks.last is not None
    views = [wide_view(one, settings.rough) for one in (patch_pair(tracks.last), pair)]
    motion = wide_motion(views[0], views[1], settings.rough)
    return motion if isinstance(motion, Failed) else wide_consensus(tracks, pair, motion, settings)
