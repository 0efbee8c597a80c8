"""Track points over many frames: new corners where there are none, each aligned with the view that it began
in.

A patch is compared with the view in which it was first seen as long as its size hardly changes, so that
errors don't accumulate from frame to frame; after that it is taken anew from its last view.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from math import inf

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int64, UInt8
from barsight.core.records.pairs import RectifiedPair
from barsight.core.settings.values import POSITIVE, expect_ranges
from barsight.features.guided_matching import (
    GuidedMatches,
    PredictedProjections,
    match_across,
    match_guided,
    triangulate_stereo,
)
from barsight.features.patch_alignment import PatchImage, PatchPair

MAX_VIEWS = 8
TILES = 4


@dataclass(frozen=True)
class TrackSettings:
    """Points followed from frame to frame."""

    points: int = 900
    """Number of points tracked at a time."""
    spacing_px: int = 14
    """Minimum distance of a new point from all others."""
    quality: float = 0.003
    """Minimum strength of a corner, as a ratio to that of the strongest one."""
    sigma_px: float = 0.25
    """Standard deviation of a point's measured position in the picture."""
    max_scale: float = 1.3
    """Maximum factor by which a patch may grow or shrink before it is taken anew from its last view."""
    min_range_m: float = 0.5
    """Minimum range of points that are used."""
    max_range_baselines: float = 60.0
    """Maximum range, in baselines, of points that are used for motion."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "tracks.", points=(50, inf), spacing_px=(3, inf), sigma_px=POSITIVE, min_range_m=POSITIVE,
            max_range_baselines=POSITIVE, max_scale=(1, inf),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Tracks:
    """Tracked points. Of each of N points: track (its name), stereo (N, 3) in the last view (u, v, right u)
    with sigma_px (N,), source (index into `views` of its patch's view), patch (N, 2) its position there,
    patch_depth (N,) m.

    views: the left pictures that the patches are from, the last frame's at the end. last: the last frame.
    """

    views: tuple[PatchImage, ...] = ()
    last: RectifiedPair | None = None
    track: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    stereo: Float64 = field(default_factory=lambda: np.empty((0, 3)))
    sigma_px: Float64 = field(default_factory=lambda: np.empty(0))
    source: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    patch: Float64 = field(default_factory=lambda: np.empty((0, 2)))
    patch_depth: Float64 = field(default_factory=lambda: np.empty(0))
    next_track: int = 0

    def chosen(self, kept: Bool) -> Tracks:
        """Select the points for which `kept` (N,) is true."""
        return replace(
            self, track=self.track[kept], stereo=self.stereo[kept], sigma_px=self.sigma_px[kept],
            source=self.source[kept], patch=self.patch[kept], patch_depth=self.patch_depth[kept],
        )  # fmt: skip


def match_tracks(
    tracks: Tracks, pair: PatchPair, predicted: PredictedProjections, settings: TrackSettings,
    repeat_px: Float64 | None = None,
) -> GuidedMatches:  # fmt: skip
    """Match the tracked points in a new pair around their `predicted` projections."""
    count = len(tracks.track)
    stereo, sigma = np.full((count, 3), np.nan), np.full(count, np.nan)
    found, ambiguous = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    for source in np.unique(tracks.source):
        group = np.flatnonzero(tracks.source == source)
        part = PredictedProjections(
            predicted.stereo[group], predicted.covariance[group], predicted.inside[group]
        )
        repeat = None if repeat_px is None else repeat_px[group]
        matches = match_guided(
            tracks.views[source], tracks.patch[group], tracks.patch_depth[group], pair, part,
            settings.sigma_px, repeat,
        )  # fmt: skip
        stereo[group], sigma[group], found[group] = matches.stereo, matches.sigma_px, matches.found
        ambiguous[group] = matches.ambiguous
    return GuidedMatches(stereo, sigma, found, ambiguous)


def update_tracks(
    tracks: Tracks, pair: PatchPair, matches: GuidedMatches, kept: Bool, coarse: Float32,
    settings: TrackSettings,
) -> Tracks:  # fmt: skip
    """Update the tracks after a new pair: the matches `kept` move to their new positions, and new points are
    added between them.

    coarse: the pair's coarse disparity (h, w), in px of the full picture, NaN where unknown, for new points.
    """
    followed = replace(
        tracks.chosen(kept), stereo=matches.stereo[kept], sigma_px=matches.sigma_px[kept],
        views=(*tracks.views, pair.left), last=pair.pair,
    )  # fmt: skip
    camera = pair.pair.camera
    last = len(followed.views) - 1
    depth = triangulate_stereo(followed.stereo, camera)[:, 2]
    ratio = depth / followed.patch_depth
    anew = (ratio > settings.max_scale) | (ratio < 1 / settings.max_scale)
    anew |= followed.source <= last - MAX_VIEWS
    followed = replace(
        followed,
        source=np.where(anew, last, followed.source),
        patch=np.where(anew[:, None], followed.stereo[:, :2], followed.patch),
        patch_depth=np.where(anew, depth, followed.patch_depth),
    )
    corners = detect_corners(pair.pair.left, settings, followed.stereo[:, :2])
    fresh, fresh_sigma = _across(pair, corners, coarse, settings)
    count = len(fresh)
    grown = replace(
        followed,
        track=np.concatenate([followed.track, followed.next_track + np.arange(count)]),
        stereo=np.vstack([followed.stereo, fresh]),
        sigma_px=np.concatenate([followed.sigma_px, fresh_sigma]),
        source=np.concatenate([followed.source, np.full(count, last)]),
        patch=np.vstack([followed.patch, fresh[:, :2]]),
        patch_depth=np.concatenate([followed.patch_depth, triangulate_stereo(fresh, camera)[:, 2]]),
        next_track=followed.next_track + count,
    )
    return _without_old_views(grown)


def detect_corners(image: UInt8, settings: TrackSettings, taken: Float64) -> Float32:
    """Detect corners (N, 2) [Shi 1994] at least `spacing_px` from each other and from the positions `taken`
    (M, 2).

    The picture is divided into 4 x 4 tiles with equal numbers of points, so that a bright label doesn't take
    them all.
    """
    small = cv2.pyrDown(image)
    mask = np.full(small.shape, 255, np.uint8)
    away = settings.spacing_px // 2
    near = np.zeros((2 * away + 1, 2 * away + 1), np.uint8)
    cv2.circle(near, (away, away), away, 1, -1)
    down, along = np.nonzero(near)
    x, y = (taken / 2).round().astype(int).T[:, :, None] - away
    mask[(y + down).clip(0, small.shape[0] - 1), (x + along).clip(0, small.shape[1] - 1)] = 0
    rows, columns = (np.linspace(7, size - 7, TILES + 1).astype(int) for size in small.shape)
    there, _, _ = np.histogram2d(taken[:, 1] / 2, taken[:, 0] / 2, [rows, columns])
    found = [np.empty((0, 2), np.float32)]
    for (i, (top, bottom)), (j, (left, right)) in product(
        enumerate(pairwise(rows)), enumerate(pairwise(columns))
    ):
        wanted = settings.points // TILES**2 - int(there[i, j])
        if wanted <= 0:
            continue
        places = cv2.goodFeaturesToTrack(
            small[top:bottom, left:right], wanted, settings.quality, settings.spacing_px / 2,
            mask=mask[top:bottom, left:right], blockSize=5,
        )  # fmt: skip
        if places is not None:
            found.append(2 * (places.reshape(-1, 2) + np.array([left, top], np.float32)))
    return np.concatenate(found)


def _across(
    pair: PatchPair, corners: Float32, coarse: Float32, settings: TrackSettings
) -> tuple[Float64, Float64]:
    """Match new corners across to the right picture: u, v and right u (M, 3) of those at a useful depth, and
    their sigmas.
    """
    camera = pair.pair.camera
    row = (corners[:, 1] * coarse.shape[0] / camera.height).astype(int)
    column = (corners[:, 0] * coarse.shape[1] / camera.width).astype(int)
    guess = coarse[row, column]
    known = np.isfinite(guess)
    places = corners[known].astype(np.float64)
    right = match_across(pair, places, guess[known].astype(np.float64))
    stereo = np.column_stack([places, right.pixels[:, 0]])
    depth = triangulate_stereo(stereo, camera)[:, 2]
    with np.errstate(invalid="ignore"):
        kept = right.found & (depth > settings.min_range_m)
        kept &= depth < settings.max_range_baselines * camera.baseline_m
    return stereo[kept], right.sigma_px[kept]


def _without_old_views(tracks: Tracks) -> Tracks:
    """Drop all but the last `MAX_VIEWS` views from memory."""
    drop = max(0, len(tracks.views) - MAX_VIEWS)
    return replace(tracks, views=tracks.views[drop:], source=tracks.source - drop)
