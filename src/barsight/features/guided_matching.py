"""Match by predicted motion: known 3D points are searched for only inside their predicted ellipses.

All bars look alike: wrong matches one bar further agree with each other as well as the true ones do. So each
point is moved by the predicted motion, and only what lies in its predicted ellipse is a match.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.core.pose import skew
from barsight.core.records.pairs import RectifiedCamera
from barsight.features.patch_alignment import (
    FINE_REACH_PX,
    AlignedPatches,
    PatchImage,
    PatchPair,
    align_patches,
)

GATE_SIGMAS = 4.0
MAX_OFF_ROW_PX = 1.0
MARGIN_PX = 8.0
"""Minimum distance from the picture's border at which a patch and its spline's support lie fully inside."""


@dataclass(frozen=True, eq=False)
class PredictedMotion:
    """new_from_old: rotation (3, 3) and translation (3,) of `rect0`. covariance: (6, 6), rotation then
    translation, of a small motion applied after it, in the new frame's axes.
    """

    rotation: Float64
    translation: Float64
    covariance: Float64


@dataclass(frozen=True, eq=False)
class PredictedProjections:
    """Predicted projections of N points into the new pair. stereo: (N, 3) u, v and right u, px, NaN behind
    the camera.

    covariance: (N, 3, 3) px^2 of the prediction. inside: (N,) whether both pictures contain the point.
    """

    stereo: Float64
    covariance: Float64
    inside: Bool

    @property
    def reach_px(self) -> Float64:
        """Return the standard deviation (N,) of the predicted position along the ellipse's longer axis."""
        result: Float64 = np.sqrt(np.linalg.eigvalsh(self.covariance[:, :2, :2])[:, 1])
        return result


@dataclass(frozen=True, eq=False)
class GuidedMatches:
    """stereo: (N, 3) u, v, right u where found, sigma_px: (N,) of each. found: (N,). ambiguous: (N,) rejected
    because the ellipse is not clearly smaller than the pattern's period.
    """

    stereo: Float64
    sigma_px: Float64
    found: Bool
    ambiguous: Bool


def project_stereo(points: Float64, camera: RectifiedCamera) -> Float64:
    """Project points (N, 3) in `rect0` to u, v and right u (N, 3), px; NaN behind the camera."""
    x, y, z = points.T
    depth = np.where(z > 0.05, z, np.nan)
    u, v = camera.focal_px * x / depth + camera.cx_px, camera.focal_px * y / depth + camera.cy_px
    return np.column_stack([u, v, u - camera.focal_px * camera.baseline_m / depth + camera.doffs_px])


def triangulate_stereo(stereo: Float64, camera: RectifiedCamera) -> Float64:
    """Invert `project_stereo`: (N, 3) m, NaN where the disparity is not positive."""
    disparity = stereo[:, 0] - stereo[:, 2] + camera.doffs_px
    depth = camera.focal_px * camera.baseline_m / np.where(disparity > 1e-3, disparity, np.nan)
    x = (stereo[:, 0] - camera.cx_px) / camera.focal_px * depth
    y = (stereo[:, 1] - camera.cy_px) / camera.focal_px * depth
    return np.column_stack([x, y, depth])


def stereo_jacobian(points: Float64, camera: RectifiedCamera) -> Float64:
    """Differentiate `project_stereo` by the points (N, 3, 3), px per m."""
    x, y, z = points.T
    f, zero = camera.focal_px, np.zeros(len(points))
    by_u = np.stack([f / z, zero, -f * x / z**2], axis=1)
    by_v = np.stack([zero, f / z, -f * y / z**2], axis=1)
    by_right = by_u + np.stack([zero, zero, f * camera.baseline_m / z**2], axis=1)
    return np.stack([by_u, by_v, by_right], axis=1)


def triangulation_jacobian(points: Float64, camera: RectifiedCamera) -> Float64:
    """Differentiate `triangulate_stereo` by u, v and right u (N, 3, 3), m per px."""
    depth = points[:, 2]
    along_ray = points * (depth / (camera.focal_px * camera.baseline_m))[:, None]
    by_places = np.stack([-along_ray, np.zeros_like(points), along_ray], axis=2)
    by_places[:, 0, 0] += depth / camera.focal_px
    by_places[:, 1, 1] += depth / camera.focal_px
    return by_places


