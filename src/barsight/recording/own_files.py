"""Restrict a recording to its own files: no name leads out of it, and the result lists the files' hashes."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from barsight.calibration.files.yaml_document import read_document
from barsight.core.errors import InputError
from barsight.core.files import lies_within
from barsight.core.reading.bounded_reading import MAX_TABLE_BYTES, open_regular, read_bytes
from barsight.core.records.gray_levels import TornImageError
from barsight.recording.image_decoding import MAX_PICTURE_BYTES

MAX_NAME_BYTES = 1000
"""Maximum length of a file's path below the recording; systems allow 4096 with all folders above."""


def expect_inner_name(name: str, path: Path, where: str) -> None:
    """Raise InputError about `path` for a name that is absolute, climbs out of its folder, too long or empty.

    where: the place in the file, such as `line 3`.
    """
    parts = PurePosixPath(name)
    if not name.isprintable() or parts.is_absolute() or ".." in parts.parts or not parts.parts:
        raise InputError(
            path, f"{where}: {name[:80]!r} leads out of the recording", "name files by their name alone"
        )
    if len(name.encode()) > MAX_NAME_BYTES or any(len(part.encode()) > 255 for part in parts.parts):
        raise InputError(path, f"{where}: {name[:80]!r} is too long for a file's name", "mend the line")


def leads_outside(path: Path, root: Path) -> bool:
    """Check whether a file is outside the recording `root`, through a symbolic link in its path."""
    return not lies_within(path, root)


def expect_own_files(root: Path, names: Iterable[str]) -> None:
    """Raise InputError for the first of a recording's files that is outside it."""
    for name in names:
        if leads_outside(root / name, root):
            raise InputError(
                root / name, "is a link out of the recording", "copy the file into the recording"
            )


def states_simulated(folder: Path) -> bool:
    """Check whether the `body.yaml` of a recording's folder states that it is simulated."""
    path = folder / "body.yaml"
    return path.is_file() and read_document(path).values.get("is_simulated") is True


def read_picture(path: Path, root: Path) -> bytes:
    """Read a picture's bytes as stored.

    Raises `TornImageError` for a link out of the recording `root` and for a file that is not regular, too
    large or not readable; and FileNotFoundError.
    """
    if not path.exists():
        raise FileNotFoundError(path)
    try:
        if leads_outside(path, root):
            raise TornImageError("is a link out of the recording: copy the picture into it")
        return read_bytes(path, MAX_PICTURE_BYTES)
    except InputError as error:
        raise TornImageError(error.problem) from None


def file_digests(root: Path, paths: Iterable[Path], bags: Iterable[Path] = ()) -> dict[str, str]:
    """Compute SHA-256 of the existing paths, by the name relative to `root` (or the bare name outside it).

    bags: of any size. Raises InputError for another file that is larger than any table.
    """
    digests = {}
    bounded = [(path, MAX_TABLE_BYTES) for path in paths]
    for path, max_bytes in [*((bag, None) for bag in bags), *bounded]:
        if path.is_file():
            name = path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
            with open_regular(path, max_bytes=max_bytes) as file:
                digests[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return digests
