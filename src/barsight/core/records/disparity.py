"""Define the records of a pair's disparity and of the points that it gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float32, UInt8, expect_shape


@dataclass(frozen=True)
class DisparityRange:
    """Candidates lowest_px <= d < highest_px, whole pixels."""

    lowest_px: int
    highest_px: int

    def __post_init__(self) -> None:
        if self.highest_px <= self.lowest_px:
            raise ValueError(f"the disparity range {self.lowest_px}:{self.highest_px} is empty")

    @property
    def count(self) -> int:
        """Return the number of whole candidates."""
        return self.highest_px - self.lowest_px

    def fits(self, width: int) -> bool:
        """Check that pictures of this width (px) can have such disparities, and as many."""
        return self.lowest_px < width and self.highest_px > -width and self.count <= width


@dataclass(frozen=True, eq=False)
class Disparity:
    """disparity_px, sigma_px (one standard deviation): (H, W) float32, NaN where there is no match.

    bias_sigma_px: the part of sigma_px that other views of the same surface repeat, such as pixel locking.
    """

    disparity_px: Float32
    sigma_px: Float32
    bias_sigma_px: float = 0.0

    def __post_init__(self) -> None:
        expect_shape("disparity_px", self.disparity_px, (None, None))
        expect_shape("sigma_px", self.sigma_px, self.disparity_px.shape)

    @property
    def coverage(self) -> float:
        """Return the fraction of pixels that have a disparity."""
        return float(np.isfinite(self.disparity_px).mean()) if self.disparity_px.size else 0.0


@dataclass(frozen=True, eq=False)
class StereoPoints:
    """The points of one view, in `rect0`.

    xyz_m: (N, 3) float32. range_sigma_m: (N,) float32, noise along the viewing ray (averages out over views).
    shared_sigma_m: (N,) float32, the part that is the same in every view (calibration, the method's bias).
    intensity: (N,) uint8.
    """

    stamp_ns: int
    xyz_m: Float32
    range_sigma_m: Float32
    shared_sigma_m: Float32
    intensity: UInt8
