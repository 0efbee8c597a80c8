"""The rig's drift in the batch estimate: a yaw between the cameras and a scale, unknowns like the poses.

The same point seen from several places of a known way has a depth without stereo; the disparity that this
depth asks for against the measured one shows the yaw (px nearly the same everywhere) and the scale (px in
proportion to the disparity).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from barsight.core.arrays import Bool, Float64
from barsight.core.types import RigDrift
from barsight.motion.problem import Problem, StereoSightings

HUBER_SIGMAS = 2.2
"""For the length of three whitened numbers, of which 19 % are longer; 1.345 is for one."""
LOOSE = (0.02, 0.2)
"""Priors (rad, share) that only keep the system solvable; the real ones are weighed in afterwards."""
SERVICE_RAD = float(np.deg2rad(0.2))
"""How far a camera may turn in service (1 sigma), where encoders are there to see it."""
MATCHING_BIAS_PX = 0.015
"""Disparity error that matching leaves everywhere alike, whatever the calibration."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What the sightings alone say: step (2,) from the values linearised at, covariance (2, 2).

    others: GTSAM's step of everything else that goes with it. swing: (M, 6, 2) how the poses move with yaw
    and scale (GTSAM's order, body axes).
    """

    step: Float64
    covariance: Float64
    others: Any
    swing: Float64


def columns(seen: StereoSightings) -> Float64:
    """(N, 2) px by which the right picture's columns move per rad of yaw and per share of scale."""
    camera = seen.camera
    x = (seen.stereo[:, 2] - camera.doffs_px - camera.cx_px) / camera.focal_px
    disparity = seen.stereo[:, 0] - seen.stereo[:, 2] + camera.doffs_px
    return np.column_stack([-camera.focal_px * (1 + x**2), -disparity])


def huber_weights(residual: Float64, sigma_px: Float64) -> Float64:
    """(N,) weights of residuals (N, 3) px with sigmas (N,) px."""
    size = np.linalg.norm(residual, axis=1) / sigma_px
    return np.asarray(np.minimum(1.0, HUBER_SIGMAS / np.maximum(size, 1e-9)))


def look(linear: Any, problem: Problem, residual: Float64, used: Bool) -> Seen:
    """The drift as the linearised graph's sightings show it, everything else free.

    linear: the graph at its best values, the used sightings' factors last. Its normal equations H dx = g grow
    by the drift's columns: with Y = H^-1 (g, h) of one factorisation the drift's own part follows (Schur).
    """
    seen = problem.sightings
    assert seen is not None
    design, right = _system(linear)
    by = np.zeros((design.shape[0], 2))
    by[-3 * int(used.sum()) + 1 :: 3] = _whitened_columns(seen, residual, used, problem.sees_scale)
    normal = (design.T @ design).tocsc()
    factor = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    solved = factor.solve(design.T @ np.column_stack([right, by]))
    free = np.column_stack([right, by]) - design @ solved
    covariance = np.linalg.inv(by.T @ free[:, 1:] + np.diag(1 / np.array(LOOSE) ** 2))
    step = covariance @ (by.T @ free[:, 0])
    starts = _starts(linear)
    poses = [starts[X(k)] for k in range(len(problem.start))]
    swing = -np.array([solved[at : at + 6, 1:] for at in poses])
    return Seen(step, covariance, _step(solved[:, 0] - solved[:, 1:] @ step, starts), swing)


def weigh(theta: Float64, covariance: Float64, problem: Problem) -> RigDrift:
    """The drift seen, weighed against what the calibration may be off by.

    Matching has a bias of its own, and another one for what lies nearer, glossy bars say: both pass for
    drift (`_floor`). Without encoders a yaw as large as the calibration's own does too, since what
    rectification leaves differs from place to place, and near points lie low and far ones high.
    """
    seen = problem.sightings
    assert seen is not None
    focal, baseline = seen.camera.focal_px, seen.camera.baseline_m
    disparity = seen.stereo[:, 0] - seen.stereo[:, 2] + seen.camera.doffs_px
    yaw_prior = SERVICE_RAD if problem.placed else problem.offset_prior_px / focal
    prior = np.array([yaw_prior, problem.scale_prior]) ** 2
    floor = _floor(disparity, focal)
    if not problem.placed:
        floor[0, 0] += prior[0]
    information = np.linalg.inv(covariance + floor)
    combined = np.linalg.inv(information + np.diag(1 / prior))
    yaw, scale = combined @ information @ theta
    range_m = focal * baseline / float(np.median(disparity))
    return RigDrift(
        float(yaw), float(scale), combined, np.sqrt(prior), baseline, range_m, bool(problem.placed)
    )


def _floor(disparity: Float64, focal_px: float) -> Float64:
    """(2, 2) of yaw and scale: a matching bias at the mean disparity and another over its spread."""
    everywhere = MATCHING_BIAS_PX
    per_px = MATCHING_BIAS_PX / max(float(disparity.std()), 1e-3)
    by = np.array([[-1 / focal_px, float(disparity.mean()) / focal_px], [0.0, -1.0]])
    floor: Float64 = by @ np.diag([everywhere**2, per_px**2]) @ by.T
    return floor


def _whitened_columns(seen: StereoSightings, residual: Float64, used: Bool, scale: bool) -> Float64:
    """(used, 2) in the units of the graph's whitened rows; 0 for a scale that nothing shows."""
    weight = np.sqrt(huber_weights(residual[used], seen.sigma_px[used])) / seen.sigma_px[used]
    result: Float64 = columns(seen)[used] * weight[:, None] * ([1.0, 1.0] if scale else [1.0, 0.0])
    return result


def _system(linear: Any) -> tuple[csc_matrix, Float64]:
    """The whitened Jacobian (rows, unknowns) and right side (rows,) of a linear graph."""
    row, column, value = linear.sparseJacobian_()
    count = int(column.max())
    whole = csc_matrix((value, (row.astype(int) - 1, column.astype(int) - 1)), (int(row.max()), count))
    return whole[:, : count - 1], whole[:, [count - 1]].toarray().ravel()


def _starts(linear: Any) -> dict[int, int]:
    """Where each key's unknowns begin in the linear system: keys ascend."""
    sizes = {"x": 6, "v": 3, "b": 6, "l": 3, "e": 1}
    keys = linear.keyVector()
    widths = [sizes[chr(gtsam.symbolChr(key))] for key in keys]
    return dict(zip(keys, np.concatenate([[0], np.cumsum(widths)[:-1]]).tolist(), strict=True))


def _step(flat: Float64, starts: dict[int, int]) -> Any:
    """GTSAM's vectors of a solution."""
    vectors = gtsam.VectorValues()
    ends = [*list(starts.values())[1:], len(flat)]
    for (key, first), last in zip(starts.items(), ends, strict=True):
        vectors.insert(key, flat[first:last])
    return vectors
