"""Find the floor under the stack, where the map shows some of it."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float32
from barsight.core.records.heights import HeightSource
from barsight.yard.sections import patches
from barsight.yard.types import HeightMap, YardMap

_BLOCK_M = 0.3
_FLAT_M = 0.012
_LEVEL_M = 0.03
_KNOWN_RATIO = 0.6
_PATCH_BLOCKS = 64
_SUNKEN_M, _SUNKEN_RATIO = 0.04, 0.2
"""Maximum depth of an outline below the floor due to the map's errors: the smaller of the first (m) and the
second (in widths).
"""


def find_floor(yard: YardMap) -> float | None:
    """Find the height (m) of the lowest level ground in the map; None where no block of 0.3 m is level.

    No bundle has a level top of 0.3 m, so a level block is floor, or a platform: the lowest blocks count.
    """
    block = max(round(_BLOCK_M / yard.cell_m), 2)
    found = [_levels(yard.part(*patch), block) for patch in patches(yard, _PATCH_BLOCKS * block)]
    level = np.sort(np.concatenate([*found, np.empty(0, np.float32)]))
    if level.size == 0:
        return None
    return float(np.median(level[level < level[max(level.size // 50, 0)] + _LEVEL_M]))


def _levels(height_map: HeightMap, block: int) -> Float32:
    """Compute the median heights of the blocks that are level."""
    rows, columns = (n // block for n in height_map.shape)
    part = np.s_[: rows * block, : columns * block]
    z = np.where(HeightSource.measured(height_map.source[part]), height_map.z_m[part], np.nan)
    cut = z.reshape(rows, block, columns, block)
    blocks = cut.transpose(0, 2, 1, 3).reshape(rows * columns, block * block)
    known = np.isfinite(blocks).sum(axis=1)
    enough = known >= _KNOWN_RATIO * blocks.shape[1]
    ordered, at = np.sort(blocks[enough], axis=1), known[enough] - 1  # NaN last
    low, middle, high = (ordered[np.arange(at.size), np.rint(q * at).astype(int)] for q in (0.1, 0.5, 0.9))
    level: Float32 = middle[high - low < 2 * _FLAT_M]
    return level


def is_sunken(floor_m: float | None, bottom_m: float, width_m: float) -> bool:
    """Check whether an outline reaches further below the floor than the map's errors explain."""
    return floor_m is not None and floor_m - bottom_m >= min(_SUNKEN_M, _SUNKEN_RATIO * width_m)
