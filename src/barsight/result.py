"""Represent a measured yard in Python: a result folder whose parts are read on demand."""

from __future__ import annotations

import shutil
import tempfile
import time
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from barsight.core.errors import MEASURE_AGAIN, InputError, OutputError
from barsight.core.files import atomic_directory
from barsight.core.records.heights import Contour
from barsight.core.settings.values import checked_value
from barsight.report.files.result_files import RESULT_FILES
from barsight.report.page import write_report
from barsight.result_folder import (
    CameraPath,
    changed_inputs,
    open_folder,
    read_contours,
    read_heights,
    read_path,
    read_summary,
)
from barsight.yard.events import YardEvent, events_since, kept_events, merged, write_events
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.lifting.lift_file import forbidden_since, read_lifts
from barsight.yard.types import Bundle, HeightMap

T = TypeVar("T")


@dataclass(frozen=True)
class LiftTarget:
    """A lift: the magnet's position (yard frame), yaw of its beam, the bundles under it, and any vetoes.

    rank: 1 is the safest; None if it is refused. z_m: None without a contact. valid_until_ns: time on the
    frames' clock after which it must not be used. vetoes: (code, sentence).
    record: its complete content in lifts.json.
    """

    rank: int | None
    x_m: float
    y_m: float
    z_m: float | None
    yaw_deg: float
    bundles: tuple[int, ...]
    mass_kg: float | None
    mass_sigma_kg: float | None
    valid_until_ns: int | None
    vetoes: tuple[tuple[str, str], ...]
    record: dict[str, Any]

    def __repr__(self) -> str:
        rank = "refused" if self.rank is None else f"rank {self.rank}"
        told = ", ".join(code for code, _ in self.vetoes)
        place = f"({self.x_m:.2f}, {self.y_m:.2f}) m"
        return f"<LiftTarget {rank}: bundles {self.bundles} at {place}{told and f'; vetoes {told}'}>"


@dataclass(frozen=True)
class Lifts:
    """offered: safest first; iteration and `len` use these. refused: one of each other bundle. vetoes: (code,
    sentence) that forbid every lift of the map. past: lifts offered as of the recording's end, if they were
    judged in retrospect (`at="end"`): never for a crane, and then nothing is offered.
    """

    offered: tuple[LiftTarget, ...]
    refused: tuple[LiftTarget, ...]
    vetoes: tuple[tuple[str, str], ...]
    past: tuple[LiftTarget, ...] = ()

    def __iter__(self) -> Iterator[LiftTarget]:
        return iter(self.offered)

    def __len__(self) -> int:
        return len(self.offered)

    def __repr__(self) -> str:
        counts = f"{len(self.offered)} offered, {len(self.refused)} refused, {len(self.past)} past"
        forbidden = ", ".join(code for code, _ in self.vetoes)
        return f"<Lifts: {counts}{forbidden and f'; forbidden by {forbidden}'}>"


class TemporaryFolder:
    """A new folder that is deleted as soon as nothing holds this object. Copies of a yard hold the same one;
    what is pickled can't.
    """

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="barsight."))
        self.delete = weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)

    def __deepcopy__(self, memo: object) -> TemporaryFolder:
        return self

    def __reduce__(self) -> NoReturn:
        remedy = "save the yard, and load the folder elsewhere (bs.load)"
        raise OutputError(f"{self.path}: is temporary, so its yard can't be pickled; {remedy}")


