"""Predict a pair's disparity from that of the previous pair and the motion between them.

A pixel with disparity d sees the point q = d + doffs at depth f b / q. In homogeneous coordinates scaled by q
/ b the motion is X' = R (u - cx, v - cy, f) + t q / b, which gives the pixel there and its q' = f q / X'_z
without a division by the depth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float32, kernel
from barsight.core.parallel import parallel_bands
from barsight.core.pose import Pose
from barsight.core.records.disparity import Disparity
from barsight.core.records.pairs import RectifiedCamera

_MAX_SIGMA_PX = 0.5
_SAME_SURFACE_PX = np.float32(1.0)
_MAX_OFF_PX = np.float32(1.5)
_BAND_ROWS = 64
_NAN = np.float32(np.nan)


class _Transfer(NamedTuple):
    """The motion of pixels between two views: rotation (3, 3), translation over the baseline (3,), focal
    length, principal point and doffs in px.
    """

    rotation: Float32
    shift: Float32
    focal: np.float32
    cx: np.float32
    cy: np.float32
    doffs: np.float32


def predict_disparity(before: Disparity, camera: RectifiedCamera, now_from_before: Pose) -> Float32:
    """Predict the disparity (H, W) of the current left picture, NaN where nothing is known.

    Each certain point of the previous view is moved to the nearest pixel of the current view; the point
    nearest to the camera wins. Each pixel then looks up where it was before and takes the disparity from
    there, interpolated where the surrounding pixels are one surface (1 px).
    """
    known = np.where(before.sigma_px <= _MAX_SIGMA_PX, before.disparity_px, _NAN).astype(np.float32)
    there, back = _transfer(camera, now_from_before), _transfer(camera, now_from_before.inverse())
    first = np.full(known.shape, _NAN, dtype=np.float32)
    _splat(known, there, first)
    first = _without_gaps(first)
    predicted = np.empty_like(first)

    def work(start: int, end: int) -> None:
        _look_up(known, first, there, back, predicted, start, end)

    parallel_bands(work, len(known), _BAND_ROWS)
    return predicted


def _transfer(camera: RectifiedCamera, motion: Pose) -> _Transfer:
    single = np.float32
    return _Transfer(
        np.ascontiguousarray(motion.rotation, dtype=single),
        (motion.translation / camera.baseline_m).astype(single),
        single(camera.focal_px), single(camera.cx_px), single(camera.cy_px), single(camera.doffs_px),
    )  # fmt: skip


@kernel()
def _move_row(known: Float32, v: int, motion: _Transfer, moved: Float32) -> None:
    """Transform row v of a view, with disparities known (W,) px, to the other view.

    Fills moved (3, W): column, row and q = disparity + doffs there, px; NaN where unknown, q 0 behind the
    camera.
    """
    r, s, focal, zero = motion.rotation, motion.shift, motion.focal, np.float32(0)
    along, down, near = moved[0], moved[1], moved[2]
    y = np.float32(v) - motion.cy
    r00, r10, r20 = r[0, 0], r[1, 0], r[2, 0]
    s0, s1, s2 = s[0], s[1], s[2]
    x0, y0, z0 = (
        r[0, 1] * y + r[0, 2] * focal, r[1, 1] * y + r[1, 2] * focal, r[2, 1] * y + r[2, 2] * focal,
    )  # fmt: skip
    for u in range(len(known)):
        x, q = np.float32(np.int32(u)) - motion.cx, known[u] + motion.doffs
        ahead = r20 * x + z0 + s2 * q
        scale = focal / ahead
        scale = scale if ahead > zero else zero
        along[u] = (r00 * x + x0 + s0 * q) * scale + motion.cx
        down[u] = (r10 * x + y0 + s1 * q) * scale + motion.cy
        near[u] = q * scale


@kernel()
def _without_gaps(first: Float32) -> Float32:
    """Fill pixels (H, W) to which nothing was projected with the largest disparity of the eight around
    them.
    """
    height, width = first.shape
    filled = np.empty_like(first)
    largest = np.full(width + 2, -np.inf, dtype=np.float32)
    inner, none = largest[1:], np.float32(-np.inf)
    for y in range(height):
        above, here, below, found = first[max(y - 1, 0)], first[y], first[min(y + 1, height - 1)], filled[y]
        # A NaN fails each comparison.
        for x in range(width):
            most = above[x] if above[x] > none else none
            most = here[x] if here[x] > most else most
            inner[x] = below[x] if below[x] > most else most
        for x in range(width):
            most = largest[x] if largest[x] > largest[x + 1] else largest[x + 1]
            most = largest[x + 2] if largest[x + 2] > most else most
            most = most if most > none else _NAN
            found[x] = here[x] if here[x] == here[x] else most
    return filled


@kernel()
def _splat(known: Float32, motion: _Transfer, first: Float32) -> None:
    """Project each pixel to the nearest pixel of the other view; the largest disparity wins.

    known: (H, W) px, NaN where unknown. Raises first (H, W) px, which stays NaN where nothing is projected.
    """
    height, width = known.shape
    half = np.float32(0.5)
    moved = np.empty((3, width), dtype=np.float32)
    right, below = np.float32(width) - half, np.float32(height) - half
    for v in range(height):
        _move_row(known[v], v, motion, moved)
        for u in range(width):
            along, down, q = moved[0, u], moved[1, u], moved[2, u]
            if not (-half <= along < right and -half <= down < below and q > np.float32(0)):
                continue
            column, row = int(along + half), int(down + half)
            if not first[row, column] >= q - motion.doffs:
                first[row, column] = q - motion.doffs


@kernel()
def _look_up(
    known: Float32,
    first: Float32,
    there: _Transfer,
    back: _Transfer,
    predicted: Float32,
    start: int,
    end: int,
) -> None:
    """Look up where each pixel of rows start...end was before, and its disparity there.

    known: (H, W) px of the previous view; first: (H, W) px, a guess for the current view. there: motion from
    the previous to the current view, back: the inverse. Fills predicted (H, W) px: the guess where the
    previous position is beside an edge or a hole, or disagrees with it.
    """
    height, width = known.shape
    moved, seen = np.empty((3, width), dtype=np.float32), np.empty(width, dtype=np.float32)
    last_column, last_row, zero = np.float32(width - 1), np.float32(height - 1), np.float32(0)
    r20, r21, shift = there.rotation[2, 0], there.rotation[2, 1], there.shift[2]
    straight = there.rotation[2, 2] * there.focal
    for v in range(start, end):
        guesses, found = first[v], predicted[v]
        _move_row(guesses, v, back, moved)
        for u in range(width):
            seen[u] = _NAN
            along, down, q = moved[0, u], moved[1, u], moved[2, u]
            if not (zero <= along < last_column and zero <= down < last_row and q > zero):
                continue
            column, row = int(along), int(down)
            one, two = known[row, column], known[row, column + 1]
            three, four = known[row + 1, column], known[row + 1, column + 1]
            low, high = min(min(one, two), min(three, four)), max(max(one, two), max(three, four))
            if not high - low < _SAME_SURFACE_PX:
                continue
            right, below = along - np.float32(column), down - np.float32(row)
            upper, lower = one + right * (two - one), three + right * (four - three)
            value = upper + below * (lower - upper) + back.doffs
            if abs(value - q) <= _MAX_OFF_PX:
                seen[u] = value
        along, down = moved[0], moved[1]
        for u in range(width):
            x, y = along[u] - there.cx, down[u] - there.cy
            ahead = r20 * x + r21 * y + straight + shift * seen[u]
            now = seen[u] * (there.focal / ahead) - there.doffs
            found[u] = now if ahead > zero else guesses[u]
