"""Digest the package's sources, which tell two states of one version apart."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path


def sources_digest(root: Path, names: Iterable[str] = ("",)) -> str:
    """Compute SHA-256 of a package's Python sources, paths and content.

    names: of folders and modules in `root`; all of it by default.
    """
    digest = hashlib.sha256()
    for name in sorted(names):
        path = root / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            if file.suffix == ".py":
                digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()
