"""Align two views directly: find the motion that makes the points of one look as they do in the other.

Gauss-Newton on the gray values of shrunk pictures [DVO: Kerl 2013], with gain and offset as two more
unknowns and the guess as a prior: r = I_now(w(p)) - a I_before(p) - c. Encoders know the travel to
millimetres, but not the rig's swing; a swing of 0.15 degrees moves the picture by 2 or 3 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float32, Float64, UInt8, kernel
from barsight.core.errors import Failed
from barsight.core.linalg.robust import mad_sigma
from barsight.core.pose import Pose
from barsight.core.records.disparity import Disparity
from barsight.core.records.pairs import RectifiedCamera

_SHRINKS = (16, 8, 4)
"""Factors by which the pictures are shrunk, coarse to fine: the coarsest ones see past the next bar."""
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
"""Residual, in sigma, from which Tukey's biweight is zero: highlights move with the view."""


@dataclass(frozen=True, eq=False)
class _Places:
    """Points of the earlier view. rays: (N, 3), in px of the shrunk picture; q: (N,) px / m, disparity and
    doffs over the baseline; gray: (N,).
    """

    rays: Float64
    q: Float64
    gray: Float64


def align_views(
    before: UInt8, disparity: Disparity, now: UInt8, camera: RectifiedCamera, guess: Pose
) -> Pose | Failed:
    """Estimate the motion now_from_before of the rectified left camera, starting from a guess.

    before, now: (H, W) pictures; disparity: of the earlier one. The guess may be off by a degree and some cm.
    Failed `not-alike` where too few points are seen by both or their gray values differ too much.
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
            seen = _compared(places, image, motion, tone, principal)
            if len(seen.gray) < max(_MIN_INSIDE_RATIO * len(places.gray), _MIN_POINTS):
                return Failed("not-alike", "the views have too little in common")
            step = _solve(seen.residual, seen.rows, guess, motion)
            rotation = Rotation.from_rotvec(step[:3]).as_matrix()
            motion = Pose(
                motion.target, motion.source, rotation @ motion.rotation,
                rotation @ motion.translation + step[3:6],
            )  # fmt: skip
            tone = tone + step[6:]
            if np.abs(step[:3]).max() < _CLOSE_RAD and np.abs(step[3:6]).max() < _CLOSE_M:
                break
    explained = mad_sigma(tone[0] * seen.gray)
    alike = 1 - (mad_sigma(seen.residual) / max(explained, 1e-6)) ** 2
    if alike < _MIN_CORRELATION**2:
        return Failed("not-alike", f"the views don't look alike, correlation {max(alike, 0) ** 0.5:.2f}")
    return motion


def _principal(camera: RectifiedCamera, shrink: int) -> Float64:
    """Return the principal point of the shrunk picture, each of whose pixels covers shrink x shrink."""
    return (np.array([camera.cx_px, camera.cy_px]) - (shrink - 1) / 2) / shrink


def _shrink(image: UInt8 | Float32, shrink: int) -> Float32:
    """Average blocks of pixels."""
    size = image.shape[1] // shrink, image.shape[0] // shrink
    whole = image[: size[1] * shrink, : size[0] * shrink].astype(np.float32)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA))


def _smooth(image: Float32) -> Float32:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0))


def _places(small: Float32, disparity: Disparity, camera: RectifiedCamera, shrink: int) -> _Places:
    """Choose points with a disparity known to 0.3 px, on a grid in the shrunk picture of at least 16 px."""
    every = max(_EVERY_PX // shrink, 1)
    rows, columns = (np.arange(1, count - 1, every) for count in small.shape)
    v, u = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
    middle = shrink * v + shrink // 2, shrink * u + shrink // 2
    known = disparity.sigma_px[middle] <= _MAX_SIGMA_PX
    u, v, q = u[known], v[known], disparity.disparity_px[middle][known] + camera.doffs_px
    principal, focal = _principal(camera, shrink), np.full(len(u), camera.focal_px / shrink)
    rays = np.column_stack([u - principal[0], v - principal[1], focal]).astype(np.float64)
    # X' = R ray + t q / b: the ray is in shrunk pixels, so the depth's scale is too.
    return _Places(rays, q.astype(np.float64) / (shrink * camera.baseline_m), small[v, u].astype(np.float64))


@dataclass(frozen=True, eq=False)
class _Compared:
    """Points that the later view contains. residual: (N,); rows: (N, 8), its derivatives by a turn, a shift,
    gain and offset; gray: (N,), of the earlier view.
    """

    residual: Float64
    rows: Float64
    gray: Float64


def _compared(places: _Places, image: Float32, motion: Pose, tone: Float64, principal: Float64) -> _Compared:
    """Compare the points that lie in the later picture with it."""
    count = len(places.q)
    found = np.empty(count), np.empty((count, 8)), np.empty(count)
    seen = _compare(
        (places.rays, places.q, places.gray), image, (motion.rotation, motion.translation), tone, principal,
        *found,
    )  # fmt: skip
    return _Compared(*(values[:seen] for values in found))


@kernel()
def _compare(
    places: tuple[Float64, Float64, Float64], image: Float32, motion: tuple[Float64, Float64], tone: Float64,
    principal: Float64, residual: Float64, rows: Float64, grays: Float64,
) -> int:  # fmt: skip
    """Compute the residuals of the points that lie in the picture and their derivatives; return their number.

    Scaled by q / b a point moves to X = R ray + t q / b; a turn w and a shift s after that move it by
    w x X + s q / b. Gray values and gradients are interpolated bilinearly.

    places: rays (N, 3), q (N,), gray (N,). motion: rotation (3, 3), translation (3,). principal: (2,) px.
    Fills the first elements of residual (N,), rows (N, 8) and grays (N,).
    """
    (rays, q, gray), (r, t) = places, motion
    height, width = image.shape
    n = 0
    for i in range(len(q)):
        a, b, focal = rays[i, 0], rays[i, 1], rays[i, 2]
        x = r[0, 0] * a + r[0, 1] * b + r[0, 2] * focal + q[i] * t[0]
        y = r[1, 0] * a + r[1, 1] * b + r[1, 2] * focal + q[i] * t[1]
        z = r[2, 0] * a + r[2, 1] * b + r[2, 2] * focal + q[i] * t[2]
        u, v = focal * x / z + principal[0], focal * y / z + principal[1]
        if not (z > 0 and 1 <= u < width - 2 and 1 <= v < height - 2):
            continue
        column, row = np.uint64(u), np.uint64(v)
        right, below = u - np.float64(column), v - np.float64(row)
        beside, under = column + np.uint64(1), row + np.uint64(1)
        one, two = np.float64(image[row, column]), np.float64(image[row, beside])
        three, four = np.float64(image[under, column]), np.float64(image[under, beside])
        upper, lower = one + right * (two - one), three + right * (four - three)
        over = focal / z
        along = ((two - one) * (1 - below) + (four - three) * below) * over
        down = (lower - upper) * over
        toward = -(along * x + down * y) / z
        residual[n] = upper + below * (lower - upper) - tone[0] * gray[i] - tone[1]
        rows[n, 0] = y * toward - z * down
        rows[n, 1] = z * along - x * toward
        rows[n, 2] = x * down - y * along
        rows[n, 3], rows[n, 4], rows[n, 5] = q[i] * along, q[i] * down, q[i] * toward
        rows[n, 6], rows[n, 7] = -gray[i], -1.0
        grays[n] = gray[i]
        n += 1
    return n


def _solve(residual: Float64, rows: Float64, guess: Pose, motion: Pose) -> Float64:
    """Solve one step (8,) with Tukey's weights and the guess as prior of turn and shift."""
    sigma = max(mad_sigma(residual), 0.5)
    normal, pull = np.zeros((8, 8)), np.zeros(8)
    _add_equations(residual, rows, _OUTLIER_SIGMAS * sigma, normal, pull)
    off = (motion @ guess.inverse()).rotation
    turn = Rotation.from_matrix(off).as_rotvec()
    prior = np.array([_PRIOR_RAD**-2] * 3 + [_PRIOR_M**-2] * 3 + [1e-6] * 2)
    so_far = np.concatenate([turn, motion.translation - guess.translation, [0.0, 0.0]])
    step: Float64 = -np.linalg.solve(normal / sigma**2 + np.diag(prior), pull / sigma**2 + prior * so_far)
    return step


@kernel()
def _add_equations(residual: Float64, rows: Float64, end: float, normal: Float64, pull: Float64) -> None:
    """Add up the normal equations of residuals (N,) and rows (N, 8), weighted by Tukey's biweight with its
    zero at `end`.

    Fills normal (8, 8) and pull (8,), which must be zeros.
    """
    for i in range(len(residual)):
        off = residual[i] / end
        rest = 1 - off * off
        if rest <= 0:
            continue
        weight = rest * rest
        for j in range(8):
            heavy = weight * rows[i, j]
            pull[j] += heavy * residual[i]
            for k in range(j + 1):
                normal[j, k] += heavy * rows[i, k]
    for j in range(8):
        for k in range(j):
            normal[k, j] = normal[j, k]
