"""Points followed over many frames: new corners where none are, each re-found from the view it began in.

A patch is compared with the view where it was first seen as long as its size hardly changes, so that
errors don't add up from frame to frame; after that its last view takes over.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int64, UInt8
from barsight.core.errors import ConfigError
from barsight.core.types import RectifiedCamera, RectifiedPair
from barsight.features.guided import (
    GuidedMatches,
    Predicted,
    PredictedMotion,
    match_across,
    match_guided,
    predict_places,
    triangulate,
)

MOST_VIEWS = 8


@dataclass(frozen=True)
class TrackSettings:
    """Points followed from frame to frame."""

    points: int = 900
    """Points followed at a time."""
    spacing_px: int = 14
    """New points keep this far from others."""
    quality: float = 0.003
    """Corners weaker than this share of the strongest aren't used."""
    sigma_px: float = 0.25
    """The noise of a point's place (1 sigma)."""
    most_scale: float = 1.08
    """A patch that has grown or shrunk by more is taken anew from its last view."""
    nearest_m: float = 0.5
    """Points nearer than this aren't used."""
    farthest_baselines: float = 60.0
    """Points further than this many baselines aren't used for motion."""

    def __post_init__(self) -> None:
        if self.points < 50 or self.spacing_px < 3:
            raise ConfigError("tracks.points must be at least 50 and tracks.spacing_px at least 3")
        if min(self.sigma_px, self.nearest_m, self.farthest_baselines) <= 0 or self.most_scale <= 1:
            raise ConfigError("the tracks' distances must be positive and most_scale over 1")


@dataclass(frozen=True, eq=False)
class Tracks:
    """What is followed. All of N points: track (their names), stereo (N, 3) in the last view (u, v, right u),
    source (index into views of the patch's view), patch (N, 2) its place there, patch_depth (N,) m.
    """

    views: tuple[RectifiedPair, ...] = ()
    track: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    stereo: Float64 = field(default_factory=lambda: np.empty((0, 3)))
    source: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    patch: Float32 = field(default_factory=lambda: np.empty((0, 2), np.float32))
    patch_depth: Float64 = field(default_factory=lambda: np.empty(0))
    next_track: int = 0

    def chosen(self, kept: Bool) -> Tracks:
        """The points for which `kept` (N,) is true."""
        return replace(
            self, track=self.track[kept], stereo=self.stereo[kept], source=self.source[kept],
            patch=self.patch[kept], patch_depth=self.patch_depth[kept],
        )  # fmt: skip


def find_again(
    tracks: Tracks, pair: RectifiedPair, motion: PredictedMotion, settings: TrackSettings,
    repeat_px: Float64 | None = None,
) -> GuidedMatches:  # fmt: skip
    """Where the followed points are in a new pair."""
    points = triangulate(tracks.stereo, pair.camera)
    predicted = predict_places(points, settings.sigma_px, motion, pair.camera)
    count = len(tracks.track)
    stereo, found = np.full((count, 3), np.nan), np.zeros(count, np.bool_)
    ambiguous = np.zeros(count, np.bool_)
    for source in np.unique(tracks.source):
        group = np.flatnonzero(tracks.source == source)
        part = Predicted(predicted.stereo[group], predicted.covariance[group], predicted.inside[group])
        repeat = None if repeat_px is None else repeat_px[group]
        matches = match_guided(
            tracks.views[source], tracks.patch[group], pair, part, settings.sigma_px, repeat
        )
        stereo[group], found[group] = matches.stereo, matches.found
        ambiguous[group] = matches.ambiguous
    return GuidedMatches(stereo, found, ambiguous)


