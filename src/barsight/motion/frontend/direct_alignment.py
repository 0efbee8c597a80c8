"""Align two views directly: the motion that makes the places of one look as they do in the other.

Gauss-Newton on the gray values of shrunk pictures [DVO: Kerl 2013], with gain and offset as two more
unknowns and the guess as a prior: r = I_now(w(p)) - a I_before(p) - c. Encoders know the way to millimetres,
not how the rig swings; a swing of 0.15 degrees is 2 or 3 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float32, Float64, UInt8
from barsight.core.errors import Failed
from barsight.core.linalg.robust import mad_sigma
from barsight.core.pose import Pose
from barsight.core.types import Disparity, RectifiedCamera

_SHRINKS = (16, 8, 4)
"""Sizes that the pictures are shrunk to, one after the other: the first ones see past the next bar."""
_MAX_SIGMA_PX = 0.3
_MIN_SHRUNK_PX = 24
_EVERY_PX = 16
_MIN_POINTS = 200
_MIN_INSIDE_RATIO = 0.3
_MIN_CORRELATION = 0.8
_STEPS = 5
_CLOSE_RAD, _CLOSE_M = 1e-5, 1e-4
_PRIOR_RAD, _PRIOR_M = 2e-2, 3e-2
_OUTLIER_SIGMAS = 4.0
"""Tukey's biweight ends here: highlights move with the view."""


@dataclass(frozen=True, eq=False)
class _Places:
    """Places of the view before. rays: (N, 3), in px of the shrunk picture; q: (N,) px / m, disparity and
    doffs over the baseline; gray: (N,).
    """

    rays: Float64
    q: Float64
    gray: Float64


def align_views(
    before: UInt8, disparity: Disparity, now: UInt8, camera: RectifiedCamera, guess: Pose
) -> Pose | Failed:
    """Estimate the motion now_from_before of the rectified left camera, from its guess on.

    before, now: (H, W) pictures; disparity: of the one before. The guess may be off by a degree and some cm.
    Failed `not-alike` where too few places are seen by both or their gray values differ too much.
    """
    motion, tone = guess, np.array([1.0, 0.0])
    quarters = _shrink(before, _SHRINKS[-1]), _shrink(now, _SHRINKS[-1])
    for shrink in _SHRINKS:
        if min(now.shape) < shrink * _MIN_SHRUNK_PX and shrink > _SHRINKS[-1]:
            continue
        old, image = (_smooth(_shrink(quarter, shrink // _SHRINKS[-1])) for quarter in quarters)
        places = _places(old, disparity, camera, shrink)
        principal = _principal(camera, shrink)
        for _ in range(_STEPS):
            residual, rows = _residuals(places, image, motion, tone, principal)
            seen = np.isfinite(residual)
            if seen.sum() < max(_MIN_INSIDE_RATIO * len(residual), _MIN_POINTS):
                return Failed("not-alike", "the views have too little in common")
            step = _solve(residual[seen], rows[seen], guess, motion)
            turned = Rotation.from_rotvec(step[:3]).as_matrix()
            motion = Pose(
                motion.target, motion.source, turned @ motion.rotation,
                turned @ motion.translation + step[3:6],
            )  # fmt: skip
            tone = tone + step[6:]
            if np.abs(step[:3]).max() < _CLOSE_RAD and np.abs(step[3:6]).max() < _CLOSE_M:
                break
    explained = mad_sigma(tone[0] * places.gray[seen])
    alike = 1 - (mad_sigma(residual[seen]) / max(explained, 1e-6)) ** 2
    if alike < _MIN_CORRELATION**2:
        return Failed("not-alike", f"the views don't look alike, correlation {max(alike, 0) ** 0.5:.2f}")
    return motion


def _principal(camera: RectifiedCamera, shrink: int) -> Float64:
    """Return the principal point of the shrunk picture, each of whose pixels stands for shrink x shrink."""
    return (np.array([camera.cx_px, camera.cy_px]) - (shrink - 1) / 2) / shrink


def _shrink(image: UInt8 | Float32, shrink: int) -> Float32:
    """Average blocks of pixels."""
    size = image.shape[1] // shrink, image.shape[0] // shrink
    whole = image[: size[1] * shrink, : size[0] * shrink].astype(np.float32)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA))


def _smooth(image: Float32) -> Float32:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0))


