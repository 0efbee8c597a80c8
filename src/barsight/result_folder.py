"""Read the folder written by `barsight measure`, for page, viewer, export and lifts."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Float32, Float64, Int64, rows_by_number
from barsight.core.errors import MEASURE_AGAIN, InputError
from barsight.core.json_values import json_digest
from barsight.core.reading.bounded_reading import (
    MAX_PICTURES,
    MAX_PROFILES,
    expect_lines,
    in_range,
    open_regular,
    read_json,
    read_lines,
)
from barsight.core.reading.geotiff import HEIGHT_BANDS, open_geotiff
from barsight.core.reading.json_schema import expect_schema, package_schema
from barsight.core.reading.ply import read_vertices
from barsight.core.reading.sealed_json import SEAL
from barsight.core.records.heights import Contour
from barsight.core.records.sensor_samples import LaserProfile
from barsight.core.stamps import parse_seconds
from barsight.yard.identity import ID_DIGITS, MapIdentity
from barsight.yard.inventory import bundle_file
from barsight.yard.lifting import lift_file
from barsight.yard.lifting.lift_file import read_lifts
from barsight.yard.sections import PartedMap
from barsight.yard.types import HeightMap

PHOTO = "ortho.tif"
"""File without a digest in folders of earlier versions. Only it shows labels, so lifts need it."""
MAP_FILES = ("height.tif", PHOTO, "free.tif", "tops.tif", "passes.tif", "cloud.ply")
TABLES = ("contour.csv", "laser.csv", "trajectory.tum")
SEALED = (*MAP_FILES, *TABLES)
"""Files whose digests are in result.json."""
MAP_FIELDS = (
    "captured_from_ns", "captured_to_ns", "is_simulated", "reference", "hashes", "calibration_id",
    "yard_frame_id", "travel", "warnings", "map", "files",
)  # fmt: skip
"""Keys of result.json on which the map's lifts depend."""
PROPERTIES = ("x", "y", "z", "intensity", "sigma_z", "views")


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Trajectory of the body. stamp_ns: (N,). position_m: (N, 3), quaternion_xyzw: (N, 4), reference axes."""

    stamp_ns: Int64
    position_m: Float64
    quaternion_xyzw: Float64

    def __repr__(self) -> str:
        return f"<CameraPath: {self.stamp_ns.size} poses>"


@dataclass(frozen=True, eq=False)
class Cloud:
    """xyz_m: (N, 3) float32. intensity, sigma_m, views: (N,) float32. total: number of points in the file."""

    xyz_m: Float32
    intensity: Float32
    sigma_m: Float32
    views: Float32
    total: int


def read_summary(folder: Path) -> dict[str, Any]:
    """Read result.json. Raises InputError if the folder or the file is missing or the file is damaged."""
    path = folder / "result.json"
    remedy = "name a folder that `barsight measure` wrote"
    if not folder.is_dir():
        raise InputError(folder, "no such folder", remedy)
    if not path.is_file():
        raise InputError(folder, "has no result.json", remedy)
    summary = read_json(path, MEASURE_AGAIN)
    expect_schema(summary, package_schema("barsight.yard", "result"), path, MEASURE_AGAIN)
    found: dict[str, Any] = summary
    return found


def identify_map(summary: dict[str, Any]) -> MapIdentity:
    """Build the identity of the map that result.json describes; its id is a digest of MAP_FIELDS."""
    said = {name: summary.get(name) for name in MAP_FIELDS}
    return MapIdentity(
        json_digest(said)[:ID_DIGITS], bool(summary.get("is_simulated")), said["captured_from_ns"],
        said["captured_to_ns"], str(said["calibration_id"]), said["yard_frame_id"],
        str((said["files"] or {}).get("height.tif")),
    )  # fmt: skip


def seal_map(summary: dict[str, Any], folder: Path) -> MapIdentity:
    """Add the digests of the SEALED files and the map's id to the content of result.json."""
    files = (folder / name for name in SEALED)
    summary["files"] = {path.name: file_digest(path) for path in files if path.is_file()}
    identity = identify_map(summary)
    summary["map_id"] = identity.map_id
    return identity


