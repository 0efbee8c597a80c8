"""Points seen by both cameras as factors of the graph, their residuals, and what these say of their noise."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from barsight.core.arrays import Bool, Float64
from barsight.core.pose import Pose
from barsight.motion.problem import StereoSightings
from barsight.motion.rig_drift import HUBER_SIGMAS

LEAST_SIGHTINGS = 2
LEAST_PERSISTENT = 5
LEAST_PAIRS = 300


def add_points(values: Any, seen: StereoSightings, used: Bool) -> None:
    """Landmarks that `values` lacks, triangulated from their first sighting; unused ones leave."""
    camera, stereo = seen.camera, seen.stereo
    depth = camera.focal_px * camera.baseline_m / (stereo[:, 0] - stereo[:, 2] + camera.doffs_px)
    x = (stereo[:, 0] - camera.cx_px) / camera.focal_px * depth
    y = (stereo[:, 1] - camera.cy_px) / camera.focal_px * depth
    points = seen.body_from_rect0.apply(np.column_stack([x, y, depth]))
    kept = set(seen.track[used].tolist())
    for track in np.unique(seen.track[~used]).tolist():
        if track not in kept and values.exists(L(track)):
            values.erase(L(track))
    for k in np.flatnonzero(used):
        key = L(int(seen.track[k]))
        if not values.exists(key):
            values.insert(key, values.atPose3(X(int(seen.node[k]))).transformFrom(points[k]))


def add_stereo(graph: Any, seen: StereoSightings, used: Bool, shift_px: Float64) -> None:
    """Reprojection of the `used` (N,) sightings in both pictures, Huber."""
    camera = seen.camera
    calibration = gtsam.Cal3_S2Stereo(
        camera.focal_px, camera.focal_px, 0.0, camera.cx_px, camera.cy_px, camera.baseline_m
    )
    mounted = gtsam.Pose3(gtsam.Rot3(seen.body_from_rect0.rotation), seen.body_from_rect0.translation)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_SIGMAS)
    for k in np.flatnonzero(used):
        model = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Isotropic.Sigma(3, seen.sigma_px[k]))
        u, v, right = seen.stereo[k]
        measured = gtsam.StereoPoint2(u, right - camera.doffs_px - shift_px[k], v)
        node, track = X(int(seen.node[k])), L(int(seen.track[k]))
        graph.add(gtsam.GenericStereoFactor3D(measured, model, node, track, calibration, mounted))


def residuals(values: Any, seen: StereoSightings, used: Bool, shift_px: Float64) -> Float64:
    """(N, 3) px, 0 where unused."""
    residual = np.zeros((len(used), 3))
    camera = seen.camera
    for node in np.unique(seen.node[used]).tolist():
        rows = np.flatnonzero(used & (seen.node == node))
        points = np.array([values.atPoint3(L(int(seen.track[k]))) for k in rows])
        pose = values.atPose3(X(node))
        world_from_body = Pose("world", "body", pose.rotation().matrix(), np.asarray(pose.translation()))
        rect0_from_world = (world_from_body @ seen.body_from_rect0).inverse()
        x, y, z = rect0_from_world.apply(points).T
        u, v = camera.focal_px * x / z + camera.cx_px, camera.focal_px * y / z + camera.cy_px
        right = u - camera.focal_px * camera.baseline_m / z + camera.doffs_px + shift_px[rows]
        residual[rows] = seen.stereo[rows] - np.column_stack([u, v, right])
    return residual


def often(seen: StereoSightings, used: Bool) -> Bool:
    """Sightings of points that are seen often enough to check each other."""
    names, inverse = np.unique(seen.track, return_inverse=True)
    counts = np.bincount(inverse[used], minlength=len(names))
    result: Bool = used & (counts[inverse] >= LEAST_SIGHTINGS)
    return result


def persistence(residual: Float64, seen: StereoSightings, used: Bool) -> float:
    """By how much errors that persist from view to view widen sigma, at least 1.

    A highlight or a shadow edge moves with the view: it pulls a point alike in neighbouring views. With a
    correlation r between neighbours n sightings are worth n (1 - r) / (1 + r) [AR(1)]. The fitted points
    take off each track's mean, which lowers the correlation seen by about 1 / n.
    """
    order = np.lexsort((seen.node, seen.track))
    order = order[used[order]]
    _, inverse, counts = np.unique(seen.track[order], return_inverse=True, return_counts=True)
    length = counts[inverse][:-1]
    pair = (inverse[:-1] == inverse[1:]) & (length >= LEAST_PERSISTENT)
    if pair.sum() < LEAST_PAIRS:
        return 1.0
    scaled = residual[order] / seen.sigma_px[order, None]
    first, second = scaled[:-1][pair], scaled[1:][pair]
    shared = 2 * (first * second).sum() / ((first**2).sum() + (second**2).sum())
    correlation = float(np.clip(shared + (1 / length[pair]).mean(), 0.0, 0.8))
    return float(((1 + correlation) / (1 - correlation)) ** 0.5)
