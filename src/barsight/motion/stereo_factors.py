"""Points seen by both cameras: where they begin, which count, and what residuals say of their noise."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64
from barsight.features.guided import triangulate
from barsight.motion.problem import Problem, StereoSightings

LEAST_SIGHTINGS = 2
LEAST_PERSISTENT = 5
LEAST_PAIRS = 300
CELLS = 8
MOST_WHITENED = 4.0
"""Single far residuals say nothing of what neighbours share."""


def start_points(problem: Problem, poses: Float64 | None = None, which: Int64 | None = None) -> Float64:
    """(T, 4) place in the reference as the first sighting has it, and slide: none. poses: (M, 4, 4), the
    problem's own start if None. which: (T,) points, all if None.
    """
    seen = problem.sightings
    if seen is None:
        return np.empty((0, 4))
    if poses is None:
        poses = np.array([pose.matrix for pose in problem.start])
    begin = seen.first[:-1] if which is None else seen.first[which]
    in_body = seen.body_from_rect0.apply(triangulate(seen.stereo[begin], seen.camera))
    first = poses[seen.node[begin]]
    points = (first[:, :3, :3] @ in_body[:, :, None])[:, :, 0] + first[:, :3, 3]
    return np.column_stack([points, np.zeros(len(points))])


def often(seen: StereoSightings, used: Bool) -> Bool:
    """Sightings of points that are seen often enough to check each other."""
    counts = np.bincount(seen.track[used], minlength=len(seen.first) - 1)
    result: Bool = used & (counts[seen.track] >= LEAST_SIGHTINGS)
    return result


def taken_up(seen: StereoSightings, used: Bool) -> float:
    """By how much errors are larger than the residuals that a fit of points (three unknowns) and frames (six)
    leaves of them; at most sqrt(3).
    """
    rows = 3 * int(used.sum())
    points, frames = np.bincount(seen.track[used]) > 0, np.bincount(seen.node[used]) > 0
    unknowns = 3 * int(points.sum()) + 6 * int(frames.sum())
    return float((rows / max(rows - unknowns, rows / 3, 1)) ** 0.5)


def nearness(residual: Float64, seen: StereoSightings, used: Bool) -> float:
    """By how much errors that neighbours in a picture share widen sigma, at least 1.

    Points of one bar share its gloss, and corners less than a patch apart share pixels. So the residuals of a
    cell, an eighth of the picture wide, don't add up like independent ones: the sums' squares over the
    single ones' is the variance that counts.
    """
    if not used.any():
        return 1.0
    scaled = np.clip(residual[used] / seen.sigma_px[used, None], -MOST_WHITENED, MOST_WHITENED)
    cell = (seen.stereo[used, :2] * (CELLS / seen.camera.width)).astype(np.int64)
    cell -= cell.min(axis=0)
    across, down = cell.max(axis=0) + 1
    name = (seen.node[used] * across + cell[:, 0]) * down + cell[:, 1]
    sums = np.array([np.bincount(name, axis) for axis in scaled.T])
    return float(max(1.0, (sums**2).sum() / max(float((scaled**2).sum()), 1e-12)) ** 0.5)


def persistence(residual: Float64, seen: StereoSightings, used: Bool) -> float:
    """By how much errors that persist from view to view widen sigma, at least 1.

    A highlight or a shadow edge moves with the view: it pulls a point alike in neighbouring views. With a
    correlation r between neighbours n sightings are worth n (1 - r) / (1 + r) [AR(1)]. The fitted points
    take off each track's mean, which lowers the correlation seen by about 1 / n.
    """
    order = np.flatnonzero(used)
    track = seen.track[order]
    length = np.bincount(track)[track[:-1]]
    pair = (track[:-1] == track[1:]) & (length >= LEAST_PERSISTENT)
    if pair.sum() < LEAST_PAIRS:
        return 1.0
    scaled = residual[order] / seen.sigma_px[order, None]
    first, second = scaled[:-1][pair], scaled[1:][pair]
    shared = 2 * (first * second).sum() / ((first**2).sum() + (second**2).sum())
    correlation = float(np.clip(shared + (1 / length[pair]).mean(), 0.0, 0.8))
    return float(((1 + correlation) / (1 - correlation)) ** 0.5)
