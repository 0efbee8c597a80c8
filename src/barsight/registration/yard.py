"""Register the world, or the rig, in the yard, and judge the result by targets kept as checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.registration.rigid import Alignment, align_rigid, design_rows

DOUBTFUL = 0.001
"""Probability of the residuals under the stated sigmas below which these are too small, or a point is
wrong.
"""


@dataclass(frozen=True, eq=False)
class YardCalibration:
    """alignment: yard_from_<frame>, its covariance scaled by `inflation` where the residuals require it.

    names: (N,) of the points; yard_m: (N, 3) their positions; checks: (N,) those that took no part. off_m:
    (N, 3) yard minus moved point; sigma_m: (N,) expected RMS of its coordinates (1 sigma). doubts: sentences.
    """

    alignment: Alignment
    inflation: float
    names: tuple[str, ...]
    yard_m: Float64
    checks: Bool
    off_m: Float64
    sigma_m: Float64
    doubts: tuple[str, ...]

    @property
    def turn_sigma_deg(self) -> float:
        """Return the standard deviation of the frame's rotation about its worst axis, degrees."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.alignment.covariance[:3, :3])[-1])))

    @property
    def place_sigma_m(self) -> float:
        """Return the standard deviation of the frame's origin in the yard along its worst axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.alignment.covariance[3:, 3:])[-1]))


def calibrate_yard(
    names: tuple[str, ...], measured: Float64, yard: Float64, covariance_m2: Float64 | None, checks: Bool,
    frame: str,
) -> YardCalibration | Failed:  # fmt: skip
    """Estimate `yard_from_<frame>` from points measured in `frame` (N, 3) and known in the yard (N, 3), m.

    covariance_m2: as in `align_rigid`, yard axes; None estimates one sigma from the residuals. checks: (N,)
    points that are only compared. Failed `few-points`, `collinear`.
    """
    used = ~checks
    covariance = covariance_m2
    if covariance is not None:
        covariance = covariance[np.ix_(used, used)] if covariance.ndim == 2 else covariance[used]
    found = align_rigid(measured[used], yard[used], ("yard", frame), covariance)
    if isinstance(found, Failed):
        return found
    doubts: list[str] = []
    inflation = 1.0
    free = found.degrees_of_freedom
    if covariance is not None and free > 0 and chdtrc(free, found.chi2) < DOUBTFUL:
        inflation = found.chi2 / free
        doubts.append(
            f"the points disagree {(found.chi2 / free) ** 0.5:.1f} times as much as their sigmas say: "
            "a target is mistaken or moved; the stated sigma grows by that"
        )
    scaled = Alignment(
        found.target_from_source, inflation * found.covariance, found.residuals_m, found.scale,
        inflation**0.5 * found.scale_sigma, found.sigma_m, found.chi2,
    )  # fmt: skip
    if abs(scaled.scale - 1) > 3 * scaled.scale_sigma:
        doubts.append(
            f"the measured points are {100 * (1 / scaled.scale - 1):+.3f} ± {100 * scaled.scale_sigma:.3f} % "
            "too large: baseline or survey has a wrong metre (the scale is not corrected)"
        )
    off = yard - scaled.target_from_source.apply(measured)
    design = design_rows(measured @ scaled.target_from_source.rotation.T)
    own = np.full(len(measured), scaled.sigma_m**2) if covariance_m2 is None else covariance_m2
    sigma = predicted_sigma(design, scaled.covariance, own, checks)
    length = np.linalg.norm(off, axis=1)
    doubts += [
        f"check {names[k]} is {1e3 * length[k]:.1f} mm off, its sigma is {1e3 * sigma[k]:.1f} mm"
        for k in np.flatnonzero(checks & (length > 4 * sigma))
    ]
    return YardCalibration(scaled, inflation, names, yard, checks, off, sigma, tuple(doubts))


def predicted_sigma(design: Float64, covariance: Float64, own_m2: Float64, checks: Bool) -> Float64:
    """Predict the RMS (N,) over the axes of a point's own noise and, for checks, also of the fit's error
    there.

    design (N, 3, P): derivatives of the points by the fitted unknowns, covariance (P, P) of these. own_m2:
    variance (N,) of a coordinate, or covariance (N, N) of the points or (N, 3, 3) of the axes.
    """
    if own_m2.ndim == 2:
        own_m2 = np.diag(own_m2)
    elif own_m2.ndim == 3:
        own_m2 = np.trace(own_m2, axis1=1, axis2=2) / 3
    placed = np.einsum("nij,jk,nik->n", design, covariance, design) / 3
    sigma: Float64 = np.sqrt(own_m2 + np.where(checks, placed, 0.0))
    return sigma
