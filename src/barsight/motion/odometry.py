"""Stereo visual odometry: ORB features, metric PnP with RANSAC, refined on both images of the new pair."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.rectification import Rectifier
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import ConfigError, Failed
from barsight.core.pose import Pose
from barsight.core.types import (
    PosedFrame,
    RectifiedCamera,
    RefusedFrame,
    Trajectory,
)
from barsight.features.guided import match_across
from barsight.features.matching import match_mutual
from barsight.features.orb import Features, detect_orb
from barsight.features.patches import PatchPair, locate, patch_pair
from barsight.motion.gravity import level_attitude
from barsight.recording.base import Recording
from barsight.stereo.disparity_range import coarse_disparity


@dataclass(frozen=True)
class OdometrySettings:
    """Stereo visual odometry."""

    features: int = 3000
    """Features a picture."""
    nearest_m: float = 0.5
    """Points nearer than this aren't used."""
    farthest_baselines: float = 60.0
    """Points further than this many baselines aren't used for motion."""
    least_inliers: int = 25
    """A frame with fewer agreeing points is refused."""
    pixel_sigma_px: float = 0.3
    """The noise of a feature's place (1 sigma)."""
    calibration_sigma_px: float = 0.1
    """Disparity error common to all features: it makes every step too long or too short alike (1 sigma)."""
    ransac_px: float = 1.0
    """Points further off than this are outliers."""

    def __post_init__(self) -> None:
        if not 100 <= self.features <= 100_000 or self.least_inliers < 6:
            raise ConfigError("features must lie in 100...100000, least_inliers be at least 6")
        if min(self.nearest_m, self.farthest_baselines, self.pixel_sigma_px, self.ransac_px) <= 0:
            raise ConfigError("the odometry's distances and tolerances must be positive")


@dataclass(frozen=True, eq=False)
class View:
    """One frame's features with a stereo disparity. points: (N, 3) in `rect0`."""

    pair: PatchPair
    features: Features
    disparity: Float64
    points: Float64


@dataclass(frozen=True, eq=False)
class Step:
    """new_from_old: pose of the old `rect0` in the new one, and its covariance (6, 6).

    scale_sigma: relative error of the step's length that the calibration may cause; it doesn't average out.
    kept: (N,) which points agree.
    """

    rotation: Float64
    translation: Float64
    covariance: Float64
    scale_sigma: float
    kept: Bool


