"""One frame's way: rectified pair and disparity, then points and what they say of the map's cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float32, UInt8
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.timing import Stopwatch
from barsight.core.types import Disparity, DisparityRange, PosedFrame, RectifiedPair, StereoFrame
from barsight.mapping.ego_mask import carried_along
from barsight.mapping.observation import CellObservations, observe
from barsight.stereo.masking import keep, surer_than, without_gaps
from barsight.stereo.method import StereoMethod
from barsight.stereo.search_range import find_range
from barsight.stereo.settings import StereoSettings
from barsight.stereo.triangulation import triangulate


@dataclass(frozen=True, eq=False)
class Matched:
    """A frame before anybody knows where it was taken: its rectified pair, and its disparity or why not."""

    pair: RectifiedPair
    disparity: Disparity | Failed

    @property
    def stamp_ns(self) -> int:
        """The pair's."""
        return self.pair.stamp_ns


@dataclass(frozen=True, eq=False)
class View:
    """cells: what the frame says of the map. left, disparity_px: (H, W), for people to look at."""

    cells: CellObservations
    left: UInt8
    disparity_px: Float32


Neighbour = tuple[Matched, PosedFrame]


@dataclass(frozen=True, eq=False)
class Matcher:
    """From a frame to what it shows by itself: without state, so that frames run side by side."""

    stereo: StereoSettings
    method: StereoMethod
    rectifier: Rectifier
    watch: Stopwatch

    def __call__(self, frame: StereoFrame) -> Matched | Failed:
        """Failed where the images have the wrong size; the disparity Failed where they are swapped or have no
        texture.
        """
        with self.watch("rectify", 1):
            pair = self.rectifier(frame)
        return pair if isinstance(pair, Failed) else Matched(pair, self._disparity(pair))

    def _disparity(self, pair: RectifiedPair) -> Disparity | Failed:
        candidates = disparity_range(pair, self.stereo)
        if isinstance(candidates, Failed):
            return candidates
        width = pair.camera.width
        if candidates.lowest_px >= width or candidates.highest_px <= -width or candidates.count > width:
            asked = f"{candidates.lowest_px}:{candidates.highest_px}"
            return Failed("wide-range", f"the disparity range {asked} doesn't fit a picture {width} px wide")
        with self.watch("stereo", 1):
            sure = surer_than(self.method(pair, candidates), self.stereo.max_sigma_px)
            return without_gaps(sure, pair.left, self.stereo.gap_darkness)


@dataclass(frozen=True, eq=False)
class Placer:
    """From a matched frame and its pose to what it says of the map. per_pixel, max_sigma_m: see
    `triangulate`.
    """

    stereo: StereoSettings
    body_from_rect0: Pose
    cell_m: float
    per_pixel: int
    max_sigma_m: float
    watch: Stopwatch

    def __call__(
        self, matched: Matched, posed: PosedFrame, beside: Sequence[Neighbour] = ()
    ) -> View | Failed:
        """beside: the frames before and after, against which the crane's own parts stand still.

        Failed where there is no disparity, or no depth within max_depth_m and max_sigma_m.
        """
        pair, disparity = matched.pair, matched.disparity
        if isinstance(disparity, Failed):
            return disparity
        reference_from_rect0 = posed.reference_from_body @ self.body_from_rect0
        with self.watch("carried", 1):
            for other, pose in beside:
                there_from_here = (pose.reference_from_body @ self.body_from_rect0).inverse()
                still = carried_along(
                    pair.left, disparity.disparity_px, pair.camera, other.pair.left,
                    there_from_here @ reference_from_rect0,
                )  # fmt: skip
                disparity = keep(disparity, ~still)
        with self.watch("points", 1):
            points = triangulate(
                pair,
                disparity,
                self.stereo.calibration_sigma_px,
                self.stereo.max_depth_m,
                self.max_sigma_m,
                self.per_pixel,
            )
            spacing_rad = 1 / (pair.camera.focal_px * self.per_pixel)
            cells = observe(
                points, reference_from_rect0, posed.reference_from_body.translation, posed.covariance,
                self.cell_m, spacing_rad,
            )  # fmt: skip
        if cells.z_m.size == 0:
            return Failed("no-depth", "no pixel has a depth within max_depth_m and max_sigma_m")
        return View(cells, pair.left, disparity.disparity_px)


def disparity_range(pair: RectifiedPair, stereo: StereoSettings) -> DisparityRange | Failed:
    """The settings' range, its open ends found from the images."""
    low, high = stereo.lowest_disparity_px, stereo.highest_disparity_px
    if low is None or high is None:
        found = find_range(pair)
        if isinstance(found, Failed):
            return found
        low = found.lowest_px if low is None else low
        high = found.highest_px if high is None else high
    if high <= low:
        return Failed("empty-range", f"the disparity range {low}:{high} is empty")
    return DisparityRange(low, high)
