"""Model a board's deviation from flatness and from its stated size with a few parameters [mrcal].

The parameters are a parabolic bow along each axis, zero at the ends; the stretch and skew of the print; and,
for an AprilGrid, the tag size about the tag centres. The mean pitch from tag to tag (or square to square)
stays as stated, since it sets the metric scale of the calibration.
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
"""Prior standard deviations of a board's shape: bow (m), tag size (ratio), and stretch (ratio) and skew (rad)
of the print. The priors are weak, so they matter only when there are few views.
"""
WORDS = {
    "bow_x_m": ("bow along x", 1e3, "mm"),
    "bow_y_m": ("along y", 1e3, "mm"),
    "stretch_share": ("x longer than y by", 1e2, "%"),
    "skew_rad": ("skewed by", 1e3, "mrad"),
    "tag_share": ("tags larger by", 1e2, "%"),
}


@dataclass(frozen=True, eq=False)
class BoardShape:
    """A board's estimated shape.

    values: (S,), of which bow_x_m and bow_y_m are the height of the board's middle above its ends along z;
    stretch_share is the excess of x over y as a fraction; skew_rad is a right angle minus the angle between x
    and y; tag_share is the fraction by which the tags are larger than stated. covariance: (S, S).
    """

    names: tuple[str, ...]
    values: Float64
    covariance: Float64

    @property
    def sigma(self) -> Float64:
        """Return the standard deviation (S,) of each value."""
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
        """Return the points (N, 3) of the flat board, displaced by the shape."""
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
    """Apply named shape parameters to a board. Raises KeyError where one is missing."""
    values = tuple(shape[name] for name in _names(board))
    return BentBoard(
        board.kind, board.columns, board.rows, board.size_m, board.marker_m, board.spacing, board.dictionary,
        values,
    )  # fmt: skip


def board_shape(board: Board, steps: Float64, covariance: Float64) -> BoardShape:
    """Build the board shape from (S,) steps along `shape_basis` and their covariance (S, S)."""
    unit = _units(board)
    return BoardShape(_names(board), unit * steps, covariance * unit[:, None] * unit)


def shape_basis(board: Board) -> Float64:
    """Compute the displacement (N, 3, S), in metres, of the board's points for a step of one prior sigma in
    each shape parameter.
    """
    return _basis(board.kind, board.points_m) * _units(board)


def _basis(kind: BoardKind, points: Float64) -> Float64:
    """Compute the displacement (N, 3, S), in metres, of flat points (N, 3) per unit of each parameter."""
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