class Yard:
    """A measured yard; `folder` holds its files, which are read on demand.

    temporary: the temporary folder in which `folder` is; it lives as long as the yard and its copies.
    """

    def __init__(self, folder: Path | str, temporary: TemporaryFolder | None = None) -> None:
        self.folder: Path = checked_value(folder, Path, "folder").absolute()
        self._temporary = temporary
        self.summary, _ = open_folder(self.folder)

    @cached_property
    def height_map(self) -> HeightMap:
        """Return the whole map."""
        return self._read(lambda folder: read_heights(folder).whole())

    @cached_property
    def contours(self) -> tuple[Contour, ...]:
        """Return the heights along X, one contour for each profile."""
        return self._read(read_contours)

    @cached_property
    def trajectory(self) -> CameraPath:
        """Return the body's poses. Raises InputError if the folder has none."""
        path = self._read(read_path)
        if path is None:
            raise InputError(self.folder, "has no trajectory.tum", MEASURE_AGAIN)
        return path

    @cached_property
    def bundles(self) -> tuple[Bundle, ...]:
        """Return the bundles found."""
        return self._read(lambda folder: read_bundles(folder / "bundles.json"))

    def _read(self, read: Callable[[Path], T]) -> T:
        content = read(self.folder)
        self._expect_unchanged()
        return content

    def _expect_unchanged(self) -> None:
        """Raise InputError if the folder was measured anew since it was loaded."""
        if read_summary(self.folder).get("map_id") != self.summary.get("map_id"):
            raise InputError(self.folder, "was measured anew since it was loaded", "load it again")

    @property
    def lifts(self) -> Lifts:
        """Return the lifts as currently valid: as last chosen, those too old or disturbed since refused."""
        content = self._read(lambda folder: read_lifts(folder / "lifts.json"))
        offered, refused = (tuple(map(_target, content[name])) for name in ("lifts", "refused"))
        vetoes = _vetoes(content)
        if changed := changed_inputs(self.summary):
            since = ("calibration-changed", f"{changed} was changed since: measure again")
            refused += tuple(_vetoed(lift, since) for lift in offered)
            return Lifts((), refused, (*(veto for veto in vetoes if veto[0] != since[0]), since))
        if content["looks_back"]:
            return Lifts((), refused, vetoes, offered)
        now_ns = time.time_ns()
        said = []
        for lift in offered:
            found = forbidden_since(content, lift.record, self.bundles, self._events, now_ns)
            said.append((lift, [(veto.code, veto.reason) for veto in found]))
        refused += tuple(_vetoed(lift, *codes) for lift, codes in said if codes)
        return Lifts(tuple(lift for lift, codes in said if not codes), refused, vetoes)

    @property
    def _events(self) -> tuple[YardEvent, ...]:
        return kept_events(self.folder)

    @property
    def warnings(self) -> tuple[tuple[str, str], ...]:
        """Return code and sentence of each warning."""
        return tuple((str(one["code"]), str(one["message"])) for one in self.summary["warnings"])

    def save(self, out: Path | str, *, overwrite: bool = False) -> Path:
        """Write the result files and report.html into the folder `out`, all or nothing, and return it.

        Events that were reported there, and that the map may not show, are kept.
        Raises OutputError if `out` exists already and may not be overwritten.
        """
        target: Path = checked_value(out, Path, "out")
        if target.resolve() == self.folder.resolve():
            raise OutputError(f"{target}: the yard was read from there; name another folder")
        with atomic_directory(target, replace=overwrite, owned=RESULT_FILES) as staging:
            for name in RESULT_FILES:
                if (self.folder / name).is_file():
                    shutil.copyfile(self.folder / name, staging / name)
            self._expect_unchanged()
            from_ns = self.summary.get("captured_from_ns")
            later = events_since(kept_events(target), None if from_ns is None else (from_ns, from_ns))
            if told := merged(self._events, later):
                write_events(told, staging / "events.csv")
            write_report(staging, staging / "report.html")
        return target

    def __repr__(self) -> str:
        return f"<Yard: {self._figures()}>"

    def _figures(self) -> str:
        rows, columns = self.height_map.shape
        return (
            f"{columns} x {rows} cells of {1e3 * self.height_map.cell_m:.0f} mm, "
            f"{len(self.bundles)} bundles, {len(self.lifts)} lifts offered, {len(self.warnings)} warnings"
        )

    def _repr_html_(self) -> str:
        """Return the map as a picture with the bundles and lifts, for a notebook."""
        warnings = "".join(f"<li>{escape(text)}</li>" for _, text in self.warnings)
        return f"{self.height_map._repr_html_()}<p>{escape(self._figures())}</p><ul>{warnings}</ul>"


def _target(record: dict[str, Any]) -> LiftTarget:
    target = record["target"]
    return LiftTarget(
        record["rank"], target["x_m"], target["y_m"], target["z_m"], target["yaw_deg"],
        tuple(record["bundles"]), record["mass_kg"], record["mass_sigma_kg"], record["valid_until_ns"],
        _vetoes(record), record,
    )  # fmt: skip


def _vetoed(lift: LiftTarget, *vetoes: tuple[str, str]) -> LiftTarget:
    return replace(lift, rank=None, vetoes=(*lift.vetoes, *vetoes))


def _vetoes(record: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    return tuple((str(veto["code"]), str(veto["reason"])) for veto in record["vetoes"])
