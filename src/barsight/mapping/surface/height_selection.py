"""Elect the surface among a cell's heights: the highest one supported by the views that could see it.

A wrong height hangs in the air, most often beside an edge, where matching stretches the nearer surface by a
few pixels. Every view that looks through it to what lies behind speaks against it. So a height's votes are
compared with the number of views whose two cameras have a free line of sight to it, over the surface that the
votes alone would elect. A height that fewer than `min_views` views can see at all is a matching error.

Where the pictures' border cuts off a high surface, cameras still see beneath its overhang from the side. What
they see there isn't a surface to lift from, since the high one may continue above it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int8, kernel
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.mapping.settings import MapSettings
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.surface.block_visibility import (
    BLOCK,
    NOWHERE,
    SOMEWHERE,
    bound_blocks,
    highest_about,
    supported_span,
)
from barsight.mapping.surface.visibility import (
    is_pictured,
    is_unoccluded,
    may_be_occluded,
    point_density,
)
from barsight.mapping.tiles import CENTRAL, SLOTS, TILE_CELLS, VIEWS, Z

_ALONG = 30
_ALIKE_CELLS = 3.0
_BORDER_PX = 3.0
_NOTHING = np.float32(-1e6)
_MOVED_CELLS = 0.5
"""Maximum change of a height, in cells, for which the stored result of its visibility tests stays valid."""


@dataclass(frozen=True, eq=False)
class ViewFrusta:
    """Frusta of K views: rect0_from_reference as rotation (K, 3, 3) and translation (K, 3), and the
    positions of both cameras (K, 2, 3) in the reference frame. spacing_rad: angle between neighbouring
    points.
    """

    camera: RectifiedCamera
    spacing_rad: float
    rotation: Float64
    translation: Float64
    eyes: Float64

    @classmethod
    def of(cls, poses: Sequence[Pose], camera: RectifiedCamera, points_per_pixel: int = 1) -> ViewFrusta:
        """Build from the views' reference_from_rect0."""
        inverses = [pose.inverse() for pose in poses]
        both = np.array([[0.0, 0.0, 0.0], [camera.baseline_m, 0.0, 0.0]])
        return cls(
            camera,
            1 / (camera.focal_px * points_per_pixel),
            np.array([pose.rotation for pose in inverses]).reshape(-1, 3, 3),
            np.array([pose.translation for pose in inverses]).reshape(-1, 3),
            np.array([pose.apply(both) for pose in poses]).reshape(-1, 2, 3),
        )

    @property
    def height_m(self) -> float:
        """Return the cameras' median height."""
        return float(np.median(self.eyes[..., 2])) if self.eyes.size else 0.0

    def pixel_m(self, z_m: Float32, height_m: float) -> Float32:
        """Return the width of a pixel on the ground, m, at heights z_m for a camera at height_m."""
        above = np.abs(np.float32(height_m) - z_m)
        return np.asarray(above / np.float32(self.camera.focal_px), np.float32)

    def planes(self) -> Float64:
        """Compute the frustum planes (6, 4, K), a x + b y + c z + d, of the space inside both pictures of
        a view, reduced by `_BORDER_PX` on all sides; values are 0 or more on the inner side.
        """
        camera = self.camera
        rays = np.concatenate([self.rotation, self.translation[:, :, None]], axis=2)
        x, y, depth = np.moveaxis(rays, 1, 0)
        left = camera.focal_px * x + camera.cx_px * depth
        right = left + camera.doffs_px * depth - camera.focal_px * camera.baseline_m * np.eye(4)[3]
        row = camera.focal_px * y + camera.cy_px * depth
        sides = ((left, camera.width), (right, camera.width), (row, camera.height))
        low = [place - _BORDER_PX * depth for place, _ in sides]
        high = [(size - 1 - _BORDER_PX) * depth - place for place, size in sides]
        return np.ascontiguousarray(np.moveaxis(np.array(low + high), 1, 2))

    def touching(self, low_m: Float64, high_m: Float64) -> Bool:
        """Mark the views (K,) whose left picture may show part of the box from low_m to high_m (3,)."""
        corners = np.array(list(product(*zip(low_m, high_m, strict=True))))
        x, y, depth = np.moveaxis(corners @ self.rotation.mT + self.translation[:, None], -1, 0)
        camera = self.camera
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.focal_px * x / depth + camera.cx_px, camera.focal_px * y / depth + camera.cy_px
        touched = (u.max(1) >= 0) & (u.min(1) <= camera.width) & (v.max(1) >= 0) & (v.min(1) <= camera.height)
        chosen: Bool = (touched | (depth <= 0).any(1)) & (depth > 0).any(1)
        return chosen

    def only(self, chosen: Bool) -> ViewFrusta:
        """Select some of the views; chosen: (K,)."""
        return replace(
            self,
            rotation=self.rotation[chosen],
            translation=self.translation[chosen],
            eyes=self.eyes[chosen],
        )


