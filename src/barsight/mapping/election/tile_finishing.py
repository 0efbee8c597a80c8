"""Finish an elected tile: average it along the bars, sharpen it across them, and fill its narrow gaps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float32, Int8
from barsight.mapping.settings import MapSettings
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.surface.bar_directions import BLOCK_CELLS
from barsight.mapping.surface.bar_profiles import REACH_CELLS, draw_bars
from barsight.mapping.surface.directional_filter import (
    VOTE_CELLS,
    blur_sigma,
    deblur_across,
    smooth_along_bars,
    step_sigma,
    valley_mask,
    vote_directions,
)
from barsight.mapping.surface.height_selection import ViewFrusta
from barsight.mapping.surface.picture_stripes import NODE_CELLS, find_stripes
from barsight.mapping.surface.surface import Layers, fill_gaps, paste, read_tile
from barsight.mapping.tiles import TILE_CELLS, tiles_around

_ALONG_CELLS = 28
"""Maximum distance along a bar, to either side, over which heights are averaged."""
_HALO = -(-(_ALONG_CELLS + 1 + VOTE_CELLS // 2 + REACH_CELLS) // BLOCK_CELLS) * BLOCK_CELLS
"""Width, in cells, of the margin around a tile that its result depends on: the reach along a bar, and what
is read beside it. It is rounded up to whole blocks, so that stripes and directions are searched for at the
same cells in a tile and in its neighbours' halos.
"""


def finished_layers(
    elected: Path, key: TileKey, keys: frozenset[TileKey], frusta: ViewFrusta, seen_from_m: float,
    cell_m: float, settings: MapSettings,
) -> tuple[Layers, Float32]:  # fmt: skip
    """Average the tile along the bars, sharpen it and fill its narrow gaps, reading no further than the halo
    around it. Returns the layers, and the sigma that blur and gloss leave on bars.

    elected: folder of the elected tiles, `keys`. seen_from_m: height of the cameras that see this one.
    """
    along = min(round(settings.along_m / cell_m), _ALONG_CELLS)
    reach = min(round(settings.fill_m / cell_m), _HALO)
    side = TILE_CELLS + 2 * _HALO
    around = Layers.unknown(side, side)
    column, row = key[0] * TILE_CELLS - _HALO, key[1] * TILE_CELLS - _HALO
    for neighbour in tiles_around(key):
        if neighbour in keys:
            paste(read_tile(elected, neighbour), neighbour, around, column, row)
    blur = np.zeros((side, side), np.float32)
    if along > 0:
        weight: Float32 = np.nan_to_num(1 / (around.sigma_m * around.sigma_m))
        z, direction = smooth_along_bars(around.z_m, weight, settings.min_gate_m, along)
        pixel_m = frusta.pixel_m(z, seen_from_m)
        sharp = deblur_across(z, direction, settings.sharpen_px * pixel_m / cell_m)
        blur = blur_sigma(sharp - z, valley_mask(sharp, _within(direction, reach)))
        pixel_cells = float(np.nanmedian(pixel_m)) / cell_m if np.isfinite(pixel_m).any() else 1.0
        steps = step_sigma(sharp, pixel_cells)
        bar = _within(vote_directions(direction), reach + NODE_CELLS)
        stripes = find_stripes(z, around.intensity, bar, cell_m)
        draws, pixel = settings.thin_bars == "drawn", pixel_m / np.float32(cell_m)
        bars, unsure, hidden = draw_bars(z, bar, stripes, pixel, cell_m, draws)
        drawn = np.isfinite(bars)
        sharp = np.where(drawn, bars, sharp)
        blur = np.where(drawn, unsure, np.maximum(blur, hidden))
        around = replace(around, z_m=sharp, sigma_m=np.sqrt(around.sigma_m**2 + blur**2 + steps**2))
    if reach > 0:
        fill_gaps(around, reach)
    inner = slice(_HALO, _HALO + TILE_CELLS)
    return around.part(inner, inner), blur[inner, inner]


def _within(direction: Int8, margin: int) -> Int8:
    """Keep the directions of the tile and of a margin of cells around it, and set those further out to -1,
    where nothing is read.
    """
    out = max(_HALO - margin, 0)
    inner = slice(out, direction.shape[0] - out)
    kept = np.full_like(direction, -1)
    kept[inner, inner] = direction[inner, inner]
    return kept
