"""Read and write the stock list of what should be in the yard, and compare it with what was found."""

from __future__ import annotations

import contextlib
import csv
import io
import math
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import MAX_ENTRIES, in_range, read_json, read_lines
from barsight.yard.axes import turn_between
from barsight.yard.inventory.matching import MOVE_SIGMAS, MOVED_M, Places, displace, match_bundles
from barsight.yard.types import Bundle

_NEEDED = ("name", "x_m", "y_m")
_OPTIONAL = ("top_z_m", "yaw_deg", "length_m", "width_m", "bar_diameter_m", "bars")
_REMEDY = (
    f"give a CSV with the columns {', '.join(_NEEDED)} (and any of {', '.join(_OPTIONAL)}), commas between, "
    "decimals with a point, or JSON objects"
)
MAX_LISTED = 10_000
"""Maximum number of listed bundles."""
_REACH_M = 1.0
"""Maximum distance (m) between a listed bundle and the one found."""
_LIST_SIGMAS = 0.05, 0.17, 0.05, math.radians(5.0)
"""Standard deviations of a listed place across, along and up (m) and of its yaw."""
_TURNED_DEG, _DIFFERENT_RATIO = 5.0, 0.1
"""Minimum angle and share of a size by which a bundle differs from the list, beside MOVE_SIGMAS."""


@dataclass(frozen=True)
class ListedBundle:
    """A bundle of the stock list: place of its middle (m, yard); other fields are None if not listed."""

    name: str
    x_m: float
    y_m: float
    top_z_m: float | None = None
    yaw_deg: float | None = None
    length_m: float | None = None
    width_m: float | None = None
    bar_diameter_m: float | None = None
    bars: int | None = None


@dataclass(frozen=True)
class MatchedEntry:
    """A listed bundle and the one found. moved_m: along x, y (and z where listed, otherwise 0).

    disagrees: sentences on how the found bundle differs from the list.
    """

    name: str
    bundle: int
    moved_m: tuple[float, float, float]
    disagrees: tuple[str, ...]


@dataclass(frozen=True)
class StockMatch:
    """Comparison of list and map. moved: names of matched bundles that lie elsewhere than listed.

    missing: listed bundles that weren't found where they could have been seen; hidden: listed ones under
    another bundle, where the map can't show them; extra: ids of found ones that aren't listed.
    """

    matched: tuple[MatchedEntry, ...]
    moved: tuple[str, ...]
    missing: tuple[str, ...]
    hidden: tuple[str, ...]
    extra: tuple[int, ...]


def read_stock(path: Path) -> tuple[ListedBundle, ...]:
    """Read the list from a CSV or JSON file.

    Raises InputError where it is missing, truncated, or repeats a name.
    """
    if not path.is_file():
        raise InputError(path, "no such file", _REMEDY)
    try:
        rows = _json_rows(path) if path.suffix.lower() == ".json" else _csv_rows(path)
    except (ValueError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"can't be read ({error})", _REMEDY) from error
    if len(rows) > MAX_LISTED:
        raise InputError(path, f"lists {len(rows)} bundles, at most {MAX_LISTED} are read", _REMEDY)
    listed = tuple(_expected(path, number, row) for number, row in enumerate(rows, start=1))
    counts = Counter(one.name for one in listed)
    twice = sorted(name for name, count in counts.items() if count > 1)
    if twice:
        raise InputError(path, f"lists {twice[0]!r} {counts[twice[0]]} times", "give each its own name")
    return listed


