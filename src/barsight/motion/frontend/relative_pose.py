"""Estimate one step of stereo odometry: metric PnP with RANSAC, refined on both pictures; chain
covariances.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.core.linalg.robust import mad_sigma
from barsight.core.pose import skew
from barsight.core.records.pairs import RectifiedCamera
from barsight.features.guided_matching import match_across, project_stereo, triangulation_jacobian
from barsight.features.matching import match_mutual
from barsight.features.patch_alignment import align_patches
from barsight.motion.frontend.relative_pose_kernel import MAX_SIGMAS, step_equations
from barsight.motion.frontend.stereo_features import FeatureView, OdometrySettings

SIDES_APART = "sides-apart"
"""Code of a step whose left pictures agree on a motion that the right ones contradict."""
MIN_AGREE_RATIO, MIN_ASIDE_PX, ASIDE_SPREADS = 0.5, 0.5, 3.0
"""Minimum share of the points whose left pictures agree; minimum offset of the right ones, px (sound yards
show 0.03, from a car 0.18) and in sigma of a point.
"""


@dataclass(frozen=True, eq=False)
class RelativePose:
    """new_from_old: pose of the old `rect0` in the new one, and its covariance (6, 6).

    scale_sigma: relative error of the step's length due to the calibration; it doesn't average out. kept:
    (N,) mask of the points that agree.
    """

    rotation: Float64
    translation: Float64
    covariance: Float64
    scale_sigma: float
    kept: Bool


def estimate_step(old: FeatureView, new: FeatureView, settings: OdometrySettings) -> RelativePose | Failed:
    """Estimate the motion between two views from their mutually matching features."""
    camera = new.pair.pair.camera
    pairs = match_mutual(old.features, new.features)
    if len(pairs) < settings.min_inliers:
        return Failed("no-matches", f"only {len(pairs)} features match the frame before")
    points = old.points(pairs[:, 0], settings)
    known = np.isfinite(points[:, 2])
    pairs, points = pairs[known], points[known]
    places = old.features.pixels[pairs[:, 0]].astype(np.float64)
    guesses = new.features.pixels[pairs[:, 1]].astype(np.float64)
    about = new.about_px[pairs[:, 1]].astype(np.float64)
    grown = points[:, 2] * (about + camera.doffs_px) / (camera.focal_px * camera.baseline_m)
    again = align_patches(old.pair.left, new.pair.left, places, guesses, grown=grown)
    right = match_across(new.pair, again.pixels, about)
    kept = again.found & right.found
    points, target = points[kept], np.column_stack([again.pixels, right.pixels[:, 0]])[kept]
    if len(points) < settings.min_inliers:
        return Failed("no-matches", f"only {len(points)} features can be followed from the frame before")
    start = ransac(points, target[:, :2], camera, settings)
    if isinstance(start, Failed):
        return start
    rotation, translation = start
    failed = check_sides(points, target, rotation, translation, camera, settings)
    return failed or refine_pose(points, target, rotation, translation, camera, settings)


def check_sides(
    points: Float64,
    target: Float64,
    rotation: Float64,
    translation: Float64,
    camera: RectifiedCamera,
    settings: OdometrySettings,
) -> Failed | None:
    """Check that a motion on which the left pictures agree fits the right ones too.

    Cameras that expose at different times while they travel change every depth by the same share, and left
    pictures alone don't show it: in one of the two pairs all right points lie aside by the same amount.
    """
    off = target - project_stereo(points @ rotation.T + translation, camera)
    agree = np.linalg.norm(off[:, :2], axis=1) < settings.ransac_px
    aside = (off[:, 2] - off[:, 0])[agree]
    if agree.mean() < MIN_AGREE_RATIO:
        return None
    middle = float(np.median(aside))
    spread = float(mad_sigma(aside - middle))
    if abs(middle) < max(MIN_ASIDE_PX, ASIDE_SPREADS * spread):
        return None
    return Failed(SIDES_APART, f"the right picture's points lie {middle:.1f} px aside since the frame before")


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
    if not good or count < settings.min_inliers:
        return Failed("no-consensus", f"only {count} of {len(points)} matches agree on one motion")
    return Rotation.from_rotvec(turn.ravel()).as_matrix(), shift.ravel()


def refine_pose(
    points: Float64,
    target: Float64,
    rotation: Float64,
    translation: Float64,
    camera: RectifiedCamera,
    settings: OdometrySettings,
) -> RelativePose | Failed:
    """Refine by Gauss-Newton on u, v and u_right of the new pair, each point's residual whitened by its own
    covariance.

    The noise of the three coordinates that the old point was triangulated from, most of it along its ray, is
    projected into the new pair and added to the residual's covariance. Residuals have Huber weights; outliers
    beyond 5 sigma are removed. The step's covariance is that of a small motion applied after it, in the new
    frame's axes.
    """
    base = camera.focal_px * camera.baseline_m
    lens = np.array([camera.focal_px, camera.cx_px, camera.cy_px, base, camera.doffs_px])
    by_old_places, target = triangulation_jacobian(points, camera), np.ascontiguousarray(target)
    kept: Bool = np.ones(len(points), dtype=np.bool_)
    distance, normal, gradient = np.empty(len(points)), np.empty((6, 6)), np.empty(6)
    for _ in range(10):
        step_equations(
            points, by_old_places, target, rotation, translation, lens, settings.pixel_sigma_px**2, distance,
            normal, gradient,
        )  # fmt: skip
        kept = distance < MAX_SIGMAS
        if kept.sum() < settings.min_inliers:
            return Failed("no-consensus", f"only {int(kept.sum())} of {len(points)} points agree in 3D")
        update = np.linalg.solve(normal, gradient)
        rotation = Rotation.from_rotvec(update[:3]).as_matrix() @ rotation
        translation = Rotation.from_rotvec(update[:3]).as_matrix() @ translation + update[3:]
        if np.abs(update).max() < 1e-9:
            break
    depth = float(np.median(points[kept, 2]))
    scale_sigma = settings.offset_sigma_px * depth / base
    return RelativePose(rotation, translation, np.linalg.inv(normal).astype(np.float64), scale_sigma, kept)


def transport_covariance(covariance: Float64, way: Float64) -> Float64:
    """Transport a pose covariance (6, 6), rotation then translation in the reference's axes, to a point
    rigidly attached at `way` (m): the attitude's error swings that point.
    """
    further = np.eye(6)
    further[3:, :3] = -skew(way)
    result: Float64 = further @ covariance @ further.T
    return result


def rotate_covariance(covariance: Float64, rotation: Float64) -> Float64:
    """Rotate a pose covariance (6, 6) into other axes by a rotation (3, 3)."""
    block_rotation = np.zeros((6, 6))
    block_rotation[:3, :3] = block_rotation[3:, 3:] = rotation
    result: Float64 = block_rotation @ covariance @ block_rotation.T
    return result
