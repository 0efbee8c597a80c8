"""Match densely with our own method: semi-global start, consistency check, direct refinement along the bars,
sharpening of edges.

What only one image sees stays NaN; with `fill_occlusions` it is guessed, with a large sigma.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from barsight.core.arrays import Float32, UInt8
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.core.settings.values import NOT_NEGATIVE, POSITIVE, expect_ranges
from barsight.stereo.direct.confidence import (
    Doubts,
    add_edge_sigma,
    disparity_bend,
    edge_risk,
    judge_matches,
    start_disagreement,
    vertical_error_px,
)
from barsight.stereo.direct.confirmation import EDGE_WINDOW_PX, confirmed_start
from barsight.stereo.direct.consistency import drop_invalid, hits_valid, is_consistent, remove_islands
from barsight.stereo.direct.depth_edges import sharpen_edges
from barsight.stereo.direct.kernels.pyramid import double_disparity, halve
from barsight.stereo.direct.occlusion_filling import fill_occlusions_by_planes, fill_row_holes
from barsight.stereo.direct.refinement import (
    MIN_HALVED_PX,
    RefinedDisparity,
    RefinementSettings,
    refine_at_half_size,
    refine_disparity,
)
from barsight.stereo.direct.row_binning import (
    BINNED_ROWS,
    are_rows_alike,
    bin_disparity,
    bin_rows,
    spread_rows,
)
from barsight.stereo.direct.semiglobal.matching import SemiGlobalSettings, match_semiglobal
from barsight.stereo.masking import mask_values

_NAN = np.float32(np.nan)
_FAST_HALF_SIZE_STEPS = 2
"""Number of refinement steps that the preset `fast` runs at half size."""
_JUMP_PX = 1.0
"""Minimum difference between neighbours at a depth edge."""
_MAX_MOVED_PX = 2.0
"""Maximum distance between a match and its start; beyond it, the match is dropped."""
_MIN_CONTRAST_GRAY = 0.5
"""Minimum standard deviation of a picture's gray levels; with less, nothing is matched."""
_FAR_STEP_PX, _MAX_FAR_RATIO = 0.3, 0.15
"""Length of a refinement step, and maximum share of pixels that step further, above which a prediction is
rejected as a whole.
"""


