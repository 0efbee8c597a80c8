"""Define a version: configuration and the files it names, calibration, magnet, software; and a task's key."""

from __future__ import annotations

import functools
import hashlib
import json
import socket
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any

import barsight
from barsight.core.compiling.sources import sources_digest
from barsight.core.errors import ConfigError
from barsight.core.json_values import json_digest, json_value
from barsight.core.reading.bounded_reading import MAX_DOCUMENT_BYTES, read_bytes
from barsight.fleet.objects import Objects

FLAGS = {
    "config": "--config", "rig": "--recording.rig", "magnet": "--magnet", "yard": "--yard",
    "stock": "--bundles.stock-list", "imu": "--recording.imu-yaml",
}  # fmt: skip
"""File names, without suffix, of a version's files in the results, and their options of `barsight
measure`.
"""
_FILES = "files.json"
_FILES_SCHEMA = {"type": "object", "additionalProperties": {"type": "string"}}
LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless")


@functools.cache
def installed_software() -> str:
    """Name the installed software: Barsight's version, and a digest of its sources and numerical libraries.

    Sources and libraries may change a result without a change of the version.
    """
    sources = sources_digest(Path(barsight.__file__).parent)
    found = json_digest([sources, [metadata.version(name) for name in LIBRARIES]])
    return f"{barsight.__version__}+{found[:12]}"


def expect_software(wanted: str) -> None:
    """Raise ConfigError if this machine would measure with other software."""
    if installed_software() != wanted:
        raise ConfigError(
            f"{socket.gethostname()}: has Barsight {installed_software()}, not {wanted}; install the same on "
            "all machines and plan or begin again"
        )


@dataclass(frozen=True)
class Version:
    """Definition of a measurement. name: 16 digits of the digest of the rest; the others: digests or empty.

    rig: file name of a calibration that replaces the recordings' own. software: from `installed_software`.
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
    """A recording to measure under a version.

    manifest: digest of its files, which identifies it at any place; archive: URL of its archive.
    """

    key: str
    name: str
    passes: tuple[str, ...]
    version: Version
    manifest: str
    archive: str
    size: int = 0
    pairs: int = 0


def places(tasks: Iterable[FleetTask]) -> dict[str, str]:
    """Name tasks by key: their paths in the archive, with the archive's URL if there are several."""
    listed = list(tasks)
    is_one = len({task.archive for task in listed}) == 1
    return {
        task.key: task.name or task.archive if is_one else f"{task.archive}/{task.name}".rstrip("/")
        for task in listed
    }


def publish_version(
    results: Objects, settings: Any, config: Path | None, rig: Path | None, magnet: Path | None
) -> Version:
    """Store a version's files in the results, from which workers read them, and return the version.

    settings: the content of `config`, already checked. The files that it names count by their content. Raises
    ConfigError for a configuration that names a calibration by a path.
    """
    if settings.recording.rig is not None or settings.recording.camchain is not None:
        raise ConfigError(f"{config}: names a calibration by its path; give it with --rig instead")
    named = {
        "yard": settings.yard, "stock": settings.bundles.stock_list, "imu": settings.recording.imu_yaml,
    }  # fmt: skip
    given = {
        "configuration": json_digest(json_value(_by_content(asdict(settings)))),
        "calibration": "" if rig is None else _digest(rig),
        "magnet": "" if magnet is None else _digest(magnet),
        "software": installed_software(),
    }
    version = Version(json_digest(given)[:16], **given, rig="" if rig is None else f"rig{rig.suffix}")
    files = {}
    for name, path in {"config": config, "rig": rig, "magnet": magnet, **named}.items():
        if path is not None:
            data = read_bytes(path, MAX_DOCUMENT_BYTES)
            files[f"{name}{path.suffix}"] = hashlib.sha256(data).hexdigest()
            results.write(f"versions/{version.name}/{name}{path.suffix}", data)
    results.write(f"versions/{version.name}/{_FILES}", json.dumps(files).encode())
    return version


def arguments(results: Objects, version: Version, folder: Path) -> list[str]:
    """Copy a version's files into a folder and return the arguments of `barsight measure` that name them.

    Raises ConfigError if the results don't contain them as planned.
    """
    words: list[str] = []
    prefix = f"versions/{version.name}"
    for name, digest in _version_files(results, version).items():
        data = results.read(f"{prefix}/{name}")
        if data is None or hashlib.sha256(data).hexdigest() != digest:
            raise ConfigError(f"{results.url}/{prefix}/{name}: is not as it was planned; plan again")
        (folder / name).write_bytes(data)
        words += [FLAGS[PurePosixPath(name).stem], str(folder / name)]
    return words


def _version_files(results: Objects, version: Version) -> dict[str, str]:
    """Read the names and digests of a version's files. Raises ConfigError if the results don't know it."""
    files: dict[str, str] | None = results.read_json(f"versions/{version.name}/{_FILES}", _FILES_SCHEMA)
    if files is None:
        raise ConfigError(
            f"{results.url}: version {version.name} was planned for other results; name those, or plan again"
        )
    if any(PurePosixPath(name).name != name or PurePosixPath(name).stem not in FLAGS for name in files):
        raise ConfigError(f"{results.url}/versions/{version.name}/{_FILES}: is damaged; plan again")
    return files


def _by_content(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _by_content(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_by_content(item) for item in value]
    return _digest(value) if isinstance(value, Path) else value


def _digest(path: Path) -> str:
    return hashlib.sha256(read_bytes(path, MAX_DOCUMENT_BYTES)).hexdigest()
