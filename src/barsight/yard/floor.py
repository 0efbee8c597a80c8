"""The floor under the stack, where the map shows some of it."""

from __future__ import annotations

import numpy as np

from barsight.core.types import Source
from barsight.yard.types import HeightMap

_BLOCK_M = 0.3
_FLAT_M = 0.012
_LEVEL_M = 0.03
_KNOWN_SHARE = 0.6


def find_floor(height_map: HeightMap) -> float | None:
    """Height (m) of the lowest level ground in the map; None where no block of 0.3 m is level.

    No bundle has a level top of 0.3 m, so level blocks are floor (or a platform: the lowest counts).
    """
    block = max(round(_BLOCK_M / height_map.cell_m), 2)
    rows, columns = (n // block for n in height_map.z_m.shape)
    if rows == 0 or columns == 0:
        return None
    z = np.where(height_map.source == Source.VISION, height_map.z_m, np.nan)
    cut = z[: rows * block, : columns * block].reshape(rows, block, columns, block)
    blocks = cut.transpose(0, 2, 1, 3).reshape(rows * columns, -1)
    known = np.isfinite(blocks).sum(axis=1)
    enough = known >= _KNOWN_SHARE * blocks.shape[1]
    if not enough.any():
        return None
    ordered, last = np.sort(blocks[enough], axis=1), known[enough] - 1  # NaN last
    low, middle, high = (
        ordered[np.arange(last.size), np.rint(q * last).astype(int)] for q in (0.1, 0.5, 0.9)
    )
    level = np.sort(middle[high - low < 2 * _FLAT_M])
    if level.size == 0:
        return None
    return float(np.median(level[level < level[max(level.size // 50, 0)] + _LEVEL_M]))
