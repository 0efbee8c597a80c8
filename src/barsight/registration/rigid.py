"""The rigid motion between two sets of matched points, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64, expect_shape
from barsight.core.errors import Failed
from barsight.core.pose import Pose

LEAST_POINTS = 3
LEAST_WIDTH = 0.01
"""Points that stray less than this share of their length from a line leave the turn about it open."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """target_from_source, and how well it is known.

    covariance: (6, 6), a small rotation (rad) from the left, then the translation (m), both in target axes.
    residuals_m: (N, 3) target minus moved source. scale, scale_sigma: what a similarity would have found
    instead of 1, a diagnosis only. sigma_m: one coordinate's noise as the residuals show it (NaN for three
    points in a plane fit exactly). chi2: of the residuals by the stated covariances, NaN where none are.
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
        """Of chi2: the coordinates beyond the six unknowns."""
        return self.residuals_m.size - 6


def align(
    source: Float64, target: Float64, frames: tuple[str, str], covariance_m2: Float64 | None = None
) -> Alignment | Failed:
    """The motion that brings `source` (N, 3) onto `target` (N, 3), m [paper Eq. 13-20, see below].

    frames: (target, source). covariance_m2: (N, 3, 3) of each pair's difference, target axes; points count
    by its trace, and the stated covariance follows from it whole. Without it all count alike and one sigma
    for all is taken from the residuals.
    W = sum q'' p''^T = U S V^T is minimised by R = V diag(1, 1, det(V U^T)) U^T [Arun 1987, Umeyama 1991];
    the paper prints its transpose. Failed `few-points`, `collinear`.
    """
    expect_shape("source", source, (None, 3))
    expect_shape("target", target, (len(source), 3))
    if len(source) < LEAST_POINTS:
        return Failed("few-points", f"{len(source)} pairs of points; {LEAST_POINTS} are the least")
    weight = np.ones(len(source))
    if covariance_m2 is not None:
        expect_shape("covariance_m2", covariance_m2, (len(source), 3, 3))
        weight = 3 / np.trace(covariance_m2, axis1=1, axis2=2)
    q, p = source - np.average(source, 0, weight), target - np.average(target, 0, weight)
    line = _line(q, weight)
    if line is not None:
        return line
    u, stretch, vt = np.linalg.svd((weight[:, None] * q).T @ p)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ (sign[:, None] * u.T)
    centre = np.average(target, 0, weight)
    translation = centre - rotation @ np.average(source, 0, weight)
    residuals = target - source @ rotation.T - translation
    extent = float((weight * (q**2).sum(1)).sum())
    turned = q @ rotation.T

    free = max(residuals.size - 6, 0)
    sigma = float(np.sqrt((weight[:, None] * residuals**2).sum() / free / weight.mean())) if free else np.nan
    spread, chi2 = np.eye(3)[None] * sigma**2, np.nan
    if covariance_m2 is not None:
        spread = covariance_m2
        chi2 = float(np.einsum("ni,nij,nj->", residuals, np.linalg.inv(spread), residuals))
    along = np.einsum("ni,nij,nj->n", turned, np.broadcast_to(spread, (len(q), 3, 3)), turned)
    return Alignment(
        Pose(*frames, rotation, translation),
        _covariance(turned, centre - translation, weight, spread),
        residuals,
        float(sign @ stretch) / extent,
        float(np.sqrt((weight**2 * along).sum())) / extent,
        sigma,
        chi2,
    )


def _line(centred: Float64, weight: Float64) -> Failed | None:
    """Failed where the points lie on a line."""
    spread = np.sqrt(weight / weight.sum())[:, None] * centred
    length, width, _ = np.linalg.svd(spread, full_matrices=False)[1]
    if length > 0 and width >= LEAST_WIDTH * length:
        return None
    return Failed(
        "collinear",
        f"the points lie on a line ({1e3 * width:.1f} mm wide, {length:.2f} m long, RMS): "
        "the turn about it can't be seen",
    )


def _covariance(turned: Float64, centre: Float64, weight: Float64, spread: Float64) -> Float64:
    """(6, 6): A^-1 B A^-1 of weighted least squares. centre: (3,) from the source's origin, target axes."""
    x, y, z = turned.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    design = np.concatenate([cross, np.broadcast_to(np.eye(3), (len(x), 3, 3))], axis=2)
    normal = np.einsum("n,nki,nkj->ij", weight, design, design)
    noise = np.einsum("n,nki,nkl,nlj->ij", weight**2, design, np.broadcast_to(spread, (len(x), 3, 3)), design)
    bread = np.linalg.inv(normal)
    a, b, c = centre
    move = np.eye(6)
    # A turn about the points' centre carries the source's origin along.
    move[3:, :3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]]
    covariance: Float64 = move @ bread @ noise @ bread @ move.T
    return covariance
