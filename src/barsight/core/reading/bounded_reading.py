"""Read files that others made: regular ones only, and no larger, deeper or longer than they may be.

A name in a recording or a result folder may hide a pipe, a device or a file of any size; a short file may
stand for a long one (nested brackets, numbers of 400 digits, packed zeros). Every reader of text, TOML, JSON
and archives goes through here; YAML's own traps are in `calibration.files.yaml_document`.
"""

from __future__ import annotations

import io
import json
import os
import stat
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from barsight.core.errors import InputError

MAX_TABLE_BYTES = 512 << 20
"""Maximum size of a table of numbers: five hours of an IMU at 200 Hz take 400 MB."""
MAX_DOCUMENT_BYTES = 256 << 20
"""Maximum size of a JSON result."""
MAX_SETTINGS_BYTES = 1 << 20
"""Maximum size of a file that people write: settings, magnets, calibrations."""
MAX_ARCHIVE_BYTES, MAX_ARCHIVE_ARRAYS = 1 << 30, 10_000
"""Maximum size of an archive's arrays, unpacked, and their maximum number."""
MAX_WIDE_BYTES = 64 << 20
"""Maximum size of a text that isn't all ASCII: one letter of another alphabet makes every letter take four
bytes.
"""
MAX_LINES, MAX_LINE_BYTES = 4_000_000, 1 << 20
"""Maximum number of lines of a table (five hours of an IMU at 200 Hz; short lines cost far more than their
bytes), and maximum size of a line.
"""
MAX_PICTURES = 500_000
"""Maximum number of lines of a list with one line per picture or pose: four hours at 30 Hz."""
MAX_ENTRIES = 100_000
"""Maximum number of lines of a list that people keep: stock, targets, events."""
MAX_PROFILES = 5_000
"""Maximum number of profiles of a laser or contours of a map."""
MAX_VALUES = 4_000_000
"""Maximum number of values in a JSON document, by its commas and opening brackets; that many take half a
GiB.
"""
MAX_DEPTH, MAX_NODES = 64, 1_000_000
"""Maximum nesting of lists and mappings, and maximum number of values in a settings file."""
MAX_INTEGER = 2**64
MAX_DIGITS = 30
MAX_MAGNITUDE = 1e15
"""Maximum magnitude of a number in a table or a calibration, so that what is computed from it stays
finite.
"""
REMEDY = "take the original file"
_READING = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
"""Flags for opening a file. Windows only has the first, and no pipes among its files."""


def in_range(values: ArrayLike) -> NDArray[np.bool_]:
    """Check for each value that it is a number of at most MAX_MAGNITUDE."""
    return np.asarray(np.abs(np.asarray(values, dtype=np.float64)) <= MAX_MAGNITUDE)


def open_regular(
    path: Path, remedy: str = REMEDY, kind: type[InputError] = InputError, max_bytes: int | None = None
) -> io.BufferedReader:
    """Open a regular file for reading bytes.

    kind: of the error for a file that is missing, may not be read, is a folder, a pipe or a device, or has
    more than max_bytes.
    """
    try:
        _expect_regular(path, path.stat(), remedy, kind, max_bytes)
        # Another file may have taken the place meanwhile: a pipe must not block.
        descriptor = os.open(path, _READING)
    except FileNotFoundError:
        raise kind(path, "no such file", remedy) from None
    except PermissionError:
        raise kind(path, "no permission to read it", "ask its owner or copy it") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise kind(path, f"can't be read ({reason})", remedy) from None
    file = open(path, "rb", opener=lambda *_: descriptor)  # noqa: SIM115
    try:
        _expect_regular(path, os.fstat(descriptor), remedy, kind, max_bytes)
    except InputError:
        file.close()
        raise
    return file


def _expect_regular(
    path: Path, found: os.stat_result, remedy: str, kind: type[InputError], max_bytes: int | None
) -> None:
    if not stat.S_ISREG(found.st_mode):
        what = "is a folder" if stat.S_ISDIR(found.st_mode) else "is a pipe or a device, not a regular file"
        raise kind(path, what, remedy)
    if max_bytes is not None and found.st_size > max_bytes:
        raise kind(path, f"has {found.st_size} bytes, at most {max_bytes} are read", remedy)


def read_bytes(
    path: Path, max_bytes: int, remedy: str = REMEDY, kind: type[InputError] = InputError
) -> bytes:
    """Read a regular file of at most max_bytes. Raises `kind`."""
    with open_regular(path, remedy, kind, max_bytes) as file:
        try:
            return file.read(max_bytes)
        except OSError as error:
            raise kind(path, f"can't be read ({error.strerror})", remedy) from None


def read_text(
    path: Path, max_bytes: int = MAX_TABLE_BYTES, remedy: str = REMEDY, kind: type[InputError] = InputError
) -> str:
    """Read UTF-8 text, with or without a BOM; lines end with newlines alone. Raises `kind`."""
    data = read_bytes(path, max_bytes, remedy, kind)
    if len(data) > MAX_WIDE_BYTES and not data.isascii():
        problem = f"has {len(data)} bytes, at most {MAX_WIDE_BYTES} are read of a text that isn't all ASCII"
        raise kind(path, problem, remedy)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise kind(path, f"is not UTF-8 text (byte {error.start})", remedy) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_lines(
    path: Path, max_lines: int = MAX_LINES, remedy: str = REMEDY, kind: type[InputError] = InputError
) -> list[str]:
    """Read a table's lines as `read_text`, after `expect_lines`. Raises `kind`."""
    expect_lines(path, max_lines, remedy, kind)
    return read_text(path, remedy=remedy, kind=kind).removesuffix("\n").split("\n")