@dataclass(eq=False)
class ViewSupport:
    """Visibility of a tile's heights in the first `views` views: (rows, columns, SLOTS, 3) float32, z,
    number of views that see it and number of points these have in its cell; NaN where nothing was tested.
    """

    views: int
    heights: Float32

    @classmethod
    def none(cls) -> ViewSupport:
        """Create an empty record, with no view tested."""
        return cls(0, np.full((TILE_CELLS, TILE_CELLS, SLOTS, 3), np.nan, np.float32))


@kernel()
def elect_by_votes(tile: Float32, min_views: int, top_ratio: float) -> Float32:
    """Elect heights (rows, columns) by votes alone: the highest with at least top_ratio of the best-seen
    one's views; NaN where none has enough views.
    """
    rows, columns = tile.shape[:2]
    highest = np.full((rows, columns), np.nan, np.float32)
    for i in range(rows):
        for j in range(columns):
            most = np.float32(0)
            for s in range(SLOTS):
                most = max(most, tile[i, j, s, VIEWS])
            needed = max(np.float32(min_views), np.float32(top_ratio) * most)
            for s in range(SLOTS):
                if tile[i, j, s, VIEWS] >= needed and not highest[i, j] >= tile[i, j, s, Z]:
                    highest[i, j] = tile[i, j, s, Z]
    return highest


def elect_surface(
    tile: Float32,
    key: TileKey,
    around: Float32,
    frusta: ViewFrusta,
    cell_m: float,
    min_views: int,
    settings: MapSettings,
    asked: ViewSupport,
) -> Int8:
    """Elect which of each cell's heights is the surface, (rows, columns), -1 where none is.

    around: (3 * TILE_CELLS, 3 * TILE_CELLS) `elect_by_votes` of the tile and its eight neighbours.
    asked: updated in place.
    """
    box = supported_box(tile, key, cell_m, min_views)
    if box is None:
        return np.full(tile.shape[:2], -1, np.int8)
    corner = np.array(key, np.float64) * TILE_CELLS
    near = frusta.touching(*box)
    first_new, asked.views = int(near[: asked.views].sum()), near.size
    frusta = frusta.only(near)
    around = np.fmax(around, _NOTHING)
    ceiling = float(around.max())
    planes, one_point_m = frusta.planes(), cell_m / frusta.spacing_rad
    roof = highest_about(around)
    blocks = bound_blocks(
        tile, corner, roof, ceiling, planes, frusta.eyes, cell_m, float(min_views), one_point_m, first_new
    )
    scene = around, roof, ceiling
    share, expected = np.full((2, *tile.shape[:3]), -1, np.float32)
    _support(
        tile,
        corner,
        scene,
        planes,
        frusta.eyes,
        blocks,
        cell_m,
        float(min_views),
        one_point_m,
        (first_new, asked.heights, share, expected),
    )
    return _elected(tile, share, expected, cell_m, float(min_views), settings.own_ratio, settings.along_ratio)


def supported_box(tile: Float32, key: TileKey, cell_m: float, min_views: int) -> Float64 | None:
    """Return the corners (2, 3) m, lowest and highest, of the box around the heights with min_views views;
    None without any.
    """
    low_m, high_m = supported_span(tile, min_views)
    if low_m > high_m:
        return None
    corner = np.array(key, np.float64) * TILE_CELLS * cell_m
    box: Float64 = np.array([[*corner, low_m], [*(corner + TILE_CELLS * cell_m), high_m]])
    return box


@kernel(borrows=True)
def _support(
    tile: Float32, corner: Float64, scene: tuple[Float32, Float32, float], planes: Float64, eyes: Float64,
    blocks: tuple[Int8, Bool, Float64, Bool], cell_m: float, min_views: float, one_point_m: float,
    asked: tuple[int, Float32, Float32, Float32],
) -> None:  # fmt: skip
    """Fill two arrays (rows, columns, SLOTS) of -1: the ratio of a height's votes to the votes expected for
    it, and the expected votes; left at -1 where fewer than min_views see or can see it, or it may be
    occluded.

    A view that can see a height is expected to vote for it in the cell's middle, with less weight where its
    points are further apart than cells: at ranges over one_point_m, and at grazing angles. scene: around,
    roof and ceiling of `is_unoccluded`. blocks: result of `bound_blocks`. asked: the first view not yet
    tested; what the ones before it see, of `ViewSupport`, valid for a height that has hardly moved and
    updated in place; then the arrays to fill.
    """
    rows, columns = tile.shape[:2]
    (around, _, ceiling), (within, dense, clear, is_open) = scene, blocks
    first_new, known, share, expected = asked
    for i in range(rows):
        for j in range(columns):
            a, b = i // BLOCK, j // BLOCK
            for s in range(SLOTS):
                if tile[i, j, s, VIEWS] < min_views:
                    continue
                z = float(tile[i, j, s, Z])
                x, y = (corner[0] + j) * cell_m, (corner[1] + i) * cell_m
                point = x, y, np.float64(z)
                able, votes, first = 0.0, 0.0, 0
                if abs(known[i, j, s, 0] - z) <= _MOVED_CELLS * cell_m:
                    able, votes, first = known[i, j, s, 1], known[i, j, s, 2], first_new
                else:
                    known[i, j, s, 0] = z
                for k in range(first, eyes.shape[0]):
                    if within[a, b, k] == NOWHERE:
                        continue
                    if within[a, b, k] == SOMEWHERE and not is_pictured(x, y, z, planes, k):
                        continue
                    near = z < max(clear[a, b, k, 0], clear[a, b, k, 1])
                    if near and not _is_seen(point, i, j, eyes, k, clear, scene, cell_m):
                        continue
                    able += 1
                    way = eyes[k, 0, 0] - x, eyes[k, 0, 1] - y, eyes[k, 0, 2] - z
                    votes += 1.0 if dense[a, b, k] else point_density(way, one_point_m)
                known[i, j, s, 1], known[i, j, s, 2] = able, votes
                if able < min_views:
                    continue
                if not is_open[a, b] and may_be_occluded(
                    point, i, j, around, ceiling, planes, cell_m, min_views
                ):
                    continue
                share[i, j, s] = min(tile[i, j, s, CENTRAL] / max(votes, 1e-6), 1.0)
                expected[i, j, s] = votes


