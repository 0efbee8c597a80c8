"""Model a board's deviation from flat and from its stated size by a few parameters [mrcal].

A parabola along each of its axes, zero at the ends; the print's stretch and skew; for an AprilGrid the tags'
size about their centres. The mean pitch from tag to tag (square to square) stays the stated one: it is the
calibration's metre.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from barsight.calibration.boards.board import Board, BoardKind
from barsight.core.arrays import Float64

BOW_SIGMA_M = 2e-3
TAG_SIGMA = 0.01
PRINT_SIGMA = 3e-3
"""What is expected of boards before any is seen: weak, so that only few views are held by it."""
WORDS = {
    "bow_x_m": ("bow along x", 1e3, "mm"),
    "bow_y_m": ("along y", 1e3, "mm"),
    "stretch_share": ("x longer than y by", 1e2, "%"),
    "skew_rad": ("skewed by", 1e3, "mrad"),
    "tag_share": ("tags larger by", 1e2, "%"),
}


@dataclass(frozen=True, eq=False)
class BoardShape:
    """A board's shape as found.

    values: (S,) bow_x_m and bow_y_m, the middle's height along the board's z over its ends; stretch_share, by
    how much x is longer than y; skew_rad, by how much the angle between x and y is less than a right one;
    tag_share, by how much the tags are larger than stated. covariance: (S, S).
    """

    names: tuple[str, ...]
    values: Float64
    covariance: Float64

    @property
    def sigma(self) -> Float64:
        """Return one standard deviation (S,) of each."""
        return np.sqrt(np.diag(self.covariance))

    def __str__(self) -> str:
        parts = []
        for name, value, sigma in zip(self.names, self.values, self.sigma, strict=True):
            text, factor, unit = WORDS[name]
            parts.append(f"{text} {factor * value:+.2f} ± {factor * sigma:.2f} {unit}")
        return ", ".join(parts)


@dataclass(frozen=True)
class BentBoard(Board):
    """A board of known shape. shape: the values of a `BoardShape`."""

    shape: tuple[float, ...] = ()

    @property
    def points_m(self) -> Float64:
        """Return the points (N, 3) of the flat board, moved by the shape."""
        flat = super().points_m
        moved: Float64 = flat + _basis(self.kind, flat) @ np.array(self.shape)
        return moved

    def __str__(self) -> str:
        words = (
            f"{text} {factor * value:+.2f} {unit}"
            for value, (text, factor, unit) in zip(self.shape, WORDS.values(), strict=False)
        )
        return ", ".join((super().__str__(), *words))


def apply_shape(board: Board, shape: Mapping[str, float]) -> BentBoard:
    """Apply shape parameters by name to a board. Raises KeyError where one is missing."""
    values = tuple(shape[name] for name in _names(board))
    return BentBoard(
        board.kind, board.columns, board.rows, board.size_m, board.marker_m, board.spacing, board.dictionary,
        values,
    )  # fmt: skip


def board_shape(board: Board, steps: Float64, covariance: Float64) -> BoardShape:
    """Build the shape of (S,) steps along `shape_basis` and their covariance (S, S)."""
    unit = _units(board)
    return BoardShape(_names(board), unit * steps, covariance * unit[:, None] * unit)


def shape_basis(board: Board) -> Float64:
    """Compute the displacement (N, 3, S) m of the board's points by each shape parameter, in its
    prior sigma.
    """
    return _basis(board.kind, board.points_m) * _units(board)


def _basis(kind: BoardKind, points: Float64) -> Float64:
    """Compute displacements (N, 3, S) m per unit of each parameter, for flat points (N, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    across = (2 * points - low - high)[:, :2] / (high - low)[:2]
    basis = np.zeros((len(points), 3, len(WORDS) if kind is BoardKind.APRILGRID else len(WORDS) - 1))
    basis[:, 2, :2] = 1 - across**2
    middle = points[:, :2] - (low + high)[:2] / 2
    basis[:, :2, 2] = middle * [0.5, -0.5]
    basis[:, :2, 3] = middle[:, ::-1] / 2
    if kind is BoardKind.APRILGRID:
        tags = points.reshape(-1, 4, 3)
        basis[:, :, 4] = (tags - tags.mean(axis=1, keepdims=True)).reshape(-1, 3)
    return basis


def _names(board: Board) -> tuple[str, ...]:
    return tuple(WORDS)[: _units(board).size]


def _units(board: Board) -> Float64:
    tag = [TAG_SIGMA] if board.kind is BoardKind.APRILGRID else []
    return np.array([BOW_SIGMA_M, BOW_SIGMA_M, PRINT_SIGMA, PRINT_SIGMA, *tag])
