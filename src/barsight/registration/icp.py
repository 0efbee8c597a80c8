"""Refinement of a predicted motion by ICP, with what the geometry can't see locked to the prediction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import small_gicp
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64, expect_shape
from barsight.core.errors import ConfigError, Failed
from barsight.core.pose import Pose, skew

LEAST_INLIERS = 100


@dataclass(frozen=True)
class IcpSettings:
    """Refinement by ICP."""

    kind: Literal["plane", "gicp"] = "plane"
    """plane: point to plane. gicp: plane to plane [Segal 2009]."""
    spacing_m: float = 0.03
    """Both clouds are thinned to one point per cube of this side."""
    reach_m: float = 0.1
    """Points further apart than this are no pair."""
    alike_points: int = 20
    """So many neighbouring points have one error in common: they tell as much as one."""
    least_gain: float = 1.0
    """A direction is locked unless the points know it this much better than the prior (variances)."""

    def __post_init__(self) -> None:
        if min(self.spacing_m, self.reach_m, self.least_gain) <= 0 or self.alike_points < 1:
            raise ConfigError("spacing_m, reach_m and least_gain must be positive, alike_points at least 1")


@dataclass(frozen=True, eq=False)
class Refined:
    """target_from_source and its covariance (6, 6): a small rotation from the left, then the translation.

    locked: (K, 6) directions, whitened by the prior, that were left as predicted. furthest_sigma: the largest
    move along a direction in the prior's sigmas; warning: a sentence where it is over 3, else None.
    """

    target_from_source: Pose
    covariance: Float64
    locked: Float64
    furthest_sigma: float
    warning: str | None


def refine(
    source: Float64, target: Float64, prior: Pose, covariance: Float64, settings: IcpSettings
) -> Refined | Failed:
    """Bring source (N, 3) onto target (M, 3), m, from the prediction `prior` with its covariance (6, 6).

    The points' information is ICP's own normal matrix over the residuals' variance. In the directions,
    whitened by the prior, where it gains less than `least_gain` the prediction stays (along the bars there is
    nothing to hold on to); in the others both are weighed by their information. Failed `no-overlap`,
    `no-convergence`.
    """
    expect_shape("source", source, (None, 3))
    expect_shape("target", target, (None, 3))
    expect_shape("covariance", covariance, (6, 6))
    if min(len(source), len(target)) < LEAST_INLIERS:
        return Failed("no-overlap", f"{min(len(source), len(target))} points; {LEAST_INLIERS} are the least")
    # About the source's own middle: far from the origin turn and shift are hardly told apart.
    middle = source.mean(axis=0)
    at = prior.apply(middle)
    start = np.eye(4)
    start[:3, :3] = prior.rotation
    found = small_gicp.align(
        target - at,
        source - middle,
        start,
        registration_type={"plane": "PLANE_ICP", "gicp": "GICP"}[settings.kind],
        downsampling_resolution=settings.spacing_m,
        max_correspondence_distance=settings.reach_m,
        max_iterations=100,
        rotation_epsilon=1e-5,
        translation_epsilon=1e-4,
    )
    if found.num_inliers < LEAST_INLIERS:
        return Failed(
            "no-overlap", f"only {found.num_inliers} points lie within {settings.reach_m} m of the target"
        )
    if not found.converged:
        return Failed("no-convergence", f"ICP didn't settle in {found.iterations} iterations")
    turned = block_diag(prior.rotation, prior.rotation)
    variance = 2 * found.error / (found.num_inliers - 6) * settings.alike_points
    information = turned @ found.H @ turned.T / variance
    moved = found.T_target_source
    move = np.r_[Rotation.from_matrix(moved[:3, :3] @ prior.rotation.T).as_rotvec(), moved[:3, 3]]

    carry = np.eye(6)
    carry[3:, :3] = -skew(at - prior.translation)
    root = np.linalg.cholesky(carry @ covariance @ carry.T)
    gain, axes = np.linalg.eigh(root.T @ information @ root)
    along = axes.T @ np.linalg.solve(root, move)
    free = gain >= settings.least_gain
    share = np.where(free, gain / (1 + gain), 0.0)
    furthest = float(np.abs(np.where(free, along, 0.0)).max())
    step = root @ axes @ (share * along)
    rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ prior.rotation
    pose = Pose(prior.target, prior.source, rotation, at + step[3:] - rotation @ middle)
    back = np.eye(6)
    back[3:, :3] = skew(at - prior.translation)
    spread = back @ root @ axes
    warning = f"ICP moved the pose by {furthest:.1f} sigma of its prediction" if furthest > 3 else None
    return Refined(pose, (spread * (1 - share)) @ spread.T, axes[:, ~free].T, furthest, warning)
