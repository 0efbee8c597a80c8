"""Keep a coarse copy of each survey's heights in the store, to look up the state of a place later."""

from __future__ import annotations

import json
import zlib

import numpy as np

from barsight.yard.types import HeightMap, YardMap

CELL_M = 0.1
"""Approximate side (m) of a coarse cell."""
_STRIPE = 256
"""Number of the map's rows that are read at once."""
_UNKNOWN = np.iinfo(np.int16).min


def pack(heights: YardMap) -> bytes:
    """Take every tenth 10 mm cell in both directions, in mm; filled cells become unknown."""
    step = max(1, round(CELL_M / heights.cell_m))
    rows, columns = heights.shape
    stripe = step * max(1, _STRIPE // step)
    parts = (
        heights.part(slice(first, min(first + stripe, rows)), slice(0, columns))
        for first in range(0, rows, stripe)
    )
    nan = np.float32(np.nan)
    z = np.concatenate([np.where(part.is_seen, part.z_m, nan)[::step, ::step] for part in parts])
    mm = np.where(np.isfinite(z), np.clip(np.round(1e3 * z), -32000, 32000), _UNKNOWN).astype("<i2")
    head = json.dumps([heights.x0_m, heights.y0_m, step * heights.cell_m, *mm.shape])
    return zlib.compress(head.encode() + b"\n" + mm.tobytes())


def unpack(packed: bytes) -> HeightMap:
    """Read the output of `pack`; sigma and views are not kept."""
    head, _, body = zlib.decompress(packed).partition(b"\n")
    x0_m, y0_m, cell_m, rows, columns = json.loads(head)
    mm = np.frombuffer(body, "<i2").reshape(rows, columns)
    known = mm != _UNKNOWN
    z = np.where(known, mm / np.float32(1e3), np.float32(np.nan)).astype(np.float32)
    return HeightMap(x0_m, y0_m, cell_m, z, np.full_like(z, np.nan), np.zeros_like(z), known.astype(np.uint8))