@dataclass(frozen=True)
class StereoOdometry:
    """`TrajectoryEstimator` for any stereo recording; the reference is `world`, its origin the first body.

    Errors add up along the way, and so does the covariance.
    """

    settings: OdometrySettings

    def __call__(self, recording: Recording, rectifier: Rectifier, advance: Callable[[], None]) -> Trajectory:
        """Frames without enough agreeing features are refused; the next one is tied to the last good one."""
        level = level_attitude(recording)
        body_from_rect0 = rectifier.body_from_rect0
        placed: list[PosedFrame] = []
        refused: list[RefusedFrame] = []
        last: View | None = None
        noise, stretch = np.diag([1e-12] * 6), np.zeros(3)
        for frame in recording.frames():
            advance()
            if isinstance(frame, RefusedFrame):
                refused.append(frame)
                continue
            pair = rectifier(frame)
            view = pair if isinstance(pair, Failed) else self.look(patch_pair(pair))
            if isinstance(view, Failed):
                refused.append(RefusedFrame(frame.stamp_ns, view.reason))
                continue
            if last is None:
                pose = level.world_from_body
                placed.append(PosedFrame(frame.stamp_ns, pose, noise))
                last = view
                continue
            step = self.move(last, view, rectifier.camera)
            if isinstance(step, Failed):
                refused.append(RefusedFrame(frame.stamp_ns, step.reason))
                continue
            old_from_new = Pose("rect0", "rect0", step.rotation, step.translation).inverse()
            old = placed[-1]
            world_from_old = old.reference_from_body @ body_from_rect0
            world_from_new = world_from_old @ old_from_new
            pose = world_from_new @ body_from_rect0.inverse()
            way = pose.translation - old.reference_from_body.translation
            lever = pose.translation - world_from_new.translation
            added = _carried(_in_world(step.covariance, world_from_new.rotation), lever)
            noise = _carried(noise, way) + added
            stretch = stretch + step.scale_sigma * way
            covariance = noise.copy()
            covariance[3:, 3:] += np.outer(stretch, stretch)
            placed.append(PosedFrame(frame.stamp_ns, pose, covariance))
            last = view
        sensors = ("stereo", "imu") if level.from_imu else ("stereo",)
        return Trajectory("world", tuple(placed), tuple(refused), sensors, level.warnings)

    def look(self, pair: PatchPair) -> View | Failed:
        camera, settings = pair.pair.camera, self.settings
        features = detect_orb(pair.pair.left, settings.features)
        coarse = coarse_disparity(pair.pair.left, pair.pair.right, camera.doffs_px)
        row = (features.pixels[:, 1] * coarse.shape[0] / camera.height).astype(int)
        column = (features.pixels[:, 0] * coarse.shape[1] / camera.width).astype(int)
        guess = coarse[row, column]
        near = np.isfinite(guess)
        features, guess = features.chosen(near), guess[near]
        places = features.pixels.astype(np.float64)
        right = match_across(pair, places, guess.astype(np.float64))
        kept, disparity = right.found, places[:, 0] - right.pixels[:, 0]
        depth = camera.focal_px * camera.baseline_m / np.maximum(disparity + camera.doffs_px, 1e-3)
        kept &= (depth > settings.nearest_m) & (depth < settings.farthest_baselines * camera.baseline_m)
        if kept.sum() < settings.least_inliers:
            return Failed("no-features", f"only {int(kept.sum())} features have a depth")
        features, disparity = features.chosen(kept), disparity[kept]
        return View(pair, features, disparity, _triangulated(places[kept], disparity, camera))

    def move(self, old: View, new: View, camera: RectifiedCamera) -> Step | Failed:
        settings = self.settings
        pairs = match_mutual(old.features, new.features)
        if len(pairs) < settings.least_inliers:
            return Failed("no-matches", f"only {len(pairs)} features match the frame before")
        places = old.features.pixels[pairs[:, 0]].astype(np.float64)
        guesses = new.features.pixels[pairs[:, 1]].astype(np.float64)
        again = locate(old.pair.left, new.pair.left, places, guesses)
        right = match_across(new.pair, again.pixels, new.disparity[pairs[:, 1]], sure=True)
        kept = again.found & right.found
        pairs, target = pairs[kept], np.column_stack([again.pixels, right.pixels[:, 0]])[kept]
        if len(pairs) < settings.least_inliers:
            return Failed("no-matches", f"only {len(pairs)} features can be followed from the frame before")
        points = old.points[pairs[:, 0]]
        start = ransac(points, target[:, :2], camera, settings)
        if isinstance(start, Failed):
            return start
        rotation, translation = start
        return refine(points, target, rotation, translation, camera, settings)


def _triangulated(pixels: Float64, disparity: Float64, camera: RectifiedCamera) -> Float64:
    depth = camera.focal_px * camera.baseline_m / (disparity + camera.doffs_px)
    x = (pixels[:, 0] - camera.cx_px) / camera.focal_px * depth
    y = (pixels[:, 1] - camera.cy_px) / camera.focal_px * depth
    return np.column_stack([x, y, depth])


def _by_old_places(points: Float64, camera: RectifiedCamera) -> Float64:
    """(N, 3, 3) how triangulated points move with the u, v and u_right that they were seen at, m per px."""
    depth = points[:, 2]
    along_ray = points * (depth / (camera.focal_px * camera.baseline_m))[:, None]
    by_places = np.stack([-along_ray, np.zeros_like(points), along_ray], axis=2)
    by_places[:, 0, 0] += depth / camera.focal_px
    by_places[:, 1, 1] += depth / camera.focal_px
    return by_places


