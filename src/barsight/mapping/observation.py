"""One view's points to one observation per cell and surface: what a view can say about a cell, said once.

Neighbouring pixels share their matching window, so their errors are nearly the same: the points of one view
that fall into one cell count as a single observation whose variance is theirs, not theirs over their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int32, Int64, UInt8, kernel
from barsight.core.pose import Pose
from barsight.core.types import StereoPoints


@dataclass(frozen=True, eq=False)
class CellObservations:
    """A view's heights, cell by cell; a cell may have several (a side, an overhang), highest first.

    x, y: (N,) int32 cell numbers (a cell's centre is its number times the cell's side). central: (N,)
    bool, whether the view sees this height in the cell's middle and not only at its border. z_m, variance_m2:
    height and its noise (matching and pose), float32. shared_m: what the calibration may add, float32.
    intensity: (N,) float32 grey levels.
    """

    x: Int32
    y: Int32
    central: Bool
    z_m: Float32
    variance_m2: Float32
    shared_m: Float32
    intensity: Float32


def observe(
    points: StereoPoints,
    reference_from_rect0: Pose,
    body_origin_m: Float64,
    covariance: Float64,
    cell_m: float,
    spacing_rad: float,
) -> CellObservations:
    """Bring a view's points into the reference frame and gather them by cell.

    body_origin_m: (3,) about which the attitude's error turns. covariance: (6, 6) of the body's pose,
    rotation then translation, reference axes. spacing_rad: angle between neighbouring points.
    """
    if len(points.xyz_m) == 0:
        return _no_observations()
    about = covariance[np.ix_((0, 1, 5), (0, 1, 5))]
    x, y, z, off, variance, pose_variance, shared = _in_reference(
        points.xyz_m,
        points.range_sigma_m,
        points.shared_sigma_m,
        reference_from_rect0.rotation,
        reference_from_rect0.translation,
        body_origin_m,
        about,
        cell_m,
    )
    low_x, low_y = int(x.min()), int(y.min())
    width, height = int(x.max()) - low_x + 1, int(y.max()) - low_y + 1
    flat = (y.astype(np.int64) - low_y) * width + (x - low_x)
    order, starts = _by_cell(flat, width * height)
    half_pixel = 0.5 * spacing_rad * points.xyz_m[:, 2]
    cell, central, *heights = _gather(
        order, starts, z, off, half_pixel, variance, pose_variance, shared, points.intensity, cell_m
    )
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
    xyz: Float32,
    range_sigma: Float32,
    shared_sigma: Float32,
    rotation: Float64,
    translation: Float64,
    origin: Float64,
    about: Float64,
    cell_m: float,
) -> tuple[Int32, Int32, Float32, Float32, Float32, Float32, Float32]:
    """Cell numbers, height, distance from the cell's middle (the larger of along x and y), matching variance,
    pose variance and shared sigma of the height, each (N,).

    The height's error is the range error along the ray times the ray's slope, plus that of the pose:
    dz = dt_z + theta_x * q_y - theta_y * q_x for a point q as seen from the body.
    """
    count = xyz.shape[0]
    x, y = np.empty(count, np.int32), np.empty(count, np.int32)
    z, off, variance = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    pose_variance, shared = np.empty(count, np.float32), np.empty(count, np.float32)
    for i in range(count):
        a, b, c = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        rx = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c
        ry = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c
        rz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c
        slope = rz / np.sqrt(a * a + b * b + c * c)
        px, py, pz = rx + translation[0], ry + translation[1], rz + translation[2]
        x[i] = np.int32(np.floor(px / cell_m + 0.5))
        y[i] = np.int32(np.floor(py / cell_m + 0.5))
        z[i] = pz
        off[i] = max(abs(px - x[i] * cell_m), abs(py - y[i] * cell_m))
        variance[i] = (range_sigma[i] * slope) ** 2
        shared[i] = np.abs(shared_sigma[i] * slope)
        jx, jy = py - origin[1], -(px - origin[0])
        pose_variance[i] = (
            about[0, 0] * jx * jx
            + about[1, 1] * jy * jy
            + about[2, 2]
            + 2 * (about[0, 1] * jx * jy + about[0, 2] * jx + about[1, 2] * jy)
        )
    return x, y, z, off, variance, pose_variance, shared


@kernel()
def _by_cell(flat: Int64, cells: int) -> tuple[Int64, Int64]:
    """Counting sort: the order that brings points of a cell together, and where each cell starts."""
    starts = np.zeros(cells + 1, np.int64)
    for i in range(flat.size):
        starts[flat[i] + 1] += 1
    for k in range(cells):
        starts[k + 1] += starts[k]
    cursor = starts[:-1].copy()
    order = np.empty(flat.size, np.int64)
    for i in range(flat.size):
        order[cursor[flat[i]]] = i
        cursor[flat[i]] += 1
    return order, starts


@kernel()
def _highest_first(members: Int64, z: Float32) -> None:
    """Order the few points of a cell in place; many (a wall seen from the side) by a real sort."""
    if members.size > 32:
        members[:] = members[np.argsort(-z[members])]
        return
    for i in range(1, members.size):
        m = members[i]
        j = i
        while j > 0 and z[members[j - 1]] < z[m]:
            members[j] = members[j - 1]
            j -= 1
        members[j] = m


@kernel()
def _gather(
    order: Int64,
    starts: Int64,
    z: Float32,
    off: Float32,
    half_pixel: Float32,
    variance: Float32,
    pose_variance: Float32,
    shared: Float32,
    intensity: UInt8,
    cell_m: float,
) -> tuple[Int64, Bool, Float32, Float32, Float32, Float32]:
    """Within each cell, from the top: points no deeper than 4 sigma below the first are one surface."""
    count = order.size
    cell, middle = np.empty(count, np.int64), np.zeros(count, np.bool_)
    out = np.empty((4, count), np.float32)
    n = 0
    for k in range(starts.size - 1):
        first, last = starts[k], starts[k + 1]
        if first == last:
            continue
        members = order[first:last]
        _highest_first(members, z)
        i = 0
        while i < members.size:
            top = members[i]
            floor = z[top] - max(4 * np.sqrt(variance[top]), 2 * cell_m)
            weights = heights = variances = extra = grey = 0.0
            held = 0
            while i < members.size and z[members[i]] >= floor:
                m = members[i]
                w = 1.0 / max(variance[m], 1e-10)
                weights += w
                heights += w * z[m]
                variances += variance[m] + pose_variance[m]
                extra += shared[m]
                grey += intensity[m]
                middle[n] |= off[m] <= half_pixel[m]
                held += 1
                i += 1
            cell[n] = k
            out[0, n] = heights / weights
            out[1, n] = variances / held
            out[2, n] = extra / held
            out[3, n] = grey / held
            n += 1
    return cell[:n], middle[:n], out[0, :n], out[1, :n], out[2, :n], out[3, :n]
