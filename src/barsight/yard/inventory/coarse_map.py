"""Keep a coarse copy of each survey's heights in the store, to look up the state of a place later."""

from __future__ import annotations

import json
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Bool
from barsight.yard.sections import PartedMap
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
    known = np.isfinite(z)
    mm = np.where(known, np.clip(np.round(1e3 * z), -32000, 32000), _UNKNOWN).astype("<i2")
    head = json.dumps([heights.x0_m, heights.y0_m, step * heights.cell_m, *mm.shape])
    seen = np.packbits(known, axis=1).tobytes()
    return zlib.compress(head.encode() + b"\n" + seen) + zlib.compress(mm.tobytes())


def unpack(packed: bytes) -> HeightMap:
    """Read the output of `pack`; sigma and views are not kept."""
    (x0_m, y0_m, cell_m, *shape), seen, body = _parted(packed)
    mm = np.frombuffer(zlib.decompress(body) if body else seen, "<i2").reshape(shape)
    return _known_map(x0_m, y0_m, cell_m, mm != _UNKNOWN, mm)


def unpack_seen(packed: bytes) -> YardMap:
    """Read only which places were seen, 0 m high there: a small part of the time to read their heights."""
    (x0_m, y0_m, cell_m, *shape), seen, body = _parted(packed)
    if not body:
        return unpack(packed)
    bits = np.frombuffer(seen, np.uint8).reshape(shape[0], -1)

    def read(rows: slice, columns: slice) -> HeightMap:
        known = np.unpackbits(bits[rows], axis=1, count=shape[1])[:, columns].astype(np.bool_)
        origin = x0_m + cell_m * columns.start, y0_m + cell_m * rows.start
        return _known_map(*origin, cell_m, known, np.zeros(known.shape, np.int16))

    return PartedMap(x0_m, y0_m, cell_m, (shape[0], shape[1]), read)


def _parted(packed: bytes) -> tuple[list[Any], bytes, bytes]:
    """Read place and size, and the bits of what was seen; return the heights still packed. Maps of earlier
    versions have no bits: their heights are returned in place of these.
    """
    first = zlib.decompressobj()
    head, _, seen = first.decompress(packed).partition(b"\n")
    return json.loads(head), seen, first.unused_data


def _known_map(x0_m: float, y0_m: float, cell_m: float, known: Bool, mm: NDArray[np.int16]) -> HeightMap:
    z = np.where(known, mm / np.float32(1e3), np.float32(np.nan)).astype(np.float32)
    return HeightMap(x0_m, y0_m, cell_m, z, np.full_like(z, np.nan), np.zeros_like(z), known.astype(np.uint8))
