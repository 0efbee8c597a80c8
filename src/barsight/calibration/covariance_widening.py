"""The covariance of common parameters where residuals hang together more than independent noise would."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64

WIDENED_FROM = 3.0
"""Standard deviations of its own scatter by which the groups' correlation must stand out to widen sigmas."""


def widened(
    inverse: Float64, variance: float, scores: Float64, informations: Float64
) -> tuple[Float64, float]:
    """(covariance (C, C), correlation: the factor on the variances, 1 for none).

    inverse: (C, C) of the whole information at unit weights; variance: the residuals'. scores (G, C) and
    informations (G, C, C): each group's (a view's, a second's) share of gradient and information. A group
    pulls the parameters by inverse @ score. Under independent noise these pulls add up to the covariance
    variance * inverse, but for the share that the groups' own leverage takes. Where they scatter clearly
    more, their own covariance takes its place (the sandwich estimator over groups), shrunk towards the
    multiple of the former with the same trace [Ledoit and Wolf 2004], as groups are often fewer than
    parameters.
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