def ransac(
    points: Float64,
    pixels: Float64,
    camera: RectifiedCamera,
    settings: OdometrySettings,
) -> tuple[Float64, Float64] | Failed:
    matrix = np.array([[camera.focal_px, 0, camera.cx_px], [0, camera.focal_px, camera.cy_px], [0, 0, 1]])
    cv2.setRNGSeed(1)
    good, turn, shift, inliers = cv2.solvePnPRansac(
        points,
        np.ascontiguousarray(pixels),
        matrix,
        None,
        iterationsCount=500,
        reprojectionError=settings.ransac_px,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    count = 0 if inliers is None else len(inliers)
    if not good or count < settings.least_inliers:
        return Failed("no-consensus", f"only {count} of {len(points)} matches agree on one motion")
    return Rotation.from_rotvec(turn.ravel()).as_matrix(), shift.ravel()


def refine(
    points: Float64,
    target: Float64,
    rotation: Float64,
    translation: Float64,
    camera: RectifiedCamera,
    settings: OdometrySettings,
) -> Step | Failed:
    """Gauss-Newton on u, v and u_right of the new pair, each residual whitened by its own covariance.

    The noise of the three places that the old point was triangulated from, most of it along its ray, is
    projected into the new pair and widens the residual's covariance. Huber's weights; outliers beyond 5
    sigma leave. The step's covariance is that of a small motion that follows it, in the new frame's axes.
    """
    focal, base = camera.focal_px, camera.focal_px * camera.baseline_m
    variance = settings.pixel_sigma_px**2
    by_old_places = _by_old_places(points, camera)
    kept: Bool = np.ones(len(points), dtype=np.bool_)
    normal = np.eye(6)
    for _ in range(10):
        moved = points @ rotation.T + translation
        in_front = moved[:, 2] > 0.1
        x, y, z = np.where(in_front[:, None], moved, 1.0).T
        u, v = focal * x / z + camera.cx_px, focal * y / z + camera.cy_px
        predicted = np.column_stack([u, v, u - base / z + camera.doffs_px])
        residual = target - predicted
        zero = np.zeros_like(z)
        by_point = np.stack(
            [
                np.stack([focal / z, zero, -focal * x / z**2], axis=1),
                np.stack([zero, focal / z, -focal * y / z**2], axis=1),
                np.stack([focal / z, zero, -focal * x / z**2 + base / z**2], axis=1),
            ],
            axis=1,
        )
        by_turn = -by_point @ _cross(moved)
        jacobian = np.concatenate([by_turn, by_point], axis=2)
        spread = by_point @ rotation @ by_old_places
        covariance = variance * (spread @ spread.transpose(0, 2, 1) + np.eye(3))
        information = np.linalg.inv(covariance)
        distance = np.sqrt(((information @ residual[:, :, None])[:, :, 0] * residual).sum(axis=1))
        kept = (distance < 5.0) & in_front
        if kept.sum() < settings.least_inliers:
            return Failed("no-consensus", f"only {int(kept.sum())} of {len(points)} points agree in 3D")
        weight = np.where(kept, np.minimum(1.0, 1.5 / np.maximum(distance, 1e-9)), 0.0)
        weighted = information * weight[:, None, None]
        rows = jacobian.reshape(-1, 6)
        normal = rows.T @ (weighted @ jacobian).reshape(-1, 6)
        gradient = rows.T @ (weighted @ residual[:, :, None]).reshape(-1)
        update = np.linalg.solve(normal, gradient)
        rotation = Rotation.from_rotvec(update[:3]).as_matrix() @ rotation
        translation = Rotation.from_rotvec(update[:3]).as_matrix() @ translation + update[3:]
        if np.abs(update).max() < 1e-9:
            break
    depth = float(np.median(points[kept, 2]))
    scale_sigma = settings.calibration_sigma_px * depth / base
    return Step(rotation, translation, np.linalg.inv(normal).astype(np.float64), scale_sigma, kept)


def _cross(vectors: Float64) -> Float64:
    """(N, 3) to (N, 3, 3) with `_cross(v) @ w = v x w`."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = [np.stack(row, axis=1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack(rows, axis=1)


def _carried(covariance: Float64, way: Float64) -> Float64:
    """(6, 6) of a pose, rotation then translation in the reference's axes, for a point `way` (m) further on
    that is fixed to it: what the attitude is off by swings the point.
    """
    further = np.eye(6)
    further[3:, :3] = -_cross(way[None])[0]
    result: Float64 = further @ covariance @ further.T
    return result


def _in_world(covariance: Float64, rotation: Float64) -> Float64:
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = rotation
    result: Float64 = turned @ covariance @ turned.T
    return result
