"""Read and write the stock list of what should be in the yard, and compare it with what was found."""

from __future__ import annotations

import csv
import io
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from barsight.core.arrays import Float64
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import MAX_ENTRIES, in_range, read_json, read_lines
from barsight.yard.axes import turn_between
from barsight.yard.types import Bundle

_NEEDED = ("name", "x_m", "y_m")
_OPTIONAL = ("top_z_m", "yaw_deg", "length_m", "width_m", "bar_diameter_m", "bars")
_REMEDY = (
    f"give a CSV with the columns {', '.join(_NEEDED)} (and any of {', '.join(_OPTIONAL)}), commas between, "
    "decimals with a point, or JSON objects"
)
MAX_LISTED = 10_000
"""Maximum number of listed bundles: each one is compared with each bundle of the map."""
_REACH_M = 1.0
"""Maximum distance (m) between a listed bundle and the one found."""
_MOVED_M, _TURNED_DEG, _DIFFERENT_RATIO, _SIGMAS = 0.05, 5.0, 0.1, 3.0
"""Minimum distance (m), angle and share of a size by which a bundle differs from the list, and the same in
sigmas.
"""


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
    """Format a list as CSV that `read_stock` reads; lengths to 0.1 mm, angles to 0.001 deg."""
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
            [one.name]
            + [
                "" if value is None else f"{value:.{digits.get(name, 4)}f}"
                for name, value in zip(names[1:], finite, strict=True)
            ]
        )
    return out.getvalue()


def _csv_rows(path: Path) -> list[dict[str, Any]]:
    reader = csv.DictReader(read_lines(path, MAX_ENTRIES, _REMEDY))
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
    name = str(given).strip() if isinstance(given, str | int) else ""
    if not name:
        raise InputError(path, f"bundle {number} has no name", _REMEDY)
    bars = figures.pop("bars")
    return ListedBundle(name, bars=None if bars is None else int(bars), **figures)  # type: ignore[arg-type]


def match_stock(listed: tuple[ListedBundle, ...], bundles: tuple[Bundle, ...]) -> StockMatch:
    """Pair listed and found bundles, each once, so that the total distance is smallest and none exceeds 1 m.

    A bundle has moved if the distance exceeds both 50 mm and three of the found place's sigmas.
    """
    cost = np.array([[_distance(one, bundle) for bundle in bundles] for one in listed])
    cost = cost.reshape(len(listed), len(bundles))
    pairs = zip(*linear_sum_assignment(np.minimum(cost, 2 * _REACH_M)), strict=True)
    partner = {int(i): int(k) for i, k in pairs if cost[i, k] <= _REACH_M}
    matched, moved = [], []
    names = {one.name for one in listed}
    for i, k in partner.items():
        shift = _shift(listed[i], bundles[k])
        differs = (*_disagreements(listed[i], bundles[k]), *_other_label(listed[i], bundles[k], names))
        matched.append(MatchedEntry(listed[i].name, bundles[k].id, shift, differs))
        if _has_moved(shift, bundles[k]):
            moved.append(listed[i].name)
    absent = [one for i, one in enumerate(listed) if i not in partner]
    hidden = tuple(one.name for one in absent if _is_covered(one, bundles))
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


def _across_along(shift: tuple[float, float, float], bundle: Bundle) -> tuple[float, float]:
    across, along = (bundle.axes @ shift[:2]).tolist()
    return across, along


def _distance(one: ListedBundle, bundle: Bundle) -> float:
    """Compute a weighted distance: across and up count fully; 1 m along the axis counts as 0.3 m across.

    A bundle that lies half its width higher or lower than listed is another one.
    """
    shift = _shift(one, bundle)
    if abs(shift[2]) > bundle.width_m / 2:
        return float(2 * _REACH_M)
    across, along = _across_along(shift, bundle)
    if any(bundle.ends_open) and abs(along) < bundle.length_m / 2:
        along = 0.0
    return float(np.linalg.norm([across, 0.3 * along, shift[2]]))


def _has_moved(shift: tuple[float, float, float], bundle: Bundle) -> bool:
    """Check whether a bundle has moved; along the axis only where both ends, and so its middle, were seen."""
    across, along = _across_along(shift, bundle)
    sigma = bundle.sigma
    moves: Float64 = np.abs([across, shift[2], 0.0 if any(bundle.ends_open) else along])
    along_sigma = sigma.along_m if np.isfinite(sigma.along_m) else 0.0
    limits = [max(_MOVED_M, _SIGMAS * s) for s in (sigma.lateral_m, sigma.top_z_m, along_sigma)]
    return bool((moves > limits).any())


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
        if abs(found - listed) > max(_SIGMAS * spread, _DIFFERENT_RATIO * listed):
            out.append(f"{name} {1e3 * found:.0f} mm instead of {1e3 * listed:.0f} mm")
    if one.yaw_deg is not None:
        listed_rad = np.radians(one.yaw_deg)
        turn_deg = abs(np.degrees(turn_between(listed_rad, bundle.yaw_rad)))
        if not turn_deg <= max(_SIGMAS * np.degrees(np.nan_to_num(sigma.yaw_rad)), _TURNED_DEG):
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


def _is_covered(one: ListedBundle, bundles: tuple[Bundle, ...]) -> bool:
    """Check whether a found bundle lies over the listed place, above the listed top if there is one."""
    for bundle in bundles:
        shift = _shift(one, bundle)
        across, along = _across_along(shift, bundle)
        over = abs(across) < bundle.width_m / 2 and abs(along) < bundle.length_m / 2
        if over and (one.top_z_m is None or bundle.top_z_m > one.top_z_m):
            return True
    return False
