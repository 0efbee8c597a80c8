"""Estimate the shifts of passes over one yard against each other, each pass with a prior of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.linalg.robust import CHI2_3_MEDIAN
from barsight.core.pose import skew
from barsight.registration.block_shifts import BlockShifts

UNKNOWNS = 7
"""Number of unknowns of a pass: turn about x, y and z (rad), shift along x, y and z (m), scale along x."""
DOUBTFUL_SIGMAS = 4.0
"""Deviation of a tie, in sigma, from which it contradicts the passes' own sigmas."""
FLOOR_M = np.array([0.001, 0.001, 0.002])
"""Standard deviation along x, y and z of the error that all blocks of an overlap share, however many they
are.
"""
MIN_BLOCKS, MIN_PLANE = 4, 8
"""Minimum number of blocks to estimate their scatter, and the number above which it is taken about a
plane.
"""
FEW_INFLATION, MIN_INFLATION = 10.0, 1e-3
"""Factor on the stated variance where blocks are too few to show it, and the minimum of the estimated
factor.
"""
NOTHING = 1e-3
"""Information (1 / m^2) that is assumed for directions which a block doesn't show."""
_ROUNDS = 15


@dataclass(frozen=True, eq=False)
class PassPrior:
    """Prior of a pass's own position. about_m: (3,) its middle, about which it turns and stretches.
    covariance: (7, 7) of the unknowns.
    """

    about_m: Float64
    covariance: Float64


@dataclass(frozen=True, eq=False)
class PassCorrection:
    """Correction of a pass: its point p lies at p + shift_at(p) in the common map.

    about_m: (3,). unknowns: (7,), covariance: (7, 7) of their remaining errors.
    """

    about_m: Float64
    unknowns: Float64
    covariance: Float64

    def shift_at(self, points_m: Float64) -> Float64:
        """Compute the shift (N, 3) m of points (N, 3)."""
        shift: Float64 = design_at(points_m, self.about_m) @ self.unknowns
        return shift


@dataclass(frozen=True, eq=False)
class PairTie:
    """Shift between two passes by their overlap. first, second: their numbers from 0. blocks: number of
    blocks in common. shift_m, sigma_m: (3,) that moves the second onto the first in the overlap's middle,
    before any correction, and its sigma. expected_sigma_m: (3,) the shift's sigma expected from the passes'
    own. off_sigmas: the shift relative to both sigmas.
    """

    first: int
    second: int
    blocks: int
    shift_m: Float64
    sigma_m: Float64
    expected_sigma_m: Float64
    off_sigmas: float

    @property
    def contradicts(self) -> bool:
        """Check whether the overlap contradicts the passes' own sigmas."""
        return self.off_sigmas > DOUBTFUL_SIGMAS


@dataclass(frozen=True, eq=False)
class PassTies:
    """corrections: one per pass; pairs: one per pair of passes that overlap."""

    corrections: tuple[PassCorrection, ...]
    pairs: tuple[PairTie, ...]


def design_at(points_m: Float64, about_m: Float64) -> Float64:
    """Compute the Jacobian (N, 3, 7) of points (N, 3) by a pass's unknowns."""
    away = points_m - about_m
    design = np.zeros((len(points_m), 3, UNKNOWNS))
    design[:, :, :3] = -skew(away)
    design[:, :, 3:6] = np.eye(3)
    design[:, 0, 6] = away[:, 0]
    return design


