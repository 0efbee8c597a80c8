"""Hold corners per picture, pairs of pictures, and removed ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64, expect_shape


@dataclass(frozen=True, eq=False)
class Corners:
    """ids: (N,) int64 indices into the board's points, each once. pixels: (N, 2) raw px.

    edge_px: the width of the board's black-white edges in the picture (blur), NaN where not known.
    """

    ids: Int64
    pixels: Float64
    edge_px: float = float("nan")

    def __post_init__(self) -> None:
        expect_shape("pixels", self.pixels, (self.ids.size, 2))

    def keep(self, mask: Bool) -> Corners:
        """Select the corners where `mask` (N,) is true."""
        return Corners(self.ids[mask], self.pixels[mask], self.edge_px)


@dataclass(frozen=True, eq=False)
class BoardView:
    """One moment: the board in cam0 and in cam1, None where that camera doesn't see (enough of) it."""

    name: str
    cam0: Corners | None
    cam1: Corners | None

    @property
    def cameras(self) -> tuple[Corners | None, Corners | None]:
        """Return both cameras' corners."""
        return self.cam0, self.cam1


@dataclass(frozen=True)
class Removed:
    """Something left out of the solve. view: its name; camera: cam0, cam1 or both; reason: a sentence."""

    view: str
    camera: str
    reason: str


def common_corners(view: BoardView) -> tuple[Int64, Float64, Float64]:
    """Intersect both cameras' corners: ids (N,) and their pixels (N, 2) in cam0 and in cam1."""
    if view.cam0 is None or view.cam1 is None:
        return np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2))
    ids, first, second = np.intersect1d(view.cam0.ids, view.cam1.ids, return_indices=True)
    return ids, view.cam0.pixels[first], view.cam1.pixels[second]