def file_digest(path: Path) -> str:
    """Compute SHA-256 of a file."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def open_folder(
    folder: Path, *, lifts: bool = True, cloud: bool = False
) -> tuple[dict[str, Any], MapIdentity | None]:
    """Read result.json and check that the folder's files belong to the map and are unchanged.

    Returns None as the identity of a folder with neither bundles nor lifts. lifts, cloud: whether lifts.json
    and cloud.ply matter. Raises InputError for the first file that was changed or belongs to another map.
    """
    summary = read_summary(folder)
    path = folder / "result.json"
    bundles, chosen = folder / "bundles.json", folder / "lifts.json"
    if "map_id" not in summary:
        if bundles.is_file() or chosen.is_file():
            raise InputError(path, "has no map_id: an earlier version wrote it", MEASURE_AGAIN)
        return summary, None
    identity = identify_map(summary)
    if identity.map_id != summary["map_id"]:
        raise InputError(path, "was changed after it was written", MEASURE_AGAIN)
    for name in SEALED:
        file, digest = folder / name, (summary.get("files") or {}).get(name)
        if not file.is_file() or (name == "cloud.ply" and not cloud):
            continue
        if digest is None and name == PHOTO:
            continue
        if digest is None:
            raise InputError(path, f"has no digest of {name}: an earlier version wrote it", MEASURE_AGAIN)
        _expect_form(file)
        if file_digest(file) != digest:
            raise InputError(file, "is not the one that result.json was written with", MEASURE_AGAIN)
    if bundles.is_file():
        found = bundle_file.bundles_content(bundles)
        identity.expect(bundles, found, MEASURE_AGAIN)
        if lifts and chosen.is_file():
            content = read_lifts(chosen)
            identity.expect(chosen, content, lift_file.REMEDY)
            if content["bundles_sha256"] != found[SEAL]:
                raise InputError(chosen, "was chosen from another bundles.json", lift_file.REMEDY)
    return summary, identity


def _expect_form(file: Path) -> None:
    """Refuse, by its header, a file that would take long to digest and is no map, cloud or table."""
    if file.name in TABLES:
        expect_lines(file, remedy=MEASURE_AGAIN)
    elif file.suffix == ".tif":
        with open_geotiff(file, HEIGHT_BANDS if file.name == "height.tif" else 1):
            pass
    else:
        read_cloud(file, max_points=1)


def bundles_digest(folder: Path) -> str:
    """Return the digest stored in bundles.json. Raises InputError."""
    return str(bundle_file.bundles_content(folder / "bundles.json")[SEAL])


def next_sequence(lifts: Path, identity: MapIdentity) -> int:
    """Return the next sequence number after that of lifts.json; 1 if there is none of this map."""
    try:
        found = read_lifts(lifts)
    except InputError:
        return 1
    return int(found["sequence"]) + 1 if found["map_id"] == identity.map_id else 1


def changed_inputs(summary: dict[str, Any]) -> str:
    """Find a calibration file of the recording that has changed since the measurement; empty if there is
    none, or if the recording no longer exists.
    """
    hashes = (summary.get("hashes") or {}).get("inputs") or {}
    passes = summary.get("passes") or [{"recording": summary.get("recording"), "inputs": hashes}]
    for one in passes:
        recording = Path((one["recording"] or {}).get("path") or "")
        for name, digest in one["inputs"].items():
            for root in (recording, recording / "mav0"):
                file = root / name
                if file.suffix in (".yaml", ".yml") and file.is_file() and file_digest(file) != digest:
                    return str(file)
    return ""


def read_heights(folder: Path) -> PartedMap:
    """Open height.tif, and ortho.tif, free.tif, tops.tif, passes.tif if present; parts are read on demand.

    Raises InputError, then or later, if one is missing or damaged.
    """
    names = ("height.tif", "ortho.tif", "free.tif", "tops.tif", "passes.tif")
    path, photo, free, tops, passes = (folder / name for name in names)
    if not path.is_file():
        raise InputError(folder, "has no height.tif", MEASURE_AGAIN)
    with open_geotiff(path, HEIGHT_BANDS) as file:
        size, cell_m = file.size, file.cell_m
        x0_m, y0_m = file.left_m + cell_m / 2, file.top_m - (size[0] - 0.5) * cell_m
    for other, dtype in ((photo, np.uint8), (free, np.float32), (tops, np.uint8), (passes, np.uint8)):
        if other.is_file():
            with open_geotiff(other) as file:
                if file.size != size or file.page.dtype != dtype:
                    raise InputError(other, "doesn't fit height.tif", MEASURE_AGAIN)

    def layer(path: Path, rows: slice, columns: slice) -> NDArray[Any] | None:
        if not path.is_file():
            return None
        with open_geotiff(path) as file:
            found: NDArray[Any] = file.rectangle(1, rows, columns)[0]
        return found

    def read(rows: slice, columns: slice) -> HeightMap:
        with open_geotiff(path, HEIGHT_BANDS) as file:
            z, sigma, views, source = file.rectangle(HEIGHT_BANDS, rows, columns)
        layers = (layer(other, rows, columns) for other in (photo, free, tops, passes))
        x, y = x0_m + cell_m * columns.start, y0_m + cell_m * rows.start
        return HeightMap(x, y, cell_m, z, sigma, views, source.astype(np.uint8), *layers)

    return PartedMap(x0_m, y0_m, cell_m, size, read)


def read_path(folder: Path) -> CameraPath | None:
    """Read trajectory.tum; None if there is none. Raises InputError for a line that isn't in TUM format."""
    path = folder / "trajectory.tum"
    if not path.is_file():
        return None
    stamps: list[int] = []
    numbers: list[list[float]] = []
    for count, line in enumerate(read_lines(path, MAX_PICTURES, MEASURE_AGAIN), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            stamps.append(parse_seconds(fields[0]))
            numbers.append([float(field) for field in fields[1:]])
        except ValueError as error:
            raise InputError(path, f"line {count} is not TUM ({error})", MEASURE_AGAIN) from error
        if len(numbers[-1]) != 7:
            raise InputError(path, f"line {count} has {len(fields)} numbers instead of 8", MEASURE_AGAIN)
    table = np.array(numbers, dtype=np.float64).reshape(-1, 7)
    far = ~in_range(table).all(axis=1)
    loose = ~(np.abs(np.linalg.norm(table[:, 3:], axis=1) - 1) <= 0.01)
    for wrong, says in ((far, "its numbers are out of range"), (loose, "its quaternion has not length 1")):
        if wrong.any():
            raise InputError(path, f"pose {int(np.argmax(wrong)) + 1}: {says}", MEASURE_AGAIN)
    return CameraPath(np.array(stamps, dtype=np.int64), table[:, :3], table[:, 3:])


def read_cloud(path: Path, max_points: int | None = None) -> Cloud:
    """Read at most `max_points` evenly drawn points of cloud.ply (all, if None) from disk.

    Raises InputError if the file is missing, damaged or empty or lacks one of PROPERTIES.
    """
    if not path.is_file():
        raise InputError(path, "no such file", MEASURE_AGAIN)
    try:
        data = read_vertices(path)
    except (ValueError, OSError) as error:
        raise InputError(path, f"is damaged ({error})", MEASURE_AGAIN) from error
    missing = [name for name in PROPERTIES if name not in (data.dtype.names or ())]
    if missing:
        raise InputError(path, f"has no property {missing[0]}", MEASURE_AGAIN)
    if data.size == 0:
        raise InputError(path, "has no points", MEASURE_AGAIN)
    count = int(data.size) if max_points is None else min(int(data.size), max_points)
    drawn = data[np.arange(count) * data.size // count]
    column = {name: np.asarray(drawn[name], dtype=np.float32) for name in PROPERTIES}
    return Cloud(
        np.stack([column["x"], column["y"], column["z"]], axis=1),
        column["intensity"],
        column["sigma_z"],
        column["views"],
        int(data.size),
    )


def read_contours(folder: Path) -> tuple[Contour, ...]:
    """Read contour.csv, a contour per profile; empty if there is no such file."""
    table = _read_table(folder / "contour.csv", 3, 6)
    parts = _by_profile(folder / "contour.csv", table)
    return tuple(
        Contour(number, part[:, 1], part[:, 2], part[:, 3], part[:, 4], part[:, 5].astype(np.uint8))
        for number, part in parts.items()
    )


def read_laser(folder: Path) -> tuple[LaserProfile, ...]:
    """Read laser.csv; empty if there is no such file. range_std_m: NaN if unknown, as in folders of older
    versions.
    """
    table = _read_table(folder / "laser.csv", 4, 4, 5)
    stated = table.shape[1] == 5
    return tuple(
        LaserProfile(
            number, part[:, 1], part[:, 2], part[:, 3], float(part[0, 4]) if stated else float("nan")
        )
        for number, part in _by_profile(folder / "laser.csv", table).items()
    )


def _by_profile(path: Path, table: Float64) -> dict[int, Float64]:
    found = rows_by_number(table[:, 0])
    if len(found) > MAX_PROFILES:
        raise InputError(path, f"holds {len(found)} profiles, at most {MAX_PROFILES} are read", MEASURE_AGAIN)
    return {number: table[rows] for number, rows in found.items()}


def _read_table(path: Path, known: int, *columns: int) -> Float64:
    """Read (N, one of `columns`) from a CSV with a header.

    An empty field is NaN, which isn't allowed in the first `known` columns.
    """
    if not path.is_file():
        return np.empty((0, columns[0]))
    lines = read_lines(path, remedy=MEASURE_AGAIN)[1:]
    if not lines:
        return np.empty((0, columns[0]))
    filled = (re.sub(",(?=,|$)", ",nan", line) for line in lines)
    try:
        table = np.loadtxt(filled, dtype=np.float64, delimiter=",", ndmin=2)
    except ValueError as error:
        raise InputError(path, f"is damaged ({str(error).split(';')[0]})", MEASURE_AGAIN) from error
    if table.shape[1] not in columns:
        raise InputError(path, f"has {table.shape[1]} columns instead of {columns[-1]}", MEASURE_AGAIN)
    if (~in_range(table) & ~np.isnan(table)).any() or np.isnan(table[:, :known]).any():
        raise InputError(path, "holds a number out of range", MEASURE_AGAIN)
    return table
