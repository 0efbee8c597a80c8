"""The first look at a recording: can it be matched at all, and how fine can its map be."""

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
    RectifiedPair,
    RefusedFrame,
)
from barsight.recording.base import Recording
from barsight.stereo.search_range import find_range
from barsight.stereo.vertical_offset import MOST_OFFSET_PX, vertical_offset

CELL_SIDES_M = (0.01, 0.02, 0.05, 0.1, 0.2)
_MOST_POINTS_PER_PIXEL = 4


@dataclass(frozen=True, eq=False)
class FirstLook:
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
        """What is wrong with the calibration, as far as one pair shows it."""
        if not self.off_rows_px > MOST_OFFSET_PX:
            return ()
        return (
            f"matches lie {self.off_rows_px:.1f} px off their rows in the first pair: "
            "the calibration doesn't fit these pictures, calibrate anew",
        )


def first_look(source: Recording, rectifier: Rectifier) -> FirstLook:
    """Look for the first frame that can be matched.

    Raises InputError where left and right are swapped, MeasurementError where no frame can be used.
    """
    reasons: list[str] = []
    swapped = 0
    for frame in source.frames():
        if isinstance(frame, RefusedFrame):
            reasons.append(frame.reason)
            continue
        pair = rectifier(frame)
        found = pair if isinstance(pair, Failed) else find_range(pair)
        if isinstance(pair, RectifiedPair) and isinstance(found, DisparityRange):
            camera = rectifier.camera
            middle = (found.lowest_px + found.highest_px) / 2 + camera.doffs_px
            offset = vertical_offset(pair.left, pair.right)
            off_rows = math.nan if isinstance(offset, Failed) else offset
            pixel_m = camera.baseline_m / max(middle, 1.0)
            return FirstLook(found, pixel_m, off_rows, camera.focal_px * pixel_m)
        assert isinstance(found, Failed)
        reasons.append(found.reason)
        swapped += found.code == "swapped"
        if swapped >= 2:
            break
    if swapped:
        raise InputError(
            source.path, reasons[-1], "exchange the folders or topics of cam0 (left) and cam1 (right)"
        )
    if not reasons:
        raise InputError(source.path, "no stereo pair at all", "check the cameras' time stamps")
    raise MeasurementError(
        f"{source.path}: none of the {len(reasons)} frames can be used; first: {reasons[0]}"
    )


def choose_cell(first: FirstLook, *, has_crane: bool) -> float:
    """10 mm in the yard; elsewhere the first round size that holds one and a half pixels."""
    if has_crane:
        return CELL_SIDES_M[0]
    wanted = 1.5 * first.pixel_on_surface_m
    return next((side for side in CELL_SIDES_M if side >= wanted), CELL_SIDES_M[-1])


def apart(frames: Sequence[PosedFrame], rectifier: Rectifier, range_m: float, least_shift: float) -> set[int]:
    """The stamps of the frames whose picture has moved, since the last one taken, by least_shift of its
    shorter side on a surface range_m away; the first and the last always.
    """
    ahead = np.array([0.0, 0.0, range_m])
    seen = [(frame.reference_from_body @ rectifier.body_from_rect0).apply(ahead) for frame in frames]
    stamps = [frame.stamp_ns for frame in frames]
    return set(_spread(stamps, np.array(seen), least_way_m(rectifier.camera, range_m, least_shift)))


def apart_by_encoders(
    stamps_ns: Sequence[int], crane: CraneSamples, shift_ns: int, camera: RectifiedCamera, range_m: float,
    least_shift: float,
) -> list[int]:  # fmt: skip
    """About the same before a trajectory is known: as if the crane carried the camera without a sway.

    shift_ns: from the frames' clock to the encoders'.
    """
    start = int(crane.stamp_ns[0])
    at, known = (np.asarray(times) - start for times in (np.array(stamps_ns) + shift_ns, crane.stamp_ns))
    places = np.column_stack([np.interp(at, known, axis) for axis in crane.position_m.T])
    return _spread(stamps_ns, places, least_way_m(camera, range_m, least_shift))


def least_way_m(camera: RectifiedCamera, range_m: float, least_shift: float) -> float:
    """The way on a surface range_m away that least_shift of a picture's shorter side spans, m."""
    return least_shift * min(camera.width, camera.height) * range_m / camera.focal_px


def _spread(stamps_ns: Sequence[int], places_m: Float64, least_m: float) -> list[int]:
    """The stamps whose place (N, 3) lies least_m from the last one taken; the first and the last always."""
    taken: list[int] = []
    last: Float64 | None = None
    for stamp, place in zip(stamps_ns, places_m, strict=True):
        if last is None or np.linalg.norm(place - last) >= least_m or stamp == stamps_ns[-1]:
            taken.append(stamp)
            last = place
    return taken


def points_per_pixel(first: FirstLook, cell_m: float) -> int:
    """Points along each axis of a pixel so that no cell between two pixels stays empty."""
    wanted = math.ceil(first.pixel_on_surface_m / (0.9 * cell_m))
    return min(max(1, wanted), _MOST_POINTS_PER_PIXEL)
