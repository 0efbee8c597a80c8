"""Compute SHA-256 of input files, so that a result says which inputs it came from."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from barsight.core.reading.bounded_reading import open_regular


def file_digests(root: Path, paths: Iterable[Path]) -> dict[str, str]:
    """Compute SHA-256 by the name relative to `root` (or the bare name outside it), of those paths that
    exist.
    """
    digests = {}
    for path in paths:
        if path.is_file():
            name = path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
            with open_regular(path) as file:
                digests[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return digests
