"""Aggregate costs non-locally [Yang, "A non-local cost aggregation method for stereo matching", CVPR 2012].

Costs are aggregated over the minimum spanning tree of the image, exactly. For the non-local refinement, a
second cost is |d - D| where left and right agree on the disparity D, and zero elsewhere; aggregated over the
same tree with half the sigma, it carries the certain disparities to the pixels that have none. Memory: two
blocks of 16 candidates, whatever their number.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numba
import numpy as np

from barsight.core.arrays import Bool, Float32, Int32, kernel
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.core.settings.values import OVER_0, expect_ranges
from barsight.stereo.baselines.gradient_cost import GradientCostSettings, cost_images, gradient_cost
from barsight.stereo.baselines.left_right_check import left_right_agreement
from barsight.stereo.baselines.postprocessing import (
    OutputSettings,
    assemble_disparity,
    is_matchable,
    mirror_pair,
    no_match,
)
from barsight.stereo.baselines.spanning_tree import SpanningTree, spanning_tree, tree_filter
from barsight.stereo.baselines.winner_takes_all import Winners, sweep

_MEDIAN_PX = 5


@dataclass(frozen=True)
class NonlocalSettings:
    """Settings of non-local aggregation on the spanning tree."""

    cost: GradientCostSettings = field(
        default_factory=lambda: GradientCostSettings(gray_weight=0.2, gray_limit=7.0, gradient_limit=4.0)
    )
    """Matching cost equivalent to the author's weights of 0.11 and 0.89, where the gradient is half the
    difference between the next and the previous pixel.
    """
    sigma: float = 0.1
    """Gray difference along the tree over which support falls to 1/e, as a share of 255 gray levels; the
    refinement uses half of it.
    """
    output: OutputSettings = field(
        default_factory=lambda: OutputSettings(subpixel_sigma_px=0.32, filled_sigma_px=1.6)
    )

    def __post_init__(self) -> None:
        expect_ranges(self, "nonlocal_tree.", sigma=(OVER_0, 10))


@dataclass(frozen=True)
class Nonlocal:
    """`StereoMethod`: non-local aggregation and refinement."""

    settings: NonlocalSettings

    def __call__(self, pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        """Match; see `StereoMethod`."""
        settings = self.settings
        if not is_matchable(pair, candidates):
            return no_match(pair)
        tree = spanning_tree(pair.left)
        winners = tree_winners(pair, tree, candidates, settings)
        mirror = mirror_pair(pair)
        mirrored = tree_winners(mirror, spanning_tree(mirror.left), candidates, settings)
        smooth = _median(winners.candidate_px)
        right = _median(np.ascontiguousarray(mirrored.candidate_px[:, ::-1]))
        matched = left_right_agreement(smooth, right)
        chosen = _median(refine_nonlocal(smooth, matched, tree, candidates, settings.sigma * 255 / 2))
        # A pixel is as certain as a match only where refinement kept the value that both images agreed on.
        matched &= chosen == smooth
        return assemble_disparity(pair, winners, chosen, matched, settings.output)


def tree_winners(
    pair: RectifiedPair, tree: SpanningTree, candidates: DisparityRange, settings: NonlocalSettings
) -> Winners:
    """Select the left image's winners from the aggregated costs."""
    images = cost_images(
        pair.left.astype(np.float32), pair.right.astype(np.float32), pair.left_valid, pair.right_valid
    )
    aggregate = tree_filter(tree, settings.sigma * 255)

    def fill(lowest_px: int, slices: Float32) -> None:
        gradient_cost(images, lowest_px, settings.cost, slices)
        aggregate(slices)

    return sweep(pair.left.shape, candidates, fill)


def refine_nonlocal(
    values: Int32, matched: Bool, tree: SpanningTree, candidates: DisparityRange, sigma_gray: float
) -> Int32:
    """Refine non-locally: compute each pixel's weighted median of the matched values over the tree, in
    whole pixels.
    """
    aggregate = tree_filter(tree, sigma_gray)

    def fill(lowest_px: int, slices: Float32) -> None:
        _distance(values, matched, lowest_px, slices)
        aggregate(slices)

    return sweep(values.shape, candidates, fill).candidate_px


def _median(values: Int32) -> Int32:
    """Apply a 5x5 median in float32, the widest type that OpenCV's accepts there."""
    median: Int32 = np.rint(cv2.medianBlur(values.astype(np.float32), _MEDIAN_PX)).astype(np.int32)
    return median


@kernel(parallel=True)
def _distance(values: Int32, matched: Bool, lowest: int, slices: Float32) -> None:
    """Compute the refinement's costs |d - D| of the candidates from `lowest` px on [Yang, CVPR 2012].

    values: (H, W) disparities D, px. Fills slices (K, H, W); 0 where a pixel isn't matched.
    """
    count, height, width = slices.shape
    for row in numba.prange(height):
        for index in range(count):
            shift = np.int32(lowest + index)
            costs, found, certain = slices[index, row], values[row], matched[row]
            for x in range(width):
                costs[x] = np.float32(abs(found[x] - shift)) if certain[x] else np.float32(0)