def carry_on(
    tracks: Tracks, pair: RectifiedPair, stereo: Float64, kept: Bool, coarse: Float32, settings: TrackSettings
) -> Tracks:
    """The tracks after a new pair: those `kept` at their new places `stereo`, and new ones between them.

    coarse: the pair's coarse disparity (h, w), in px of the full picture, NaN unknown, for new points.
    """
    followed = replace(tracks.chosen(kept), stereo=stereo[kept], views=(*tracks.views, pair))
    last = len(followed.views) - 1
    depth = triangulate(followed.stereo, pair.camera)[:, 2]
    ratio = depth / followed.patch_depth
    anew = (ratio > settings.most_scale) | (ratio < 1 / settings.most_scale)
    anew |= followed.source <= last - MOST_VIEWS
    followed = replace(
        followed,
        source=np.where(anew, last, followed.source),
        patch=np.where(anew[:, None], followed.stereo[:, :2], followed.patch).astype(np.float32),
        patch_depth=np.where(anew, depth, followed.patch_depth),
    )
    corners = detect_corners(pair.left, settings, followed.stereo[:, :2])
    fresh = _across(pair, corners, coarse, settings)
    count = len(fresh)
    grown = replace(
        followed,
        track=np.concatenate([followed.track, followed.next_track + np.arange(count)]),
        stereo=np.vstack([followed.stereo, fresh]),
        source=np.concatenate([followed.source, np.full(count, last)]),
        patch=np.vstack([followed.patch, fresh[:, :2]]).astype(np.float32),
        patch_depth=np.concatenate([followed.patch_depth, triangulate(fresh, pair.camera)[:, 2]]),
        next_track=followed.next_track + count,
    )
    return _without_old_views(grown)


def detect_corners(image: UInt8, settings: TrackSettings, taken: Float64) -> Float32:
    """(N, 2) corners [Shi 1994] at least `spacing_px` from each other and from the places `taken` (M, 2).

    The picture is cut into 4 x 4 tiles that yield alike, so that a bright label doesn't take them all.
    """
    mask = np.full(image.shape, 255, np.uint8)
    for x, y in taken.round().astype(int):
        cv2.circle(mask, (int(x), int(y)), settings.spacing_px, 0, -1)
    wanted = max(0, settings.points - len(taken))
    if wanted == 0:
        return np.empty((0, 2), np.float32)
    rows, columns = (np.linspace(14, size - 14, 5).astype(int) for size in image.shape)
    found = []
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            tile = image[top:bottom, left:right]
            places = cv2.goodFeaturesToTrack(
                tile, max(1, wanted // 16), settings.quality, settings.spacing_px,
                mask=mask[top:bottom, left:right], blockSize=7,
            )  # fmt: skip
            if places is not None:
                found.append(places.reshape(-1, 2) + np.array([left, top], np.float32))
    return np.concatenate(found).astype(np.float32) if found else np.empty((0, 2), np.float32)


def _across(pair: RectifiedPair, corners: Float32, coarse: Float32, settings: TrackSettings) -> Float64:
    """(M, 3) u, v and right u of the corners that the right picture shows too, at a useful depth."""
    camera: RectifiedCamera = pair.camera
    row = (corners[:, 1] * coarse.shape[0] / camera.height).astype(int)
    column = (corners[:, 0] * coarse.shape[1] / camera.width).astype(int)
    guess = coarse[row, column]
    known = np.isfinite(guess)
    places, guess = corners[known], guess[known]
    right, kept = match_across(pair, places, places - np.column_stack([guess, 0 * guess]).astype(np.float32))
    stereo = np.column_stack([places, right]).astype(np.float64)
    depth = triangulate(stereo, camera)[:, 2]
    with np.errstate(invalid="ignore"):
        kept &= (depth > settings.nearest_m) & (depth < settings.farthest_baselines * camera.baseline_m)
    return stereo[kept]


def _without_old_views(tracks: Tracks) -> Tracks:
    """Only the last `MOST_VIEWS` views stay in memory."""
    drop = max(0, len(tracks.views) - MOST_VIEWS)
    return replace(tracks, views=tracks.views[drop:], source=tracks.source - drop)