def predict_projections(
    points: Float64,
    sigma_px: float | Float64,
    motion: PredictedMotion,
    camera: RectifiedCamera,
) -> PredictedProjections:
    """Predict projections of points (N, 3) in the old `rect0`, seen there with noise `sigma_px` in u, v and
    right u, a number or (N, 3).
    """
    moved = points @ motion.rotation.T + motion.translation
    stereo = project_stereo(moved, camera)
    safe = np.where(np.isfinite(stereo[:, :1]), moved, [0.0, 0.0, 1.0])
    by_point = stereo_jacobian(safe, camera)
    by_motion = np.concatenate([by_point @ -skew(safe), by_point], axis=2)
    covariance = by_motion @ motion.covariance @ by_motion.transpose(0, 2, 1)
    old = by_point @ motion.rotation @ triangulation_jacobian(points, camera)
    variance = np.broadcast_to(np.square(sigma_px), (len(points), 3))
    covariance += (old * variance[:, None, :]) @ old.transpose(0, 2, 1)
    with np.errstate(invalid="ignore"):
        inside: Bool = (stereo[:, [0, 2]] > MARGIN_PX).all(1) & (stereo[:, 1] > MARGIN_PX)
        inside &= (stereo[:, [0, 2]] < camera.width - MARGIN_PX).all(1)
        inside &= stereo[:, 1] < camera.height - MARGIN_PX
    return PredictedProjections(stereo, covariance, inside)


def match_guided(
    source: PatchImage, places: Float64, depth: Float64, pair: PatchPair, predicted: PredictedProjections,
    sigma_px: float, repeat_px: Float64 | None = None,
) -> GuidedMatches:  # fmt: skip
    """Match the patches of `source` at `places` (N, 2), at depth (N,) m, in both pictures of `pair`.

    The search starts at the predicted position in the left picture, with the full-size pictures alone where
    the predictions are precise enough, and goes on across to the right one. repeat_px: (N,) distance at which
    each patch repeats (the bars' pitch); an ellipse whose 2 sigma exceed a quarter of it is ambiguous.
    """
    count = len(places)
    ambiguous = np.zeros(count, dtype=np.bool_)
    if repeat_px is not None:
        ambiguous = predicted.inside & (2 * predicted.reach_px > repeat_px / 4)
    stereo, sigma = np.full((count, 3), np.nan), np.full(count, np.nan)
    found = np.zeros(count, dtype=np.bool_)
    tried = np.flatnonzero(predicted.inside & ~ambiguous)
    if tried.size == 0:
        return GuidedMatches(stereo, sigma, found, ambiguous)
    guess = predicted.stereo[tried]
    disparity = guess[:, 0] - guess[:, 2]
    camera = pair.pair.camera
    now = camera.focal_px * camera.baseline_m / (disparity + camera.doffs_px)
    sure = bool(GATE_SIGMAS * np.quantile(predicted.reach_px[tried], 0.9) < FINE_REACH_PX)
    left = align_patches(source, pair.left, places[tried], guess[:, :2], sure, grown=depth[tried] / now)
    right = match_across(pair, left.pixels, disparity, sure=True)
    stereo[tried] = np.column_stack([left.pixels, right.pixels[:, 0]])
    sigma[tried] = np.hypot(left.sigma_px, right.sigma_px) / 2**0.5
    off = stereo[tried] - guess
    spread = predicted.covariance[tried] + sigma_px**2 * np.eye(3)
    distance2 = np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off)
    found[tried] = left.found & right.found & (distance2 < GATE_SIGMAS**2)
    return GuidedMatches(stereo, sigma, found, ambiguous)


def match_left(
    source: PatchImage, places: Float64, depth: Float64, pair: PatchPair, predicted: PredictedProjections,
    sigma_px: float, repeat_px: Float64,
) -> tuple[Float64, Bool]:  # fmt: skip
    """Match patches in the left picture of `pair` alone: places (N, 2), found (N,).

    Works as `match_guided`, but needs a prediction already checked by consensus, since one picture alone
    doesn't check the depth.
    """
    camera, guess = pair.pair.camera, predicted.stereo
    with np.errstate(invalid="ignore"):
        shown = (guess[:, :2] > MARGIN_PX).all(axis=1) & (2 * predicted.reach_px < repeat_px / 4)
        shown &= (guess[:, :2] < np.array([camera.width, camera.height]) - MARGIN_PX).all(axis=1)
    pixels, found = np.full((len(places), 2), np.nan), np.zeros(len(places), np.bool_)
    tried = np.flatnonzero(shown)
    disparity = guess[tried, 0] - guess[tried, 2]
    now = camera.focal_px * camera.baseline_m / (disparity + camera.doffs_px)
    left = align_patches(source, pair.left, places[tried], guess[tried, :2], grown=depth[tried] / now)
    off = left.pixels - guess[tried, :2]
    spread = predicted.covariance[tried, :2, :2] + sigma_px**2 * np.eye(2)
    distance2 = np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off)
    pixels[tried], found[tried] = left.pixels, left.found & (distance2 < GATE_SIGMAS**2)
    return pixels, found


def match_across(pair: PatchPair, left: Float64, disparity: Float64, sure: bool = False) -> AlignedPatches:
    """Match left positions (N, 2) of roughly known disparity (N,) in the right picture, on their row only.

    sure: the disparities are correct to a pixel or two.
    """
    guess = np.column_stack([left[:, 0] - disparity, left[:, 1]])
    right = align_patches(pair.left, pair.right, left, guess, sure)
    return replace(right, found=right.found & (np.abs(right.pixels[:, 1] - left[:, 1]) < MAX_OFF_ROW_PX))
