"""What a killed run has done already: results kept whole beside the output until the run ends well."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from barsight.core.files import atomic_path

T = TypeVar("T")


def keeping_folder(root: Path, fingerprint: str) -> Path:
    """The folder of one measurement under `root`: fingerprint tells its settings and inputs. What other
    settings or inputs left there is removed.
    """
    folder = root / fingerprint[:32]
    root.mkdir(parents=True, exist_ok=True)
    for other in root.iterdir():
        if other != folder:
            shutil.rmtree(other)
    folder.mkdir(exist_ok=True)
    return folder


def once(folder: Path | None, name: str, make: Callable[[], T]) -> T:
    """make()'s result, or what an earlier run kept of it under this name; without a folder nothing is kept.

    The file appears whole or not at all. Only files of our own are read: never point `folder` elsewhere.
    """
    if folder is None:
        return make()
    file = folder / f"{name}.pickle"
    if file.is_file():
        with file.open("rb") as stream:
            kept: T = pickle.load(stream)
        return kept
    made = make()
    with atomic_path(file) as path, path.open("wb") as stream:
        pickle.dump(made, stream, protocol=5)
    return made
