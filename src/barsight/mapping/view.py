"""Process one frame: rectify and match the pair, then triangulate its points and bin them to map cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from barsight.core.arrays import Float32
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.core.records.trajectory import PosedFrame
from barsight.core.timing import Stopwatch
from barsight.mapping.ego_mask import mask_carried
from barsight.mapping.observation import CellObservations, sort_points
from barsight.motion.frontend.direct_alignment import align_views
from barsight.stereo.direct.pipeline import BarsightStereo
from barsight.stereo.masking import mask_disparity, mask_gaps, mask_pieces, mask_unsure
from barsight.stereo.method import StereoMethod
from barsight.stereo.prediction import predict_disparity
from barsight.stereo.search_range import (
    check_matchable,
    find_disparity_range,
    follow_disparity_range,
    is_well_textured,
)
from barsight.stereo.settings import StereoSettings
from barsight.stereo.triangulation import triangulate_disparity


@dataclass(frozen=True, eq=False)
class MatchedFrame:
    """A matched frame without a pose: its rectified pair, and its disparity or the reason why there is
    none.
    """

    pair: RectifiedPair
    disparity: Disparity | Failed

    @property
    def stamp_ns(self) -> int:
        """Return the pair's stamp."""
        return self.pair.stamp_ns


@dataclass(frozen=True, eq=False)
class Preceding:
    """The previous frame, and a guess of the rectified left camera's motion since then."""

    frame: MatchedFrame
    now_from_before: Pose


@dataclass(frozen=True, eq=False)
class PosedView:
    """A posed frame.

    cells: its observations of the map. pair: its pictures. disparity_px: (H, W), for display only.
    """

    cells: CellObservations
    pair: RectifiedPair
    disparity_px: Float32


Neighbour = tuple[RectifiedPair, PosedFrame]


@dataclass(frozen=True, eq=False)
class Matcher:
    """Match a rectified pair. A matcher keeps no state, so that pairs can be matched in parallel."""

    stereo: StereoSettings
    method: StereoMethod
    watch: Stopwatch

    def __call__(self, pair: RectifiedPair, preceding: Preceding | None = None) -> MatchedFrame:
        """Match a pair; the disparity is Failed where the pictures are swapped or have no texture.

        preceding: if its view can be aligned with this one, its disparity is only confirmed instead of
        searched for anew.
        """
        return MatchedFrame(pair, self._disparity(pair, preceding))

    def _disparity(self, pair: RectifiedPair, preceding: Preceding | None) -> Disparity | Failed:
        predicted = None
        if preceding is not None and isinstance(self.method, BarsightStereo):
            with self.watch("stereo"):
                predicted = _predicted(pair, preceding)
        candidates = disparity_range(pair, self.stereo, predicted)
        if isinstance(candidates, Failed):
            return candidates
        width = pair.camera.width
        if not candidates.fits(width):
            asked = f"{candidates.lowest_px}:{candidates.highest_px}"
            return Failed("wide-range", f"the disparity range {asked} doesn't fit a picture {width} px wide")
        with self.watch("stereo", 1):
            if predicted is not None and isinstance(self.method, BarsightStereo):
                found = self.method.confirm(pair, candidates, predicted)
            else:
                found = self.method(pair, candidates)
            sure = mask_unsure(found, self.stereo.max_sigma_px)
            return mask_pieces(mask_gaps(sure, pair.left, self.stereo.gap_darkness), pair.left)


def _predicted(pair: RectifiedPair, preceding: Preceding) -> Float32 | None:
    """Predict the disparity (H, W) px, NaN where unknown; None where the views can't be aligned."""
    before, camera = preceding.frame, pair.camera
    if isinstance(before.disparity, Failed):
        return None
    guess = preceding.now_from_before
    motion = align_views(before.pair.left, before.disparity, pair.left, camera, guess)
    return None if isinstance(motion, Failed) else predict_disparity(before.disparity, camera, motion)


@dataclass(frozen=True, eq=False)
class PointBinner:
    """Triangulate a matched frame and bin its points using its pose. per_pixel, max_sigma_m: see
    `triangulate_disparity`.
    """

    stereo: StereoSettings
    body_from_rect0: Pose
    cell_m: float
    per_pixel: int
    max_sigma_m: float
    watch: Stopwatch

    def __call__(
        self, matched: MatchedFrame, posed: PosedFrame, beside: Sequence[Neighbour] = ()
    ) -> PosedView | Failed:
        """Bin the frame's points. beside: the frames before and after, in which the crane's own parts stay in
        place.

        Returns Failed where there is no disparity, or no depth within max_depth_m and max_sigma_m.
        """
        pair, disparity = matched.pair, matched.disparity
        if isinstance(disparity, Failed):
            return disparity
        reference_from_rect0 = posed.reference_from_body @ self.body_from_rect0
        with self.watch("carried", 1):
            for other, pose in beside:
                there_from_here = (pose.reference_from_body @ self.body_from_rect0).inverse()
                still = mask_carried(
                    pair.left, disparity.disparity_px, pair.camera, other.left,
                    there_from_here @ reference_from_rect0,
                )  # fmt: skip
                if still.any():
                    disparity = mask_disparity(disparity, ~still)
        with self.watch("points", 1):
            points = triangulate_disparity(
                pair,
                disparity,
                self.stereo.calibration_sigma_px,
                self.stereo.max_depth_m,
                self.max_sigma_m,
                self.per_pixel,
            )
            spacing_rad = 1 / (pair.camera.focal_px * self.per_pixel)
            by_cell = sort_points(
                points, reference_from_rect0, posed.reference_from_body.translation, posed.covariance,
                self.cell_m, spacing_rad,
            )  # fmt: skip
            del points  # 27 MB at 1280x1024
            cells = by_cell.merged()
        if cells.z_m.size == 0:
            return Failed("no-depth", "no pixel has a depth within max_depth_m and max_sigma_m")
        return PosedView(cells, pair, disparity.disparity_px)


def check_pair(pair: RectifiedPair, stereo: StereoSettings) -> Failed | None:
    """Return Failed if `Matcher` would find no disparity in the pair; takes a small part of its time."""
    if stereo.min_disparity_px is not None and stereo.max_disparity_px is not None:
        return check_matchable(pair)
    if is_well_textured(pair):
        return None
    found = find_disparity_range(pair)
    return found if isinstance(found, Failed) else None


def disparity_range(
    pair: RectifiedPair, stereo: StereoSettings, predicted: Float32 | None = None
) -> DisparityRange | Failed:
    """Complete the settings' disparity range: a missing end is found from the images or the predicted
    disparity.
    """
    low, high = stereo.min_disparity_px, stereo.max_disparity_px
    if low is None or high is None:
        found = find_disparity_range(pair) if predicted is None else follow_disparity_range(pair, predicted)
        if isinstance(found, Failed):
            return found
        low = found.lowest_px if low is None else low
        high = found.highest_px if high is None else high
    if high <= low:
        return Failed("empty-range", f"the disparity range {low}:{high} is empty")
    return DisparityRange(low, high)
