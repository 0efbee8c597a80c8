"""Define the records of stereo pairs, as recorded and as rectified."""

from __future__ import annotations

import operator
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64, UInt8, expect_shape
from barsight.core.errors import InputError
from barsight.core.records.gray_levels import TornImageError, to_gray

PICTURE_REMEDY = "give uint8, as (image >> 4).astype(np.uint8) of 12 bits"


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """One raw pair. left, right: (H, W) uint8, cam0 and cam1; others are converted as `to_gray` does.
    stamp_ns: cam0's clock. Raises InputError for what can't be a pair.
    """

    stamp_ns: int
    left: UInt8
    right: UInt8

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "stamp_ns", operator.index(self.stamp_ns))
            np.int64(self.stamp_ns)
        except (TypeError, OverflowError):
            problem = f"its stamp {self.stamp_ns!r} is no integer of 64 bits"
            raise InputError("pair", problem, "give nanoseconds") from None
        for name in ("left", "right"):
            try:
                object.__setattr__(self, name, to_gray(np.asanyarray(getattr(self, name))))
            except TornImageError as error:
                raise InputError(
                    f"{name} picture of {self.stamp_ns} ns", str(error), PICTURE_REMEDY
                ) from error


@dataclass(frozen=True, eq=False)
class NamedPoints:
    """Identified points of a pair. stamp_ns: cam0's clock.

    names: (N,) int64, unique. left, right: (N, 2) raw px in cam0 and cam1.
    """

    stamp_ns: int
    names: Int64
    left: Float64
    right: Float64

    def __post_init__(self) -> None:
        expect_shape("left", self.left, (self.names.size, 2))
        expect_shape("right", self.right, (self.names.size, 2))


@dataclass(frozen=True)
class RefusedFrame:
    """A frame that can't be used, and why. The run goes on without it.

    is_stale: its pictures are older than its stamp, so that nothing may place them.
    """

    stamp_ns: int
    reason: str
    is_stale: bool = False


@dataclass(frozen=True)
class RectifiedCamera:
    """The geometry of a rectified pair: depth = focal_px * baseline_m / (disparity + doffs_px).

    focal_px is common to both; (cx_px, cy_px) is the left principal point; doffs_px = cx_right - cx_left
    [Middlebury 2014]. width, height in pixels.
    """

    focal_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    doffs_px: float
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """left, right: (H, W) uint8 with matches on the same row, x_right = x_left - disparity.

    left_valid, right_valid: (H, W) bool, False where the raw image has no such pixel.
    left_colour, right_colour: (H, W, 3) uint8, the same in colour (BGR), or None; most methods look at gray.
    """

    stamp_ns: int
    left: UInt8
    right: UInt8
    left_valid: Bool
    right_valid: Bool
    camera: RectifiedCamera
    left_colour: UInt8 | None = None
    right_colour: UInt8 | None = None

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        for name in ("left", "right", "left_valid", "right_valid"):
            expect_shape(name, getattr(self, name), shape)
        for name in ("left_colour", "right_colour"):
            if getattr(self, name) is not None:
                expect_shape(name, getattr(self, name), (*shape, 3))
