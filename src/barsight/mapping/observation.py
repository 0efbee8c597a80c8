"""Bin one view's points to one observation per cell and surface.

Neighbouring pixels share their matching window, so their errors are nearly the same: the points of one view
that fall into one cell count as a single observation whose variance is theirs, not theirs over their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int32, Int64, UInt8, kernel
from barsight.core.pose import Pose
from barsight.core.types import StereoPoints

_SAID = 6
_HEIGHT, _NOISE, _POSE, _SHARED, _GRAY, _MIDDLE = range(_SAID)


@dataclass(frozen=True, eq=False)
class CellObservations:
    """A view's heights, cell by cell; a cell may have several (a side, an overhang), highest first.

    x, y: (N,) int32 cell numbers (a cell's centre is its number times the cell's side). central: (N,)
    bool, whether the view sees this height in the cell's middle and not only at its border. z_m, variance_m2:
    height and its noise (matching and pose), float32. shared_m: what the calibration may add, float32.
    intensity: (N,) float32 gray levels.
    """

    x: Int32
    y: Int32
    central: Bool
    z_m: Float32
    variance_m2: Float32
    shared_m: Float32
    intensity: Float32


def bin_points(
    points: StereoPoints,
    reference_from_rect0: Pose,
    body_origin_m: Float64,
    covariance: Float64,
    cell_m: float,
    spacing_rad: float,
) -> CellObservations:
    """Transform a view's points to the reference frame and bin them by cell.

    body_origin_m: (3,) about which the attitude's error turns. covariance: (6, 6) of the body's pose,
    rotation then translation, reference axes. spacing_rad: angle between neighbouring points.
    """
    if len(points.xyz_m) == 0:
        return _no_observations()
    about = covariance[np.ix_((0, 1, 5), (0, 1, 5))]
    x, y, said = _in_reference(
        points.xyz_m, points.range_sigma_m, points.shared_sigma_m, points.intensity,
        reference_from_rect0.rotation, reference_from_rect0.translation, body_origin_m, about,
        cell_m, 0.5 * spacing_rad,
    )  # fmt: skip
    low_x, low_y = int(x.min()), int(y.min())
    width, height = int(x.max()) - low_x + 1, int(y.max()) - low_y + 1
    by_cell, starts = _by_cell(x, y, said, low_x, low_y, width, height)
    cell, central, *heights = _gather(by_cell, starts, cell_m)
    rows, columns = np.divmod(cell, width)
    return CellObservations(
        (columns + low_x).astype(np.int32), (rows + low_y).astype(np.int32), central, *heights
    )


def _no_observations() -> CellObservations:
    none = np.empty(0, np.float32)
    whole = np.empty(0, np.int32)
    return CellObservations(whole, whole, np.empty(0, np.bool_), none, none, none, none)


@kernel()
def _in_reference(
    xyz: Float32, range_sigma: Float32, shared_sigma: Float32, intensity: UInt8, rotation: Float64,
    translation: Float64, origin: Float64, about: Float64, cell_m: float, half_rad: float,
) -> tuple[Int32, Int32, Float32]:  # fmt: skip
    """Transform and pack: cell numbers (N,) and, side by side in memory, what each point says (N, _SAID): its
    height, matching variance, pose variance and shared sigma of the height, its gray level and whether it
    lies within half_rad (half a pixel) of the cell's middle, along x and along y.

    The height's error is the range error along the ray times the ray's slope, plus that of the pose:
    dz = dt_z + theta_x * q_y - theta_y * q_x for a point q as seen from the body.
    """
    count = xyz.shape[0]
    x, y = np.empty(count, np.int32), np.empty(count, np.int32)
    said = np.empty((count, _SAID), np.float32)
    half = np.float32(half_rad)
    for i in range(count):
        a, b, c = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        rx = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c
        ry = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c
        rz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c
        slope = rz / np.sqrt(a * a + b * b + c * c)
        px, py = rx + translation[0], ry + translation[1]
        column, row = np.floor(px / cell_m + 0.5), np.floor(py / cell_m + 0.5)
        x[i], y[i] = np.int32(column), np.int32(row)
        said[i, _HEIGHT] = rz + translation[2]
        said[i, _NOISE] = (range_sigma[i] * slope) ** 2
        jx, jy = py - origin[1], -(px - origin[0])
        said[i, _POSE] = (
            about[0, 0] * jx * jx
            + about[1, 1] * jy * jy
            + about[2, 2]
            + 2 * (about[0, 1] * jx * jy + about[0, 2] * jx + about[1, 2] * jy)
        )
        said[i, _SHARED] = np.abs(shared_sigma[i] * slope)
        said[i, _GRAY] = np.float32(intensity[i])
        off = np.float32(max(abs(px - column * cell_m), abs(py - row * cell_m)))
        said[i, _MIDDLE] = np.float32(off <= half * xyz[i, 2])
    return x, y, said


@kernel()
def _by_cell(
    x: Int32, y: Int32, said: Float32, low_x: int, low_y: int, width: int, height: int
) -> tuple[Float32, Int64]:
    """Sort by counting: what is said (N, _SAID), cell by cell and row by row, and where each cell starts
    (cells + 1,).

    x, y: (N,) cell numbers, within width columns from low_x and height rows from low_y on; said: (N, _SAID).
    """
    starts = np.zeros(width * height + 1, np.int64)
    for i in range(x.size):
        starts[(y[i] - low_y) * width + x[i] - low_x + 1] += 1
    for k in range(width * height):
        starts[k + 1] += starts[k]
    cursor = starts[:-1].copy()
    by_cell = np.empty_like(said)
    for i in range(x.size):
        k = (y[i] - low_y) * width + x[i] - low_x
        for field in range(_SAID):  # a row at once takes Numba ten seconds more to compile
            by_cell[cursor[k], field] = said[i, field]
        cursor[k] += 1
    return by_cell, starts


@kernel()
def _gather(
    said: Float32, starts: Int64, cell_m: float
) -> tuple[Int64, Bool, Float32, Float32, Float32, Float32]:
    """Merge within each cell, from the top: points no deeper than 4 sigma below the highest are one surface;
    those below wait at the cell's front.

    said: (N, _SAID) and starts: (cells + 1,), of `_by_cell`; said's order changes. Returns (M,) each: a
    surface's cell, whether a point lies at the cell's middle, height (m), its variance (m^2), shared sigma
    (m), gray level.
    """
    count = said.shape[0]
    cell, middle = np.empty(count, np.int64), np.zeros(count, np.bool_)
    out = np.empty((4, count), np.float32)
    n = 0
    for k in range(starts.size - 1):
        first, last = starts[k], starts[k + 1]
        while first < last:
            top = first
            for i in range(first + 1, last):
                if said[i, _HEIGHT] > said[top, _HEIGHT]:
                    top = i
            floor = said[top, _HEIGHT] - max(4 * np.sqrt(said[top, _NOISE]), 2 * cell_m)
            weights = heights = variances = extra = gray = 0.0
            left = first
            for i in range(first, last):
                if said[i, _HEIGHT] < floor:
                    for field in range(_SAID):
                        said[left, field] = said[i, field]
                    left += 1
                    continue
                w = 1.0 / max(said[i, _NOISE], 1e-10)
                weights += w
                heights += w * said[i, _HEIGHT]
                variances += said[i, _NOISE] + said[i, _POSE]
                extra += said[i, _SHARED]
                gray += said[i, _GRAY]
                middle[n] |= said[i, _MIDDLE] > 0
            held = last - left
            cell[n] = k
            out[0, n] = heights / weights
            out[1, n] = variances / held
            out[2, n] = extra / held
            out[3, n] = gray / held
            n += 1
            last = left
    return cell[:n], middle[:n], out[0, :n], out[1, :n], out[2, :n], out[3, :n]
