"""A measured yard as Python sees it: a result folder, read as parts of it are asked for."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

from barsight.core.errors import InputError, OutputError
from barsight.core.files import atomic_directory
from barsight.core.types import Contour
from barsight.report.page import write_report
from barsight.report.result_files import RESULT_FILES
from barsight.result_folder import (
    CameraPath,
    changed_inputs,
    open_folder,
    read_contours,
    read_heights,
    read_path,
)
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.lifting.lift_file import read_lifts
from barsight.yard.types import Bundle, HeightMap


@dataclass(frozen=True)
class LiftTarget:
    """A lift: the magnet's place (yard frame), yaw of its beam, the bundles under it, and what forbids it.

    rank: 1 is the safest; None where it is refused. z_m: None without a contact. valid_until_ns: on the
    frames' clock, after which it must not be used. vetoes: (code, sentence).
    record: everything that lifts.json says of it.
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


@dataclass(frozen=True)
class Lifts:
    """offered: safest first, which iterating and `len` see. refused: one of each other bundle. vetoes: (code,
    sentence) that forbid every lift of the map.
    """

    offered: tuple[LiftTarget, ...]
    refused: tuple[LiftTarget, ...]
    vetoes: tuple[tuple[str, str], ...]

    def __iter__(self) -> Iterator[LiftTarget]:
        return iter(self.offered)

    def __len__(self) -> int:
        return len(self.offered)


class Yard:
    """A measured yard; `folder` holds its files, which are read when they are asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.summary, _ = open_folder(folder)
        self._kept: object = None

    def keep(self, owner: object) -> None:
        """Hold on to the owner of `folder`, with which it goes."""
        self._kept = owner

    @cached_property
    def height_map(self) -> HeightMap:
        """Return the whole map."""
        heights = read_heights(self.folder)
        rows, columns = heights.shape
        return heights.part(slice(0, rows), slice(0, columns))

    @cached_property
    def contours(self) -> tuple[Contour, ...]:
        """Heights along X, one contour for each profile."""
        return read_contours(self.folder)

    @cached_property
    def trajectory(self) -> CameraPath:
        """Return the body's poses. Raises InputError where the folder has none."""
        path = read_path(self.folder)
        if path is None:
            raise InputError(self.folder, "has no trajectory.tum", "measure the recording again")
        return path

    @cached_property
    def bundles(self) -> tuple[Bundle, ...]:
        """Return the bundles found."""
        return read_bundles(self.folder / "bundles.json")

    @cached_property
    def lifts(self) -> Lifts:
        """Return the lifts, and what forbids them."""
        content = read_lifts(self.folder / "lifts.json")
        offered, refused = (tuple(map(_target, content[name])) for name in ("lifts", "refused"))
        vetoes = _vetoes(content)
        if changed := changed_inputs(self.summary):
            since = ("calibration-changed", f"{changed} was changed since: measure again")
            refused += tuple(_vetoed(lift, since) for lift in offered)
            return Lifts((), refused, (*(veto for veto in vetoes if veto[0] != since[0]), since))
        if not content.get("looks_back"):
            now_ns = time.time_ns()
            late = ("map-too-old", "the lift was valid once, it isn't any more")
            fresh = tuple(lift for lift in offered if (lift.valid_until_ns or 0) >= now_ns)
            refused += tuple(_vetoed(lift, late) for lift in offered if lift not in fresh)
            offered = fresh
        return Lifts(offered, refused, vetoes)

    @property
    def warnings(self) -> tuple[tuple[str, str], ...]:
        """Return (code, sentence): of each warning."""
        return tuple((str(one["code"]), str(one["message"])) for one in self.summary["warnings"])

    def save(self, out: Path | str, *, overwrite: bool = False) -> Path:
        """Write the result files and report.html into the folder `out`, all or nothing, and return it.

        Raises OutputError where `out` exists already and may not be overwritten.
        """
        target = Path(out)
        if target.resolve() == self.folder.resolve():
            raise OutputError(f"{target}: the yard was read from there; name another folder")
        with atomic_directory(target, replace=overwrite, owned=RESULT_FILES) as staging:
            for name in RESULT_FILES:
                if (self.folder / name).is_file():
                    shutil.copyfile(self.folder / name, staging / name)
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
        """Return the map as a picture with what was found in it, for a notebook."""
        warnings = "".join(f"<li>{escape(text)}</li>" for _, text in self.warnings)
        return f"{self.height_map._repr_html_()}<p>{escape(self._figures())}</p><ul>{warnings}</ul>"


def _target(record: dict[str, Any]) -> LiftTarget:
    target = record["target"]
    return LiftTarget(
        record["rank"], target["x_m"], target["y_m"], target["z_m"], target["yaw_deg"],
        tuple(record["bundles"]), record["mass_kg"], record["mass_sigma_kg"], record["valid_until_ns"],
        _vetoes(record), record,
    )  # fmt: skip


def _vetoed(lift: LiftTarget, veto: tuple[str, str]) -> LiftTarget:
    return replace(lift, rank=None, vetoes=(*lift.vetoes, veto))


def _vetoes(record: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    return tuple((str(veto["code"]), str(veto["reason"])) for veto in record["vetoes"])
