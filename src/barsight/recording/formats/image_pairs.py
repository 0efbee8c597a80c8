"""Find pairs of pictures without a calibration, the input of `barsight calibrate`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from barsight.core.arrays import UInt8
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import read_bytes
from barsight.core.records.gray_levels import TornImageError
from barsight.recording.image_decoding import MAX_PICTURE_BYTES, decode_gray

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm"}
FOLDERS = (
    ("mav0/cam0/data", "mav0/cam1/data"), ("cam0/data", "cam1/data"), ("cam0", "cam1"), ("left", "right"),
    ("image_0", "image_1"), ("image_left", "image_right"), ("l", "r"),
)  # fmt: skip
MARKS = (("left", "right"), ("cam0", "cam1"), ("camera0", "camera1"), ("_l", "_r"), ("l", "r"))
INSIDE = tuple(
    re.compile(rf"(?P<before>.*){mark}(?P<after>.*)")
    for mark in (
        "(?P<side>[Ll]eft|[Rr]ight|LEFT|RIGHT)", r"[Cc]am(era)?[-_]?(?P<side>[01])(?!\d)",
        r"(?<=[a-z0-9_.-])(?P<side>[LR])(?=[-_.\d]|$)", r"(?<=[-_.])(?P<side>[lr])(?=[-_.\d])",
    )
)  # fmt: skip
"""Marks of the side within a name, as in imageL0 and imageR0."""
FORMS = (
    "a folder with left and right (or cam0 and cam1) inside, with pictures named left01.png and right01.png, "
    "or an EuRoC recording"
)


@dataclass(frozen=True)
class PicturePair:
    """name: common name of both pictures, without left and right. left, right: their files."""

    name: str
    left: Path
    right: Path


@dataclass(frozen=True, eq=False)
class ReadPair:
    """A pair's two gray pictures (H, W) uint8, None where one can't be read; problems: (camera, reason)."""

    name: str
    left: UInt8 | None
    right: UInt8 | None
    problems: tuple[tuple[str, str], ...]


def find_pairs(path: Path) -> tuple[PicturePair, ...]:
    """Find the pairs below `path`, in the order of their names (numbers by value).

    Files of two folders pair if their names are equal without `left`/`right`. Raises InputError if there are
    none.
    """
    if not path.is_dir():
        what = "is a file" if path.exists() else "no such folder"
        raise InputError(path, what, f"give {FORMS}")
    for first, second in FOLDERS:
        if (path / first).is_dir() and (path / second).is_dir():
            left = {_key(file.stem, 0): file for file in _pictures(path / first)}
            right = {_key(file.stem, 1): file for file in _pictures(path / second)}
            if left or right:
                return _matched(path, left, right)
    files = _pictures(path)
    for marks in MARKS:
        left, right = ({_cut(f.stem, mark): f for f in files if _has(f.stem, mark)} for mark in marks)
        if left and right and set(left) & set(right):
            return _matched(path, left, right)
    for inside in INSIDE:
        sides: tuple[dict[str, Path], dict[str, Path]] = ({}, {})
        for file in files:
            if found := inside.fullmatch(file.stem):
                side = found["side"].lower() in ("right", "r", "1")
                sides[side][found["before"] + found["after"]] = file
        if set(sides[0]) & set(sides[1]):
            return _matched(path, *sides)
    raise InputError(path, "holds no pairs of pictures", f"give {FORMS}")


def read_pair_files(pair: PicturePair) -> ReadPair:
    """Decode a pair."""
    images: list[UInt8 | None] = []
    problems = []
    for camera, file in (("cam0", pair.left), ("cam1", pair.right)):
        try:
            images.append(decode_gray(read_bytes(file, MAX_PICTURE_BYTES)))
        except (InputError, TornImageError) as error:
            reason = error.problem if isinstance(error, InputError) else str(error)
            problems.append((camera, f"{file.name} {reason}"))
            images.append(None)
    return ReadPair(pair.name, images[0], images[1], tuple(problems))


def _pictures(folder: Path) -> list[Path]:
    return [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and file.name[0] != "."]


def _matched(path: Path, left: dict[str, Path], right: dict[str, Path]) -> tuple[PicturePair, ...]:
    names = sorted(set(left) & set(right), key=_natural)
    if not names:
        raise InputError(
            path,
            "no left picture has a right one of the same name",
            "give both pictures of a pair one number",
        )
    return tuple(PicturePair(name, left[name], right[name]) for name in names)


def _key(stem: str, side: int) -> str:
    for marks in MARKS[:3]:
        if _has(stem, marks[side]):
            return _cut(stem, marks[side])
    return stem


def _has(stem: str, mark: str) -> bool:
    lower = stem.lower()
    return lower.startswith(mark) or lower.endswith(mark)


def _cut(stem: str, mark: str) -> str:
    lower = stem.lower()
    cut = stem[len(mark) :] if lower.startswith(mark) else stem[: -len(mark)]
    return cut.strip("_-. ") or stem


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