def stock_text(listed: tuple[ListedBundle, ...]) -> str:
    """Format a list as CSV that `read_stock` reads; lengths to 0.1 mm, angles to 0.001 deg.

    Spreadsheets open it safely: an apostrophe stands before a name that they would execute, and a byte order
    mark before a list with letters beyond ASCII, which they would take for another encoding.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = ("name", *_NEEDED[1:], *_OPTIONAL)
    writer.writerow(names)
    for one in listed:
        figures = asdict(one)
        digits = {"yaw_deg": 3, "bars": 0}
        row = [figures[name] for name in names[1:]]
        finite = [value if value is not None and np.isfinite(value) else None for value in row]
        writer.writerow(
            [f"'{one.name}" if _is_formula(one.name) else one.name]
            + [
                "" if value is None else f"{value:.{digits.get(name, 4)}f}"
                for name, value in zip(names[1:], finite, strict=True)
            ]
        )
    text = out.getvalue()
    return text if text.isascii() else f"\ufeff{text}"


def _is_formula(name: str) -> bool:
    """Check whether a spreadsheet would calculate a name, apostrophes aside; a number stays as it is."""
    with contextlib.suppress(ValueError):
        float(name)
        return False
    return name.lstrip("'").startswith(("=", "+", "-", "@"))


def _csv_rows(path: Path) -> list[dict[str, Any]]:
    reader = csv.DictReader(f"{line}\n" for line in read_lines(path, MAX_ENTRIES, _REMEDY))
    header = [name.strip().lower() for name in reader.fieldnames or ()]
    for name in (*_NEEDED, *_OPTIONAL):
        if header.count(name) > 1 or (name in _NEEDED and name not in header):
            problem = f"has the column {name} twice" if name in header else f"has no column {name}"
            raise InputError(path, problem, _REMEDY)
    reader.fieldnames = header
    rows = list[dict[str, Any]](reader)
    long = next((number for number, row in enumerate(rows, start=1) if None in row), None)
    if long is not None:
        raise InputError(path, f"bundle {long} has more fields than the header", _REMEDY)
    return [row for row in rows if any(row.values())]


def _json_rows(path: Path) -> list[dict[str, Any]]:
    content = read_json(path, _REMEDY)
    rows = content.get("bundles") if isinstance(content, dict) else content
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(path, "is not a list of bundles", _REMEDY)
    return rows


def _expected(path: Path, number: int, row: dict[str, Any]) -> ListedBundle:
    figures: dict[str, float | None] = {}
    for key in (*_NEEDED[1:], *_OPTIONAL):
        text = row.get(key)
        if text is None or text == "":
            if key in _NEEDED:
                raise InputError(path, f"bundle {number} has no {key}", _REMEDY)
            figures[key] = None
            continue
        try:
            value = float(text)
        except (TypeError, ValueError, OverflowError):
            value = float("nan")
        positive = key in ("length_m", "width_m", "bar_diameter_m", "bars")
        is_wrong = isinstance(text, bool) or (key == "bars" and value % 1 != 0)
        if is_wrong or not in_range(value) or (positive and value <= 0):
            raise InputError(path, f"bundle {number}: {key} can't be {str(text)[:40]!r}", _REMEDY)
        figures[key] = value
    given = row.get("name")
    name = " ".join(str(given).splitlines()).strip() if isinstance(given, str | int) else ""
    if name.startswith("'") and _is_formula(name):
        name = name[1:]
    if not name:
        raise InputError(path, f"bundle {number} has no name", _REMEDY)
    bars = figures.pop("bars")
    return ListedBundle(name, bars=None if bars is None else int(bars), **figures)  # type: ignore[arg-type]


def match_stock(listed: tuple[ListedBundle, ...], bundles: tuple[Bundle, ...]) -> StockMatch:
    """Match listed and found bundles, each at most once, by place and size; none is over 1 m off across.

    A bundle has moved if it is off by more than MOVED_M and than chance at SIGNIFICANCE; along the axis only
    where both ends, and so its middle, were seen.
    """
    found, places = Places.of(bundles), _places(listed)
    pairs = match_bundles(found, places, _REACH_M, sizes_agree=False)
    partner = {i: k for k, i in sorted(pairs.items(), key=lambda pair: pair[1])}
    exact = replace(places, sigmas=np.zeros_like(places.sigmas), sizes=np.full_like(places.sizes, np.nan))
    moves = displace(found.take(list(partner.values())), exact.take(list(partner)))
    matched, moved = [], []
    names = {one.name for one in listed}
    for (i, k), is_moved in zip(partner.items(), moves.moved(MOVED_M, math.inf), strict=True):
        differs = (*_disagreements(listed[i], bundles[k]), *_other_label(listed[i], bundles[k], names))
        matched.append(MatchedEntry(listed[i].name, bundles[k].id, _shift(listed[i], bundles[k]), differs))
        if is_moved:
            moved.append(listed[i].name)
    absent = [one for i, one in enumerate(listed) if i not in partner]
    hidden = tuple(one.name for one in absent if _is_covered(one, found))
    taken = set(partner.values())
    return StockMatch(
        matched=tuple(matched),
        moved=tuple(moved),
        missing=tuple(one.name for one in absent if one.name not in hidden),
        hidden=hidden,
        extra=tuple(bundle.id for k, bundle in enumerate(bundles) if k not in taken),
    )


def contradicted_bundles(match: StockMatch) -> dict[int, str]:
    """List the found bundles (by id) that contradict the list, and how: moved, of another
    kind, not listed.
    """
    told = dict.fromkeys(match.extra, "the stock list doesn't name it")
    for one in match.matched:
        moved = [f"lies {1e3 * np.linalg.norm(one.moved_m):.0f} mm from there"] * (one.name in match.moved)
        if differs := [*one.disagrees, *moved]:
            told[one.bundle] = f"the stock list has {one.name} there, which this isn't: {'; '.join(differs)}"
    return told


def list_contradiction(listed: tuple[ListedBundle, ...], match: StockMatch) -> str | None:
    """Report it where half of the listed bundles or more, not counting hidden ones, contradict the map."""
    seen = len(listed) - len(match.hidden)
    wrong = len(match.missing) + sum(bool(one.disagrees) or one.name in match.moved for one in match.matched)
    if 2 * wrong < max(seen, 1):
        return None
    return f"{wrong} of {seen} listed bundles contradict the map: is it this yard's list, in its frame?"


def stock_warnings(listed: tuple[ListedBundle, ...], match: StockMatch | None) -> tuple[str, ...]:
    """List warnings where list and map differ. match: None where the map isn't in the yard's frame."""
    if match is None:
        return ("the map isn't in the yard's frame: the stock list can't be held against it",)
    differs = [f"{one.name} ({'; '.join(one.disagrees)})" for one in match.matched if one.disagrees]
    return tuple(
        f"stock list: {len(names)} of {total} {what}: {', '.join(map(str, names))}"
        for names, total, what in (
            (match.missing, len(listed), "listed bundles weren't found"),
            (match.moved, len(listed), "lie elsewhere than listed"),
            (differs, len(listed), "aren't as listed"),
            (match.hidden, len(listed), "lie under others, so the map can't tell"),
            (match.extra, len(match.extra) + len(match.matched), "found ones aren't listed, bundle"),
        )
        if names
    )


def _shift(one: ListedBundle, bundle: Bundle) -> tuple[float, float, float]:
    rise = 0.0 if one.top_z_m is None else bundle.top_z_m - one.top_z_m
    return float(bundle.centre_m[0] - one.x_m), float(bundle.centre_m[1] - one.y_m), float(rise)


def _places(listed: tuple[ListedBundle, ...]) -> Places:
    """Collect the listed places, as rough as lists are."""

    def table(*names: str) -> Float64:
        rows = [[getattr(one, name) for name in names] for one in listed]
        return np.array(rows, np.float64).reshape(-1, len(names))

    shape = len(listed), 4
    section = np.full((len(listed), 1), np.nan)
    return Places(
        table("x_m", "y_m", "top_z_m"), np.radians(table("yaw_deg")[:, 0]),
        np.hstack([table("length_m", "width_m", "bar_diameter_m"), section]),
        np.broadcast_to(_LIST_SIGMAS, shape), np.full(shape, np.nan),
        np.zeros((len(listed), 2), np.bool_), np.full((len(listed), 2), np.nan),
    )  # fmt: skip


def _disagreements(one: ListedBundle, bundle: Bundle) -> tuple[str, ...]:
    out = []
    sigma = bundle.sigma
    for name, listed, found, spread in (
        ("width", one.width_m, bundle.width_m, sigma.width_m),
        ("bars' diameter", one.bar_diameter_m, bundle.bar_diameter_m, sigma.bar_diameter_m),
        ("length", one.length_m, bundle.length_m, sigma.length_m),
    ):
        if listed is None or not np.isfinite(spread):
            continue
        if abs(found - listed) > max(MOVE_SIGMAS * spread, _DIFFERENT_RATIO * listed):
            out.append(f"{name} {1e3 * found:.0f} mm instead of {1e3 * listed:.0f} mm")
    if one.yaw_deg is not None:
        listed_rad = np.radians(one.yaw_deg)
        turn_deg = abs(np.degrees(turn_between(listed_rad, bundle.yaw_rad)))
        if not turn_deg <= max(MOVE_SIGMAS * np.degrees(np.nan_to_num(sigma.yaw_rad)), _TURNED_DEG):
            out.append(f"it lies turned by {turn_deg:.0f} deg")
    if one.bars is not None and bundle.bars not in (None, one.bars):
        out.append(f"{bundle.bars} bars instead of {one.bars}")
    return tuple(out)


def _other_label(one: ListedBundle, bundle: Bundle, names: set[str]) -> tuple[str, ...]:
    """Report it where a bundle's label gives another name than the list; empty where it wasn't read."""
    if bundle.label is None or bundle.label.text in (None, one.name):
        return ()
    known = "another one's of the list" if bundle.label.text in names else "which the list lacks"
    return (f"its label reads {bundle.label.text!r}, {known}",)


def _is_covered(one: ListedBundle, found: Places) -> bool:
    """Check whether a found bundle lies over the listed place, above the listed top if there is one."""
    (length, width), top = found.sizes[:, :2].T, found.top_m
    across, along = found.across_along(np.array([one.x_m, one.y_m]) - top[:, :2])
    over = (np.abs(across) < width / 2) & (np.abs(along) < length / 2)
    return bool((over & (one.top_z_m is None or top[:, 2] > one.top_z_m)).any())
