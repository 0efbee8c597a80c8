"""Read surveyed targets: their places in the yard, and where the rig saw them."""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import MAX_ENTRIES, in_range, read_lines

COLUMNS = ("name", "yard_x", "yard_y", "yard_z", "x", "y", "z")
REMEDY = "give name,yard_x,yard_y,yard_z,x,y,z and, if wanted, sigma_m and check"


@dataclass(frozen=True, eq=False)
class Targets:
    """names (N,); yard_m, measured_m (N, 3); sigma_m (N,) of each coordinate's difference, NaN where not
    said; checks (N,): set apart.
    """

    names: tuple[str, ...]
    yard_m: Float64
    measured_m: Float64
    sigma_m: Float64
    checks: Bool


def read_targets(path: Path) -> Targets:
    """Read a CSV with a header, m: `name,yard_x,yard_y,yard_z,x,y,z`, optionally `sigma_m` and `check` (1 or
    0).

    Raises `InputError` naming the line.
    """
    first, *others = read_lines(path, MAX_ENTRIES, REMEDY)
    lines = [first.lstrip("# "), *others]
    try:
        rows = list(csv.DictReader(lines, skipinitialspace=True))
    except csv.Error as error:
        raise InputError(path, f"can't be read ({error})", REMEDY) from error
    header = [name.strip() for name in lines[0].split(",")]
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise InputError(path, f"has no column {missing[0]}", REMEDY)
    numbers = []
    for n, row in enumerate(rows, start=2):
        try:
            values = [float(row[name]) for name in COLUMNS[1:]]
            values += [float(row.get("sigma_m") or "nan"), float(row.get("check") or 0)]
        except (TypeError, ValueError):
            raise InputError(path, f"line {n}: a number is missing or is none", REMEDY) from None
        if not in_range(values[:6]).all() or values[6] <= 0 or values[7] not in (0, 1):
            raise InputError(
                path, f"line {n}: a value can't be", "places finite, sigma_m positive, check 0 or 1"
            )
        numbers.append(values)
    names = [row["name"].strip() for row in rows]
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise InputError(path, f"target {twice} is there twice", "give each target once")
    table = np.array(numbers, np.float64).reshape(-1, 8)
    return Targets(tuple(names), table[:, :3], table[:, 3:6], table[:, 6], table[:, 7] == 1)