def expect_lines(
    path: Path, max_lines: int = MAX_LINES, remedy: str = REMEDY, kind: type[InputError] = InputError
) -> None:
    """Raise `kind` unless the file is regular and has at most MAX_TABLE_BYTES and max_lines lines, none of
    them much longer than MAX_LINE_BYTES.
    """
    lines = 0
    with open_regular(path, remedy, kind, MAX_TABLE_BYTES) as file:
        while part := file.read(MAX_LINE_BYTES):
            ends = max(part.count(b"\n"), part.count(b"\r"))
            if not ends and len(part) == MAX_LINE_BYTES:
                raise kind(path, f"has a line of over {MAX_LINE_BYTES} bytes", remedy)
            lines += ends
            if lines > max_lines:
                raise kind(path, f"has over {max_lines} lines", remedy)


def read_json(path: Path, remedy: str = REMEDY, kind: type[InputError] = InputError) -> Any:
    """Read a JSON document. Raises `kind` if it is damaged, too large, too deeply nested, or holds NaN."""
    return _parsed(path, "JSON", _parse_json, MAX_DOCUMENT_BYTES, remedy, kind)


def read_toml(path: Path, remedy: str = REMEDY, kind: type[InputError] = InputError) -> dict[str, Any]:
    """Read a TOML file of settings. Raises `kind` as `read_json`."""
    content: dict[str, Any] = _parsed(path, "TOML", tomllib.loads, MAX_SETTINGS_BYTES, remedy, kind)
    try:
        expect_modest(content)
    except ValueError as error:
        raise kind(path, f"is not a TOML file: {error}", remedy) from None
    return content


def parse_json(data: bytes, source: str, remedy: str = REMEDY) -> Any:
    """Parse a JSON document that didn't come from a file. Raises InputError, naming `source`."""
    if len(data) > MAX_DOCUMENT_BYTES:
        raise InputError(source, f"has {len(data)} bytes, at most {MAX_DOCUMENT_BYTES} are read", remedy)
    return _told(source, "JSON", _parse_json, data.decode("utf-8-sig", "replace"), remedy, InputError)


def _parsed(
    path: Path, form: str, parse: Callable[[str], Any], max_bytes: int, remedy: str, kind: type[InputError]
) -> Any:
    return _told(path, form, parse, read_text(path, max_bytes, remedy, kind), remedy, kind)


def _told(
    path: Path | str, form: str, parse: Callable[[str], Any], text: str, remedy: str, kind: type[InputError]
) -> Any:
    try:
        return parse(text)
    except RecursionError:
        raise kind(path, f"is not a {form} file: brackets nested over {MAX_DEPTH} deep", remedy) from None
    except ValueError as error:
        raise kind(path, f"is not a {form} file: {error}", remedy) from None


def _parse_json(text: str) -> Any:
    if text.count(",") + text.count("[") + text.count("{") > MAX_VALUES:
        raise ValueError(f"over {MAX_VALUES} values")
    tree = json.loads(text, parse_int=_whole, parse_constant=_constant)
    _expect_shallow(tree)
    return tree


def _whole(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"a number has {len(digits)} digits")
    return int(digits)


def _constant(name: str) -> Any:
    raise ValueError(f"{name} is not a number")


def _expect_shallow(tree: Any) -> None:
    level = [tree]
    for _ in range(MAX_DEPTH):
        level = [
            item
            for node in level if isinstance(node, (dict, list))
            for item in (node.values() if isinstance(node, dict) else node) if isinstance(item, (dict, list))
        ]  # fmt: skip
        if not level:
            return
    raise ValueError(f"brackets nested over {MAX_DEPTH} deep")


def expect_modest(tree: Any) -> None:
    """Raise ValueError for a tree of mappings and lists that is too deep or too large, or holds an integer of
    more than 64 bits. A part that occurs several times counts each time.
    """
    waiting, nodes = [(tree, 0)], 0
    while waiting:
        node, depth = waiting.pop()
        nodes += 1
        if depth > MAX_DEPTH:
            raise ValueError(f"brackets nested over {MAX_DEPTH} deep")
        if nodes > MAX_NODES:
            raise ValueError(f"over {MAX_NODES} values")
        if isinstance(node, int) and abs(node) >= MAX_INTEGER:
            raise ValueError("an integer takes over 64 bits")
        if isinstance(node, dict):
            waiting += [(item, depth + 1) for item in node.values()]
        elif isinstance(node, list):
            waiting += [(item, depth + 1) for item in node]


def read_arrays(
    path: Path, remedy: str = REMEDY, kind: type[InputError] = InputError
) -> dict[str, NDArray[Any]]:
    """Read an npz archive's arrays. Raises `kind` if it is damaged, too large, or holds objects."""
    data = read_bytes(path, MAX_ARCHIVE_BYTES, remedy, kind)
    if (members := data.count(b"PK\x01\x02")) > MAX_ARCHIVE_ARRAYS:
        raise kind(path, f"holds {members} arrays, at most {MAX_ARCHIVE_ARRAYS} are read", remedy)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
        if unpacked > MAX_ARCHIVE_BYTES:
            raise kind(path, f"unpacks to {unpacked} bytes, at most {MAX_ARCHIVE_BYTES} are read", remedy)
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except InputError:
        raise
    except Exception as error:  # NumPy, zipfile and zlib raise all kinds on a torn archive
        raise kind(path, f"is not an archive of arrays ({error})", remedy) from None
