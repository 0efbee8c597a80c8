"""Repeat a recording end to end, to get a long yard without rendering every metre of it.

Each lap continues where the crane stopped; its images are those of the first lap. At a joint the image
changes while the crane is at rest, as if the yard had been exchanged below it: measurements there are wrong,
and the result has no truth. It shows how time and memory grow.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from barsight.core.errors import InputError
from barsight.core.files import atomic_directory

_CAMERAS, _CLOCKED = ("cam0", "cam1"), ("imu0", "crane0")


def repeat(recording: Path, target: Path, times: int) -> None:
    """Write `target`, an EuRoC folder with crane encoders; its images are links to those of `recording`.

    Raises InputError if `recording` lacks cameras or encoders, or if its images aren't PNGs named by stamp.
    """
    mav = recording.resolve() / "mav0"
    for name in (*_CAMERAS, "crane0"):
        if not (mav / name / "data.csv").is_file():
            raise InputError(mav / name, "has no data.csv", "give a recording of `barsight simulate`")
    head, crane = _table(mav / "crane0")
    places = np.array([row[1:] for row in crane], dtype=np.float64)
    way = places[-1] - places[0]
    sensors = [name for name in (*_CAMERAS, *_CLOCKED) if (mav / name).is_dir()]
    first = min(int(_table(mav / name)[1][0][0]) for name in sensors)
    last = max(int(_table(mav / name)[1][-1][0]) for name in sensors)
    step = int(crane[1][0]) - int(crane[0][0])
    lap_ns = last - first + step
    with atomic_directory(target) as staging:
        for name in sensors:
            (staging / "mav0" / name).mkdir(parents=True)
            shutil.copyfile(mav / name / "sensor.yaml", staging / "mav0" / name / "sensor.yaml")
        if (mav / "body.yaml").is_file():
            shutil.copyfile(mav / "body.yaml", staging / "mav0" / "body.yaml")
        for name in _CAMERAS:
            _repeat_pictures(mav / name, staging / "mav0" / name, times, lap_ns)
        if "imu0" in sensors:
            head_imu, imu = _table(mav / "imu0")
            samples = ((int(row[0]) + lap * lap_ns, *row[1:]) for lap in range(times) for row in imu)
            _write(staging / "mav0" / "imu0", head_imu, samples)
        readings = (
            (int(row[0]) + lap * lap_ns, *(f"{p:.6f}" for p in place + lap * way))
            for lap in range(times)
            for row, place in zip(crane, places, strict=True)
        )
        _write(staging / "mav0" / "crane0", head, readings)


def _repeat_pictures(source: Path, target: Path, times: int, lap_ns: int) -> None:
    head, rows = _table(source)
    (target / "data").mkdir()
    for lap in range(times):
        for stamp, name in rows:
            (target / "data" / f"{int(stamp) + lap * lap_ns}.png").hardlink_to(source / "data" / name)
    stamps = (int(stamp) + lap * lap_ns for lap in range(times) for stamp, _ in rows)
    _write(target, head, ((stamp, f"{stamp}.png") for stamp in stamps))


def _write(folder: Path, head: str, rows: Iterable[tuple[object, ...]]) -> None:
    with (folder / "data.csv").open("w", encoding="ascii") as file:
        file.write(f"{head}\n")
        file.writelines(f"{','.join(map(str, row))}\n" for row in rows)


def _table(folder: Path) -> tuple[str, list[list[str]]]:
    """Read the header line of a data.csv, and its rows."""
    lines = (folder / "data.csv").read_text(encoding="ascii").splitlines()
    return lines[0], [[field.strip() for field in line.split(",")] for line in lines[1:] if line.strip()]
