"""Carve unseen places beside bundles by photo-consistency (space carving, Kutulakos and Seitz 2000).

Matching finds nothing in a dark gully between two bundles, so that nothing bounds what stands there. But
something as high as the bundles would show the same brightness to all views. Where some views show the
dark of the gully and others a flank, at each height from the known bound down to the bundle's top, nothing
that high stands there. Something dark and glossy, whose highlight only some views show, may be taken for a
gully: so this is off unless `map.carve_gullies` is set.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from barsight.bundle_pictures.samples import PlacedFrames, bundle_axes, is_placed
from barsight.core.arrays import Bool, Float32, Float64, UInt8, kernel
from barsight.core.pose import Pose
from barsight.core.records.pairs import RefusedFrame
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.yard.map_lookup import CellGrid, is_blocked
from barsight.yard.sections import patches
from barsight.yard.types import Bundle, HeightMap, YardMap

BESIDE_M, BELOW_M = 0.3, 0.02
"""Distance around a bundle and depth below its top to which unseen places are carved."""
MIN_RATIO = 2.5
"""Minimum ratio of the brightness that OUTER_RATIO of the views exceed to that under which OUTER_RATIO lie,
both as seen and over the mean brightness around, for nothing to stand at a height.
"""
OUTER_RATIO = 0.15
MIN_VIEWS = 10
"""Minimum number of pictures, two of each frame, that must show a place."""
STEP_M = 0.01
"""Step between the heights tested."""
DARK = 4.0
"""Offset added to gray levels before their ratio, so that noise in dark areas counts less."""
_PATCH_CELLS, _MARGIN_M = 512, 0.5
"""Side of the patches that are carved at a time, and the part of the map around one that may hide it."""
_AROUND_PX, _STRIDE_PX = 151, 8
"""Window of the mean brightness, and the step between its samples."""
_MAX_FRAMES = 32
"""Maximum number of frames for a patch; of more, every second, third or further one is used."""


@dataclass(frozen=True, eq=False)
class CarvedPatch:
    """New upper bounds (rows, columns) of what stands in each cell from `row` and `column` of a map on, m;
    inf where nothing new is proven.
    """

    row: int
    column: int
    bound_m: Float32


class CarvingViews(NamedTuple):
    """Pictures (V, H, W), 0 where they show nothing valid; their mean brightness around each _STRIDE_PX
    pixels; their projections (V, 3, 4) of places in the map to pixels; their positions (V, 3).
    """

    pictures: UInt8
    around: UInt8
    projections: Float64
    eyes: Float64


def carve_beside(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], yard: YardMap, bundles: Sequence[Bundle]
) -> Iterator[CarvedPatch]:
    """Carve the unseen places within and beside the bundles on top.

    poses: reference_from_body by the stamp of each frame that may be used.
    """
    frames = PlacedFrames.of(pairs.rectifier, poses)
    highest = [bundle for bundle in bundles if bundle.on_top is not False and is_placed(bundle)]
    margin = math.ceil(_MARGIN_M / yard.cell_m)
    for rows, columns in patches(yard, _PATCH_CELLS):
        top, left = max(rows.start - margin, 0), max(columns.start - margin, 0)
        part = yard.part(
            slice(top, min(rows.stop + margin, yard.shape[0])),
            slice(left, min(columns.stop + margin, yard.shape[1])),
        )
        if part.free_m is None:
            return
        own = (slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left))
        low = _depths(part, highest)
        wanted = np.zeros(part.shape, bool)
        # With the cells around the patch, so that no proven place ends at its border.
        wanted[max(own[0].start - 1, 0) : own[0].stop + 1, max(own[1].start - 1, 0) : own[1].stop + 1] = True
        wanted &= np.isnan(part.z_m) & (low < part.free_m) & np.isfinite(part.free_m)
        if wanted[own].any():
            bound = _carved(pairs, frames, part, wanted, low)[own]
            yield CarvedPatch(rows.start, columns.start, bound)


def _depths(part: HeightMap, bundles: Sequence[Bundle]) -> Float32:
    """Return the depth (rows, columns) to which each cell is carved; inf away from all bundles."""
    x, y = np.meshgrid(part.x_m, part.y_m)
    low = np.full(part.shape, np.inf, np.float32)
    for bundle in bundles:
        along, across = bundle_axes(bundle)
        from_x, from_y = x - bundle.centre_m[0], y - bundle.centre_m[1]
        inside = np.abs(from_x * along[0] + from_y * along[1]) < bundle.length_m / 2 + BESIDE_M
        inside &= np.abs(from_x * across[0] + from_y * across[1]) < bundle.width_m / 2 + BESIDE_M
        low[inside] = np.minimum(low[inside], np.float32(bundle.top_z_m - BELOW_M))
    return low


def _carved(
    pairs: RectifiedPairs, frames: PlacedFrames, part: HeightMap, wanted: Bool, low: Float32
) -> Float32:
    """Return the bounds (rows, columns) of the wanted cells; inf elsewhere and where nothing is proven."""
    free = np.asarray(part.free_m, np.float32)
    rows, columns = np.nonzero(wanted)
    places = np.stack([part.x_m[columns], part.y_m[rows], free[rows, columns].astype(np.float64)], axis=1)
    views = _views(pairs, frames, places)
    if views is None:
        return np.full(part.shape, np.inf, np.float32)
    bound = np.full(part.shape, np.inf, np.float32)
    bound[rows, columns] = carve_cells(places, low[rows, columns], views, CellGrid.of(part))
    bound[~(bound < free)] = np.inf
    # Single cells are dropped: most that are proven wrongly are single ones at the edges of things.
    return np.asarray(ndimage.grey_closing(bound, (2, 2), mode="constant", cval=np.inf), np.float32)


def _views(pairs: RectifiedPairs, frames: PlacedFrames, places: Float64) -> CarvingViews | None:
    """Read the pictures that may show any of the places (N, 3); None if too few do."""
    ends = np.stack([places.min(axis=0), places.max(axis=0)])
    corners = np.stack(np.meshgrid(*ends.T), axis=-1).reshape(-1, 3)
    showing = [k for k in range(len(frames.stamps_ns)) if _may_show(frames, k, corners)]
    chosen = showing[:: math.ceil(len(showing) / _MAX_FRAMES)] if showing else []
    views = list[tuple[UInt8, UInt8, Float64, Float64]]()
    for pair in pairs({frames.stamps_ns[k] for k in chosen}):
        if isinstance(pair, RefusedFrame):
            continue
        cameras = frames.cameras[frames.stamps_ns.index(pair.stamp_ns)]
        for picture, valid, camera in zip(
            (pair.left, pair.right), (pair.left_valid, pair.right_valid), cameras, strict=True
        ):
            around = cv2.blur(picture, (_AROUND_PX, _AROUND_PX))[::_STRIDE_PX, ::_STRIDE_PX]
            shown = np.where(valid, np.maximum(picture, 1), 0).astype(np.uint8)
            views.append((shown, around, camera.projection, camera.map_from_rect.translation))
    if len(views) < MIN_VIEWS:
        return None
    pictures, around, projections, eyes = (np.stack(layer) for layer in zip(*views, strict=True))
    return CarvingViews(pictures, around, projections, eyes)


def _may_show(frames: PlacedFrames, k: int, corners: Float64) -> bool:
    """Check whether a frame's left picture may show something between the corners (8, 3)."""
    at, _ = frames.cameras[k][0].project(corners)
    return bool((at.max(axis=0) > 0).all() and (at.min(axis=0) < np.array(frames.size_px)).all())


