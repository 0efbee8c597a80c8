"""Read the vertices of a PLY file: scalar properties, ASCII or binary of either byte order.

Format: G. Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from barsight.core.reading.bounded_reading import open_regular

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1",
    "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_BYTES = 1 << 16


class _Header(NamedTuple):
    """form: a key of _BYTE_ORDERS. size: in bytes. elements: name, count and fields (name and type; None for
    lists) of each up to the vertices."""

    form: str
    size: int
    elements: list[tuple[str, int, list[tuple[str, str]] | None]]


def read_vertices(path: Path) -> NDArray[Any]:
    """Read the element `vertex` as a structured array (N,). A binary one is mapped from disk, not loaded.

    What follows the vertices isn't read. Raises ValueError for a file that isn't PLY or is cut short, and for
    lists in or before the vertices.
    """
    with open_regular(path) as file:
        header = _read_header(file)
        dtypes = []
        for name, count, fields in header.elements:
            if not fields:
                raise ValueError(f"element {name} has {'lists' if fields is None else 'no properties'}")
            dtypes.append(
                (count, np.dtype([(field, _BYTE_ORDERS[header.form] + kind) for field, kind in fields]))
            )
        count, dtype = dtypes.pop()
        rest = path.stat().st_size - header.size
        if header.form == "ascii":
            before = sum(other for other, _ in dtypes)
            return _read_ascii(file, before, count, dtype, rest)
    before = sum(other * each.itemsize for other, each in dtypes)
    if before + count * dtype.itemsize > rest:
        raise ValueError(
            f"{count} vertices take {count * dtype.itemsize} bytes, {max(rest - before, 0)} are there"
        )
    if count == 0:
        return np.empty(0, dtype)
    return np.memmap(path, dtype, "r", header.size + before, (count,))


def _read_header(file: BinaryIO) -> _Header:
    form, size = "", 0
    elements: list[tuple[str, int, list[tuple[str, str]] | None]] = []
    while size < _MAX_HEADER_BYTES:
        line = file.readline(_MAX_HEADER_BYTES)
        if size == 0 and line.strip() != b"ply":
            raise ValueError("doesn't begin with ply")
        size += len(line)
        match line.decode("ascii", "replace").split():
            case ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _BYTE_ORDERS:
                form = name
            case ["element", name, count] if count.isdecimal():
                elements.append((name, int(count), []))
            case ["property", "list", _, _, _] if elements:
                elements[-1] = (*elements[-1][:2], None)
            case ["property", kind, name] if kind in _TYPES and elements:
                fields = elements[-1][2]
                if fields is not None:
                    fields.append((name, _TYPES[kind]))
            case ["end_header"]:
                break
            case _:
                raise ValueError(f"{line[:60]!r} in the header")
    else:
        raise ValueError("the header has no end")
    names = [name for name, _, _ in elements]
    if not form or "vertex" not in names:
        raise ValueError(f"the header names no {'element vertex' if form else 'format'}")
    return _Header(form, size, elements[: names.index("vertex") + 1])


def _read_ascii(file: BinaryIO, before: int, count: int, dtype: np.dtype[Any], rest: int) -> NDArray[Any]:
    """Read `count` lines after `before` others; each number takes two bytes or more of the `rest`."""
    if 2 * count * len(dtype.names or ()) > rest + 1:
        raise ValueError(f"{count} vertices don't fit into {rest} bytes")
    lines = [line.decode("ascii") for line in islice(file, before, before + count) if line.strip()]
    if len(lines) != count:
        raise ValueError(f"{len(lines)} of {count} vertices are there")
    if count == 0:
        return np.empty(0, dtype)
    table: NDArray[Any] = np.loadtxt(lines, dtype, comments=None, ndmin=1)
    return table
