"""Probe a recording: check that it can be matched, and find the resolution that its map can have."""

from __future__ import annotations

import math
from dataclasses import dataclass

from barsight.core.errors import Failed, InputError, MeasurementError
from barsight.core.records.disparity import DisparityRange
from barsight.core.records.pairs import RefusedFrame
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.stereo.search_range import find_disparity_range
from barsight.stereo.vertical_offset import MAX_OFFSET_PX, vertical_offset

CELL_SIDES_M = (0.01, 0.02, 0.05, 0.1, 0.2)
_MAX_POINTS_PER_PIXEL = 4


@dataclass(frozen=True, eq=False)
class RecordingProbe:
    """Result of the first usable pair: disparity range and the size of its pixels on the surface (median, m).

    off_rows_px: vertical offset of matches from their rows (see `vertical_offset`), NaN where it can't be
    measured. range_m: depth at the middle of the disparity range.
    """

    candidates: DisparityRange
    pixel_on_surface_m: float
    off_rows_px: float
    range_m: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """List the faults of the calibration that a single pair reveals."""
        if not self.off_rows_px > MAX_OFFSET_PX:
            return ()
        return (
            f"matches lie {self.off_rows_px:.1f} px off their rows in the first pair: "
            "the calibration doesn't fit these pictures, calibrate anew",
        )


def probe_recording(pairs: RectifiedPairs) -> RecordingProbe:
    """Match the first usable pair.

    Raises InputError where left and right are swapped, MeasurementError where no frame can be used.
    """
    reasons: list[str] = []
    swapped, path = 0, pairs.recording.path
    for pair in pairs():
        if isinstance(pair, RefusedFrame):
            reasons.append(pair.reason)
            continue
        found = find_disparity_range(pair)
        if isinstance(found, DisparityRange):
            camera = pair.camera
            middle = (found.lowest_px + found.highest_px) / 2 + camera.doffs_px
            offset = vertical_offset(pair.left, pair.right)
            off_rows = math.nan if isinstance(offset, Failed) else offset
            pixel_m = camera.baseline_m / max(middle, 1.0)
            return RecordingProbe(found, pixel_m, off_rows, camera.focal_px * pixel_m)
        reasons.append(found.reason)
        swapped += found.code == "swapped"
        if swapped >= 2:
            break
    if swapped:
        raise InputError(path, reasons[-1], "exchange the folders or topics of cam0 (left) and cam1 (right)")
    if not reasons:
        raise InputError(path, "no stereo pair at all", "check the cameras' time stamps")
    raise MeasurementError(f"{path}: none of the {len(reasons)} frames can be used; first: {reasons[0]}")


def choose_cell_size(first: RecordingProbe, *, has_crane: bool) -> float:
    """Choose the cell size: 10 mm in the yard; elsewhere the smallest standard size that spans one and a
    half pixels.
    """
    if has_crane:
        return CELL_SIDES_M[0]
    wanted = 1.5 * first.pixel_on_surface_m
    return next((side for side in CELL_SIDES_M if side >= wanted), CELL_SIDES_M[-1])


def points_per_pixel(first: RecordingProbe, cell_m: float) -> int:
    """Choose the number of points along each axis of a pixel so that no cell between two pixels stays
    empty.
    """
    wanted = math.ceil(first.pixel_on_surface_m / (0.9 * cell_m))
    return min(max(1, wanted), _MAX_POINTS_PER_PIXEL)