@dataclass(frozen=True)
class BarsightSettings:
    """Settings of Barsight's own stereo."""

    preset: Literal["best", "fast"] = "best"
    """Trade-off between accuracy and speed. `fast` starts at half size, runs all refinement steps but the
    last there, uses only the long support, and doesn't sharpen edges.
    """
    fill_occlusions: bool = True
    """Guess what only one image sees (sigma of 1 px or more, which no map accepts) instead of leaving NaN."""
    consistency_px: float = 1.0
    """Maximum difference between the left and the right disparity of a match."""
    island_px: int = 40
    """Minimum size of a connected patch, in pixels; smaller ones are dropped."""
    model_sigma_px: float = 0.005
    """Minimum error of the method itself (1 sigma)."""
    vertical_error_ratio: float = 1.5
    """Disparity error per vertical error measured in the images; above 1, because parallax adds its own."""
    edge_error_ratio: float = 0.55
    """Disparity error per pixel by which the disparity bends within 3 px."""
    max_edge_px: float = 0.5
    """Maximum bend of the disparity that is counted, at a curved surface or an edge."""
    start_error_ratio: float = 0.09
    """Disparity error per pixel of disagreement between the start and its refinement over a window."""
    wrong_side_px: float = 0.3
    """Disparity error on a depth edge, where a pixel may belong to either side; it falls to 1 / e within 3
    px.
    """
    other_side_error_ratio: float = 0.5
    """Disparity error within 2.5 px of a depth edge, per pixel of disparity to its other side: at 0.5, 2
    sigma reach the other side. It isn't used for a map, which outvotes wrong sides.
    """
    max_sigma_px: float = 1.0
    """Maximum sigma of a match; less certain ones are dropped, unless fill_occlusions is on."""
    semiglobal: SemiGlobalSettings = field(default_factory=SemiGlobalSettings)
    refinement: RefinementSettings = field(default_factory=RefinementSettings)

    def __post_init__(self) -> None:
        expect_ranges(
            self, "barsight.", consistency_px=POSITIVE, max_sigma_px=POSITIVE,
            vertical_error_ratio=NOT_NEGATIVE, edge_error_ratio=NOT_NEGATIVE,
            start_error_ratio=NOT_NEGATIVE, other_side_error_ratio=NOT_NEGATIVE,
            max_edge_px=NOT_NEGATIVE, wrong_side_px=NOT_NEGATIVE, model_sigma_px=NOT_NEGATIVE,
            island_px=NOT_NEGATIVE,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Start:
    """left_px: (H, W), NaN where unmatched or inconsistent. right_px: (H, W), of the right image."""

    left_px: Float32
    right_px: Float32


@dataclass(frozen=True)
class BarsightStereo:
    """`StereoMethod` of Barsight: direct refinement of a semi-global start.

    binned_row_m: maximum width of two rows that are averaged where rows are alike, 0 averages none.
    """

    settings: BarsightSettings
    binned_row_m: float = 0.0

    def __call__(self, pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        """Match; see `StereoMethod`. Candidates beyond the image's width are left out.

        Memory: the semi-global stripes (about 130 MB per thread) and some thirty float32 images.
        """
        return self._in_rows(pair, candidates, None)

    def confirm(self, pair: RectifiedPair, candidates: DisparityRange, predicted: Float32) -> Disparity:
        """Match a pair whose disparity is predicted, (H, W) px, NaN where not: with a single refinement
        step where the pair's own pictures confirm it, or with all steps if that one moves many pixels far.
        """
        return self._in_rows(pair, candidates, predicted)

    def _in_rows(
        self, pair: RectifiedPair, candidates: DisparityRange, predicted: Float32 | None
    ) -> Disparity:
        """Match at the pictures' own size, or with pairs of rows averaged."""
        candidates = _inside(candidates, pair.camera.width)
        if not (self.binned_row_m > 0 and are_rows_alike(pair, candidates, self.binned_row_m)):
            return _Matching(self.settings).match(pair, candidates, predicted)
        found = _Matching(_in_binned_rows(self.settings), halves_rows=False).match(
            bin_rows(pair), candidates, None if predicted is None else bin_disparity(predicted)
        )
        return spread_rows(found, len(pair.left))


def _in_binned_rows(settings: BarsightSettings) -> BarsightSettings:
    """Convert lengths along the columns to binned rows; windows keep their area."""
    refinement = settings.refinement
    return replace(
        settings,
        island_px=settings.island_px // BINNED_ROWS,
        vertical_error_ratio=settings.vertical_error_ratio * BINNED_ROWS,
        refinement=replace(
            refinement,
            along_px=refinement.along_px / BINNED_ROWS,
            short_px=refinement.short_px / BINNED_ROWS,
            gloss_px=refinement.gloss_px / BINNED_ROWS,
            window_px=max(int(refinement.window_px / BINNED_ROWS**0.5) | 1, 3),
        ),
    )


@dataclass(frozen=True)
class _Matching:
    """The matching of one pair. halves_rows: whether half size halves the rows too; not if they are
    binned.
    """

    settings: BarsightSettings
    halves_rows: bool = True

    def match(self, pair: RectifiedPair, candidates: DisparityRange, predicted: Float32 | None) -> Disparity:
        """Match a pair, starting from a predicted disparity if there is one."""
        if min(_contrast(pair.left), _contrast(pair.right)) < _MIN_CONTRAST_GRAY:
            nothing = np.full(pair.left.shape, _NAN, dtype=np.float32)
            return Disparity(nothing, nothing.copy())
        if predicted is not None and min(pair.left.shape) >= MIN_HALVED_PX:
            return self._confirm(pair, candidates, predicted)
        settings, refinement = self.settings, self.settings.refinement
        if settings.preset == "fast":
            halved = _FAST_HALF_SIZE_STEPS
            steps = min(refinement.steps, halved + 1)
            refinement = replace(refinement, steps=steps, short_px=0.0, half_size_steps=halved)
        start = self._start(pair, candidates)
        return self._finish(pair, candidates, start, self._refined(pair, start.left_px, refinement))

    def _confirm(self, pair: RectifiedPair, candidates: DisparityRange, predicted: Float32) -> Disparity:
        start, refinement = self._confirmed_start(pair, candidates, predicted), self.settings.refinement
        started = start.left_px
        refined = self._refined(pair, started, replace(refinement, steps=1))
        moved = np.subtract(refined.disparity_px, started)
        far = np.count_nonzero(np.abs(moved, out=moved) > _FAR_STEP_PX)
        if far > _MAX_FAR_RATIO * np.count_nonzero(np.isfinite(started)):
            refined = self._refined(pair, started, refinement)
        return self._finish(pair, candidates, start, refined)

    def _confirmed_start(self, pair: RectifiedPair, candidates: DisparityRange, predicted: Float32) -> _Start:
        own = self._start_at_half_size(pair, candidates)
        matched = np.isfinite(own.left_px)
        own_px = refine_at_half_size(
            pair.left, pair.right, fill_row_holes(own.left_px), matched, self.settings.refinement,
            self.halves_rows,
        )  # fmt: skip
        own_px = mask_values(own_px, matched)
        rows = EDGE_WINDOW_PX if self.halves_rows else EDGE_WINDOW_PX // BINNED_ROWS | 1
        started = confirmed_start(pair.left, pair.right, predicted, own_px, own.right_px, rows)
        return _Start(mask_values(started, pair.left_valid), own.right_px)

    def _refined(
        self, pair: RectifiedPair, start_px: Float32, settings: RefinementSettings
    ) -> RefinedDisparity:
        filled, matched = fill_row_holes(start_px), np.isfinite(start_px)
        return refine_disparity(pair.left, pair.right, filled, matched, settings, self.halves_rows)

    def _finish(
        self, pair: RectifiedPair, candidates: DisparityRange, start: _Start, refined: RefinedDisparity
    ) -> Disparity:
        """Complete a refined start: compute its sigma, fill occlusions, sharpen edges."""
        settings = self.settings
        disparity, sigma = self._judged(pair, refined, start.left_px)
        if settings.fill_occlusions:
            limits = float(candidates.lowest_px), float(candidates.highest_px)
            disparity, guessed = fill_occlusions_by_planes(disparity, pair.left, start.right_px, *limits)
            sigma = np.where(np.isfinite(guessed), guessed, sigma)
        sharp = disparity
        if settings.preset == "best":
            sharp = sharpen_edges(disparity, pair.left, _JUMP_PX)
        beside, other_side = edge_risk(sharp, _JUMP_PX, settings.other_side_error_ratio > 0)
        # The distance by which a pixel was moved counts as an additional sigma.
        add_edge_sigma(disparity, sharp, beside, settings.wrong_side_px, pair.left_valid, sigma)
        if other_side is not None:
            sigma = _both(sigma, np.float32(settings.other_side_error_ratio) * other_side)
        return Disparity(sharp, sigma)

    def _judged(
        self, pair: RectifiedPair, refined: RefinedDisparity, start_px: Float32
    ) -> tuple[Float32, Float32]:
        """Compute the disparity and sigma of a refined start, NaN where unmatched or dropped."""
        settings, found = self.settings, refined.disparity_px
        vertical_px = vertical_error_px(pair.left, pair.right, found, np.isfinite(start_px))
        doubts = Doubts(
            np.float32(settings.model_sigma_px**2 + (settings.vertical_error_ratio * vertical_px) ** 2),
            np.float32(settings.edge_error_ratio**2),
            np.float32(settings.start_error_ratio),
            np.float32(_MAX_MOVED_PX),
            np.float32(np.inf if settings.fill_occlusions else settings.max_sigma_px),
        )
        bend, disagreement = disparity_bend(found, settings.max_edge_px), start_disagreement(start_px, found)
        return judge_matches(start_px, found, refined.variance_px2, bend, disagreement, doubts)

    def _start(self, pair: RectifiedPair, candidates: DisparityRange) -> _Start:
        settings = self.settings
        if settings.preset == "fast" and min(pair.left.shape) >= MIN_HALVED_PX:
            return self._start_at_half_size(pair, candidates)
        found = match_semiglobal(
            pair.left, pair.right, candidates.lowest_px, candidates.count, settings.semiglobal
        )
        believed = is_consistent(found.left_px, found.right_px, settings.consistency_px) & pair.left_valid
        believed &= hits_valid(pair.right_valid, found.left_px)
        left_px = mask_values(found.left_px, believed)
        return _Start(remove_islands(left_px, settings.island_px, 1.0), found.right_px)

    def _start_at_half_size(self, pair: RectifiedPair, candidates: DisparityRange) -> _Start:
        """Match the start at half size, an eighth of the work; refinement compensates for the coarser
        steps.
        """
        settings, shape = self.settings, pair.left.shape
        left, right = (halve(image, rows=self.halves_rows) for image in (pair.left, pair.right))
        lowest = candidates.lowest_px // 2
        found = match_semiglobal(
            left, right, lowest, -(-candidates.highest_px // 2) - lowest, settings.semiglobal
        )
        believed = is_consistent(found.left_px, found.right_px, settings.consistency_px)
        left_px = mask_values(found.left_px, believed)
        small = remove_islands(left_px, settings.island_px // 4, 1.0)
        left_px, right_px = double_disparity(small, shape), double_disparity(found.right_px, shape)
        drop_invalid(pair.left_valid, pair.right_valid, left_px)
        return _Start(left_px, right_px)


def _contrast(image: UInt8) -> float:
    """Compute the standard deviation of the gray values; a black or blown-out image has none."""
    return float(image[::2, ::2].std())


def _inside(candidates: DisparityRange, width: int) -> DisparityRange:
    lowest = min(max(candidates.lowest_px, -width), width - 1)
    return DisparityRange(lowest, max(min(candidates.highest_px, width), lowest + 1))


def _both(one: Float32, other: Float32) -> Float32:
    """Add two sigmas in quadrature. NumPy's hypot, which guards against overflow, takes several times as
    long.
    """
    together: Float32 = np.sqrt(one * one + other * other)
    return together
