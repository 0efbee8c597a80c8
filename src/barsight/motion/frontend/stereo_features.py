"""Detect features with depth in each picture for stereo odometry, or return why there are none."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np

from barsight.core.arrays import Float32, Float64, Int64
from barsight.core.errors import Failed
from barsight.core.records.pairs import RectifiedPair
from barsight.core.settings.values import POSITIVE, expect_ranges
from barsight.features.guided_matching import match_across, triangulate_stereo
from barsight.features.orb import Features, detect_orb
from barsight.features.patch_alignment import PatchPair, patch_pair
from barsight.stereo.search_range import coarse_disparity


@dataclass(frozen=True)
class OdometrySettings:
    """Stereo visual odometry."""

    features: int = 3000
    """Number of features detected per picture."""
    min_range_m: float = 0.5
    """Minimum range of points that are used."""
    max_range_baselines: float = 60.0
    """Maximum range, in baselines, of points that are used for motion."""
    min_inliers: int = 25
    """Minimum number of points that must agree on a motion; a frame with fewer is refused."""
    pixel_sigma_px: float = 0.3
    """Standard deviation of a feature's measured position in the picture."""
    offset_sigma_px: float = 0.1
    """Standard deviation of a disparity error common to all features. It isn't estimated; it makes all steps
    too long or too short alike.
    """
    ransac_px: float = 1.0
    """Reprojection error above which RANSAC takes a point as an outlier."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "odometry.", features=(100, 100_000), min_inliers=(6, inf), min_range_m=POSITIVE,
            max_range_baselines=POSITIVE, pixel_sigma_px=POSITIVE, ransac_px=POSITIVE,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class FeatureView:
    """Features of one frame. about_px: (N,) their coarse disparities; coarse: (h, w) the pair's, NaN where
    unknown; both in px of the full picture.
    """

    pair: PatchPair
    features: Features
    about_px: Float32
    coarse: Float32

    @property
    def stamp_ns(self) -> int:
        """Return the frame's stamp."""
        return self.pair.pair.stamp_ns

    def points(self, index: Int64, settings: OdometrySettings) -> Float64:
        """Triangulate the features of an index (M,): (M, 3) in `rect0`, NaN where the right picture shows
        none at a useful depth.
        """
        camera = self.pair.pair.camera
        places = self.features.pixels[index].astype(np.float64)
        right = match_across(self.pair, places, self.about_px[index].astype(np.float64))
        points = triangulate_stereo(np.column_stack([places, right.pixels[:, 0]]), camera)
        with np.errstate(invalid="ignore"):
            kept = right.found & (points[:, 2] > settings.min_range_m)
            kept &= points[:, 2] < settings.max_range_baselines * camera.baseline_m
        return np.where(kept[:, None], points, np.nan)


def feature_view(pair: RectifiedPair, settings: OdometrySettings) -> FeatureView | Failed:
    """Detect a pair's ORB features; Failed `no-features` where too few have a disparity."""
    return match_coarsely(patch_pair(pair), detect_orb(pair.left, settings.features), settings)


def match_coarsely(
    pair: PatchPair, features: Features, settings: OdometrySettings,
    span: tuple[float, float] | None = None,
) -> FeatureView | Failed:  # fmt: skip
    """Select a pair's left features that have a coarse disparity; Failed `no-features` where too few have
    one.

    span: the lowest and highest disparity to expect, px, where that is known.
    """
    camera = pair.pair.camera
    coarse = coarse_disparity(pair.pair.left, pair.pair.right, camera.doffs_px, known=span, both_ways=False)
    row = (features.pixels[:, 1] * coarse.shape[0] / camera.height).astype(int)
    column = (features.pixels[:, 0] * coarse.shape[1] / camera.width).astype(int)
    about = coarse[row, column]
    known = np.isfinite(about)
    if known.sum() < settings.min_inliers:
        return Failed("no-features", f"only {int(known.sum())} features have a depth")
    return FeatureView(pair, features.chosen(known), about[known], coarse)
