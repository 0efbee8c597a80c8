"""Read an IMU's log at rest of any writer: CSV or columns, s or ns, g or m/s^2, degrees or radians."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import in_range, read_text
from barsight.core.stamps import NS_PER_S, parse_seconds
from barsight.core.types import ImuSamples

GRAVITY_MPS2 = 9.80665
COLUMNS = 7
FORM = "seven columns: time, three of the gyroscope, three of the accelerometer (or these two exchanged)"


class GyroUnit(StrEnum):
    """auto: degrees where the file's header says deg, else radians."""

    AUTO = "auto"
    RADIANS = "rad/s"
    DEGREES = "deg/s"


class AccelUnit(StrEnum):
    """auto: g where the resting IMU shows about 1, m/s^2 where it shows about 9.8."""

    AUTO = "auto"
    MPS2 = "m/s^2"
    G = "g"


@dataclass(frozen=True, eq=False)
class ImuLog:
    """samples: SI units, in the IMU's own axes. notes: what was assumed of units and order."""

    samples: ImuSamples
    notes: tuple[str, ...]


def read_imu_log(
    path: Path, gyro_unit: GyroUnit = GyroUnit.AUTO, accel_unit: AccelUnit = AccelUnit.AUTO
) -> ImuLog:
    """Read a log of an IMU at rest; a folder's `imu0/data.csv` is found. Raises InputError.

    Stamps are whole ns where they have no decimal point and 15 digits or more, else seconds.
    """
    file = _file(path)
    header, stamp_ns, values = _rows(file)
    norms = [float(np.median(np.linalg.norm(values[:, k : k + 3], axis=1))) for k in (0, 3)]
    notes = []
    first, second = values[:, :3], values[:, 3:]
    if _is_gravity(norms[0]) and not _is_gravity(norms[1]):
        first, second, norms = second, first, norms[::-1]
        notes.append("the accelerometer's columns come first")
    if accel_unit is AccelUnit.AUTO:
        if not _is_gravity(norms[1]):
            raise InputError(
                file,
                f"the accelerometer shows {norms[1]:.3g}, neither 1 g nor 9.8 m/s^2",
                "give accel_unit",
            )
        accel_unit = AccelUnit.G if norms[1] < 2 else AccelUnit.MPS2
    if gyro_unit is GyroUnit.AUTO:
        gyro_unit = GyroUnit.DEGREES if re.search(r"deg|°|dps", header, re.IGNORECASE) else GyroUnit.RADIANS
    notes.append(f"read as {gyro_unit} and {accel_unit}")
    gyro = np.radians(first) if gyro_unit is GyroUnit.DEGREES else first
    accel = second * GRAVITY_MPS2 if accel_unit is AccelUnit.G else second
    return ImuLog(ImuSamples(stamp_ns, gyro, accel), tuple(notes))


def _file(path: Path) -> Path:
    if path.is_dir():
        for name in ("mav0/imu0/data.csv", "imu0/data.csv", "imu0.csv", "data.csv"):
            if (path / name).is_file():
                return path / name
        raise InputError(path, "holds no imu0/data.csv", "name the log file itself")
    if not path.is_file():
        raise InputError(path, "no such file", "check the path")
    return path


def _rows(path: Path) -> tuple[str, Int64, Float64]:
    """Read header text, stamps (N,) ns in time's order and values (N, 6)."""
    lines = read_text(path, remedy=f"give {FORM}").splitlines()
    start = next((k for k, line in enumerate(lines) if re.match(r"\s*[-+.\d]", line)), len(lines))
    rows = [(k + 1, line) for k, line in enumerate(lines[start:], start) if line.strip() and line[0] != "#"]
    stamps, values = [], []
    for number, line in rows:
        parts = line.replace(",", " ").replace(";", " ").replace("\t", " ").split()
        try:
            if len(parts) != COLUMNS:
                raise ValueError
            text = parts[0]
            stamps.append(int(text) if len(text) >= 15 and text.isdigit() else parse_seconds(text))
            values.append([float(part) for part in parts[1:]])
        except ValueError:
            raise InputError(path, f"line {number}: not {COLUMNS} numbers", f"give {FORM}") from None
    array = np.array(values, dtype=np.float64).reshape(-1, 6)
    stamp_ns = np.array(stamps, dtype=np.int64)
    if stamp_ns.size < 2:
        raise InputError(path, "holds no samples", f"give {FORM}")
    good = in_range(array).all(axis=1)
    stamp_ns, array = stamp_ns[good], array[good]
    back = np.flatnonzero(np.diff(stamp_ns) <= 0)
    if back.size:
        raise InputError(
            path, f"{back.size} stamps repeat or go back, first near {stamp_ns[back[0]] / NS_PER_S:.3f} s",
            "sort the log by time and drop doubled lines",
        )  # fmt: skip
    return " ".join(lines[:start]), stamp_ns, array


def _is_gravity(norm: float) -> bool:
    return 0.8 < norm < 1.25 or 8.0 < norm < 12.0
