"""Initialise points, select sightings, and estimate their noise from residuals."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64, kernel
from barsight.features.guided_matching import triangulate_stereo
from barsight.motion.problem.problem import Problem, StereoObservations

MIN_SIGHTINGS = 2
MIN_PERSISTENT = 5
MIN_PAIRS = 300
CELLS = 8
MAX_WHITENED = 4.0
"""Sigmas at which residuals are clipped: single outliers say nothing about the errors that neighbours
share.
"""


def initial_points(problem: Problem, poses: Float64 | None = None, which: Int64 | None = None) -> Float64:
    """Initialise points (T, 4): position in the reference by the first sighting, and zero slide. poses:
    (M, 4, 4), the problem's initial ones if None. which: (T,) points, all if None.
    """
    seen = problem.sightings
    if seen is None:
        return np.empty((0, 4))
    if poses is None:
        poses = np.array([pose.matrix for pose in problem.start])
    begin = seen.first[:-1] if which is None else seen.first[which]
    in_body = seen.body_from_rect0.apply(triangulate_stereo(seen.stereo[begin], seen.camera))
    first = poses[seen.node[begin]]
    points = (first[:, :3, :3] @ in_body[:, :, None])[:, :, 0] + first[:, :3, 3]
    return np.column_stack([points, np.zeros(len(points))])


def well_observed(seen: StereoObservations, used: Bool) -> Bool:
    """Select sightings of points that are seen often enough for their sightings to check each other."""
    counts = np.bincount(seen.track[used], minlength=len(seen.first) - 1)
    result: Bool = used & (counts[seen.track] >= MIN_SIGHTINGS)
    return result


def dof_correction(seen: StereoObservations, used: Bool) -> float:
    """Compute the degrees-of-freedom correction of residuals: the ratio of errors to the residuals that
    remain after fitting points (three unknowns) and frames (six); at most sqrt(3).
    """
    rows = 3 * int(used.sum())
    points, frames = np.bincount(seen.track[used]) > 0, np.bincount(seen.node[used]) > 0
    unknowns = 3 * int(points.sum()) + 6 * int(frames.sum())
    return float((rows / max(rows - unknowns, rows / 3, 1)) ** 0.5)


def spatial_inflation(residual: Float64, seen: StereoObservations, used: Bool) -> float:
    """Estimate the sigma inflation due to errors that neighbours in a picture share, at least 1.

    Points of one bar share its gloss, and corners less than a patch apart share pixels. So the residuals of a
    cell, an eighth of the picture wide, don't add up like independent ones: the effective variance is that of
    the cells' sums over that of single residuals.
    """
    sums, single = _shared_squares(
        residual, seen.sigma_px, seen.stereo, seen.node, used, CELLS / seen.camera.width
    )
    return float(max(1.0, sums / max(single, 1e-12)) ** 0.5)


def temporal_inflation(residual: Float64, seen: StereoObservations, used: Bool) -> float:
    """Estimate the sigma inflation due to errors that persist from view to view, at least 1.

    A highlight or a shadow edge moves with the view: it pulls a point in the same direction in neighbouring
    views. With a correlation r between neighbours, n sightings are worth n (1 - r) / (1 + r) [AR(1)]. Fitting
    the points removes each track's mean, which lowers the observed correlation by about 1 / n.
    """
    pairs, product, squares, shorter = _neighbours(residual, seen.sigma_px, seen.track, used)
    if pairs < MIN_PAIRS:
        return 1.0
    correlation = min(max(2 * product / squares + shorter / pairs, 0.0), 0.8)
    return float(((1 + correlation) / (1 - correlation)) ** 0.5)


@kernel()
def _shared_squares(
    residual: Float64, sigma: Float64, stereo: Float64, node: Int64, used: Bool, per_px: float
) -> tuple[float, float]:
    """Sum used residuals over their sigmas: the squares of each cell's sum, and those of single residuals.

    residual, stereo: (N, 3) px; sigma: (N,) px; node, used: (N,). per_px: cells per pixel.
    """
    low, high, last = np.full(2, 1 << 40), np.full(2, -(1 << 40)), 0
    for k in range(len(used)):
        if used[k]:
            last = max(last, node[k])
            for a in range(2):
                cell = int(stereo[k, a] * per_px)
                low[a], high[a] = min(low[a], cell), max(high[a], cell)
    sums, single = np.zeros((last + 1, max(high[0] - low[0] + 1, 0), max(high[1] - low[1] + 1, 0), 3)), 0.0
    for k in range(len(used)):
        if used[k]:
            across, down = int(stereo[k, 0] * per_px) - low[0], int(stereo[k, 1] * per_px) - low[1]
            for i in range(3):
                scaled = min(max(residual[k, i] / sigma[k], -MAX_WHITENED), MAX_WHITENED)
                sums[node[k], across, down, i] += scaled
                single += scaled**2
    return (sums**2).sum(), single


@kernel()
def _neighbours(
    residual: Float64, sigma: Float64, track: Int64, used: Bool
) -> tuple[int, float, float, float]:
    """Sum over the pairs of neighbouring used sightings of points seen often: the number of pairs, the
    products and squares of their residuals in sigma, and the reciprocal number of the point's sightings.

    residual: (N, 3) px; sigma: (N,) px; track, used: (N,), in the tracks' order.
    """
    counts = np.zeros(0 if len(track) == 0 else track[-1] + 1, np.int64)
    for k in range(len(used)):
        counts[track[k]] += used[k]
    pairs, product, squares, shorter, old = 0, 0.0, 0.0, 0.0, -1
    for k in range(len(used)):
        if not used[k]:
            continue
        if old >= 0 and track[old] == track[k] and counts[track[k]] >= MIN_PERSISTENT:
            pairs += 1
            shorter += 1 / counts[track[k]]
            for i in range(3):
                first, second = residual[old, i] / sigma[old], residual[k, i] / sigma[k]
                product += first * second
                squares += first**2 + second**2
        old = k
    return pairs, product, squares, shorter
