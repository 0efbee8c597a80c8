"""Plan a rig for a yard: lens, baseline, exposure, rate and data from range, width and required accuracy."""

from __future__ import annotations

import math
from dataclasses import dataclass

from barsight.core.errors import ConfigError, MeasurementError
from barsight.core.settings.values import expect

DISPARITY_SIGMA_PX = 0.1
"""Robust sigma in pixels of a match on rendered yards
(benchmarks/results/2026-11-23-live-faults-and-plan.md).
"""
LENSES_MM = (3.5, 4.0, 5.0, 6.0, 8.0, 12.0, 16.0, 25.0, 35.0)
"""Focal lengths in millimetres of common C-mount lenses."""
STOPS = (1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0)
LANE_OVERLAP_RATIO = 0.1
"""Overlap of neighbouring passes, as a share of a lane."""
MIN_BAR_PX = 10.0
"""Minimum width of a bar on the floor in pixels: thinner bars are measured less accurately
(docs/explanation/stereo.md).
"""
MAX_DISPARITY_RATIO = 1 / 3
"""Largest disparity at the highest pile, as a share of a row; only one camera sees the pixels beyond it."""
MAX_BLUR_PX = 0.5
TURN_RADPS = 0.01
"""Turn rate of a swaying crane in rad/s."""
MIN_VIEWS, MIN_RATE_HZ = 8, 5.0
"""Minimum number of frames that see each place, and minimum rate (Hz) for tracking the crane."""
KEYFRAME_WAY_M, KEPT_BYTES_PER_PIXEL = 0.1, 16
"""Keyframe distance (m) of a live run, and bytes per pixel of a pair kept until it is measured."""
MAX_PASSES = 12
LINK_RATIO = 1.1
"""Data rate with packet headers, relative to that of the pixels alone."""


@dataclass(frozen=True)
class CatalogueCamera:
    """Camera class by its sensor: size, pixel pitch in micrometres, largest picture rate on 1 Gbit/s."""

    width_px: int
    height_px: int
    pixel_um: float
    max_rate_hz: float


CAMERAS = {
    "1.3MP": CatalogueCamera(1280, 1024, 4.8, 80.0),
    "1.6MP": CatalogueCamera(1440, 1080, 3.45, 70.0),
    "5MP": CatalogueCamera(2448, 2048, 3.45, 22.0),
    "12MP": CatalogueCamera(4096, 3000, 3.45, 9.0),
}


@dataclass(frozen=True)
class Wish:
    """Requirements of a yard. range_m: from the cameras to the floor. width_m: of the yard, along the bars.

    stack_m: height of the highest pile. bar_m: diameter of the thinnest bar. sigma_m: of a depth on the floor
    from one match. speed_mps: of the crane.
    """

    range_m: float
    width_m: float
    stack_m: float = 2.0
    bar_m: float = 0.09
    sigma_m: float = 0.01
    speed_mps: float = 0.5

    def __post_init__(self) -> None:
        for flag, value, low, high in (
            ("range", self.range_m, 0.5, 60), ("width", self.width_m, 0.5, 200),
            ("stack", self.stack_m, 0, 50), ("bar-diameter", self.bar_m, 0.005, 2),
            ("sigma", self.sigma_m, 1e-4, 1), ("speed", self.speed_mps, 0.01, 5),
        ):  # fmt: skip
            unit = "m/s" if flag == "speed" else "m"
            expect(low <= value <= high, f"--{flag} must lie in {low:g}...{high:g} {unit}, not {value:g}")
        if self.stack_m > 0.8 * self.range_m:
            raise ConfigError(
                f"--stack {self.stack_m:g} m is more than four fifths of --range {self.range_m:g} m: mount "
                "the cameras higher"
            )

    @property
    def near_m(self) -> float:
        """Return the range to the top of the highest pile."""
        return self.range_m - self.stack_m


