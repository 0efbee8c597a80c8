"""Append records to files that a killed writer leaves readable: readings in fixed rows, frames in lines."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float64, Int64


class ReadingLog:
    """Rows of a stamp (int64, ns) and `width` float64; one process appends, any may read.

    An incomplete row at the end was left by a killed writer: readers ignore it, the next writer cuts it off.
    """

    def __init__(self, path: Path, width: int) -> None:
        self._path, self._width, self._row = path, width, 8 * (1 + width)
        self._rows_read = 0

    def append(self, stamp_ns: Int64, values: Float64) -> None:
        """Append rows: (N,) stamps, (N, width) values."""
        rows = np.empty((len(stamp_ns), 1 + self._width), np.float64)
        rows[:, 0] = np.ascontiguousarray(stamp_ns, np.int64).view(np.float64)
        rows[:, 1:] = values
        with self._path.open("ab") as file:
            whole = file.tell() // self._row * self._row
            if whole != file.tell():
                file.truncate(whole)
            file.write(rows.tobytes())

    def read(self) -> tuple[Int64, Float64]:
        """Return the rows appended since the last call: (N,) stamps, (N, width) values."""
        rows = self._rows(self._rows_read)
        self._rows_read += len(rows)
        return rows[:, 0].copy().view(np.int64), rows[:, 1:].copy()

    def last(self, count: int) -> tuple[Int64, Float64]:
        """Return the last `count` rows, or as many as there are."""
        size = self._path.stat().st_size // self._row if self._path.exists() else 0
        rows = self._rows(max(size - count, 0))[:count]  # it may have grown since
        return rows[:, 0].copy().view(np.int64), rows[:, 1:].copy()

    def _rows(self, first: int) -> Float64:
        if not self._path.exists():
            return np.empty((0, 1 + self._width))
        with self._path.open("rb") as file:
            file.seek(first * self._row)
            data = file.read()
        count = len(data) // self._row
        return np.frombuffer(data[: count * self._row], np.float64).reshape(count, 1 + self._width)


class NumberLog:
    """Lines of whole numbers; one process appends, any may read. An incomplete last line is ignored."""

    def __init__(self, path: Path) -> None:
        self._path, self._place, self._is_whole = path, 0, False

    def append(self, numbers: Iterable[int]) -> None:
        """Append a line in one write; the first write cuts off what a killed writer left."""
        line = (",".join(str(int(number)) for number in numbers) + "\n").encode("ascii")
        if not self._is_whole and self._path.exists():
            os.truncate(self._path, self._path.read_bytes().rfind(b"\n") + 1)
        self._is_whole = True
        with self._path.open("ab") as file:
            file.write(line)

    def read(self) -> list[tuple[int, ...]]:
        """Return the lines appended since the last call."""
        if not self._path.exists():
            return []
        with self._path.open("rb") as file:
            file.seek(self._place)
            data = file.read()
        whole = data[: data.rfind(b"\n") + 1]
        self._place += len(whole)
        return [tuple(map(int, line.split(b","))) for line in whole.splitlines()]
