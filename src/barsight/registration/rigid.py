"""Align two sets of matched points rigidly, with covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64, expect_shape
from barsight.core.errors import Failed
from barsight.core.pose import Pose, nearest_rotation, skew

MIN_POINTS = 3
MIN_WIDTH = 0.01
"""Minimum ratio of the points' width to their length, below which the turn about their line is
undetermined.
"""
ROUNDS, ROUNDING = 5, 1e-9
"""Maximum number of Gauss-Newton steps after the closed form, and the relative increase of chi2 allowed for
rounding.
"""


@dataclass(frozen=True, eq=False)
class Alignment:
    """target_from_source, and its uncertainty.

    covariance: (6, 6), a small rotation (rad) from the left, then the translation (m), both in target axes.
    residuals_m: (N, 3) target minus moved source. scale, scale_sigma: the scale that a similarity would have
    found instead of 1, for diagnosis only. sigma_m: noise of a coordinate according to the residuals. chi2:
    of the residuals with the stated covariances, NaN where there are none.
    """

    target_from_source: Pose
    covariance: Float64
    residuals_m: Float64
    scale: float
    scale_sigma: float
    sigma_m: float
    chi2: float

    @property
    def degrees_of_freedom(self) -> int:
        """Return the degrees of freedom of chi2: the number of coordinates minus the six unknowns."""
        return self.residuals_m.size - 6


def align_rigid(
    source: Float64, target: Float64, frames: tuple[str, str], covariance_m2: Float64 | None = None
) -> Alignment | Failed:
    """Align `source` (N, 3) rigidly with `target` (N, 3), m [paper Eq. 13-20, see below].

    frames: (target, source). covariance_m2: (N, 3, 3) of each pair's difference, target axes, or (N, N) of
    the points, the same on each axis. Points are first weighted by its trace, then by all of it (`_refined`),
    so that chi2 has its degrees of freedom. Without it all have the same weight, and a common sigma is
    estimated from the residuals: errors divided by that follow Student's t distribution, of which the
    covariance is the variance. The rotation is the one nearest to sum p'' q''^T; the paper prints its
    transpose. Failed `few-points`, `collinear`.
    """
    expect_shape("source", source, (None, 3))
    expect_shape("target", target, (len(source), 3))
    if len(source) < MIN_POINTS:
        return Failed("few-points", f"{len(source)} pairs of points; {MIN_POINTS} are the least")
    weight = np.ones(len(source))
    together = covariance_m2 is not None and covariance_m2.ndim == 2
    if covariance_m2 is not None:
        expect_shape("covariance_m2", covariance_m2, (len(source),) * 2 if together else (len(source), 3, 3))
    if covariance_m2 is not None and not together:
        weight = 3 / np.trace(covariance_m2, axis1=1, axis2=2)
    q, p = source - np.average(source, 0, weight), target - np.average(target, 0, weight)
    line = _line(q, weight)
    if line is not None:
        return line
    moment = p.T @ (weight[:, None] * q)
    rotation = nearest_rotation(moment)
    shift = np.average(target, 0, weight) - rotation @ np.average(source, 0, weight)
    pose = Pose(*frames, rotation, shift)
    if covariance_m2 is not None:
        pose = _refined(source, target, pose, covariance_m2)
    rotation = pose.rotation
    residuals = target - pose.apply(source)
    extent = float((weight * (q**2).sum(1)).sum())

    free = residuals.size - 6
    sigma = float(np.sqrt((weight[:, None] * residuals**2).sum() / free / weight.mean()))
    spread, chi2 = np.broadcast_to(np.eye(3), (len(source), 3, 3)), np.nan
    known = sigma**2 * free / (free - 2)
    if covariance_m2 is not None:
        spread, known = covariance_m2, 1.0
        chi2 = float((residuals * _divided(residuals, spread)).sum())
    weighted = weight[:, None] * (q @ rotation.T)
    along = known * float((weighted * _times(spread, weighted)).sum())
    return Alignment(
        pose,
        known * _covariance(source @ rotation.T, spread),
        residuals,
        float((rotation * moment).sum()) / extent,
        float(np.sqrt(along)) / extent,
        sigma,
        chi2,
    )


def _line(centred: Float64, weight: Float64) -> Failed | None:
    """Return Failed where the points lie on a line."""
    spread = np.sqrt(weight / weight.sum())[:, None] * centred
    length, width, _ = np.linalg.svd(spread, full_matrices=False)[1]
    if length > 0 and width >= MIN_WIDTH * length:
        return None
    return Failed(
        "collinear",
        f"the points lie on a line ({1e3 * width:.1f} mm wide, {length:.2f} m long, RMS): "
        "the turn about it can't be seen",
    )


def design_rows(turned: Float64) -> Float64:
    """Compute Jacobians (N, 3, 6) of points (N, 3), given about their centre, by a small turn and a shift."""
    return np.concatenate([-skew(turned), np.broadcast_to(np.eye(3), (len(turned), 3, 3))], axis=2)


def _times(spread: Float64, values: Float64) -> Float64:
    """Multiply a covariance, (N, 3, 3) or (N, N), by values (N, 3, ...)."""
    if spread.ndim == 2:
        return np.tensordot(spread, values, 1)
    product: Float64 = np.einsum("nij,nj...->ni...", spread, values)
    return product


def _divided(values: Float64, spread: Float64) -> Float64:
    """Multiply values (N, 3, ...) by the inverse of a covariance, (N, 3, 3) or (N, N)."""
    rows = values.reshape(len(values), -1) if spread.ndim == 2 else values.reshape(len(values), 3, -1)
    solved = np.linalg.solve(spread, rows)
    return np.asarray(solved, np.float64).reshape(values.shape)


def _refined(source: Float64, target: Float64, pose: Pose, spread: Float64) -> Pose:
    """Refine a pose by least squares with the points' covariance S: it minimises r^T S^-1 r, where r are the
    residuals [Aitken 1936]. A step that increases it, as a wrong point may cause, isn't taken.
    """
    off = target - pose.apply(source)
    for _ in range(ROUNDS):
        rotated = source @ pose.rotation.T
        centre = rotated.mean(axis=0)
        design = design_rows(rotated - centre)
        weighted = _divided(design, spread)
        normal = np.einsum("nki,nkj->ij", design, weighted)
        step = np.linalg.solve(normal, np.einsum("nki,nk->i", weighted, off))
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        shift = pose.translation + centre - turn @ centre + step[3:]
        trial = Pose(pose.target, pose.source, turn @ pose.rotation, shift)
        left = target - trial.apply(source)
        after, before = ((one * _divided(one, spread)).sum() for one in (left, off))
        if not after <= before * (1 + ROUNDING):
            break
        pose, off = trial, left
    return pose


def _covariance(rotated: Float64, spread: Float64) -> Float64:
    """Compute the covariance (J^T S^-1 J)^-1 (6, 6) of least squares with a covariance S, (N, 3, 3) or (N,
    N).

    rotated: (N, 3) points from the source's origin, target axes.
    """
    centre = rotated.mean(axis=0)
    design = design_rows(rotated - centre)
    bread = np.linalg.inv(np.einsum("nki,nkj->ij", design, _divided(design, spread)))
    move = np.eye(6)
    # A turn about the points' centre also moves the source's origin.
    move[3:, :3] = skew(centre)
    covariance: Float64 = move @ bread @ move.T
    return covariance
