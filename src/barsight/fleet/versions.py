"""Name a version: configuration, calibration, magnet and software; and a task's key under it."""

from __future__ import annotations

import functools
import hashlib
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import barsight
from barsight.core.errors import ConfigError
from barsight.core.json_values import json_digest, json_value
from barsight.core.reading.bounded_reading import MAX_SETTINGS_BYTES, read_bytes
from barsight.fleet.objects import Objects
from barsight.result_folder import file_digest

FILES = ("config.toml", "rig", "magnet.toml")
"""Names under which a version's files are kept in the results."""
LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless")


@functools.cache
def installed_software() -> str:
    """Name what measures here: Barsight's version, and a digest of its sources and of the libraries that
    compute, as those may change a result without the version.
    """
    root, found = Path(barsight.__file__).parent, hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        found.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    for name in LIBRARIES:
        found.update(f"{name} {metadata.version(name)}".encode())
    return f"{barsight.__version__}+{found.hexdigest()[:12]}"


@dataclass(frozen=True)
class Version:
    """A way to measure. name: 16 digits of the digest of all else; the others are digests, empty for none.

    rig: name of the file of a calibration that takes the place of the recordings' own. software: as
    `installed_software` tells it.
    """

    name: str
    configuration: str
    calibration: str
    magnet: str
    software: str
    rig: str = ""

    def key(self, manifest: str) -> str:
        """Compute the key of a recording's task: SHA-256 of its manifest and all that measures it."""
        return json_digest([manifest, self.configuration, self.calibration, self.magnet, self.software])


@dataclass(frozen=True)
class FleetTask:
    """A recording to be measured under a version."""

    key: str
    name: str
    passes: tuple[str, ...]
    version: Version
    size: int = 0
    pairs: int = 0


def publish_version(
    results: Objects, settings: Any, config: Path | None, rig: Path | None, magnet: Path | None
) -> Version:
    """Keep a version's files in the results, where workers read them, and return it.

    settings: what `config` holds, already checked. Raises ConfigError for a configuration that names a
    calibration by a path, which other machines may not have.
    """
    if settings.recording.rig is not None or settings.recording.camchain is not None:
        raise ConfigError(f"{config}: names a calibration by its path; give it with --rig instead")
    given = {
        "configuration": json_digest(json_value(settings)),
        "calibration": "" if rig is None else file_digest(rig),
        "magnet": "" if magnet is None else file_digest(magnet),
        "software": installed_software(),
    }
    version = Version(json_digest(given)[:16], **given, rig="" if rig is None else f"rig{rig.suffix}")
    sources = ((config, "config.toml"), (rig, version.rig), (magnet, "magnet.toml"))
    for path, name in sources:
        if path is not None:
            results.write(f"versions/{version.name}/{name}", read_bytes(path, MAX_SETTINGS_BYTES))
    return version


def arguments(results: Objects, version: Version, folder: Path) -> list[str]:
    """Copy a version's files into a folder and return the arguments of `barsight measure` that name them."""
    words: list[str] = []
    for name, flag in (
        ("config.toml", "--config"),
        (version.rig, "--recording.rig"),
        ("magnet.toml", "--magnet"),
    ):
        data = results.read(f"versions/{version.name}/{name}") if name else None
        if data is not None:
            (folder / name).write_bytes(data)
            words += [flag, str(folder / name)]
    return words