@dataclass(frozen=True)
class RigPlan:
    """A rig that meets the requirements. focal_px, focal_mm: of the lens.

    baseline_m: along the travel, across the bars. passes: number of lanes that cover the width.
    exposure_us: longest exposure. f_number: smallest f-number. rate_hz: picture rate.
    """

    wish: Wish
    camera: CatalogueCamera
    focal_mm: float
    passes: int
    baseline_m: float
    exposure_us: float
    f_number: float
    rate_hz: float

    @property
    def focal_px(self) -> float:
        """Return the focal length in pixels: f / pixel."""
        return 1e3 * self.focal_mm / self.camera.pixel_um

    @property
    def common_m(self) -> float:
        """Return the common field of view along the travel at the highest pile: W z / f - B."""
        return self.camera.width_px * self.wish.near_m / self.focal_px - self.baseline_m

    @property
    def lane_m(self) -> float:
        """Return the field of view along the bars at the highest pile: H z / f."""
        return self.camera.height_px * self.wish.near_m / self.focal_px

    @property
    def data_mbps(self) -> float:
        """Return the data rate of both cameras, Mbit/s: 2 W H rate 8 bits, plus headers."""
        return LINK_RATIO * 2 * self.camera.width_px * self.camera.height_px * self.rate_hz * 8e-6

    def figures(self) -> tuple[tuple[str, str, str], ...]:
        """List the calculated figures: name, value, formula."""
        wish, f, near = self.wish, self.focal_px, self.wish.near_m
        far_mm, near_mm = (1e3 * depth_sigma_m(z, f, self.baseline_m) for z in (wish.range_m, near))
        max_px, min_px = (f * self.baseline_m / z for z in (near, wish.range_m))
        overlap = 100 * (1 - wish.speed_mps / self.rate_hz / self.common_m)
        blur = f"{MAX_BLUR_PX:g} px / (f (v / z + {TURN_RADPS:g} rad/s))"
        floor = f"Z / f; at most bar / {MIN_BAR_PX:g}"
        match = f"Z^2 sigma_d / (f B), sigma_d = {DISPARITY_SIGMA_PX:g} px"
        return (
            ("focal length", f"{self.focal_mm:g} mm, {f:.0f} px", "f = H z / lane, z to the highest pile"),
            ("pixel on the floor", f"{1e3 * wish.range_m / f:.1f} mm", floor),
            (
                "lanes",
                f"{self.passes}, {self.lane_m:.1f} m each",
                f"H z / f; neighbours share {100 * LANE_OVERLAP_RATIO:.0f} %",
            ),
            ("baseline", f"{self.baseline_m:.2f} m", "B = Z^2 sigma_d / (f sigma_Z)"),
            ("disparities", f"{min_px:.0f} to {max_px:.0f} px", "f B / Z"),
            ("sigma of a depth", f"{far_mm:.1f} mm on the floor, {near_mm:.1f} mm on top", match),
            ("exposure", f"{self.exposure_us:.0f} us at most", blur),
            ("aperture", f"f/{self.f_number:g} or more", "f^2 (Z - z) / (2 Z z pixel); sharp from z to Z"),
            ("rate", f"{self.rate_hz:g} Hz", f"{MIN_VIEWS} v / common view; at least {MIN_RATE_HZ:g} Hz"),
            ("overlap", f"{overlap:.0f} %", "1 - v / (rate (W z / f - B))"),
            ("data", f"{self.data_mbps:.0f} Mbit/s", f"{LINK_RATIO:g} x 2 W H rate x 8 bits"),
            ("disk", f"{self.disk_gib():.1f} GiB per 35 m", "W H 16 bytes every 0.1 m, until measured"),
        )

    def disk_gib(self) -> float:
        """Compute the disk space in GiB that 35 m of travel need until they are measured."""
        kept = self.camera.width_px * self.camera.height_px * KEPT_BYTES_PER_PIXEL
        return 35 / KEYFRAME_WAY_M * kept / 2**30

    def parts(self) -> tuple[tuple[str, str], ...]:
        """List the parts: item and requirement."""
        camera, links = self.camera, 1 if self.data_mbps < 900 else 2
        size = f"{camera.width_px}x{camera.height_px}, {camera.pixel_um:g} um, mono, global shutter"
        return (
            (
                "2 cameras",
                f"{size}, GigE Vision, {self.rate_hz:g} Hz by a hardware trigger, a block number that counts "
                "exposures",
            ),
            (
                "2 lenses",
                f"{self.focal_mm:g} mm, C mount, focus and iris locked by screws, f/{self.f_number:g}",
            ),
            (
                "beam",
                f"one stiff piece of metal, {self.baseline_m:.2f} m between the lenses, along the travel",
            ),
            (
                "light",
                f"floodlights: gray levels around 120 at {self.exposure_us:.0f} us and f/{self.f_number:g}",
            ),
            ("trigger", "one signal to both cameras"),
            ("IMU", "200 Hz or more, on the beam; noise and mounting calibrated"),
            ("encoders", "bridge, trolley and hoist, 20 Hz or more, each reading with its time"),
            ("network", f"{links} x 1 Gbit/s for the cameras alone, jumbo frames (MTU 9000)"),
            ("computer", f"x86, 4 cores, 8 GiB, SSD with {2 * self.disk_gib():.0f} GiB free, Linux"),
        )


