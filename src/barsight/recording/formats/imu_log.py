"""Read a log of a resting IMU in any common form: CSV or columns, s or ns, g or m/s^2, degrees or radians."""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import in_range, read_lines
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import NS_PER_S, rows_not_later
from barsight.recording.formats.bag_file import BAG_KINDS, IMU_TYPE, BagFile

GRAVITY_MPS2 = 9.80665
COLUMNS = 7
MAX_SAMPLES = 2_000_000
"""Maximum number of samples of a log: three hours at 200 Hz."""
FORM = "seven columns: time, three of the gyroscope, three of the accelerometer (or these two exchanged)"
NAMES_FORM = "more than seven columns need a header that names gyro and accel"
NAMED = {
    "gyro": re.compile(r"gyr|angular|omega|^w_|^w[xyz]\b|^g[xyz]\b", re.IGNORECASE),
    "accel": re.compile(r"acc|^a_|^a[xyz]\b", re.IGNORECASE),
}

DEGREES = re.compile(r"(?:deg|°)(?!\w*[ _/.]*[CF](?:elsius|ahrenheit)?\b)|dps", re.IGNORECASE)
"""Of angle, not of temperature."""


class TimeUnit(StrEnum):
    """auto: by the header, otherwise the unit in which the sample rate is between 2.5 and 2500 Hz."""

    AUTO = "auto"
    S = "s"
    MS = "ms"
    US = "us"
    NS = "ns"


UNIT_NS = {TimeUnit.S: NS_PER_S, TimeUnit.MS: 10**6, TimeUnit.US: 10**3, TimeUnit.NS: 1}
SLOWEST_S = 0.4


class GyroUnit(StrEnum):
    """auto: degrees if the file's header says deg, otherwise radians."""

    AUTO = "auto"
    RADIANS = "rad/s"
    DEGREES = "deg/s"


class AccelUnit(StrEnum):
    """auto: g if the resting IMU measures about 1, m/s^2 if it measures about 9.8."""

    AUTO = "auto"
    MPS2 = "m/s^2"
    G = "g"


@dataclass(frozen=True, eq=False)
class ImuLog:
    """samples: SI units, in the IMU's own axes. notes: assumptions on units and order."""

    samples: ImuSamples
    notes: tuple[str, ...]


def read_imu_log(
    path: Path, gyro_unit: GyroUnit = GyroUnit.AUTO, accel_unit: AccelUnit = AccelUnit.AUTO,
    time_unit: TimeUnit = TimeUnit.AUTO,
) -> ImuLog:  # fmt: skip
    """Read a log of an IMU at rest, or a bag; a folder's `imu0/data.csv` is found. Raises InputError.

    Stamps may have any epoch, also start-up; their unit is given by `TimeUnit`.
    """
    is_bag = path.suffix in BAG_KINDS or (path / "metadata.yaml").is_file()
    file = path if is_bag else _file(path)
    header, stamp_ns, values = _bag_rows(path) if is_bag else _rows(file, time_unit)
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
        gyro_unit = _gyro_unit(header)
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


def _rows(path: Path, unit: TimeUnit) -> tuple[str, Int64, Float64]:
    """Read header text, stamps (N,) ns in time order and values (N, 6), by column name if there are more."""
    lines = read_lines(path, MAX_SAMPLES, f"give {FORM}")
    start = next((k for k, line in enumerate(lines) if re.match(r"\s*[-+.\d]", line)), len(lines))
    rows = [(k + 1, line) for k, line in enumerate(lines[start:], start) if line.strip() and line[0] != "#"]
    header = lines[start - 1].lstrip("# ") if start else ""
    count = len(_parts(rows[0][1])) if rows else 0
    columns = list(range(COLUMNS)) if count == COLUMNS else _named_columns(path, header, count)
    stamps, values = [], []
    for number, line in rows:
        parts = _parts(line)
        try:
            if len(parts) != count:
                raise ValueError
            stamps.append(Decimal(parts[0]))
            values.append([float(parts[k]) for k in columns[1:]])
        except (ArithmeticError, ValueError):
            raise InputError(path, f"line {number}: not {count} numbers", f"give {FORM}") from None
    array = np.array(values, dtype=np.float64).reshape(-1, 6)
    stamp_ns = _stamps_ns(path, stamps, header, unit)
    good = in_range(array).all(axis=1)
    stamp_ns, array = stamp_ns[good], array[good]
    _expect_rising(path, stamp_ns)
    return " ".join(lines[:start]), stamp_ns, array


def _parts(line: str) -> list[str]:
    return line.rstrip(" ,;\t").replace(",", " ").replace(";", " ").replace("\t", " ").split()


