"""Aggregate costs across scales [Zhang, Fang, Min, Sun, Yang, Yan, Tian, CVPR 2014].

Costs are first aggregated at each scale of a pyramid separately, then coupled: the costs z_s of one position
at the scales s minimise sum_s |z_s - a_s|^2 + lambda sum_s |z_s - z_(s-1)|^2, a tridiagonal system; the first
row of its inverse gives the finest scale's cost as a weighted sum of the scales' aggregated costs a_s. The
next steps are winner takes all, left-right check, a weighted median where it fails and a parabola where it
doesn't. Aggregation uses the guided filter, in colour where the pair has it, or the spanning tree of
`nonlocal`.

Memory: the scales above the finest are stored, together a seventh of the volume (float32); the finest is
processed in blocks of 16 candidates (the tree needs the same amount again).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf
from typing import Literal

import cv2
import numba
import numpy as np

from barsight.core.arrays import Float32, Float64, UInt8, kernel
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.core.settings.values import NOT_NEGATIVE, POSITIVE, expect_ranges
from barsight.stereo.baselines.gradient_cost import (
    CostImages,
    GradientCostSettings,
    cost_images,
    gradient_cost,
)
from barsight.stereo.baselines.guided_filter import colour_guided_filter, guided_filter
from barsight.stereo.baselines.left_right_check import (
    fill_from_background,
    left_right_agreement,
    weighted_median,
)
from barsight.stereo.baselines.postprocessing import (
    OutputSettings,
    assemble_disparity,
    is_matchable,
    mirror_pair,
    no_match,
)
from barsight.stereo.baselines.spanning_tree import spanning_tree, tree_filter
from barsight.stereo.baselines.winner_takes_all import Winners, sweep

_MIN_CANDIDATES = 5


@dataclass(frozen=True)
class CscaSettings:
    """Settings of cross-scale cost aggregation."""

    aggregation: Literal["guided", "tree"] = "guided"
    """Method that aggregates each scale's costs."""
    cost: GradientCostSettings = field(default_factory=GradientCostSettings)
    regulariser: float = 0.3
    """Strength of the coupling between scales (the authors' lambda); 0 uses the finest scale alone."""
    scales: int = 5
    """Maximum number of scales; a scale with fewer than five candidates is left out."""
    radius_px: int = 9
    """Radius of the guided filter's window, at every scale."""
    epsilon: float = 6.5
    """Regulariser of the guided filter, in gray levels squared."""
    tree_sigma_gray: float = 25.5
    """Gray difference along the tree over which support falls to 1/e."""
    median_radius_px: int = 9
    """Radius of the weighted median at pixels that fail the left-right check."""
    median_sigma_px: float = 9.0
    """Distance at which the median's weights fall to 1/e."""
    median_sigma_gray: float = 14.7
    """Gray difference at which the median's weights fall to 1/e (the authors' 0.1 over three colours)."""
    output: OutputSettings = field(
        default_factory=lambda: OutputSettings(subpixel_sigma_px=0.27, filled_sigma_px=1.0)
    )

    def __post_init__(self) -> None:
        expect_ranges(
            self, "csca.", regulariser=NOT_NEGATIVE, scales=(1, inf), radius_px=(1, inf), epsilon=POSITIVE,
            tree_sigma_gray=POSITIVE, median_radius_px=(1, inf), median_sigma_px=POSITIVE,
            median_sigma_gray=POSITIVE,
        )  # fmt: skip


