"""Read surveyed targets: their positions in the yard, and where the rig saw them or which tag they carry."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from barsight.calibration.boards.ring_detection import ring_codes
from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import MAX_ENTRIES, in_range, read_lines

YARD = ("yard_x", "yard_y", "yard_z")
PLACE = ("x", "y", "z")
TAGS = 587
"""Number of tags in the family 36h11."""
SAME_M = 0.02
"""Minimum distance in metres between two targets; closer ones are the same target."""
MAX_APART_M = 2000.0
"""Maximum distance of a yard's targets along an axis in metres; larger ones are in other units."""


@dataclass(frozen=True, eq=False)
class Targets:
    """names (N,); yard_m, measured_m (N, 3); sigma_m (N,) of each coordinate's difference, NaN where not
    given; checks (N,): whether a target is only a check.
    """

    names: tuple[str, ...]
    yard_m: Float64
    measured_m: Float64
    sigma_m: Float64
    checks: Bool


@dataclass(frozen=True, eq=False)
class SurveyedTags:
    """numbers (N,) of AprilTags 36h11, or of coded circles where `are_rings`; yard_m (N, 3) of their middles;
    sigma_m (N,) of each coordinate, NaN where not given; checks (N,): whether a target is only a check.
    width_m (N,) of columns, whose position is the middle of their tops; NaN for other targets.
    """

    numbers: Int64
    yard_m: Float64
    sigma_m: Float64
    checks: Bool
    are_rings: bool = False
    width_m: Float64 | None = None


def read_targets(path: Path) -> Targets:
    """Read a CSV with a header, m: `name,yard_x,yard_y,yard_z,x,y,z`, optionally `sigma_m` and `check` (1 or
    0).

    Raises `InputError` naming the line.
    """
    names, table = _read_table(path, "name", (*YARD, *PLACE))
    _expect_once(path, "target", names)
    for places, how in ((table[:, :3], "surveyed"), (table[:, 3:6], "measured")):
        _expect_apart(path, names, places, how)
    return Targets(names, table[:, :3], table[:, 3:6], table[:, 6], table[:, 7] == 1)


def read_tags(path: Path) -> SurveyedTags:
    """Read a CSV with a header, m: `tag,yard_x,yard_y,yard_z` (`ring` for coded circles), optionally
    `sigma_m` and `check` (1 or 0).

    Raises `InputError` naming the line.
    """
    are_rings = read_lines(path, MAX_ENTRIES, f"give tag,{','.join(YARD)}")[0].lstrip("# ").startswith("ring")
    kind, family, count = ("ring", "circle coded in 12", len(ring_codes())) if are_rings else (
        "tag", "tag of the family 36h11", TAGS
    )  # fmt: skip
    names, table = _read_table(path, kind, YARD)
    numbers = [int(name) if re.fullmatch(r"[0-9]{1,6}", name) else count for name in names]
    strange = next((name for name, number in zip(names, numbers, strict=True) if number >= count), None)
    if strange is not None:
        raise InputError(path, f"{strange!r} is no {family}", f"give the number on it, 0 to {count - 1}")
    _expect_once(path, kind, tuple(map(str, numbers)))
    _expect_apart(path, names, table[:, :3], "surveyed")
    found = np.array(numbers, np.int64), table[:, :3], table[:, 3], table[:, 4] == 1
    return SurveyedTags(*found, are_rings)


def read_places(path: Path, text: str | None = None) -> tuple[tuple[str, ...], SurveyedTags]:
    """Read a CSV with a header, m: `name,yard_x,yard_y,yard_z`, optionally `sigma_m`, `check` (1 or 0) and,
    for columns, `width_m`. Returns the names, and targets numbered in their order.

    text: the content, where it isn't in a file yet. Raises `InputError` naming the line.
    """
    names, table = _read_table(path, "name", YARD, text)
    _expect_once(path, "target", names)
    _expect_apart(path, names, table[:, :3], "surveyed")
    numbers = np.arange(len(names), dtype=np.int64)
    return names, SurveyedTags(numbers, table[:, :3], table[:, 3], table[:, 4] == 1, width_m=table[:, 5])


