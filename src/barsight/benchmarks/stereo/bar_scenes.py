"""Draw the scenes of `bench subpixel` and `bench target-size`: a tilted floor, with or without a bar over it.

The camera is the crane's: 1250 px focal length, 0.5 m baseline; the paper doesn't state its own. Only a
window of the image is rendered. The right image's window is offset by a whole number of pixels (`doffs_px`),
as by a search range derived from the images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from barsight.benchmarks.stereo.bar_renderer import BarScene, Material, RenderedBar
from barsight.core.arrays import Float64
from barsight.core.records.disparity import DisparityRange
from barsight.core.records.pairs import RectifiedCamera

FOCAL_PX, BASELINE_M = 1250.0, 0.5
WIDTH_PX, HEIGHT_PX = 416, 384
BAR_DIAMETER_M = 0.09
_MARGIN_PX = 12


@dataclass(frozen=True)
class PoseSpread:
    """Half ranges of a benchmark's random poses; values are drawn uniformly from plus or minus each field."""

    roll_deg: float = 20.0
    """Angle in the image between the bar and the columns, degrees."""
    tilt_deg: float = 8.0
    """Angle of the floor's normal from the optical axis, about each image axis, degrees."""
    off_centre_px: float = 40.0
    """Offset of the bar from the window's centre, px; its fractional part is nearly uniform."""


@dataclass(frozen=True, eq=False)
class PosedScene:
    """A scene and the disparity range that covers it. range_m: depth of the bar's top near the window's
    centre, or of the floor at the centre if there is no bar, m.
    """

    scene: BarScene
    candidates: DisparityRange
    range_m: float
    roll_deg: float


def bar_over_floor(
    rng: np.random.Generator,
    range_m: float,
    gloss: float,
    raised_m: float = 0.0,
    spread: PoseSpread | None = None,
) -> PosedScene:
    """Draw a bar of 90 mm whose top is range_m deep near the window's centre, in a random pose.

    gloss: gray levels of the strongest highlight. raised_m: clearance between bar and floor, m.
    Draw a bar of 90 mm whose top is range_m deep near the window's centre; all else is random.

    gloss: gray levels of the strongest highlight. raised_m: clearance between bar and floor, m. Light and
    texture are random too.
    """
    spread = spread or PoseSpread()
    normal = _tilted(rng, spread.tilt_deg)
    roll = math.radians(rng.uniform(-spread.roll_deg, spread.roll_deg))
    radius = BAR_DIAMETER_M / 2
    middle = rng.uniform(-spread.off_centre_px, spread.off_centre_px, 2) / FOCAL_PX
    top = range_m * np.array([middle[0], middle[1], 1.0])
    centre = top - normal * radius
    # The direction in the floor that projects onto the image's columns, rotated by the roll.
    column = np.cross(normal, [math.cos(roll), math.sin(roll), 0.0])
    axis = column / np.linalg.norm(column)
    offset = float(normal @ (centre - normal * (radius + raised_m)))
    pixel_m = range_m / FOCAL_PX
    steel = Material(
        brightness=rng.uniform(45, 75),
        contrast=0.12,
        finest_m=2 * pixel_m,
        stretch=3.0,
        gloss=gloss,
        sharpness=rng.uniform(20, 60),
    )
    bar = RenderedBar(centre, axis, radius, steel)
    return _finish(rng, normal, offset, bar, range_m, math.degrees(roll))


def tilted_floor(rng: np.random.Generator, range_m: float, tilt_deg: float) -> PosedScene:
    """Draw the floor alone, its normal tilted by tilt_deg in a random direction."""
    turn = rng.uniform(0, 2 * math.pi)
    lean = math.tan(math.radians(tilt_deg))
    normal = np.array([lean * math.cos(turn), lean * math.sin(turn), -1.0])
    normal /= np.linalg.norm(normal)
    return _finish(rng, normal, float(normal[2] * range_m), None, range_m, 0.0)


def _tilted(rng: np.random.Generator, tilt_deg: float) -> Float64:
    lean = np.tan(np.radians(rng.uniform(-tilt_deg, tilt_deg, 2)))
    normal = np.array([lean[0], lean[1], -1.0])
    unit: Float64 = normal / np.linalg.norm(normal)
    return unit


def _finish(
    rng: np.random.Generator,
    normal: Float64,
    offset: float,
    bar: RenderedBar | None,
    range_m: float,
    roll_deg: float,
) -> PosedScene:
    """Add light, floor, window and disparity range to the geometry."""
    camera, candidates = _window(normal, offset, range_m)
    side = rng.uniform(0, 2 * math.pi)
    height = math.radians(rng.uniform(35, 75))
    lamp = np.array([math.cos(side) * math.cos(height), math.sin(side) * math.cos(height), -math.sin(height)])
    floor = Material(rng.uniform(100, 140), 0.09, 2 * range_m / FOCAL_PX)
    ambient = float(rng.uniform(0.5, 0.8))
    scene = BarScene(camera, normal, offset, floor, bar, lamp, ambient)
    return PosedScene(scene, candidates, range_m, roll_deg)


def _window(normal: Float64, offset: float, range_m: float) -> tuple[RectifiedCamera, DisparityRange]:
    """Build the window's camera, with the smallest disparity a margin above zero, and its disparity range.

    The floor's disparity is f b (normal . ray) / offset; the bar's top is the nearest point of the scene.
    """
    cx, cy = (WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2
    corners = [
        FOCAL_PX * BASELINE_M * float(normal @ np.array([x / FOCAL_PX, y / FOCAL_PX, 1.0])) / offset
        for x in (-cx, cx)
        for y in (-cy, cy)
    ]
    lowest = math.floor(min(corners)) - _MARGIN_PX
    # The nearest point of a tilted bar or floor in the window is nearer than the point at its centre.
    floor_middle = FOCAL_PX * BASELINE_M * float(normal[2]) / offset
    rise = FOCAL_PX * BASELINE_M / range_m - floor_middle
    highest = math.ceil(max(corners) + max(rise, 0.0) * max(corners) / floor_middle) + _MARGIN_PX
    count = -(-(highest - lowest) // 16) * 16
    camera = RectifiedCamera(FOCAL_PX, cx, cy, BASELINE_M, float(lowest), WIDTH_PX, HEIGHT_PX)
    return camera, DisparityRange(0, count)
