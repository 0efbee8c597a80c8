"""Model pinhole cameras with radial-tangential (4, 5 or 8 coefficients) or equidistant lenses."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np

from barsight.core.arrays import Float64

MAX_PIXELS = 1 << 26
"""Maximum number of pixels of a picture, as a small file may claim any number. Cameras over a yard have 2 to
25 million.
"""


MIN_FOCAL_SIDES, MAX_FOCAL_SIDES = 1e-3, 1e4
"""Limits of a focal length, in sides of the picture: fields of view of 180 degrees and of 20 seconds of
arc.
"""


class Distortion(StrEnum):
    """Lens distortion models. RADTAN: k1 k2 p1 p2 [k3 [k4 k5 k6]] in OpenCV's order. EQUIDISTANT: k1..k4
    [Kannala 2006].
    """

    NONE = "none"
    RADTAN = "radial-tangential"
    EQUIDISTANT = "equidistant"


COEFFICIENT_COUNTS = {
    Distortion.NONE: (0,),
    Distortion.RADTAN: (4, 5, 8),
    Distortion.EQUIDISTANT: (4,),
}


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with focal lengths and principal point in px; (0, 0) is the centre of the first pixel.

    Raises ValueError for an invalid value (focal length not positive, wrong number of coefficients).
    """

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: Distortion = Distortion.NONE
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.coefficients)
        if not np.isfinite(numbers).all():
            raise ValueError("a camera parameter is not finite")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"the image size {self.width}x{self.height} is impossible")
        if self.width * self.height > MAX_PIXELS:
            raise ValueError(f"an image of {self.width}x{self.height} has over {MAX_PIXELS} pixels")
        if self.fx_px <= 0 or self.fy_px <= 0:
            raise ValueError(f"the focal lengths {self.fx_px}, {self.fy_px} must be positive")
        sides = (self.fx_px / self.width, self.fy_px / self.height)
        if not all(MIN_FOCAL_SIDES < ratio < MAX_FOCAL_SIDES for ratio in sides):
            raise ValueError(f"the focal lengths {self.fx_px}, {self.fy_px} px are impossible")
        if not (-self.width < self.cx_px < 2 * self.width and -self.height < self.cy_px < 2 * self.height):
            raise ValueError(f"the principal point ({self.cx_px}, {self.cy_px}) lies far outside the image")
        counts = COEFFICIENT_COUNTS[self.distortion]
        if len(self.coefficients) not in counts:
            raise ValueError(
                f"{self.distortion} takes {' or '.join(map(str, counts))} coefficients, "
                f"not {len(self.coefficients)}"
            )

    @property
    def matrix(self) -> Float64:
        """Return the intrinsic matrix K (3, 3)."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1]], np.float64)

    @property
    def is_ideal(self) -> bool:
        """Check that there is no lens distortion at all.

        An equidistant lens bends rays even where its coefficients are zero.
        """
        return self.distortion is not Distortion.EQUIDISTANT and not any(self.coefficients)

    def project(self, points: Float64) -> Float64:
        """Project points (N, 3) in the camera's frame (z > 0) to raw pixels (N, 2)."""
        pts = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 1, 3)
        if len(pts) == 0:
            return np.empty((0, 2))
        zero = np.zeros(3)
        coefficients = np.array(self.coefficients, dtype=np.float64)
        if self.distortion is Distortion.EQUIDISTANT:
            pixels, _ = cv2.fisheye.projectPoints(pts, zero, zero, self.matrix, coefficients)
        else:
            pixels, _ = cv2.projectPoints(pts, zero, zero, self.matrix, coefficients)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)

    def rays(self, pixels: Float64) -> Float64:
        """Unproject raw pixels (N, 2) to directions (N, 3) with z = 1 in the camera's frame."""
        pts = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        coefficients = np.array(self.coefficients, dtype=np.float64)
        if self.is_ideal:
            plane = (pts.reshape(-1, 2) - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px)
        elif self.distortion is Distortion.EQUIDISTANT:
            plane = cv2.fisheye.undistortPoints(pts, self.matrix, coefficients).reshape(-1, 2)
        else:
            criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-12)
            plane = cv2.undistortPointsIter(pts, self.matrix, coefficients, None, None, criteria)
            plane = plane.reshape(-1, 2)
        return np.column_stack([plane, np.ones(len(plane))])