def _places(small: Float32, disparity: Disparity, camera: RectifiedCamera, shrink: int) -> _Places:
    """Choose places on a grid of at least 16 px, in the shrunk picture, of a disparity known to 0.3 px."""
    every = max(_EVERY_PX // shrink, 1)
    rows, columns = (np.arange(1, count - 1, every) for count in small.shape)
    v, u = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
    middle = shrink * v + shrink // 2, shrink * u + shrink // 2
    known = disparity.sigma_px[middle] <= _MAX_SIGMA_PX
    u, v, q = u[known], v[known], disparity.disparity_px[middle][known] + camera.doffs_px
    principal, focal = _principal(camera, shrink), np.full(len(u), camera.focal_px / shrink)
    rays = np.column_stack([u - principal[0], v - principal[1], focal]).astype(np.float64)
    # X' = R ray + t q / b: the ray is shrunk, so is the depth's scale.
    return _Places(rays, q.astype(np.float64) / (shrink * camera.baseline_m), small[v, u].astype(np.float64))


def _residuals(
    places: _Places, image: Float32, motion: Pose, tone: Float64, principal: Float64
) -> tuple[Float64, Float64]:
    """Compute residuals (N,) and their derivatives (N, 8) by a turn, a shift, gain and offset; NaN outside.

    Scaled by q / b a place moves to X = R ray + t q / b; a turn w and a shift s after that move it by
    w x X + s q / b.
    """
    focal = places.rays[0, 2]
    moved = places.rays @ motion.rotation.T + places.q[:, None] * motion.translation
    x, y, z = moved.T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = focal * x / z + principal[0], focal * y / z + principal[1]
    height, width = image.shape
    inside = (z > 0) & (u >= 1) & (v >= 1) & (u < width - 2) & (v < height - 2)
    u, v = np.where(inside, u, 1.0), np.where(inside, v, 1.0)
    gray, along, down = _read(image, u, v)
    over = focal / np.where(inside, z, 1.0)
    toward = -(along * x + down * y) * over / np.where(inside, z, 1.0)
    slope = np.column_stack([along * over, down * over, toward])
    rows = np.column_stack(
        [np.cross(moved, slope), places.q[:, None] * slope, -places.gray, -np.ones(len(gray))]
    )
    residual = np.where(inside, gray - tone[0] * places.gray - tone[1], np.nan)
    return residual, rows


def _read(image: Float32, u: Float64, v: Float64) -> tuple[Float64, Float64, Float64]:
    """Read gray values (N,) and slopes along both axes between pixels, bilinearly."""
    column, row = u.astype(np.int64), v.astype(np.int64)
    right, below = u - column, v - row
    one, two = image[row, column].astype(np.float64), image[row, column + 1]
    three, four = image[row + 1, column], image[row + 1, column + 1]
    upper, lower = one + right * (two - one), three + right * (four - three)
    along = (two - one) * (1 - below) + (four - three) * below
    return upper + below * (lower - upper), along, lower - upper


def _solve(residual: Float64, rows: Float64, guess: Pose, motion: Pose) -> Float64:
    """Solve one step (8,) by Tukey's weights, with the guess as prior of turn and shift."""
    sigma = max(mad_sigma(residual), 0.5)
    rest = 1 - (residual / (_OUTLIER_SIGMAS * sigma)) ** 2
    weight = np.square(np.maximum(rest, 0)) / sigma**2
    off = (motion @ guess.inverse()).rotation
    turned = Rotation.from_matrix(off).as_rotvec()
    prior = np.array([_PRIOR_RAD**-2] * 3 + [_PRIOR_M**-2] * 3 + [1e-6] * 2)
    so_far = np.concatenate([turned, motion.translation - guess.translation, [0.0, 0.0]])
    normal = rows.T @ (weight[:, None] * rows) + np.diag(prior)
    step: Float64 = -np.linalg.solve(normal, rows.T @ (weight * residual) + prior * so_far)
    return step