def depth_sigma_m(range_m: float, focal_px: float, baseline_m: float) -> float:
    """Compute the sigma of a depth from one match, m: Z^2 sigma_d / (f B)."""
    return range_m**2 * DISPARITY_SIGMA_PX / (focal_px * baseline_m)


def plan_rig(wish: Wish, camera: CatalogueCamera) -> RigPlan:
    """Choose the fewest lanes, and the longest lens for them, that resolve the thinnest bar.

    Raises MeasurementError if no lens or baseline does, with what would help.
    """
    for passes in range(1, MAX_PASSES + 1):
        lane_m = wish.width_m / passes * (1 + LANE_OVERLAP_RATIO * (passes > 1))
        max_px = camera.height_px * wish.near_m / lane_m
        fitting = [mm for mm in LENSES_MM if 1e3 * mm / camera.pixel_um <= max_px]
        if fitting and wish.range_m * MIN_BAR_PX <= 1e3 * fitting[-1] / camera.pixel_um * wish.bar_m:
            return _with_baseline(wish, camera, fitting[-1], passes)
    raise MeasurementError(
        f"no lens shows bars of {1e3 * wish.bar_m:.0f} mm with {MIN_BAR_PX:g} pixels from {wish.range_m:g} m "
        f"in {MAX_PASSES} lanes; take a camera with more pixels or mount it lower"
    )


def _with_baseline(wish: Wish, camera: CatalogueCamera, focal_mm: float, passes: int) -> RigPlan:
    """Choose baseline, exposure, aperture and rate for a lens."""
    f, near = 1e3 * focal_mm / camera.pixel_um, wish.near_m
    baseline_m = math.ceil(20 * depth_sigma_m(wish.range_m, f, 1.0) / wish.sigma_m - 1e-9) / 20
    max_m = MAX_DISPARITY_RATIO * camera.width_px * near / f
    if baseline_m > max_m:
        raise MeasurementError(
            f"a sigma of {1e3 * wish.sigma_m:g} mm needs a baseline of {baseline_m:.2f} m, the common view "
            f"allows {max_m:.2f} m; allow {1e3 * depth_sigma_m(wish.range_m, f, max_m):.1f} mm, take a "
            "camera with more pixels or mount it lower"
        )
    exposure_us = 1e6 * MAX_BLUR_PX / (f * (wish.speed_mps / near + TURN_RADPS))
    needed = (focal_mm * 1e-3) ** 2 * wish.stack_m / (2 * wish.range_m * near * camera.pixel_um * 1e-6)
    f_number = next((stop for stop in STOPS if stop >= needed), None)
    if f_number is None:
        raise MeasurementError(
            f"{focal_mm:g} mm needs f/{needed:.0f} to be sharp from {near:g} to {wish.range_m:g} m, lenses "
            f"close to f/{STOPS[-1]:g}; hang it higher, lower the piles or take a camera of larger pixels"
        )
    common_m = camera.width_px * near / f - baseline_m
    rate_hz = math.ceil(max(MIN_VIEWS * wish.speed_mps / common_m, MIN_RATE_HZ))
    if rate_hz > camera.max_rate_hz:
        raise MeasurementError(
            f"at {wish.speed_mps:g} m/s {rate_hz} pictures a second are needed, the camera gives "
            f"{camera.max_rate_hz:g}; take a faster one, or drive slower"
        )
    return RigPlan(wish, camera, focal_mm, passes, baseline_m, exposure_us, f_number, rate_hz)