@dataclass(frozen=True)
class Csca:
    """`StereoMethod`: cross-scale cost aggregation."""

    settings: CscaSettings

    def __call__(self, pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        """Match; see `StereoMethod`."""
        settings = self.settings
        if not is_matchable(pair, candidates):
            return no_match(pair)
        winners = cross_scale_winners(pair, candidates, settings)
        mirrored = cross_scale_winners(mirror_pair(pair), candidates, settings)
        right = np.ascontiguousarray(mirrored.candidate_px[:, ::-1])
        matched = left_right_agreement(winners.candidate_px, right)
        chosen = weighted_median(
            fill_from_background(winners.candidate_px, matched),
            pair.left,
            ~matched,
            settings.median_radius_px,
            settings.median_sigma_px,
            settings.median_sigma_gray,
        )
        return assemble_disparity(pair, winners, chosen, matched, settings.output)


def scale_weights(scales: int, regulariser: float) -> Float64:
    """Compute the weight (scales,) of each scale's cost in the finest scale's: the first row of the
    inverse [Zhang, Eq. 12].
    """
    system = np.eye(scales)
    for scale in range(scales - 1):
        system[scale : scale + 2, scale : scale + 2] += regulariser * np.array([[1, -1], [-1, 1]])
    weights: Float64 = np.linalg.inv(system)[0]
    return weights


def cross_scale_winners(pair: RectifiedPair, candidates: DisparityRange, settings: CscaSettings) -> Winners:
    """Select the left image's winners from the coupled costs."""
    pyramid = _pyramid(pair, candidates, settings.scales)
    weights = scale_weights(len(pyramid), settings.regulariser).astype(np.float32)
    tied: _Scale | None = None
    for scale, weight in zip(reversed(pyramid[1:]), reversed(weights[1:]), strict=True):
        costs = np.empty((scale.candidates.count, *scale.images.left.shape), dtype=np.float32)
        gradient_cost(scale.images, scale.candidates.lowest_px, settings.cost, costs)
        _aggregation(scale, settings)(costs)
        _tie(costs, weight, scale.candidates.lowest_px, tied)
        tied = replace(scale, costs=costs)
    finest = pyramid[0].images
    aggregate = _aggregation(pyramid[0], settings)

    def fill(lowest_px: int, slices: Float32) -> None:
        gradient_cost(finest, lowest_px, settings.cost, slices)
        aggregate(slices)
        _tie(slices, weights[0], lowest_px, tied)

    return sweep(finest.left.shape, candidates, fill)


@dataclass(frozen=True, eq=False)
class _Scale:
    """guide: (H, W) gray or (H, W, 3) colour. costs: (K, H, W)."""

    images: CostImages
    guide: Float32
    candidates: DisparityRange
    costs: Float32


def _pyramid(pair: RectifiedPair, candidates: DisparityRange, scales: int) -> list[_Scale]:
    """Build the pyramid, the finest first, without costs."""
    images = cost_images(
        pair.left.astype(np.float32), pair.right.astype(np.float32), pair.left_valid, pair.right_valid
    )
    guide = images.left if pair.left_colour is None else pair.left_colour.astype(np.float32)
    no_costs = np.empty((0, 0, 0), dtype=np.float32)
    pyramid = [_Scale(images, guide, candidates, no_costs)]
    while len(pyramid) < scales:
        held = pyramid[-1].candidates
        coarser = DisparityRange(held.lowest_px // 2, held.highest_px // 2 + 1)
        if coarser.count < _MIN_CANDIDATES or min(images.left.shape) < 2:
            break
        masks = [np.ascontiguousarray(mask[::2, ::2]) for mask in (images.left_valid, images.right_valid)]
        images = cost_images(cv2.pyrDown(images.left), cv2.pyrDown(images.right), *masks)
        guide = cv2.pyrDown(guide)
        pyramid.append(_Scale(images, guide, coarser, no_costs))
    return pyramid


def _aggregation(scale: _Scale, settings: CscaSettings) -> Callable[[Float32], Float32]:
    if settings.aggregation == "guided":
        by_guide = guided_filter if scale.guide.ndim == 2 else colour_guided_filter
        return by_guide(scale.guide, settings.radius_px, settings.epsilon)
    guide: UInt8 = np.rint(scale.images.left).clip(0, 255).astype(np.uint8)
    return tree_filter(spanning_tree(guide), settings.tree_sigma_gray)


def _tie(slices: Float32, weight: float, lowest_px: int, coarser: _Scale | None) -> None:
    """Combine slices = weight * slices + the coarser scale's coupled costs at half the position and half the
    candidate.

    An odd candidate takes the mean of its two neighbours there. The authors' program rounds it up instead,
    which shifts all subpixel disparities by about -0.12 px.
    """
    if coarser is None:
        slices *= np.float32(weight)
    else:
        _tie_slices(slices, np.float32(weight), lowest_px, coarser.costs, coarser.candidates.lowest_px)


@kernel(parallel=True)
def _tie_slices(
    slices: Float32, weight: np.float32, lowest: int, coarse: Float32, coarse_lowest: int
) -> None:
    """Combine the costs of two neighbouring scales, in place [Zhang, CVPR 2014].

    slices: (K, H, W) aggregated costs of the candidates from `lowest` px on, multiplied by `weight`. coarse:
    (K', ceil(H / 2), ceil(W / 2)) coupled costs of the coarser scale from coarse_lowest on, in its own px.
    """
    count, height, width = slices.shape
    half = np.float32(0.5)
    for row in numba.prange(height):
        for index in range(count):
            fine = slices[index, row]
            lower = coarse[(lowest + index) // 2 - coarse_lowest, row // 2]
            upper = coarse[(lowest + index + 1) // 2 - coarse_lowest, row // 2]
            for x in range(width // 2):
                above = half * (lower[x] + upper[x])
                fine[2 * x] = weight * fine[2 * x] + above
                fine[2 * x + 1] = weight * fine[2 * x + 1] + above
            if width % 2:
                above = half * (lower[width // 2] + upper[width // 2])
                fine[width - 1] = weight * fine[width - 1] + above