def _named_columns(path: Path, header: str, count: int) -> list[int]:
    """Find time, gyroscope and accelerometer among more columns by their names."""
    names = [name.strip() for name in re.split(r"[,;\t]", header)]
    if count < COLUMNS:
        problem = f"line 1: not {COLUMNS} numbers" if count else "holds no samples"
        raise InputError(path, problem, f"give {FORM}")
    found = {kind: [k for k, name in enumerate(names) if word.search(name)] for kind, word in NAMED.items()}
    if len(names) != count or any(len(columns) != 3 for columns in found.values()):
        raise InputError(path, f"has {count} columns whose names don't tell which are which", NAMES_FORM)
    return [0, *found["gyro"], *found["accel"]]


def _stamps_ns(path: Path, stamps: list[Decimal], header: str, unit: TimeUnit) -> Int64:
    """Convert stamps to whole ns."""
    if len(stamps) < 2:
        raise InputError(path, "holds no samples", f"give {FORM}")
    if not all(stamp.is_finite() for stamp in stamps):
        raise InputError(path, "holds a stamp that is not a number", "drop that line")
    if unit is TimeUnit.AUTO:
        unit = _time_unit(path, stamps, header)
    scaled = [stamp * UNIT_NS[unit] for stamp in stamps]
    if not all(abs(stamp) < 2**63 for stamp in scaled):
        raise InputError(path, f"holds stamps that are not times in {unit}", "give their unit by --time-unit")
    return np.array([int(stamp) for stamp in scaled], dtype=np.int64)


def _gyro_unit(header: str) -> GyroUnit:
    """Find the gyroscope's unit, by its own columns where these tell one: others may have degrees too."""
    names = [name for name in re.split(r"[,;\t]", header) if NAMED["gyro"].search(name.strip(" #"))]
    own = " ".join(names)
    stated = own if re.search(r"rad|deg|°|dps", own, re.IGNORECASE) else header
    return GyroUnit.DEGREES if DEGREES.search(stated) else GyroUnit.RADIANS


def _time_unit(path: Path, stamps: list[Decimal], header: str) -> TimeUnit:
    named = re.search(r"[\[(_ ](ns|us|\u00b5s|ms|s|sec)[\])]?\s*$", re.split(r"[,;\t]", header)[0].strip())
    step = float(np.median(np.abs(np.diff(np.array([float(stamp) for stamp in stamps])))))
    fits = [one for one, ns in UNIT_NS.items() if SLOWEST_S * 1e-3 <= step * ns / NS_PER_S < SLOWEST_S]
    if named:
        text = named[1].replace("\u00b5", "u").replace("sec", "s")
        return TimeUnit(text)
    if len(fits) != 1:
        raise InputError(
            path, f"its stamps lie {step:.3g} apart: no IMU's rate in s, ms, us or ns", "give --time-unit"
        )
    return fits[0]


def _bag_rows(path: Path) -> tuple[str, Int64, Float64]:
    """Read the one IMU of a bag: header stamps (N,) ns and values (N, 6), SI units."""
    bag = BagFile(path)
    topics = [topic for topic in bag.topics if topic.kind == IMU_TYPE and topic.count]
    if len(topics) != 1:
        names = ", ".join(topic.name for topic in topics or bag.topics) or "nothing"
        what = "several IMU topics" if topics else "no IMU topic"
        raise InputError(path, f"has {what} ({names})", "give a bag with one")
    stamps, values = [], []
    for message in bag.messages([topics[0].name]):
        try:
            decoded = bag.decode(message)
        except ValueError as error:
            raise InputError(path, f"{message.topic} {error}", "copy the bag again") from None
        w, a = decoded.angular_velocity, decoded.linear_acceleration
        stamps.append(message.stamp_ns)
        values.append([w.x, w.y, w.z, a.x, a.y, a.z])
    table, stamp_ns = np.array(values, np.float64).reshape(-1, 6), np.array(stamps, np.int64)
    good = in_range(table).all(axis=1)
    _expect_rising(path, stamp_ns[good])
    return "", stamp_ns[good], table[good]


def _expect_rising(path: Path, stamp_ns: Int64) -> None:
    back = rows_not_later(stamp_ns)
    if stamp_ns.size < 2:
        raise InputError(path, "holds no samples", f"give {FORM}")
    if back.size:
        raise InputError(
            path, f"{back.size} stamps repeat or go back, first near {stamp_ns[back[0]] / NS_PER_S:.3f} s",
            "sort the log by time and drop doubled lines",
        )  # fmt: skip


def _is_gravity(norm: float) -> bool:
    return 0.8 < norm < 1.25 or 8.0 < norm < 12.0
