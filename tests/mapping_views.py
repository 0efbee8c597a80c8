"""Views of a map made by hand, and the surface that comes of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.mapping.election.surface_election import SurfaceElection
from barsight.mapping.fusion import fuse_view
from barsight.mapping.observation import CellObservations
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface.height_selection import ViewFrusta
from barsight.mapping.surface.surface import Surface
from barsight.mapping.tiles import TileStore


def view(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, sigma_m: float = 0.01, shared_m: float = 0.0
) -> CellObservations:
    """One height in each cell (x, y), all equally sure."""
    x, y, z = (np.ravel(a) for a in np.broadcast_arrays(x, y, z))
    same = np.ones(x.size, np.float32)
    return CellObservations(
        x.astype(np.int32),
        y.astype(np.int32),
        np.ones(x.size, np.bool_),
        z.astype(np.float32),
        same * np.float32(sigma_m**2),
        same * np.float32(shared_m),
        same * 100,
    )


def fused(
    views: Iterable[CellObservations],
    folder: Path,
    settings: MapSettings | None = None,
    *,
    cell_m: float = 0.01,
    resident: int = 64,
) -> Surface:
    """The finished surface of some views, every cell for itself: it asks nothing of the cells beside it and
    takes nothing from them unless the settings say how much."""
    settings = settings or MapSettings(min_views=1)
    if settings.along_ratio == MapSettings().along_ratio:
        settings = replace(settings, along_ratio=0.001)
    if settings.along_m == MapSettings().along_m:
        settings = replace(settings, along_m=0.0)
    folder.mkdir(parents=True, exist_ok=True)
    store = TileStore(folder, resident)
    poses = []
    for one in views:
        fuse_view(store, one, settings)
        poses.append(high_above(one, cell_m))
    election = SurfaceElection(store, folder, cell_m, settings)
    return election.finish(settings.min_views, ViewFrusta.of(poses, FAR_CAMERA))


HEIGHT_M = 5000.0
FAR_CAMERA = RectifiedCamera(
    focal_px=1e6, cx_px=1e4, cy_px=1e4, baseline_m=0.001, doffs_px=0.0, width=20000, height=20000
)


def high_above(one: CellObservations, cell_m: float) -> Pose:
    """The place of a camera so far above the view's middle that it sees 100 m of everything from the top."""
    middle = [cell_m * (a.min() + a.max()) / 2 if a.size else 0.0 for a in (one.x, one.y)]
    return Pose("yard", "rect0", np.diag([1.0, -1.0, -1.0]), np.array([*middle, HEIGHT_M]))


def block(columns: int, rows: int, column: int = 0, row: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """x and y (rows, columns) of a rectangle of cells."""
    x, y = np.meshgrid(np.arange(column, column + columns), np.arange(row, row + rows))
    return x, y
