"""Compute the true positions of features in the next view from true poses and depth, for evaluation only."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation, Slerp

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed, InputError
from barsight.core.pose import Pose
from barsight.core.records.pairs import RefusedFrame
from barsight.core.stamps import NS_PER_S
from barsight.features.guided_matching import project_stereo
from barsight.features.patch_alignment import PatchPair, patch_pair
from barsight.recording.base import Recording
from barsight.recording.formats.ground_truth import read_ground_truth
from barsight.recording.open import open_recording


@dataclass(frozen=True, eq=False)
class TrueStep:
    """Two successive views with true poses, the first with the true depth (H, W), m, of the raw cam0."""

    name: str
    recording: Recording
    rectifier: Rectifier
    old: PatchPair
    new: PatchPair
    depth_m: Float64
    yard_from_old: Pose
    yard_from_new: Pose


def true_steps(path: Path) -> list[TrueStep]:
    """List the views with stored true depth, each with the next view. Raises InputError if there are none."""
    recording = open_recording(path)
    rectifier = Rectifier(recording.rig)
    truth = read_ground_truth(path, np.array(recording.index.stamps_ns, np.int64), reference="yard")
    seconds = (truth.stamp_ns - truth.stamp_ns[0]) / NS_PER_S
    turns = Slerp(seconds, Rotation.from_matrix(np.array([pose.rotation for pose in truth.poses])))
    places = np.array([pose.translation for pose in truth.poses])

    def pose(stamp_ns: int) -> Pose:
        at = (stamp_ns + recording.rig.timeshift_cam_imu_ns - truth.stamp_ns[0]) / NS_PER_S
        place = np.array([np.interp(at, seconds, places[:, axis]) for axis in range(3)])
        return Pose("yard", "body", turns(at).as_matrix(), place) @ rectifier.body_from_rect0

    steps, last = [], None
    for frame in recording.frames():
        pair = None if isinstance(frame, RefusedFrame) else rectifier(frame)
        ready = None if pair is None or isinstance(pair, Failed) else patch_pair(pair)
        if last is not None and ready is not None:
            file = path / "truth" / f"depth_cam0_{last.pair.stamp_ns}.npz"
            if file.is_file():
                depth = np.load(file)["z"].astype(np.float64)
                old, new = pose(last.pair.stamp_ns), pose(ready.pair.stamp_ns)
                steps.append(TrueStep(path.name, recording, rectifier, last, ready, depth, old, new))
        last = ready
    if not steps:
        raise InputError(path, "holds no view with true depth", "simulate one (barsight simulate)")
    return steps


def reproject(step: TrueStep, pixels: Float64) -> Float64:
    """Reproject features' true points to the new left image (N, 2), px; NaN outside and at depth steps."""
    camera = step.rectifier.camera
    rig = step.recording.rig
    cam0_from_rect0 = rig.body_from_cam0.inverse() @ step.rectifier.body_from_rect0
    rays = np.column_stack([(pixels - (camera.cx_px, camera.cy_px)) / camera.focal_px, np.ones(len(pixels))])
    raw_rays = cam0_from_rect0.apply(rays * 1e6) / 1e6
    raw = rig.cam0.project(raw_rays)
    around = [
        map_coordinates(step.depth_m, [raw[:, 1] + dy, raw[:, 0] + dx], order=0, cval=np.inf)
        for dy in (-2, 0, 2)
        for dx in (-2, 0, 2)
    ]
    depth = map_coordinates(step.depth_m, [raw[:, 1], raw[:, 0]], order=1, cval=np.inf)
    smooth = np.max(around, axis=0) - np.min(around, axis=0) < 0.05
    points = rays * (depth / raw_rays[:, 2])[:, None]
    with np.errstate(invalid="ignore"):
        moved = (step.yard_from_new.inverse() @ step.yard_from_old).apply(
            np.where(np.isfinite(points), points, 1.0)
        )
        places = project_stereo(moved, camera)[:, :2]
        smooth &= np.isfinite(depth) & (places > 0).all(axis=1)
        smooth &= (places < (camera.width, camera.height)).all(axis=1)
    return np.where(smooth[:, None], places, np.nan)