@kernel(inline=True)
def _is_seen(
    point: tuple[float, float, float], row: int, column: int, eyes: Float64, view: int, clear: Float64,
    scene: tuple[Float32, Float32, float], cell_m: float,
) -> bool:  # fmt: skip
    """Check that both cameras of a view have a free line of sight to a point in a cell of the middle tile.

    point: m. eyes: (K, 2, 3) m. view: its number among the K. clear: (B, B, K, 2) m, heights from which the
    lines of a block are known to be free. scene: around, roof and ceiling of `is_unoccluded`.
    """
    (around, roof, ceiling), z = scene, point[2]
    for e in range(2):
        if z < clear[row // BLOCK, column // BLOCK, view, e]:
            way = eyes[view, e, 0] - point[0], eyes[view, e, 1] - point[1], eyes[view, e, 2] - z
            if not is_unoccluded(z, row, column, way, around, roof, ceiling, cell_m):
                return False
    return True


@kernel()
def _elected(
    tile: Float32,
    share: Float32,
    expected: Float32,
    cell_m: float,
    min_views: float,
    own_ratio: float,
    along_ratio: float,
) -> Int8:
    """Select the highest supported height of each cell: its slot (rows, columns), -1 where there is none.

    tile: (rows, columns, SLOTS, FIELDS). share, expected: (rows, columns, SLOTS) of `_support`, share -1
    where a height can't be the surface. A height is supported if its share is at least own_ratio (along_ratio
    where fewer than min_views votes are expected), or at least along_ratio averaged along a bar or an edge.
    """
    rows, columns = tile.shape[:2]
    winner = np.full((rows, columns), -1, np.int8)
    heights = np.empty_like(share)
    for i in range(rows):
        for j in range(columns):
            for s in range(SLOTS):
                heights[i, j, s] = tile[i, j, s, Z] if share[i, j, s] >= 0 else np.float32(np.nan)
    for i in range(rows):
        for j in range(columns):
            best = -1
            for s in range(SLOTS):
                z = float(heights[i, j, s])
                if np.isnan(z) or (best >= 0 and z <= heights[i, j, best]):
                    continue
                # Where fewer than min_views votes are expected, an empty neighbour means nothing.
                needed = along_ratio if expected[i, j, s] < min_views else own_ratio
                if share[i, j, s] >= needed or _share_along(heights, share, i, j, z, cell_m) >= along_ratio:
                    best = s
            winner[i, j] = best
    return winner


@kernel()
def _share_along(heights: Float32, share: Float32, row: int, column: int, z: float, cell_m: float) -> float:
    """Average the support of a height and similar ones within `_ALONG` cells (every third is read), along the
    one of four directions in which most of the tile's cells have one: the bar's own, or the edge's.

    heights, share: (rows, columns, SLOTS) of `_support`, heights NaN where share is -1. z: the height, m.
    """
    most, result = -1, 0.0
    for direction in range(4):
        di, dj = (0, 1, 1, 1)[direction], (1, 0, 1, -1)[direction]
        alike, inside, total = 0, 0, 0.0
        for n in range(-_ALONG, _ALONG + 1, 3):
            if alike + (_ALONG - n) // 3 + 1 <= most:
                break
            i, j = row + n * di, column + n * dj
            if i < 0 or j < 0 or i >= heights.shape[0] or j >= heights.shape[1]:
                continue
            inside += 1
            for s in range(SLOTS):
                if abs(heights[i, j, s] - z) <= _ALIKE_CELLS * cell_m:
                    alike += 1
                    total += share[i, j, s]
                    break
        if alike > most:
            most, result = alike, total / inside
    return result
