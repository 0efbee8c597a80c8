"""Write the cloud, one file per tile: every height with enough views, including sides and lower surfaces."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from barsight.core.arrays import Bool, Float32, Int8, Int32, UInt8
from barsight.mapping.fusion import height_sigma
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.tiles import GRAY, TILE_CELLS, VIEWS, Z


@dataclass(frozen=True, eq=False)
class CloudPart:
    """A tile's points: xyz_m (N, 3) float32 in the reference frame, intensity, sigma_z_m, views (N,).

    cell: (N,) the point's cell, row by row; elected: (N,) True if the point is its cell's surface.
    """

    xyz_m: Float32
    intensity: UInt8
    sigma_z_m: Float32
    views: Float32
    cell: Int32
    elected: Bool

    @classmethod
    def of(cls, tile: Float32, winner: Int8, key: TileKey, cell_m: float, min_views: int) -> CloudPart:
        """Select a tile's heights with at least min_views views. winner: (rows, columns) slot of the
        height that is the surface.
        """
        row, column, slot = np.nonzero(tile[..., VIEWS] >= min_views)
        kept = tile[row, column, slot]
        x, y = column + key[0] * TILE_CELLS, row + key[1] * TILE_CELLS
        return cls(
            np.column_stack([x * cell_m, y * cell_m, kept[:, Z]]).astype(np.float32),
            kept[:, GRAY].round().clip(0, 255).astype(np.uint8),
            height_sigma(kept),
            kept[:, VIEWS],
            (row * TILE_CELLS + column).astype(np.int32),
            slot == winner[row, column],
        )

    def finished(self, z_m: Float32, sigma_m: Float32, blur_m: Float32) -> CloudPart:
        """Update elected points to the finished surface, and add the blur on bars to the sigma of the others.

        z_m, sigma_m, blur_m: (rows, columns) of the tile.
        """
        xyz = self.xyz_m.copy()
        xyz[:, 2] = np.where(self.elected, z_m.ravel()[self.cell], xyz[:, 2])
        beside = np.hypot(self.sigma_z_m, blur_m.ravel()[self.cell])
        return replace(self, xyz_m=xyz, sigma_z_m=np.where(self.elected, sigma_m.ravel()[self.cell], beside))

    def write(self, folder: Path, key: TileKey) -> None:
        """Write the tile's file as a new one, so that links to an older one keep its content."""
        path = cloud_file(folder, key)
        path.unlink(missing_ok=True)
        np.savez(path, **{field.name: getattr(self, field.name) for field in fields(self)})


def read_part(folder: Path, key: TileKey) -> CloudPart:
    """Read the tile's points as last written."""
    with np.load(cloud_file(folder, key)) as part:
        return CloudPart(**part)


def cloud_file(folder: Path, key: TileKey) -> Path:
    """Return the path of a tile's points."""
    return folder / f"cloud_{key[0]}_{key[1]}.npz"
