"""Test points against their stated covariances, and find those that the others contradict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.errors import Failed
from barsight.registration.rigid import MIN_POINTS, Alignment, align_rigid, design_rows

DOUBTFUL = 0.001
"""Probability under the stated covariances below which points contradict one another."""
MAX_LEFT_OUT = 20
"""Maximum number of points that are left out; where more would have to be, the list as a whole is wrong."""
RIVAL_CHI2 = -2 * np.log(DOUBTFUL)
"""Largest difference in chi2 between two points either of which may be the mistaken one."""


@dataclass(frozen=True, eq=False)
class PointAgreement:
    """The points (N,) that agree, and those left out for it, the worst first. is_whole: whether the agreeing
    points do so; where not, no minority of the points explains the disagreement, and none is left out.

    chance: probability of residuals as large as those of all points; worst: the point that stands out most;
    disagreement: their RMS, in stated sigmas. rivals: per point left out, those that may be mistaken in its
    place.
    """

    agreeing: Bool
    left_out: tuple[int, ...]
    rivals: tuple[tuple[int, ...], ...]
    is_whole: bool
    chance: float
    worst: int
    disagreement: float


def find_agreement(source: Float64, target: Float64, covariance_m2: Float64) -> PointAgreement:
    """Leave out points until the residuals of the others are as small as stated [data snooping: Baarda 1968].

    source, target (N, 3): matched points; covariance_m2 (N, 3, 3): of each pair's difference, target axes.
    Tested are chi2 of all residuals and, for each point, the part of it that goes when that is left out. Less
    than half of the points are left out, at most MAX_LEFT_OUT, and three or more stay.
    """
    count = len(source)
    kept, out, rivals = np.ones(count, np.bool_), list[int](), list[tuple[int, ...]]()
    first: tuple[float, int, float] | None = None
    while True:
        here = np.flatnonzero(kept)
        found = align_rigid(source[kept], target[kept], ("target", "source"), covariance_m2[kept])
        if isinstance(found, Failed):
            break
        gone = _chi2_gone(found, source[kept], covariance_m2[kept])
        worst = int(gone.argmax())
        free = found.degrees_of_freedom
        chance = float(min(chdtrc(free, found.chi2), here.size * chdtrc(3, gone[worst])))
        first = first or (chance, worst, float(np.sqrt(found.chi2 / free)))
        if chance >= DOUBTFUL:
            return PointAgreement(kept, tuple(out), tuple(rivals), True, *first)
        if here.size <= max(MIN_POINTS, count // 2 + 1, count - MAX_LEFT_OUT):
            break
        near: Int64 = here[gone > gone[worst] - RIVAL_CHI2]
        rivals.append(tuple(int(k) for k in near if k != here[worst]))
        out.append(int(here[worst]))
        kept[here[worst]] = False
    return PointAgreement(np.ones(count, np.bool_), (), (), False, *(first or (0.0, 0, np.inf)))


def _chi2_gone(found: Alignment, source: Float64, spread: Float64) -> Float64:
    """Compute by how much chi2 falls (N,) when each point is left out."""
    turned = source @ found.target_from_source.rotation.T
    design = design_rows(turned - turned.mean(axis=0))
    normal = np.einsum("nki,nkj->ij", design, np.linalg.solve(spread, design))
    own = spread - design @ np.linalg.inv(normal) @ design.transpose(0, 2, 1)
    # A direction in which a point alone determines the frame has no residual.
    inverse = np.linalg.pinv(own, rcond=1e-6, hermitian=True)
    gone: Float64 = np.einsum("ni,nij,nj->n", found.residuals_m, inverse, found.residuals_m)
    return gone
