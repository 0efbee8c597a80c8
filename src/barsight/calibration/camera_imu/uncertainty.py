"""Estimate the covariance of a camera-IMU calibration from noise, correlated residuals and fixed
parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from barsight.calibration.camera_imu.arrowhead_system import (
    EliminatedChain,
    assemble,
    eliminate,
    project_out_chain,
)
from barsight.calibration.camera_imu.problem import MOUNT, CameraImuProblem, linearise_camera_imu
from barsight.calibration.camera_imu.solver import Solution, block_scores
from barsight.calibration.stereo.covariance_inflation import inflate_covariance
from barsight.core.arrays import Float64

BLOCK_S = 1.0
FLOOR = 1e-8
NEEDED = {"rad": np.radians(0.1), "m": 3e-3, "s": 2e-4, "": 1e-3}
"""Accuracy that a yard needs: 0.1 degrees, 3 mm, 0.2 ms, scales to 0.1 %. Weak directions are judged in these
units.
"""
UNDETERMINED = 10.0
SHIFT_SIGMAS = 3.0


@dataclass(frozen=True)
class HeldFixed:
    """A group of parameters that was held fixed.

    chi: expected fall of the residuals on freeing the group, per parameter, relative to what noise alone
    would give (1: nothing to gain). changes: (name, change) of those of its parameters that would change
    significantly. matters: true if the resulting change of the mounting is counted as uncertainty.
    """

    name: str
    chi: float
    changes: tuple[tuple[str, float], ...]
    matters: bool


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of the common parameters.

    covariance: (P, P) from all error sources. noise_sigma: (P,) from independent corner and IMU noise alone.
    correlation: factor on the variances, from how much more the seconds of the recording disagree than that.
    singular_values: (P,) of the information in units of the needed accuracy, descending. undetermined:
    directions known to worse than ten times the need, in words. fixed: groups held fixed. lens_names: (L,) of
    the lens parameters. by_lens: (P, L) derivatives of the common parameters with respect to them.
    """

    covariance: Float64
    noise_sigma: Float64
    correlation: float
    singular_values: Float64
    undetermined: tuple[str, ...]
    fixed: tuple[HeldFixed, ...]
    lens_names: tuple[str, ...]
    by_lens: Float64


def uncertainty(problem: CameraImuProblem, solution: Solution) -> Uncertainty:
    """Compute the covariance from the Schur complement of the common parameters.

    It is widened by the disagreement between seconds and, where freeing the fixed lenses or IMU scales would
    improve the residuals, by how far the mounting would then move.
    """
    names = problem.parameter_names
    unit = needed_units(names)
    scaled = solution.eliminated.information * unit[:, None] * unit
    values, vectors = np.linalg.eigh(scaled)
    weak = [n for n in range(values.size) if values[n] < UNDETERMINED**-2]
    undetermined = tuple(_direction(names, vectors[:, n]) for n in weak)
    # An unobserved direction gets a huge sigma instead of raising an error.
    solid = np.maximum(values, FLOOR)
    inverse = (vectors / solid) @ vectors.T * unit[:, None] * unit
    covariance, correlation = inflate_covariance(inverse, 1.0, *_blocks(problem, solution))
    free = _freed_system(problem, solution)
    fixed = []
    for group, shift in _freed(problem, free, inverse, correlation):
        fixed.append(group)
        if group.matters:
            covariance = covariance + np.outer(shift, shift)
    by_lens = -inverse @ free.information[np.ix_(free.own, free.lenses)]
    return Uncertainty(
        covariance, np.sqrt(np.diag(inverse)), correlation, values[::-1], undetermined, tuple(fixed),
        tuple(free.names[k] for k in free.lenses), by_lens,
    )  # fmt: skip


def needed_units(names: Sequence[str]) -> Float64:
    """Return the needed accuracy (P,) of each parameter, according to the unit at the end of its name."""
    ends = [name.rsplit("_", 1)[-1] if "_" in name.rsplit(".", 1)[-1] else "" for name in names]
    return np.array([NEEDED.get(end, NEEDED[""]) for end in ends])


