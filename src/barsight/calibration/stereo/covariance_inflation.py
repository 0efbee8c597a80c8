"""Widen a covariance for correlated residuals with a cluster-robust sandwich estimator."""

from __future__ import annotations

import numpy as np

from barsight.calibration.stereo.bundle_adjustment import AdjustmentResult
from barsight.core.arrays import Float64

WIDENED_FROM = 3.0
"""Minimum excess of the groups' correlation, in standard deviations of its estimate, at which sigmas are
widened.
"""


def inflate_covariance(
    inverse: Float64, variance: float, scores: Float64, informations: Float64
) -> tuple[Float64, float]:
    """Compute the cluster-robust covariance (C, C) and the variance inflation (1 for none).

    inverse: (C, C) inverse of the total information at unit weights. variance: that of the residuals. scores
    (G, C), informations (G, C, C): share of each group (a view or a second) in gradient and information. Each
    group pulls the parameters by inverse @ score. Under independent noise these pulls add up to the
    covariance variance * inverse, apart from the groups' own leverage. Where they scatter significantly more,
    the sandwich estimator over the groups replaces it. It is shrunk towards the multiple of the former with
    the same trace [Ledoit and Wolf 2004], because groups are often fewer than parameters.
    """
    groups, size = scores.shape
    covariance = inverse * variance
    scale = np.sqrt(np.diag(covariance))
    factor = scale[:, None] * np.linalg.cholesky(covariance / scale[:, None] / scale)
    shares = inverse @ informations
    expected = float(np.trace(shares, axis1=1, axis2=2).sum() - np.einsum("vij,vji->", shares, shares))
    pulls = np.linalg.solve(factor, inverse @ scores.T).T * np.sqrt(groups * size / max(expected, 1e-9))
    spread = pulls.T @ pulls / groups
    correlation = float(np.trace(spread)) / size
    if correlation <= 1 + WIDENED_FROM * np.sqrt(4 / (size * groups)):
        return covariance, 1.0
    apart = float(((spread - correlation * np.eye(size)) ** 2).sum())
    noise = float(((pulls**2).sum(axis=1) ** 2).sum() / groups - (spread**2).sum()) / groups
    shrink = min(max(noise / apart, 0.0), 1.0)
    wide = shrink * correlation * np.eye(size) + (1 - shrink) * spread
    return factor @ wide @ factor.T, correlation


def common_covariance(solved: AdjustmentResult, corners: int, views: int) -> tuple[Float64, float, float]:
    """Compute covariance (C, C), sigma_px and inflation of the common parameters, with the board's shape
    last.

    The covariance is widened where the residuals within views are correlated.
    """
    residuals = np.concatenate(solved.residuals_px)
    freedom = 2 * corners - solved.reduced.shape[0] - 6 * views
    variance = float((residuals**2).sum() / max(freedom, 1))
    inverse = scaled_inverse(solved.reduced)
    covariance, correlation = inflate_covariance(inverse, variance, solved.scores, solved.view_reduced)
    return covariance, float(np.sqrt(variance)), correlation


def scaled_inverse(matrix: Float64) -> Float64:
    """Invert a symmetric positive definite matrix whose parameters have very different scales.

    Raises LinAlgError where a direction is not determined.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    unit = matrix * scale[:, None] * scale
    values, vectors = np.linalg.eigh(unit)
    if values[0] < 1e-13 * values[-1]:
        raise np.linalg.LinAlgError("undetermined")
    inverse: Float64 = (vectors / values) @ vectors.T * scale[:, None] * scale
    return inverse
