"""One frame's way: rectified pair, disparity, points, and what they say of the map's cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from barsight.calibration.rectification import Rectifier
from barsight.core.arrays import Float32, UInt8
from barsight.core.errors import Failed
from barsight.core.timing import Stopwatch
from barsight.core.types import Disparity, DisparityRange, PosedFrame, RectifiedPair, StereoFrame
from barsight.mapping.carried import carried_along
from barsight.mapping.observation import CellObservations, observe
from barsight.stereo.disparity_range import find_range
from barsight.stereo.gaps import keep, surer_than, without_gaps
from barsight.stereo.method import StereoMethod
from barsight.stereo.points import triangulate
from barsight.stereo.settings import StereoSettings

Placed = tuple[StereoFrame, PosedFrame]


@dataclass(frozen=True, eq=False)
class View:
    """cells: what the frame says of the map. left, disparity_px: (H, W), for people to look at."""

    stamp_ns: int
    cells: CellObservations
    left: UInt8
    disparity_px: Float32


@dataclass(frozen=True, eq=False)
class Viewer:
    """From a frame and its pose to a `View`: without state, so that frames run side by side.

    per_pixel, max_sigma_m: see `triangulate`.
    """

    stereo: StereoSettings
    method: StereoMethod
    rectifier: Rectifier
    cell_m: float
    per_pixel: int
    max_sigma_m: float
    watch: Stopwatch

    def __call__(self, frame: StereoFrame, posed: PosedFrame, beside: Sequence[Placed] = ()) -> View | Failed:
        """beside: the frames before and after, against which the crane's own parts stand still.

        Failed where the images have the wrong size, are swapped, have no texture or show no depth.
        """
        with self.watch("rectify", 1):
            pair = self.rectifier(frame)
        if isinstance(pair, Failed):
            return pair
        candidates = disparity_range(pair, self.stereo)
        if isinstance(candidates, Failed):
            return candidates
        width = pair.camera.width
        if candidates.lowest_px >= width or candidates.highest_px <= -width or candidates.count > width:
            asked = f"{candidates.lowest_px}:{candidates.highest_px}"
            return Failed("wide-range", f"the disparity range {asked} doesn't fit a picture {width} px wide")
        with self.watch("stereo", 1):
            matched = self.method(pair, candidates)
            sure = surer_than(matched, self.stereo.max_sigma_px)
            disparity = without_gaps(sure, pair.left, self.stereo.gap_darkness)
        with self.watch("carried", 1):
            for other in beside:
                disparity = self._without_carried(pair, disparity, posed, other)
        with self.watch("points", 1):
            points = triangulate(
                pair,
                disparity,
                self.stereo.calibration_sigma_px,
                self.stereo.max_depth_m,
                self.max_sigma_m,
                self.per_pixel,
            )
            body = posed.reference_from_body
            reference_from_rect0 = body @ self.rectifier.body_from_rect0
            spacing_rad = 1 / (pair.camera.focal_px * self.per_pixel)
            cells = observe(
                points, reference_from_rect0, body.translation, posed.covariance, self.cell_m, spacing_rad
            )
        if cells.z_m.size == 0:
            return Failed("no-depth", "no pixel has a depth within max_depth_m and max_sigma_m")
        return View(pair.stamp_ns, cells, pair.left, disparity.disparity_px)

    def _without_carried(
        self, pair: RectifiedPair, disparity: Disparity, posed: PosedFrame, other: Placed
    ) -> Disparity:
        frame, pose = other
        if frame.left.shape != pair.left.shape:
            return disparity
        here, there = (p.reference_from_body @ self.rectifier.body_from_rect0 for p in (posed, pose))
        still = carried_along(
            pair.left, disparity.disparity_px, pair.camera, self.rectifier.left(frame.left),
            there.inverse() @ here,
        )  # fmt: skip
        return keep(disparity, ~still)


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
