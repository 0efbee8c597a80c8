"""Read the GeoTIFFs of a result folder: tiled maps whose row 0 is at the highest y."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from barsight.core.errors import MEASURE_AGAIN, InputError
from barsight.core.reading.bounded_reading import open_regular

HEIGHT_BANDS = 4
"""Bands of height.tif: z, sigma, views, source."""
MAX_CELLS = 1 << 28
"""Maximum number of cells of a map: 26,000 m^2 at 10 mm. A small file may claim any number."""
_MAX_SLACK_BYTES = 1 << 26
"""Maximum size of a map's file beyond its cells: tiles that extend over the border, offsets, tags."""
_READ_BYTES = 1 << 22
"""Size of a read; tifffile would read 256 MiB ahead."""
_TORN = (
    tifffile.TiffFileError, zlib.error, struct.error, OSError, ValueError, KeyError, IndexError, RuntimeError,
    TypeError, AttributeError, AssertionError, OverflowError, ZeroDivisionError, MemoryError,
)  # fmt: skip
"""Exceptions that tifffile raises for a file that is cut short or isn't a TIFF."""


@dataclass(frozen=True, eq=False)
class GeoTiff:
    """An open map of (bands, H, W) or (H, W) cells. left_m, top_m: the outer corner of cell (0, 0)."""

    page: tifffile.TiffPage
    cell_m: float
    left_m: float
    top_m: float

    @property
    def size(self) -> tuple[int, int]:
        """Return the numbers of rows and columns."""
        height, width = self.page.shape[-2:]
        return height, width

    def tiles(self) -> Iterator[tuple[int, int, int, NDArray[Any]]]:
        """Yield each tile's band, first row and first column, and its cells within the map."""
        height, width = self.size
        for data, index, _ in self.page.segments(maxworkers=1, buffersize=_READ_BYTES):
            if data is not None:
                row, column = int(index[2]), int(index[3])
                yield int(index[0]), row, column, data[0, : height - row, : width - column, 0]

    def rectangle(self, bands: int, rows: slice, columns: slice) -> NDArray[Any]:
        """Read (bands, R, C); rows are counted and returned from the lowest y."""
        page, (height, width) = self.page, self.size
        top, left = height - rows.stop, columns.start
        out = np.empty((bands, rows.stop - rows.start, columns.stop - left), page.dtype)
        down, across = -(-height // page.tilelength), -(-width // page.tilewidth)
        wanted = [
            (band * down + i) * across + j
            for band in range(bands)
            for i in range(top // page.tilelength, -(-(height - rows.start) // page.tilelength))
            for j in range(left // page.tilewidth, -(-columns.stop // page.tilewidth))
        ]
        file = page.parent.filehandle
        for number in wanted:
            file.seek(page.dataoffsets[number])
            data, index, _ = page.decode(file.read(page.databytecounts[number]), number)
            if data is None:
                raise ValueError(f"tile {number} is empty")
            i, j = index[2] - top, index[3] - left
            target = out[index[0], max(i, 0) : i + page.tilelength, max(j, 0) : j + page.tilewidth]
            shown = data[0, max(-i, 0) :, max(-j, 0) :, 0]
            target[:] = shown[: target.shape[0], : target.shape[1]]
        return np.ascontiguousarray(out[:, ::-1])


@contextmanager
def open_geotiff(path: Path, bands: int = 1) -> Iterator[GeoTiff]:
    """Open a tiled map with this number of planar bands.

    Raises InputError for anything else, and where the file proves damaged while it is open.
    """
    try:
        with open_regular(path, MEASURE_AGAIN) as stream, tifffile.TiffFile(stream) as file:
            page = file.pages.first
            assert isinstance(page, tifffile.TiffPage) and page.dtype is not None
            planar = (
                len(page.shape) == 2 if bands == 1 else page.shape[:-2] == (bands,) and page.planarconfig == 2
            )
            if not planar or not page.is_tiled or min(page.shape) < 1:
                raise InputError(
                    path, f"has the shape {page.shape}, not {bands} planar bands in tiles", MEASURE_AGAIN
                )
            if math.prod(page.shape) > MAX_CELLS * bands:
                raise InputError(
                    path,
                    f"has {math.prod(page.shape) // bands} cells, at most {MAX_CELLS} are read",
                    MEASURE_AGAIN,
                )
            size = path.stat().st_size
            most = 2 * math.prod(page.shape) * page.dtype.itemsize + _MAX_SLACK_BYTES
            if size > most:
                raise InputError(path, f"has {size} bytes, its cells take {most} at most", MEASURE_AGAIN)
            cell_m = float(page.tags["ModelPixelScaleTag"].value[0])
            left_m, top_m = (float(v) for v in page.tags["ModelTiepointTag"].value[3:5])
            if not (0 < cell_m < 1e3 and abs(left_m) < 1e6 and abs(top_m) < 1e6):
                raise InputError(
                    path, "is nowhere on earth: its cells or its corner are impossible", MEASURE_AGAIN
                )
            yield GeoTiff(page, cell_m, left_m, top_m)
    except _TORN as error:
        raise InputError(path, f"is damaged ({error})", MEASURE_AGAIN) from error
