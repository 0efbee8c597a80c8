"""Render one bar above a floor, or the floor alone, exactly for a rectified pair.

Rays are cast at 25 points around each pixel, weighted by a Gaussian of 0.5 px (lens and pixel), so that the
images are those of continuous surfaces rather than of shifted pixels. Albedo is band-limited noise attached
to the surfaces; lamps are far away; gloss is a Blinn-Phong lobe that depends on each camera's own line of
sight and so moves between the views. The truth holds for the pixel centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, UInt8, kernel
from barsight.core.linalg.bspline import sixfold_weights
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair

FLOOR, BAR = 1, 2
_SAMPLES = 5
_SAMPLE_STEP_PX = 0.4
_LENS_SIGMA_PX = 0.5
_TABLE = 512
_OCTAVES = 6
_LAMP_HALF_WIDTH = 0.2  # radians, the extent of a field of lamps under a hall's roof


@dataclass(frozen=True, eq=False)
class Material:
    """brightness: mean albedo, in gray levels under full light. contrast: relative spread of the albedo
    per octave of detail. finest_m: size of the finest detail, m. stretch: elongation of the details along
    the bar's axis (on the floor: along x). gloss: strength of the highlight, gray levels. sharpness: its
    Blinn-Phong exponent.
    """

    brightness: float
    contrast: float
    finest_m: float
    stretch: float = 1.0
    gloss: float = 0.0
    sharpness: float = 40.0


@dataclass(frozen=True, eq=False)
class RenderedBar:
    """An infinitely long round bar. centre_m: (3,) a point of its axis in `rect0`. axis: (3,) unit vector."""

    centre_m: Float64
    axis: Float64
    radius_m: float
    surface: Material


@dataclass(frozen=True, eq=False)
class BarScene:
    """The floor is normal . X = offset_m in `rect0`, with its normal towards the camera. lamp: (3,) unit
    vector towards the lamp. ambient: share of the light that is ambient. noise: read noise (gray levels)
    and variance per gray level.
    """

    camera: RectifiedCamera
    normal: Float64
    offset_m: float
    floor: Material
    bar: RenderedBar | None
    lamp: Float64
    ambient: float = 0.5
    read_noise: float = 0.8
    shot_variance: float = 0.035


@dataclass(frozen=True, eq=False)
class Rendered:
    """truth_px: (H, W) float64 disparity of the left image. surface: (H, W) uint8, FLOOR or BAR, 0 where a
    pixel contains both. visible: (H, W) bool, True where the right image sees the point.
    """

    pair: RectifiedPair
    truth_px: Float64
    surface: UInt8
    visible: Bool


def render_pair(scene: BarScene, seed: int) -> Rendered:
    """Render both images with noise, and the truth. The same seed gives the same texture and noise."""
    rng = np.random.default_rng(seed)
    camera = scene.camera
    table = rng.standard_normal((_TABLE, _TABLE)).astype(np.float32)
    shape, looks = _shape(scene), _looks(scene)
    clean = [np.empty((camera.height, camera.width), dtype=np.float64) for _ in range(2)]
    for image, (start_m, shift_px) in zip(
        clean, ((0.0, 0.0), (camera.baseline_m, camera.doffs_px)), strict=True
    ):
        intrinsics = (camera.focal_px, camera.cx_px + shift_px, camera.cy_px)
        _expose(start_m, *intrinsics, shape, looks, table, image)
    noisy = [
        image + rng.standard_normal(image.shape) * np.sqrt(scene.read_noise**2 + scene.shot_variance * image)
        for image in clean
    ]
    left, right = (np.rint(image).clip(0, 255).astype(np.uint8) for image in noisy)
    valid = np.ones(left.shape, dtype=np.bool_)
    pair = RectifiedPair(0, left, right, valid, valid, camera)
    truth = np.empty(left.shape, dtype=np.float64)
    surface = np.empty(left.shape, dtype=np.uint8)
    visible = np.empty(left.shape, dtype=np.bool_)
    intrinsics = (camera.focal_px, camera.cx_px, camera.cy_px)
    _measure(*intrinsics, camera.baseline_m, camera.doffs_px, shape, truth, surface, visible)
    return Rendered(pair, truth, surface, visible)


def _shape(scene: BarScene) -> Float64:
    """Pack the geometry (4, 3): normal; offset, radius (0 without a bar), 0; centre; axis."""
    bar = scene.bar
    if bar is None:
        return np.array([scene.normal, [scene.offset_m, 0, 0], [0, 0, 0], [0, 1, 0]], dtype=np.float64)
    rows = [scene.normal, [scene.offset_m, bar.radius_m, 0], bar.centre_m, bar.axis]
    return np.array(rows, dtype=np.float64)


def _looks(scene: BarScene) -> Float64:
    """Pack the appearance (3, 6): a row of `Material` for floor and for bar; then lamp and ambient."""
    bar = scene.floor if scene.bar is None else scene.bar.surface
    rows = [
        [s.brightness, s.contrast, s.finest_m, s.stretch, s.gloss, s.sharpness] for s in (scene.floor, bar)
    ]
    return np.array([*rows, [*scene.lamp, scene.ambient, 0, 0]], dtype=np.float64)


@kernel()
def _hit(x: float, dx: float, dy: float, shape: Float64) -> tuple[float, int]:
    """Intersect the ray (x, 0, 0) + z (dx, dy, 1): depth z and surface of the hit, or inf and 0.

    shape: (4, 3), see `_shape`.
    """
    normal, centre, axis = shape[0], shape[2], shape[3]
    along = normal[0] * dx + normal[1] * dy + normal[2]
    depth, surface = math.inf, 0
    if along < 0:
        depth, surface = (shape[1, 0] - normal[0] * x) / along, FLOOR
    radius = shape[1, 1]
    if radius > 0:
        slide = axis[0] * dx + axis[1] * dy + axis[2]
        ox, oy, oz = x - centre[0], -centre[1], -centre[2]
        lift = axis[0] * ox + axis[1] * oy + axis[2] * oz
        ex, ey, ez = dx - slide * axis[0], dy - slide * axis[1], 1 - slide * axis[2]
        px, py, pz = ox - lift * axis[0], oy - lift * axis[1], oz - lift * axis[2]
        a = ex * ex + ey * ey + ez * ez
        b = ex * px + ey * py + ez * pz
        root = b * b - a * (px * px + py * py + pz * pz - radius * radius)
        if root > 0:
            near = (-b - math.sqrt(root)) / a
            if 0 < near < depth:
                depth, surface = near, BAR
    return depth, surface


@kernel()
def _light_left(px: float, py: float, pz: float, lamp: Float64, shape: Float64) -> float:
    """Compute the fraction of the lamp that a floor point sees past the bar: a soft-edged shadow.

    lamp: (3,) unit vector towards it. shape: (4, 3), see `_shape`.
    """
    centre, axis, radius = shape[2], shape[3], shape[1, 1]
    if radius <= 0:
        return 1.0
    ox, oy, oz = px - centre[0], py - centre[1], pz - centre[2]
    slide = axis[0] * lamp[0] + axis[1] * lamp[1] + axis[2] * lamp[2]
    lift = axis[0] * ox + axis[1] * oy + axis[2] * oz
    ex, ey, ez = lamp[0] - slide * axis[0], lamp[1] - slide * axis[1], lamp[2] - slide * axis[2]
    qx, qy, qz = ox - lift * axis[0], oy - lift * axis[1], oz - lift * axis[2]
    a = ex * ex + ey * ey + ez * ez
    b = ex * qx + ey * qy + ez * qz
    if b >= 0:
        return 1.0
    passing = math.sqrt(max(qx * qx + qy * qy + qz * qz - b * b / a, 0.0))
    penumbra = max(_LAMP_HALF_WIDTH * -b / a, 1e-6)
    return float(min(max(0.5 + 0.5 * (passing - radius) / penumbra, 0.0), 1.0))


@kernel()
def _noise(table: Float32, x: float, y: float) -> float:
    """Interpolate random numbers on a unit lattice by a cubic B-spline, low-pass at 0.5 cycles per unit.

    table: (_TABLE, _TABLE), repeated periodically.
    """
    column, row = math.floor(x), math.floor(y)
    across, down = sixfold_weights(x - column), sixfold_weights(y - row)
    total = 0.0
    for j in range(4):
        there = table[(row + j) & (_TABLE - 1)]
        line = 0.0
        for i in range(4):
            line += across[i] * there[(column + i) & (_TABLE - 1)]
        total += down[j] * line
    return total / 36


@kernel()
def _albedo(table: Float32, x: float, y: float, looks: Float64) -> float:
    """Sum octaves of detail of equal strength, each twice as coarse as the one before.

    table: (_TABLE, _TABLE). x, y: m. looks: (6,), a row of `_looks`.
    """
    size = looks[2]
    detail = 0.0
    for octave in range(_OCTAVES):
        detail += _noise(table, x / (size * looks[3]) + 97.3 * octave, y / size + 41.7 * octave)
        size *= 2
    return float(looks[0] * max(0.05, 1 + looks[1] * detail))


@kernel()
def _shade(
    x: float, dx: float, dy: float, depth: float, surface: int, shape: Float64, looks: Float64, table: Float32
) -> float:
    """Compute the gray value seen along one ray.

    The ray (x, 0, 0) + z (dx, dy, 1) hits `surface` at z = depth. shape: (4, 3), see `_shape`; looks: (3, 6),
    see `_looks`; table: (_TABLE, _TABLE).
    """
    px, py, pz = x + depth * dx, depth * dy, depth
    lamp, ambient = looks[2, :3], looks[2, 3]
    if surface == FLOOR:
        nx, ny, nz = shape[0, 0], shape[0, 1], shape[0, 2]
        # Coordinates along two directions in the floor: the camera's x and y axes, projected along z.
        albedo = _albedo(table, px - nx / nz * pz, py - ny / nz * pz, looks[0])
        gloss, sharpness = looks[0, 4], looks[0, 5]
        lit = _light_left(px, py, pz, lamp, shape)
    else:
        centre, axis, radius = shape[2], shape[3], shape[1, 1]
        ox, oy, oz = px - centre[0], py - centre[1], pz - centre[2]
        lift = axis[0] * ox + axis[1] * oy + axis[2] * oz
        nx = (ox - lift * axis[0]) / radius
        ny = (oy - lift * axis[1]) / radius
        nz = (oz - lift * axis[2]) / radius
        # The angle around the bar is measured from the side that faces the camera.
        side = -shape[0, 2] * nz - shape[0, 1] * ny - shape[0, 0] * nx
        sx = axis[1] * nz - axis[2] * ny
        sy = axis[2] * nx - axis[0] * nz
        sz = axis[0] * ny - axis[1] * nx
        turn = sx * shape[0, 0] + sy * shape[0, 1] + sz * shape[0, 2]
        albedo = _albedo(table, lift + 11.3, radius * math.atan2(turn, -side), looks[1])
        gloss, sharpness = looks[1, 4], looks[1, 5]
        lit = 1.0
    facing = max(0.0, nx * lamp[0] + ny * lamp[1] + nz * lamp[2])
    matt = albedo * (ambient + (1 - ambient) * facing * lit)
    if gloss == 0 or facing == 0:
        return float(matt)
    length = math.sqrt(dx * dx + dy * dy + 1)
    hx, hy, hz = lamp[0] - dx / length, lamp[1] - dy / length, lamp[2] - 1 / length
    half = math.sqrt(hx * hx + hy * hy + hz * hz)
    mirrored = max(0.0, (nx * hx + ny * hy + nz * hz) / half)
    return float(matt + gloss * mirrored**sharpness * lit)


@kernel(parallel=True)
def _expose(
    x: float,
    focal: float,
    cx: float,
    cy: float,
    shape: Float64,
    looks: Float64,
    table: Float32,
    image: Float64,
) -> None:
    """Expose one camera at (x, 0, 0): fills image (H, W) with gray values without noise."""
    height, width = image.shape
    reach = _SAMPLES // 2
    weights = np.empty(_SAMPLES)
    for sample in range(_SAMPLES):
        weights[sample] = math.exp(-0.5 * ((sample - reach) * _SAMPLE_STEP_PX / _LENS_SIGMA_PX) ** 2)
    weights /= weights.sum()
    for row in numba.prange(height):
        for column in range(width):
            total = 0.0
            for j in range(_SAMPLES):
                dy = (row + (j - reach) * _SAMPLE_STEP_PX - cy) / focal
                for i in range(_SAMPLES):
                    dx = (column + (i - reach) * _SAMPLE_STEP_PX - cx) / focal
                    depth, surface = _hit(x, dx, dy, shape)
                    if surface > 0:
                        gray = _shade(x, dx, dy, depth, surface, shape, looks, table)
                        total += weights[j] * weights[i] * gray
            image[row, column] = total


@kernel(parallel=True)
def _measure(
    focal: float,
    cx: float,
    cy: float,
    baseline: float,
    doffs: float,
    shape: Float64,
    truth: Float64,
    surface: UInt8,
    visible: Bool,
) -> None:
    """Compute the left image's true disparity, its surfaces, and their visibility in the right camera.

    focal, cx, cy, doffs: px; baseline: m. shape: (4, 3), see `_shape`. Fills truth (px), surface and visible,
    (H, W), see `Rendered`.
    """
    height, width = truth.shape
    reach = _SAMPLES // 2
    for row in numba.prange(height):
        for column in range(width):
            dx, dy = (column - cx) / focal, (row - cy) / focal
            depth, owner = _hit(0.0, dx, dy, shape)
            truth[row, column] = focal * baseline / depth - doffs
            pure = True
            for j in range(_SAMPLES):
                sub_y = (row + (j - reach) * _SAMPLE_STEP_PX - cy) / focal
                for i in range(_SAMPLES):
                    sub_x = (column + (i - reach) * _SAMPLE_STEP_PX - cx) / focal
                    pure &= _hit(0.0, sub_x, sub_y, shape)[1] == owner
            surface[row, column] = owner if pure else 0
            there = (dx * depth - baseline) / depth
            again, _ = _hit(baseline, there, dy, shape)
            place = focal * there + cx + doffs
            visible[row, column] = again > depth * (1 - 1e-6) and 0 <= place <= width - 1
