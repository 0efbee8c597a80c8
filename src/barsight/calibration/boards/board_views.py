"""Hold the corners detected in each picture, the views of a camera pair, and the views left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64, expect_shape


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of a board detected in one picture.

    ids: (N,) int64 indices into the board's points, each at most once. pixels: (N, 2) raw px. edge_px: width
    of the board's black-white edges in the picture, a measure of blur; NaN where it is unknown.
    """

    ids: Int64
    pixels: Float64
    edge_px: float = float("nan")

    def __post_init__(self) -> None:
        expect_shape("pixels", self.pixels, (self.ids.size, 2))

    def keep(self, mask: Bool) -> Corners:
        """Select the corners for which `mask` (N,) is true."""
        return Corners(self.ids[mask], self.pixels[mask], self.edge_px)


@dataclass(frozen=True, eq=False)
class BoardView:
    """The board as cam0 and cam1 see it at one moment; None for a camera that does not see enough of it."""

    name: str
    cam0: Corners | None
    cam1: Corners | None

    @property
    def cameras(self) -> tuple[Corners | None, Corners | None]:
        """Return the corners of cam0 and of cam1."""
        return self.cam0, self.cam1


@dataclass(frozen=True)
class Removed:
    """A view, picture or corners left out of the solve.

    view: name of the view. camera: cam0, cam1 or both. reason: a sentence.
    """

    view: str
    camera: str
    reason: str


def common_corners(view: BoardView) -> tuple[Int64, Float64, Float64]:
    """Return the ids (N,) of the corners that both cameras see, with their pixels (N, 2) in cam0 and in
    cam1.
    """
    if view.cam0 is None or view.cam1 is None:
        return np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2))
    ids, first, second = np.intersect1d(view.cam0.ids, view.cam1.ids, return_indices=True)
    return ids, view.cam0.pixels[first], view.cam1.pixels[second]
