"""Register the world, or the rig, in the yard, and judge the result by targets kept as checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.registration.agreement import DOUBTFUL, find_agreement
from barsight.registration.rigid import Alignment, align_rigid, design_rows

STRANGE = 0.01
"""Probability under the stated sigmas below which residuals that don't contradict them are doubtful."""


@dataclass(frozen=True, eq=False)
class YardCalibration:
    """alignment: yard_from_<frame>, of the points that agree.

    names: (N,) of the points; yard_m: (N, 3) their positions; checks: (N,) those that took no part, or that
    the others contradict. off_m: (N, 3) yard minus moved point; spread_m2: (N, 3, 3) its expected covariance.
    doubts: sentences. disagreement: sentences about all points that forbid the use; mistaken: by the number
    of a point that the others contradict, those that may be mistaken in its place.
    """

    alignment: Alignment
    names: tuple[str, ...]
    yard_m: Float64
    checks: Bool
    off_m: Float64
    spread_m2: Float64
    doubts: tuple[str, ...]
    disagreement: tuple[str, ...]
    mistaken: dict[int, str]

    @property
    def sigma_m(self) -> Float64:
        """Return the expected RMS (N,) of the coordinates of off_m."""
        sigma: Float64 = np.sqrt(np.trace(self.spread_m2, axis1=1, axis2=2) / 3)
        return sigma

    @property
    def rms_m(self) -> float:
        """Return the RMS distance between the points that agree and their yard positions."""
        return float(np.sqrt((self.off_m[~self.checks] ** 2).sum(axis=1).mean()))

    @property
    def contradictions(self) -> tuple[str, ...]:
        """List what forbids the use: disagreement, mistaken points, and checks that are further off than all
        of them together are by chance.
        """
        at = np.flatnonzero(self.checks)
        off = self.off_m[at]
        chi2 = np.einsum("ni,ni->n", off, np.linalg.solve(self.spread_m2[at], off[..., None])[..., 0])
        wrong = at.size * chdtrc(3, chi2) < DOUBTFUL
        return self.disagreement + tuple(
            f"{self.names[k]} is {1e3 * np.linalg.norm(self.off_m[k]):.1f} mm off, its sigma is "
            f"{1e3 * self.sigma_m[k]:.1f} mm{self.mistaken.get(k, '')}"
            for k, is_wrong in zip(at.tolist(), wrong, strict=True)
            if is_wrong or k in self.mistaken
        )

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

    covariance_m2: as in `align_rigid`, yard axes; None estimates one sigma from the residuals. Where each
    point has its own, points that the others contradict become checks. checks: (N,) points that are only
    compared. Failed `few-points`, `collinear`.
    """
    found = _aligned(measured, yard, covariance_m2, ~checks, frame)
    if isinstance(found, Failed):
        return found
    disagreement, mistaken, doubts = list[str](), dict[int, str](), list[str]()
    if covariance_m2 is not None and covariance_m2.ndim == 3:
        disagreement, mistaken, doubts = _judged(names, measured, yard, covariance_m2, ~checks, found)
    if mistaken:
        checks = checks | np.isin(np.arange(len(names)), list(mistaken))
        found = _aligned(measured, yard, covariance_m2, ~checks, frame)
        assert not isinstance(found, Failed)
    off = yard - found.target_from_source.apply(measured)
    design = design_rows(measured @ found.target_from_source.rotation.T)
    own = np.full(len(measured), found.sigma_m**2) if covariance_m2 is None else covariance_m2
    spread = predicted_covariance(design, found.covariance, own, checks)
    doubts += _wrong_metre(found)
    return YardCalibration(
        found, names, yard, checks, off, spread, tuple(doubts), tuple(disagreement), mistaken
    )


def _aligned(
    measured: Float64, yard: Float64, covariance_m2: Float64 | None, used: Bool, frame: str
) -> Alignment | Failed:
    if covariance_m2 is not None:
        covariance_m2 = covariance_m2[np.ix_(used, used)] if covariance_m2.ndim == 2 else covariance_m2[used]
    return align_rigid(measured[used], yard[used], ("yard", frame), covariance_m2)


def _judged(
    names: tuple[str, ...], measured: Float64, yard: Float64, covariance_m2: Float64, used: Bool,
    found: Alignment,
) -> tuple[list[str], dict[int, str], list[str]]:  # fmt: skip
    """Judge the used points by their sigmas. Returns disagreement; mistaken points, each with those that
    may be mistaken in its place; and doubts.
    """
    at = np.flatnonzero(used)
    chosen = measured[at], yard[at], covariance_m2[at]
    agreement = find_agreement(*chosen)
    if agreement.is_whole and not agreement.left_out:
        if agreement.chance >= STRANGE:
            return [], {}, []
        chance, worst = f"chance {100 * agreement.chance:.2g} %", names[at[agreement.worst]]
        return [], {}, [f"the points are off more than their sigmas say ({chance}), {worst} most"]
    scaled = find_agreement(found.scale * chosen[0], *chosen[1:])
    if scaled.is_whole and not scaled.left_out and (told := _wrong_metre(found)):
        mistaken = " or ".join(names[at[k]] for k in agreement.left_out)
        return [told[0] + (f", or {mistaken} is mistaken" if mistaken else "")], {}, []
    if not agreement.is_whole:
        much = f"the points disagree {agreement.disagreement:.1f} times as much as their sigmas say"
        return [f"{much}, and leaving out a few doesn't help"], {}, []
    others = ("".join(f" (or {names[at[j]]} is)" for j in one) for one in agreement.rivals)
    return [], dict(zip(at[list(agreement.left_out)].tolist(), others, strict=True)), []


def _wrong_metre(found: Alignment) -> tuple[str, ...]:
    if abs(found.scale - 1) <= 3 * found.scale_sigma:
        return ()
    return (
        f"the measured points are {100 * (1 / found.scale - 1):+.3f} ± {100 * found.scale_sigma:.3f} % "
        "too large: baseline or survey has a wrong metre (the scale is not corrected)",
    )


def predicted_covariance(design: Float64, covariance: Float64, own_m2: Float64, checks: Bool) -> Float64:
    """Predict the covariance (N, 3, 3) of a point's own noise and, for checks, also of the fit's error there.

    design (N, 3, P): derivatives of the points by the fitted unknowns, covariance (P, P) of these. own_m2:
    variance (N,) of a coordinate, or covariance (N, N) of the points or (N, 3, 3) of the axes.
    """
    if own_m2.ndim < 3:
        own_m2 = (np.diag(own_m2) if own_m2.ndim == 2 else own_m2)[:, None, None] * np.eye(3)
    placed = np.einsum("nij,jk,nlk->nil", design, covariance, design)
    predicted: Float64 = own_m2 + checks[:, None, None] * placed
    return predicted
