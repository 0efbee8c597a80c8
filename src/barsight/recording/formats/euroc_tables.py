"""Read EuRoC's CSV files: fast, with exact stamps, and with line numbers in errors."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import MAX_LINES, MAX_PICTURES, expect_lines, in_range
from barsight.core.stamps import expect_increasing, rows_not_later
from barsight.recording.own_files import expect_inner_name


@dataclass(frozen=True, eq=False)
class Table:
    """A CSV whose first column is an integer: first (N,) int64; rest (N, K) float64."""

    path: Path
    first: Int64
    rest: Float64

    def line(self, row: int) -> int:
        """Return the line number in the file (from 1) of a row."""
        for k, (number, _) in enumerate(_data_lines(self.path)):
            if k == row:
                return number
        raise IndexError(row)

    def expect_finite(self, remedy: str) -> None:
        """Raise `InputError` naming the first line that holds NaN or inf."""
        bad = np.flatnonzero(~in_range(self.rest).all(axis=1))
        if bad.size:
            number = self.line(int(bad[0]))
            raise InputError(
                self.path,
                f"line {number}: a value is NaN, infinite or too large ({bad.size} such lines)",
                remedy,
            )

    def expect_increasing(self) -> None:
        """Raise `InputError` naming the line at which stamps repeat or go back."""
        bad = rows_not_later(self.first)
        if bad.size:
            row = int(bad[0]) + 1
            expect_increasing(self.first, self.path, self.line(row) - row)


def read_table(path: Path, columns: tuple[str, ...], *, extra_allowed: bool = False) -> Table:
    """Read a CSV of an integer and numbers; `#` lines, blank lines, CRLF and a BOM are skipped.

    columns: their names, for error messages. extra_allowed: further columns on the right are ignored.
    Raises `InputError` naming file and line for a missing file, no rows, a wrong number of columns, text
    in place of a number, or a first column that isn't whole.
    """
    expect_lines(path, MAX_LINES, COPY)
    width = len(columns) - 1
    dtype = np.dtype([("first", np.int64), ("rest", np.float64, (width,))])
    header = _header_lines(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            rows = np.loadtxt(
                path, dtype, comments="#", delimiter=",", ndmin=1, encoding="utf-8-sig", skiprows=header,
                usecols=range(width + 1) if extra_allowed else None,
            )  # fmt: skip
    except (ValueError, OverflowError, DeprecationWarning, UserWarning):
        raise _diagnosis(path, columns, extra_allowed) from None
    if rows.size == 0:
        raise _diagnosis(path, columns, extra_allowed)
    return Table(path, np.ascontiguousarray(rows["first"]), np.ascontiguousarray(rows["rest"]))


def read_image_list(path: Path) -> tuple[Int64, tuple[str, ...]]:
    """Read a camera's `data.csv`: increasing stamps (N,) and file names.

    Raises `InputError` as `read_table`.
    """
    expect_lines(path, MAX_PICTURES, COPY)
    stamps: list[int] = []
    names: list[str] = []
    lines: list[int] = []
    for number, text in _data_lines(path):
        fields = [field.strip() for field in text.split(",")]
        if len(fields) != 2 or not fields[1]:
            raise InputError(path, f"line {number}: expected `stamp,filename`, got {text[:80]!r}", _REMEDY)
        if not _is_int64(fields[0]):
            raise InputError(
                path, f"line {number}: the stamp {fields[0][:40]!r} is not a whole number of ns", _REMEDY
            )
        expect_inner_name(fields[1], path, f"line {number}")
        stamps.append(int(fields[0]))
        names.append(fields[1])
        lines.append(number)
    if not stamps:
        raise InputError(path, "has no rows", "the camera recorded nothing; record again or copy it again")
    stamp_ns = np.array(stamps, dtype=np.int64)
    bad = rows_not_later(stamp_ns)
    if bad.size:
        row = int(bad[0]) + 1
        expect_increasing(stamp_ns, path, lines[row] - row)
    return stamp_ns, tuple(names)


COPY = "copy the recording again, with all its files"
_REMEDY = "take the original file or mend the line"


def _data_lines(path: Path) -> Iterator[tuple[int, str]]:
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header = True
        for number, line in enumerate(file, 1):
            text = line.partition("#")[0].strip()
            if text and not (header and _is_header(text)):
                yield number, text
            header = header and not text


def _is_header(text: str) -> bool:
    """Check for a first line of names without `#`."""
    first = text.partition(",")[0].strip().lower()
    return first.startswith(("timestamp", "time", "profile", "stamp"))


def _header_lines(path: Path) -> int:
    """Count the lines to skip so that a header without `#` does not reach the number parser."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, 1):
            text = line.partition("#")[0].strip()
            if text:
                return number if _is_header(text) else 0
    return 0


def _diagnosis(path: Path, columns: tuple[str, ...], extra_allowed: bool) -> InputError:
    """Find the first wrong line, for which the fast parser refused the file."""
    empty = True
    for number, text in _data_lines(path):
        empty = False
        fields = [field.strip() for field in text.split(",")]
        if len(fields) < len(columns) or (len(fields) > len(columns) and not extra_allowed):
            return InputError(
                path,
                f"line {number}: {len(fields)} columns, expected {len(columns)} ({', '.join(columns)})",
                _REMEDY,
            )
        if not _is_int64(fields[0]):
            return InputError(
                path, f"line {number}: {columns[0]} {fields[0][:40]!r} is not a whole number", _REMEDY
            )
        for name, field in zip(columns[1:], fields[1:], strict=False):
            try:
                float(field)
            except ValueError:
                return InputError(path, f"line {number}: {name} {field[:40]!r} is not a number", _REMEDY)
    if empty:
        return InputError(path, "has no rows", "the sensor recorded nothing; remove its folder to go without")
    return InputError(path, "is not readable as a CSV of numbers", _REMEDY)


def _is_int64(text: str) -> bool:
    try:
        return -(2**63) <= int(text) < 2**63
    except ValueError:
        return False
