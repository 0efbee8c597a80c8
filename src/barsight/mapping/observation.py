"""Bin one view's points to one observation per cell and surface.

Neighbouring pixels share their matching window, so their errors are nearly the same: the points of one view
in one cell count as a single observation with their mean variance, not divided by their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int32, Int64, UInt8, kernel
from barsight.core.pose import Pose
from barsight.core.records.disparity import StereoPoints

_SAID = 6
_HEIGHT, _NOISE, _POSE, _SHARED, _GRAY, _MIDDLE = range(_SAID)


@dataclass(frozen=True, eq=False)
class CellObservations:
    """A view's heights, cell by cell; a cell may have several (a side, an overhang), highest first.

    x, y: (N,) int32 cell numbers (a cell's centre is its number times the cell's side). central: (N,) bool,
    True if the view sees this height in the cell's middle and not only near its border. z_m, variance_m2:
    height and its noise (matching and pose), float32. shared_m: sigma of the height due to the calibration,
    which all views share, float32. intensity: (N,) float32 gray levels.
    """

    x: Int32
    y: Int32
    central: Bool
    z_m: Float32
    variance_m2: Float32
    shared_m: Float32
    intensity: Float32


@dataclass(frozen=True, eq=False)
class SortedPoints:
    """A view's points, sorted by cell. said: (N, _SAID) values of each point, and starts: (cells + 1,), as
    `_by_cell` returns them, within shape (rows, columns) starting at corner (column, row).
    """

    said: Float32
    starts: Int64
    cell_m: float
    corner: tuple[int, int]
    shape: tuple[int, int]

    def merged(self) -> CellObservations:
        """Merge the points of each cell and surface. Call it only once: it changes their order."""
        return CellObservations(*_gather(self.said, self.starts, self.cell_m, self.corner, self.shape))


def sort_points(
    points: StereoPoints,
    reference_from_rect0: Pose,
    body_origin_m: Float64,
    covariance: Float64,
    cell_m: float,
    spacing_rad: float,
) -> SortedPoints:
    """Transform a view's points to the reference frame and sort them by cell.

    body_origin_m: (3,) centre about which attitude errors rotate the points. covariance: (6, 6) of the body's
    pose, rotation then translation, reference axes. spacing_rad: angle between neighbouring points.
    """
    if len(points.xyz_m) == 0:
        return SortedPoints(np.empty((0, _SAID), np.float32), np.zeros(1, np.int64), cell_m, (0, 0), (0, 0))
    about = covariance[np.ix_((0, 1, 5), (0, 1, 5))]
    rotation, translation = reference_from_rect0.rotation, reference_from_rect0.translation
    x, y = _cell_numbers(points.xyz_m, rotation, translation, cell_m)
    corner = int(x.min()), int(y.min())
    shape = int(y.max()) - corner[1] + 1, int(x.max()) - corner[0] + 1
    said, starts = _by_cell(
        points.xyz_m, (points.range_sigma_m, points.shared_sigma_m), points.intensity,
        (rotation, translation, body_origin_m, about), cell_m, 0.5 * spacing_rad, (x, y), corner, shape,
    )  # fmt: skip
    return SortedPoints(said, starts, cell_m, corner, shape)


@kernel()
def _cell_numbers(
    xyz: Float32, rotation: Float64, translation: Float64, cell_m: float
) -> tuple[Int32, Int32]:
    """Compute the cell numbers (N,) along x and y of points xyz (N, 3)."""
    x, y = np.empty(len(xyz), np.int32), np.empty(len(xyz), np.int32)
    for i in range(len(xyz)):
        px, py, _ = _turned(xyz, np.uint64(i), rotation)
        x[i] = np.int32(np.floor((px + translation[0]) / cell_m + 0.5))
        y[i] = np.int32(np.floor((py + translation[1]) / cell_m + 0.5))
    return x, y


@kernel(inline=True)
def _turned(xyz: Float32, i: np.uint64, rotation: Float64) -> tuple[float, float, float]:
    """Rotate point i of xyz (N, 3)."""
    a, b, c = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
    return (
        rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c,
        rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c,
        rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c,
    )


@kernel()
def _by_cell(
    xyz: Float32, sigmas: tuple[Float32, Float32], intensity: UInt8,
    pose: tuple[Float64, Float64, Float64, Float64], cell_m: float, half_rad: float,
    numbers: tuple[Int32, Int32], corner: tuple[int, int], shape: tuple[int, int],
) -> tuple[Float32, Int64]:  # fmt: skip
    """List the values of each point, sorted by cell and row (N, _SAID) with a counting sort, and where each
    cell starts (cells + 1,).

    A point's values are its height, the height's matching variance, pose variance and shared sigma, its gray
    level, and whether it lies within half_rad (half a pixel) of the cell's middle, along x and along y. The
    height's error is the range error along the ray times the ray's slope, plus that of the pose: dz = dt_z +
    theta_x * q_y - theta_y * q_x for a point q relative to the body.

    sigmas: along the ray, matching and shared, (N,) each. pose: rotation, translation, the body's origin and
    the covariance (3, 3) about it. numbers: the points' cells (N,), within shape (rows, columns) starting at
    corner (column, row).
    """
    (x, y), (range_sigma, shared_sigma) = numbers, sigmas
    rotation, translation, origin, about = pose
    width = np.uint64(shape[1])
    low_x, low_y, half = np.int32(corner[0]), np.int32(corner[1]), np.float32(half_rad)
    starts = np.zeros(shape[0] * shape[1] + 1, np.int64)
    for n in range(x.size):
        starts[np.uint64(y[n] - low_y) * width + np.uint64(x[n] - low_x) + np.uint64(1)] += 1
    for k in range(starts.size - 1):
        starts[k + 1] += starts[k]
    cursor = starts[:-1].copy()
    by_cell = np.empty((x.size, _SAID), np.float32)
    for n in range(x.size):
        i = np.uint64(n)
        rx, ry, rz = _turned(xyz, i, rotation)
        a, b, c = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        slope = rz / np.sqrt(a * a + b * b + c * c)
        px, py = rx + translation[0], ry + translation[1]
        jx, jy = py - origin[1], -(px - origin[0])
        off = np.float32(max(abs(px - x[i] * cell_m), abs(py - y[i] * cell_m)))
        cell = np.uint64(y[i] - low_y) * width + np.uint64(x[i] - low_x)
        at = np.uint64(cursor[cell])
        by_cell[at, _HEIGHT] = rz + translation[2]
        by_cell[at, _NOISE] = (range_sigma[i] * slope) ** 2
        by_cell[at, _POSE] = (
            about[0, 0] * jx * jx
            + about[1, 1] * jy * jy
            + about[2, 2]
            + 2 * (about[0, 1] * jx * jy + about[0, 2] * jx + about[1, 2] * jy)
        )
        by_cell[at, _SHARED] = np.abs(shared_sigma[i] * slope)
        by_cell[at, _GRAY] = np.float32(intensity[i])
        by_cell[at, _MIDDLE] = np.float32(off <= half * xyz[i, 2])
        cursor[cell] += 1
    return by_cell, starts


@kernel()
def _gather(
    said: Float32, starts: Int64, cell_m: float, corner: tuple[int, int], shape: tuple[int, int]
) -> tuple[Int32, Int32, Bool, Float32, Float32, Float32, Float32]:
    """Merge the points within each cell, from the top: points at most 4 sigma below the highest, or two cell
    sides if that is more, are one surface; the lower ones move to the cell's front for the next round.

    said: (N, _SAID) and starts: (cells + 1,), of `_by_cell`, with its corner and shape; said is reordered.
    Returns (M,) each: a surface's cell along x and along y, True if a point lies at the cell's middle, height
    (m), its variance (m^2), shared sigma (m), gray level.
    """
    count = said.shape[0]
    x, y, middle = np.empty(count, np.int32), np.empty(count, np.int32), np.zeros(count, np.bool_)
    out = np.empty((4, count), np.float32)
    n = np.uint64(0)
    for k in range(starts.size - 1):
        first, last = np.uint64(starts[k]), np.uint64(starts[k + 1])
        while first < last:
            top = first
            for i in range(first + np.uint64(1), last):
                if said[i, _HEIGHT] > said[top, _HEIGHT]:
                    top = np.uint64(i)
            floor = said[top, _HEIGHT] - max(4 * np.sqrt(said[top, _NOISE]), 2 * cell_m)
            weights = heights = variances = extra = gray = 0.0
            left = first
            for i in range(first, last):
                if said[i, _HEIGHT] < floor:
                    for field in range(_SAID):
                        said[left, field] = said[i, field]
                    left += np.uint64(1)
                    continue
                w = 1.0 / max(said[i, _NOISE], 1e-10)
                weights += w
                heights += w * said[i, _HEIGHT]
                variances += said[i, _NOISE] + said[i, _POSE]
                extra += said[i, _SHARED]
                gray += said[i, _GRAY]
                middle[n] |= said[i, _MIDDLE] > 0
            held = np.int64(last - left)
            x[n], y[n] = corner[0] + k % shape[1], corner[1] + k // shape[1]
            out[0, n] = heights / weights
            out[1, n] = variances / held
            out[2, n] = extra / held
            out[3, n] = gray / held
            n += np.uint64(1)
            last = left
    return x[:n], y[:n], middle[:n], out[0, :n], out[1, :n], out[2, :n], out[3, :n]
