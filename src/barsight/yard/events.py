"""Record what has happened in the yard since it was measured: lifts, set-downs, magnets that were seen."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path

from barsight.core.arrays import Float64
from barsight.core.errors import InputError
from barsight.core.files import atomic_path
from barsight.core.reading.bounded_reading import MAX_ENTRIES, read_lines
from barsight.yard.axes import corners
from barsight.yard.types import Bundle

KINDS = ("lift", "set-down", "magnet")


@dataclass(frozen=True)
class YardEvent:
    """A rectangle in the yard where something was moved. stamp_ns: on the frames' clock. kind: one of KINDS.

    yaw_deg: of its length, from +Y about Z.
    """

    stamp_ns: int
    kind: str
    x_m: float
    y_m: float
    yaw_deg: float
    length_m: float
    width_m: float

    @property
    def corners_m(self) -> Float64:
        """Compute the corners (4, 2) of the rectangle."""
        return corners((self.x_m, self.y_m), math.radians(self.yaw_deg), self.width_m, self.length_m)


COLUMNS = tuple(field.name for field in fields(YardEvent))


def lift_of(bundle: Bundle, stamp_ns: int) -> YardEvent:
    """Record that a bundle was lifted."""
    x, y = (round(float(value), 4) for value in bundle.centre_m[:2])
    yaw_deg = round(math.degrees(bundle.yaw_rad), 4)
    return YardEvent(stamp_ns, "lift", x, y, yaw_deg, round(bundle.length_m, 4), round(bundle.width_m, 4))


def read_events(path: Path) -> tuple[YardEvent, ...]:
    """Read a CSV of COLUMNS. Raises InputError where it is missing or a line isn't an event."""
    remedy = f"give a CSV with the columns {','.join(COLUMNS)}; a kind is one of {', '.join(KINDS)}"
    try:
        rows = list(csv.reader(read_lines(path, MAX_ENTRIES, remedy)))
    except csv.Error as error:
        raise InputError(path, f"can't be read ({error})", remedy) from error
    if not rows or tuple(rows[0]) != COLUMNS:
        raise InputError(path, "has another first line", remedy)
    return tuple(_event(path, number, row, remedy) for number, row in enumerate(rows[1:], start=2) if row)


def kept_events(folder: Path) -> tuple[YardEvent, ...]:
    """Read events.csv of a folder; empty where there is none."""
    path = folder / "events.csv"
    return read_events(path) if path.is_file() else ()


def events_beside(surveys: Path) -> tuple[YardEvent, ...]:
    """Read events.csv of every folder in a folder of surveys."""
    folders = (one for one in sorted(surveys.iterdir()) if one.is_dir() and not one.is_symlink())
    return merged((), (event for one in folders for event in kept_events(one)))


def _event(path: Path, number: int, row: list[str], remedy: str) -> YardEvent:
    try:
        stamp, kind, *rest = row
        x, y, yaw, length, width = (float(value) for value in rest)
        event = YardEvent(int(stamp), kind, x, y, yaw, length, width)
    except ValueError as error:
        raise InputError(path, f"line {number} is not an event ({error})", remedy) from error
    finite = all(math.isfinite(value) for value in (x, y, yaw, length, width))
    if kind not in KINDS or not finite or min(length, width) < 0 or not 0 <= event.stamp_ns < 2**63:
        raise InputError(path, f"line {number} is not an event", remedy)
    return event


def write_events(events: Iterable[YardEvent], target: Path) -> None:
    """Write a CSV of COLUMNS, completely or not at all."""
    with atomic_path(target) as path, path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows(astuple(event) for event in events)


def merged(first: Iterable[YardEvent], more: Iterable[YardEvent]) -> tuple[YardEvent, ...]:
    """Join events without duplicates, in order of time."""
    return tuple(sorted({*first, *more}, key=lambda event: tuple(asdict(event).values())))


def events_since(events: tuple[YardEvent, ...], captured_ns: tuple[int, int] | None) -> tuple[YardEvent, ...]:
    """Select events that a map may not show: those after its first frame, or all if that is unknown."""
    return tuple(event for event in events if captured_ns is None or event.stamp_ns > captured_ns[0])