def read_picks(path: Path, names: tuple[str, ...]) -> dict[int, dict[int, Float64]]:
    """Read a CSV with a header: `name,stamp_ns,u,v`, the position of a target in cam0's picture of that
    stamp, px. Returns pixels (2,) by stamp and the name's index in `names`.

    Raises `InputError` naming the line.
    """
    remedy = "give name,stamp_ns,u,v: a target's pixel in cam0's picture of that stamp"
    first, *lines = read_lines(path, MAX_ENTRIES, remedy)
    header = [name.strip() for name in first.lstrip("# ").split(",")]
    if header[:4] != ["name", "stamp_ns", "u", "v"]:
        raise InputError(path, "doesn't begin with name,stamp_ns,u,v", remedy)
    picks: dict[int, dict[int, Float64]] = {}
    for n, line in enumerate(lines, start=2):
        fields = [field.strip() for field in line.split(",")]
        if len(fields) > len(header):
            raise InputError(path, f"line {n} has more fields than the header", "write numbers with a point")
        try:
            stamp_ns, pixel = int(fields[1]), np.array([float(fields[2]), float(fields[3])])
        except (ValueError, IndexError):
            raise InputError(path, f"line {n}: a number is missing or is none", remedy) from None
        if fields[0] not in names:
            raise InputError(
                path, f"line {n}: target {fields[0]} isn't listed", "list its surveyed place too"
            )
        if not in_range(pixel).all():
            raise InputError(path, f"line {n}: a pixel can't be there", remedy)
        number = names.index(fields[0])
        if number in picks.setdefault(stamp_ns, {}):
            raise InputError(path, f"line {n}: {fields[0]} is picked twice at {stamp_ns}", "pick it once")
        picks[stamp_ns][number] = pixel
    return picks


def write_targets(targets: Targets) -> str:
    """Write the text that `read_targets` reads."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(("name", *YARD, *PLACE, "sigma_m", "check"))
    for k, name in enumerate(targets.names):
        numbers = [*targets.yard_m[k], *targets.measured_m[k], targets.sigma_m[k]]
        writer.writerow([name, *(f"{value:.5f}" for value in numbers), int(targets.checks[k])])
    return file.getvalue()


def _read_table(
    path: Path, key: str, columns: tuple[str, ...], text: str | None = None
) -> tuple[tuple[str, ...], Float64]:
    """Read the texts (N,) of `key`, and the numbers (N, columns + 3): `columns`, sigma_m (NaN where not
    given), check, width_m (NaN where not given).
    """
    remedy = f"give {','.join((key, *columns))} and, if wanted, sigma_m and check"
    first, *others = read_lines(path, MAX_ENTRIES, remedy) if text is None else text.strip().split("\n")
    lines = [first.lstrip("# "), *others]
    try:
        rows = list(csv.DictReader(lines, skipinitialspace=True))
    except csv.Error as error:
        raise InputError(path, f"can't be read ({error})", remedy) from error
    header = [name.strip() for name in lines[0].split(",")]
    missing = [name for name in (key, *columns) if name not in header]
    if missing:
        raise InputError(path, f"has no column {missing[0]}", remedy)
    numbers = []
    for n, row in enumerate(rows, start=2):
        if None in row:
            raise InputError(path, f"line {n} has more fields than the header", "write numbers with a point")
        try:
            values = [float(row[name]) for name in columns]
            values += [float(row.get("sigma_m") or "nan"), float(row.get("check") or 0)]
            values.append(float(row.get("width_m") or "nan"))
        except (TypeError, ValueError):
            raise InputError(path, f"line {n}: a number is missing or is none", remedy) from None
        sigma_m, check, width_m = values[-3:]
        if not in_range(values[:-3]).all() or sigma_m <= 0 or check not in (0, 1) or width_m <= 0:
            help_ = "places finite, sigma_m and width_m positive, check 0 or 1"
            raise InputError(path, f"line {n}: a value is out of range", help_)
        numbers.append(values)
    table = np.array(numbers, np.float64).reshape(-1, len(columns) + 3)
    return tuple((row[key] or "").strip() for row in rows), table


def _expect_once(path: Path, kind: str, names: tuple[str, ...]) -> None:
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise InputError(path, f"{kind} {twice} is there twice", f"give each {kind} once")


def _expect_apart(path: Path, names: tuple[str, ...], places_m: Float64, how: str) -> None:
    """Raise InputError if two names stand for one target, which would count twice, or no yard is so large."""
    if not len(names):
        return
    wide_m = float(np.ptp(places_m, axis=0).max())
    if wide_m > MAX_APART_M:
        raise InputError(path, f"has targets that are {how} {wide_m:.0f} m apart", "give metres")
    found = KDTree(places_m).query(places_m, k=2)
    away_m, nearest = np.asarray(found[0])[:, 1], np.asarray(found[1])
    if away_m.min() < SAME_M:
        k = int(np.argmax(away_m < SAME_M))
        other = names[next(int(n) for n in nearest[k] if n != k)]
        raise InputError(path, f"{names[k]} and {other} are {how} at one place", "give each target once")
