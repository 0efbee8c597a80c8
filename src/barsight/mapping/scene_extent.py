"""Probe a recording: can it be matched at all, and how fine can its map be; select keyframes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed, InputError, MeasurementError
from barsight.core.types import (
    CraneSamples,
    DisparityRange,
    PosedFrame,
    RectifiedCamera,
    RefusedFrame,
)
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.stereo.search_range import find_disparity_range
from barsight.stereo.vertical_offset import MAX_OFFSET_PX, vertical_offset

CELL_SIDES_M = (0.01, 0.02, 0.05, 0.1, 0.2)
_MAX_POINTS_PER_PIXEL = 4


@dataclass(frozen=True, eq=False)
class RecordingProbe:
    """The first usable pair: disparity range and the size of its pixels on the surface (median, m).

    off_rows_px: how far matches lie off their rows (see `vertical_offset`), NaN where it can't be told.
    range_m: the depth in the middle of the disparities.
    """

    candidates: DisparityRange
    pixel_on_surface_m: float
    off_rows_px: float
    range_m: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """List what is wrong with the calibration, as far as one pair shows it."""
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
    """Choose the cell size: 10 mm in the yard; elsewhere the first round size that holds one and a half
    pixels.
    """
    if has_crane:
        return CELL_SIDES_M[0]
    wanted = 1.5 * first.pixel_on_surface_m
    return next((side for side in CELL_SIDES_M if side >= wanted), CELL_SIDES_M[-1])


def select_keyframes(
    frames: Sequence[PosedFrame], rectifier: Rectifier, range_m: float, min_shift: float
) -> set[int]:
    """Select keyframes by parallax: stamps of frames whose picture has moved, since the last one taken, by
    min_shift of its shorter side on a surface range_m away; the first and the last always.
    """
    ahead = np.array([0.0, 0.0, range_m])
    seen = [(frame.reference_from_body @ rectifier.body_from_rect0).apply(ahead) for frame in frames]
    stamps = [frame.stamp_ns for frame in frames]
    return set(_spread(stamps, np.array(seen), keyframe_spacing_m(rectifier.camera, range_m, min_shift)))


def select_keyframes_by_encoders(
    stamps_ns: Sequence[int], crane: CraneSamples, shift_ns: int, camera: RectifiedCamera, range_m: float,
    min_shift: float,
) -> list[int]:  # fmt: skip
    """Select keyframes by encoders before a trajectory is known: as if the crane carried the camera without a
    sway.

    shift_ns: from the frames' clock to the encoders'.
    """
    start = int(crane.stamp_ns[0])
    at, known = (np.asarray(times) - start for times in (np.array(stamps_ns) + shift_ns, crane.stamp_ns))
    places = np.column_stack([np.interp(at, known, axis) for axis in crane.position_m.T])
    return _spread(stamps_ns, places, keyframe_spacing_m(camera, range_m, min_shift))


def keyframe_spacing_m(camera: RectifiedCamera, range_m: float, min_shift: float) -> float:
    """Return the way on a surface range_m away that min_shift of a picture's shorter side spans, m."""
    return min_shift * min(camera.width, camera.height) * range_m / camera.focal_px


def _spread(stamps_ns: Sequence[int], places_m: Float64, min_m: float) -> list[int]:
    """Select stamps whose place (N, 3) lies min_m from the last one taken; the first and the last
    always.
    """
    taken: list[int] = []
    last: Float64 | None = None
    for stamp, place in zip(stamps_ns, places_m, strict=True):
        if last is None or np.linalg.norm(place - last) >= min_m or stamp == stamps_ns[-1]:
            taken.append(stamp)
            last = place
    return taken


def points_per_pixel(first: RecordingProbe, cell_m: float) -> int:
    """Choose points along each axis of a pixel so that no cell between two pixels stays empty."""
    wanted = math.ceil(first.pixel_on_surface_m / (0.9 * cell_m))
    return min(max(1, wanted), _MAX_POINTS_PER_PIXEL)
