"""The orthophoto: the grey level of each cell's height, as a GeoTIFF on height.tif's grid and as a PNG."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

import barsight
from barsight.core.arrays import UInt8
from barsight.core.files import atomic_path
from barsight.mapping.surface import Surface, grey_levels

NO_DATA = 0
_SIDE = 256


def georeference(surface: Surface) -> list[tuple[int, str, int, Any, bool]]:
    """Tags that place a raster of the surface: a projected system of its own (32767), pixels as areas, m."""
    cell = surface.cell_m
    left, top = (surface.columns[0] - 0.5) * cell, (surface.rows[1] - 0.5) * cell
    keys = (1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32767, 3076, 0, 1, 9001)
    return [
        (33550, "d", 3, (cell, cell, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, left, top, 0.0), True),
        (34735, "H", len(keys), keys, True),
    ]


def orthophoto(surface: Surface) -> Iterator[UInt8]:
    """Grey levels from 1, NO_DATA where no view saw the cell, from the highest y on: _SIDE rows at a time,
    fewer at last."""
    rows, columns = surface.shape
    for row in range(0, rows, _SIDE):
        count = min(_SIDE, rows - row)
        lowest = surface.rows[1] - row - count
        strip = np.empty((count, columns), np.uint8)
        for column in range(0, columns, _SIDE):
            width = min(_SIDE, columns - column)
            part = surface.window(surface.columns[0] + column, lowest, width, count)
            strip[:, column : column + width] = grey_levels(part.intensity)[::-1]
        yield strip


def write_orthophoto(surface: Surface, folder: Path) -> None:
    """ortho.tif and ortho.png, each whole or not at all."""
    with atomic_path(folder / "ortho.tif") as path:
        tifffile.imwrite(
            path,
            _tiles(orthophoto(surface)),
            shape=surface.shape,
            dtype=np.uint8,
            photometric="minisblack",
            tile=(_SIDE, _SIDE),
            compression="zlib",
            metadata=None,
            software=f"barsight {barsight.__version__}",
            extratags=[*georeference(surface), (42113, "s", 0, str(NO_DATA), True)],
        )
    with atomic_path(folder / "ortho.png") as path:
        _write_png(orthophoto(surface), surface.shape, path)


def _tiles(strips: Iterator[UInt8]) -> Iterator[UInt8]:
    for strip in strips:
        for column in range(0, strip.shape[1], _SIDE):
            part = strip[:, column : column + _SIDE]
            tile = np.full((_SIDE, _SIDE), NO_DATA, np.uint8)
            tile[: part.shape[0], : part.shape[1]] = part
            yield tile


def _write_png(strips: Iterator[UInt8], shape: tuple[int, int], path: Path) -> None:
    """A grey PNG [RFC 2083], strip by strip; stored is what each pixel is more than the one before it."""
    packer = zlib.compressobj(1, strategy=zlib.Z_RLE)
    with path.open("wb") as file:

        def write(kind: bytes, content: bytes) -> None:
            file.write(struct.pack(">I", len(content)) + kind + content)
            file.write(struct.pack(">I", zlib.crc32(kind + content)))

        file.write(b"\x89PNG\r\n\x1a\n")
        write(b"IHDR", struct.pack(">IIBBBBB", shape[1], shape[0], 8, 0, 0, 0, 0))
        for strip in strips:
            rows = np.diff(np.pad(strip, ((0, 0), (1, 0))), axis=1, prepend=np.uint8(0))
            rows[:, 0] = 1
            write(b"IDAT", packer.compress(rows.tobytes()))
        write(b"IDAT", packer.flush())
        write(b"IEND", b"")