@kernel()
def carve_cells(places: Float64, low: Float32, views: CarvingViews, heights: CellGrid) -> Float32:
    """Lower the bounds of cells (N,) while no height is photo-consistent.

    places: (N, 3) the cells at their known bounds. low: (N,) where to stop. heights: that may hide them.
    """
    count = len(views.pictures)
    gray, relative = np.empty(count, np.float32), np.empty(count, np.float32)
    out = np.empty(low.size, np.float32)
    for n in range(low.size):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        out[n] = z
        while out[n] > low[n]:
            seen = 0
            for v in range(count):
                level, around = _brightness(views, v, x, y, z)
                if level > 0 and not is_blocked(heights, (x, y, z), views.eyes[v], 0.0):
                    gray[seen] = level + DARK
                    relative[seen] = gray[seen] / (around + DARK)
                    seen += 1
            if seen < MIN_VIEWS or min(_spread(gray[:seen]), _spread(relative[:seen])) < MIN_RATIO:
                break
            out[n] = z
            z -= STEP_M
    return out


@kernel()
def _spread(values: Float32) -> float:
    """Compute the ratio of the values (V,) that OUTER_RATIO of them exceed and fall short of."""
    ordered = np.sort(values)
    outer = int(ordered.size * OUTER_RATIO)
    return float(ordered[ordered.size - 1 - outer] / ordered[outer])


@kernel()
def _brightness(views: CarvingViews, v: int, x: float, y: float, z: float) -> tuple[float, float]:
    """Interpolate the gray level of a place in a picture, and look up that around it; 0, 0 where the picture
    doesn't show it.
    """
    to, picture, around = views.projections[v], views.pictures[v], views.around[v]
    depth = to[2, 0] * x + to[2, 1] * y + to[2, 2] * z + to[2, 3]
    right = (to[0, 0] * x + to[0, 1] * y + to[0, 2] * z + to[0, 3]) / depth
    down = (to[1, 0] * x + to[1, 1] * y + to[1, 2] * z + to[1, 3]) / depth
    if not (depth > 0 and 0 <= right < picture.shape[1] - 1 and 0 <= down < picture.shape[0] - 1):
        return 0.0, 0.0
    i, j = int(down), int(right)
    a, b = right - j, down - i
    corners = picture[i, j], picture[i, j + 1], picture[i + 1, j], picture[i + 1, j + 1]
    if min(corners) == 0:
        return 0.0, 0.0
    level = (1 - b) * ((1 - a) * corners[0] + a * corners[1]) + b * ((1 - a) * corners[2] + a * corners[3])
    return level, float(around[i // _STRIDE_PX, j // _STRIDE_PX])
