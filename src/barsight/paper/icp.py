"""Refine a stitched step by point-to-plane ICP, to measure the benefit of the refinement in section 4.3."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedPair
from barsight.core.records.trajectory import Trajectory
from barsight.core.stamps import interpolate_at
from barsight.paper.cloud import cloud_of
from barsight.recording.base import Recording
from barsight.recording.formats.ground_truth import truth_of
from barsight.recording.rectified_pairs import RectifiedPairs

ROUNDS = 20
REACH_M = 0.1
NEIGHBOURS = 12
MAX_POINTS = 6000


@dataclass(frozen=True)
class IcpScore:
    """RMS errors of the steps' lengths against the truth, mm: as stitched, and after ICP."""

    steps: int
    stitched_mm: float
    refined_mm: float


def refine(source: Float64, target: Float64, start: Pose) -> Pose:
    """Refine target_from_source by point-to-plane ICP between points (N, 3) [Chen and Medioni 1992]."""
    tree = cKDTree(target)
    around = target[np.asarray(tree.query(target, k=NEIGHBOURS)[1])]
    spread = around - around.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]
    pose = start
    for _ in range(ROUNDS):
        moved = pose.apply(source)
        far, index = map(np.asarray, tree.query(moved, distance_upper_bound=REACH_M))
        met = np.isfinite(far)
        if met.sum() < NEIGHBOURS:
            break
        points, normal = moved[met], normals[index[met]]
        off = ((target[index[met]] - points) * normal).sum(axis=1)
        design = np.hstack([np.cross(points, normal), normal])
        step = np.linalg.lstsq(design, off, rcond=None)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        pose = Pose(start.target, start.source, turn @ pose.rotation, turn @ pose.translation + step[3:])
    return pose


def icp_score(recording: Recording, trajectory: Trajectory, max_steps: int) -> IcpScore | None:
    """Refine the paper's first stitched steps by ICP and score their lengths; None without truth."""
    truth, frames = truth_of(recording), trajectory.frames[: max_steps + 1]
    if truth is None or len(frames) < 2:
        return None
    rectifier, shift = Rectifier(recording.rig), recording.rig.timeshift_cam_imu_ns
    stamps = np.array([frame.stamp_ns for frame in frames])
    places = interpolate_at(stamps + shift, truth.stamp_ns, np.array([p.translation for p in truth.poses]))
    rng = np.random.default_rng(0)
    clouds = {}
    for pair in RectifiedPairs(recording, rectifier)(set(stamps.tolist())):
        if isinstance(pair, RectifiedPair):
            points = cloud_of(pair)
            clouds[pair.stamp_ns] = points[rng.permutation(len(points))[:MAX_POINTS]]
    body = rectifier.body_from_rect0
    errors = []
    for k in range(1, len(frames)):
        old, new = frames[k - 1], frames[k]
        if old.stamp_ns not in clouds or new.stamp_ns not in clouds:
            continue
        way = (old.reference_from_body @ body).inverse() @ (new.reference_from_body @ body)
        refined = refine(clouds[new.stamp_ns], clouds[old.stamp_ns], way)
        true = float(np.linalg.norm(places[k] - places[k - 1]))
        steps = [(body @ one @ body.inverse()).translation for one in (way, refined)]
        errors.append([np.linalg.norm(step) - true for step in steps])
    if not errors:
        return None
    rms = 1e3 * np.sqrt(np.square(errors).mean(axis=0))
    return IcpScore(len(errors), float(rms[0]), float(rms[1]))