def tie_passes(priors: Sequence[PassPrior], overlaps: Mapping[tuple[int, int], BlockShifts]) -> PassTies:
    """Solve for all passes' corrections at once by weighted least squares, with Cauchy weights of the blocks.

    overlaps: by (first, second). A block's shift is distributed over both passes according to their sigmas;
    what no overlap shows stays at the prior. The blocks' sigmas are scaled to their actual scatter, and no
    overlap counts as more precise than FLOOR_M.
    """
    chosen = {pair: _scaled(*pair, blocks) for pair, blocks in overlaps.items() if len(blocks.place_m)}
    size = UNKNOWNS * len(priors)
    prior = np.zeros((size, size))
    for k, one in enumerate(priors):
        part = slice(UNKNOWNS * k, UNKNOWNS * (k + 1))
        prior[part, part] = np.linalg.inv(one.covariance)
    normal: Any = prior
    right: Any = np.zeros(size)
    for overlap in chosen.values():
        rows = _rows(overlap, priors)
        weighted: Float64 = np.einsum("kia,kij->kaj", rows, overlap.information)
        normal = normal + np.tensordot(weighted, rows, ((0, 2), (0, 1)))
        right = right + np.tensordot(weighted, overlap.shifts.shift_m, ((0, 2), (0, 1)))
    found: Float64 = np.linalg.solve(normal, right)
    left: Float64 = np.linalg.inv(normal)
    corrections = []
    for k, one in enumerate(priors):
        part = slice(UNKNOWNS * k, UNKNOWNS * (k + 1))
        corrections.append(PassCorrection(one.about_m, found[part], left[part, part]))
    return PassTies(tuple(corrections), tuple(_averaged(one, priors) for one in chosen.values()))


@dataclass(frozen=True, eq=False)
class _Overlap:
    """Blocks of two passes with the information (K, 3, 3) by which they are weighted."""

    first: int
    second: int
    shifts: BlockShifts
    information: Float64


def _rows(overlap: _Overlap, priors: Sequence[PassPrior]) -> Float64:
    """Compute the Jacobian (K, 3, 7 P) of the blocks' shifts: the second pass's shift minus the first's."""
    place = overlap.shifts.place_m
    rows = np.zeros((len(place), 3, UNKNOWNS * len(priors)))
    for number, sign in ((overlap.second, 1), (overlap.first, -1)):
        part = slice(UNKNOWNS * number, UNKNOWNS * (number + 1))
        rows[:, :, part] = sign * design_at(place, priors[number].about_m)
    return rows


def _scaled(first: int, second: int, blocks: BlockShifts) -> _Overlap:
    """Weight blocks by their deviation from the common fit (Cauchy), scale their information to their scatter
    about it, and bound it for all of them together.
    """
    count = len(blocks.place_m)
    plane = np.ones((count, 1))
    if count > MIN_PLANE:
        plane = np.column_stack([plane, blocks.place_m[:, :2] - blocks.place_m[:, :2].mean(axis=0)])
    off = blocks.shift_m - np.median(blocks.shift_m, axis=0)
    inflation, weight = FEW_INFLATION, np.ones(count)
    for _ in range(_ROUNDS):
        squares = np.einsum("ki,kij,kj->k", off, blocks.information, off)
        if count >= MIN_BLOCKS:
            inflation = max(float(np.median(squares)) / CHI2_3_MEDIAN, MIN_INFLATION)
        weight = 1 / (1 + squares / (9 * inflation))
        fitted = np.linalg.lstsq(np.sqrt(weight)[:, None] * plane, np.sqrt(weight)[:, None] * blocks.shift_m,
                                 rcond=None)[0]  # fmt: skip
        off = blocks.shift_m - plane @ fitted
    covariance = inflation * np.linalg.inv(blocks.information + NOTHING * np.eye(3))
    together = covariance + float(weight.sum()) * np.diag(FLOOR_M**2)
    return _Overlap(first, second, blocks, weight[:, None, None] * np.linalg.inv(together))


def _averaged(overlap: _Overlap, priors: Sequence[PassPrior]) -> PairTie:
    """Average an overlap, and compare it with the passes' own sigmas."""
    shifts = overlap.shifts
    spread: Float64 = np.linalg.inv(overlap.information.sum(axis=0))
    shift: Float64 = spread @ np.einsum("kij,kj->i", overlap.information, shifts.shift_m)
    allowed = np.zeros((3, 3))
    for number in (overlap.first, overlap.second):
        design = design_at(shifts.place_m.mean(axis=0, keepdims=True), priors[number].about_m)[0]
        allowed += design @ priors[number].covariance @ design.T
    off_sigmas = float(np.sqrt(shift @ np.linalg.solve(allowed + spread, shift) / 3))
    return PairTie(
        overlap.first, overlap.second, len(shifts.place_m), shift, np.sqrt(np.diag(spread)),
        np.sqrt(np.diag(allowed)), off_sigmas,
    )  # fmt: skip