def _blocks(problem: CameraImuProblem, solution: Solution) -> tuple[Float64, Float64]:
    times = [
        sightings.stamp_s + mount.shift_s
        for sightings, mount in zip(problem.sightings, solution.state.mounts, strict=True)
    ]
    block = (np.concatenate([*times, problem.imu.time_s]) / BLOCK_S).astype(np.int64)
    block = np.clip(block, 0, None)
    samples = solution.linearised.samples
    by_common = project_out_chain(samples, solution.eliminated.through)
    return block_scores(samples, by_common, block, int(block.max()) + 1)


@dataclass(frozen=True, eq=False)
class _FreedSystem:
    """Information (Q, Q) and gradient (Q,) of the common parameters at the solution, as if lenses and IMU
    scales were free too.

    own: (P,) indices of the parameters that were solved for. lenses, scales: indices of the others; scales is
    empty where they were solved for.
    """

    names: tuple[str, ...]
    information: Float64
    gradient: Float64
    own: list[int]
    lenses: list[int]
    scales: list[int]


def _freed_system(problem: CameraImuProblem, solution: Solution) -> _FreedSystem:
    freed = replace(problem, scales=True, lenses=True)
    linearised = linearise_camera_imu(freed, solution.state, None)
    system = assemble(linearised.samples, linearised.walks, len(solution.state.spline.places_m))
    whole: EliminatedChain = eliminate(system)
    gradient = system.common_gradient - np.einsum("np,n->p", whole.through, system.chain_gradient)
    names = freed.parameter_names
    own = [names.index(name) for name in problem.parameter_names]
    scales = range(MOUNT * len(problem.sightings) + 2, freed.lens_at[0])
    return _FreedSystem(
        names, whole.information, gradient, own, list(range(freed.lens_at[0], len(names))),
        [] if problem.scales else list(scales),
    )  # fmt: skip


def _freed(
    problem: CameraImuProblem, free: _FreedSystem, inverse: Float64, correlation: float
) -> list[tuple[HeldFixed, Float64]]:
    """Estimate the effect of freeing lenses and IMU scales with one Newton step from the solution."""
    names, own, gradient = free.names, free.own, free.gradient
    groups = {"lenses": free.lenses}
    if not problem.scales:
        groups["IMU scales and misalignments"] = free.scales
    out = []
    for name, extra in groups.items():
        mixed = free.information[np.ix_(own, extra)]
        left = free.information[np.ix_(extra, extra)] - mixed.T @ inverse @ mixed
        scale = 1 / np.sqrt(np.maximum(np.diag(left), 1e-300))
        values, vectors = np.linalg.eigh(left * scale[:, None] * scale)
        values = np.maximum(values, 1e-9 * values[-1])
        pulled = vectors.T @ (scale * (gradient[extra] - mixed.T @ inverse @ gradient[own]))
        change = scale * (vectors @ (pulled / values))
        chi = float((pulled**2 / values).sum()) / len(extra)
        limit = correlation * (1 + SHIFT_SIGMAS * np.sqrt(2 / len(extra)))
        sigma = scale * np.sqrt(((vectors**2) / values).sum(axis=1) * correlation)
        strong = [k for k in np.argsort(-np.abs(change) / sigma)[:4] if abs(change[k]) > 3 * sigma[k]]
        changes = tuple((names[extra[k]], float(change[k])) for k in strong)
        out.append((HeldFixed(name, chi / correlation, changes, chi > limit), -inverse @ mixed @ change))
    return out


def _direction(names: Sequence[str], vector: Float64) -> str:
    """Describe a direction's largest components in words."""
    order = np.argsort(-np.abs(vector))
    kept = [k for k in order[:4] if abs(vector[k]) > 0.3 * abs(vector[order[0]])]
    return " with ".join(names[k].rsplit("_", 1)[0].replace(".", " ") for k in kept)
