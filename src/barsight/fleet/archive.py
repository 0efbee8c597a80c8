"""Find the recordings of an archive, and each one's manifest: paths, sizes and digests of its files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from barsight.core.errors import InputError
from barsight.core.json_values import json_digest
from barsight.core.reading.bounded_reading import MAX_TABLE_BYTES
from barsight.fleet.objects import Objects, StoredObject
from barsight.recording.formats.bag_file import BAG_KINDS
from barsight.recording.formats.segments import PATTERN
from barsight.recording.own_files import leads_outside

SURVEY = "survey.json"
"""File that combines the recordings in its folder into one survey: its list `passes` names them."""
_BAGS = tuple(BAG_KINDS)
_INSIDE = {"mav0", "cam0", "cam1", "image_0", "image_1"}
_PICTURES = (".png", ".jpg", ".pgm", ".tif")
_UNREAD = {"truth", "alarms"}
"""Folders of a recording that measuring doesn't read."""


@dataclass(frozen=True)
class ArchivedRecording:
    """A recording, or a survey of several passes, in an archive.

    name: its path in the archive. passes: paths of its recordings, relative to `name`; "." for itself.
    files: its own, and the calibration beside a bag.
    """

    name: str
    passes: tuple[str, ...]
    files: tuple[StoredObject, ...]

    @property
    def size(self) -> int:
        """Return its size in bytes."""
        return sum(file.size for file in self.files)

    @property
    def pairs(self) -> int:
        """Return half its number of pictures; 0 for a bag, whose pictures the listing doesn't show."""
        return sum(file.path.lower().endswith(_PICTURES) for file in self.files) // 2

    def relative(self, file: StoredObject) -> str:
        """Return a file's path in the recording; `../` and its name for one beside it."""
        if not self.name:
            return file.path
        name = PurePosixPath(file.path).name
        inner = file.path.removeprefix(f"{self.name}/")
        return inner if inner != file.path else name if file.path == self.name else f"../{name}"


def find_recordings(archive: Objects) -> tuple[ArchivedRecording, ...]:
    """Find recordings and surveys in the archive's listing, in the order of their names.

    Raises InputError if there are none.
    """
    files = {one.path: one for one in archive.list()}
    surveys = {_above(path): _passes(archive, path) for path in files if PurePosixPath(path).name == SURVEY}
    roots = _roots(files, surveys)
    by_root: dict[str, list[StoredObject]] = {root: [] for root in roots}
    near: dict[str, list[StoredObject]] = {_above(root): [] for root in roots}
    for path, file in files.items():
        if (above := _above(path)) in near:
            near[above].append(file)
        owner = next(
            (one for one in (path, *map(_plain, PurePosixPath(path).parents)) if one in by_root), None
        )
        if owner is not None:
            inner = PurePosixPath(path.removeprefix(owner).lstrip("/")).parts
            if not _UNREAD & set(inner[:-1]):
                by_root[owner].append(file)
    if not by_root:
        raise InputError(archive.url, "holds no recording", "name the folder above the recordings")
    for root, listed in by_root.items():
        listed += _beside(root, listed, near[_above(root)])
    return tuple(
        ArchivedRecording(root, surveys.get(root, (".",)), tuple(sorted(by_root[root], key=lambda f: f.path)))
        for root in sorted(by_root)
    )


def _roots(files: Collection[str], surveys: Collection[str]) -> set[str]:
    """Find the paths of recordings: folders of pictures, folders of a bag's parts, single bags."""
    parted = {
        _above(path)
        for path in files
        if PurePosixPath(path).name == "metadata.yaml" or PurePosixPath(path).match(PATTERN)
    }
    roots = {root for path in files if (root := _root(path, parted)) is not None}
    whole = {*surveys, *parted & roots}
    return {r for r in roots if not any(_plain(above) in whole for above in PurePosixPath(r).parents)} | {
        *surveys
    }


def _root(path: str, parted: Collection[str]) -> str | None:
    """Return the path of the recording that a file belongs to, or None. parted: folders with a bag in
    parts.
    """
    parts = PurePosixPath(path).parts
    for place, part in enumerate(parts[:-1]):
        if part in _INSIDE:
            return "/".join(parts[:place])
    if PurePosixPath(path).suffix in _BAGS:
        return above if (above := _above(path)) in parted else path
    return None


def _beside(root: str, own: Collection[StoredObject], near: Iterable[StoredObject]) -> list[StoredObject]:
    """List the calibration beside a bag that contains none. near: the files of the folder above it."""
    is_bag = any(PurePosixPath(one.path).suffix in _BAGS and one.path.count("/") <= root.count("/") + 1
                 for one in own)  # fmt: skip
    if not root or not is_bag or any(_is_calibration(one.path, "camchain") for one in own):
        return []
    return [one for one in near if _is_calibration(one.path, "camchain") or _is_calibration(one.path, "imu")]


def _is_calibration(path: str, word: str) -> bool:
    name = PurePosixPath(path)
    return name.suffix in (".yaml", ".yml") and word in name.stem


def _above(path: str) -> str:
    """Return the folder of a path; empty for the archive's top folder."""
    return _plain(PurePosixPath(path).parent)


def _plain(folder: PurePosixPath) -> str:
    return "" if str(folder) == "." else str(folder)


def _passes(archive: Objects, path: str) -> tuple[str, ...]:
    content = archive.read_json(path)
    listed = content.get("passes") if isinstance(content, dict) else None
    sound = isinstance(listed, list) and listed and all(
        isinstance(one, str) and one and ".." not in PurePosixPath(one).parts and not one.startswith("/")
        for one in listed
    )  # fmt: skip
    if not sound:
        raise InputError(
            f"{archive.url}/{path}", "has no list of passes", 'write {"passes": ["first", "second"]}'
        )
    assert isinstance(listed, list)
    return tuple(listed)


def manifest_digest(
    archive: Objects, results: Objects, recording: ArchivedRecording, read: Callable[[int], None]
) -> str:
    """Compute SHA-256 over paths, sizes and content of a recording's files, but not its place in the archive.

    read: called with the number of bytes read. A recording with an unchanged listing is not read again: the
    digest is kept in the results under `manifests/`. Raises InputError for a file that is too large for its
    kind (only bags have no limit), and for a link out of the recording.
    """
    expect_own(archive, recording.name, recording.files)
    listed = json_digest([archive.url, recording.name, [[f.path, f.size, f.mark] for f in recording.files]])
    kept = f"manifests/{listed}.json"
    known = results.read_json(kept)
    if known is None:
        rows = []
        for file in recording.files:
            if not file.path.endswith(_BAGS):
                archive.expect_size(file.path, file.size, MAX_TABLE_BYTES)
            rows.append([recording.relative(file), file.size, _digest(archive, file)])
            read(file.size)
        known = {"manifest": json_digest([list(recording.passes), rows]), "files": rows}
        results.write(kept, json.dumps(known).encode())
    return str(known["manifest"])


def expect_own(archive: Objects, name: str, files: Iterable[StoredObject]) -> None:
    """Raise InputError for the first file of a folder's recording that is linked from elsewhere: a copy of
    the recording would contain foreign files.
    """
    if "://" in archive.url:
        return
    for file in files:
        path = Path(archive.url) / file.path
        is_own = not name or file.path == name or file.path.startswith(f"{name}/")
        if leads_outside(path, Path(archive.url) / (name if is_own else _above(name))):
            raise InputError(path, "is a link out of the recording", "copy the file into the recording")


def _digest(archive: Objects, file: StoredObject) -> str:
    found = hashlib.sha256()
    for part in archive.chunks(file.path):
        found.update(part)
    return found.hexdigest()


def download(archive: Objects, name: str, passes: tuple[str, ...], folder: Path) -> Iterator[Path]:
    """Copy a recording's files into a folder, and yield the path of each pass.

    Raises InputError for anything that the archive no longer contains.
    """
    recording = ArchivedRecording(name, passes, ())
    is_file = PurePosixPath(name).suffix in _BAGS
    files = [StoredObject(name, 0, "")] if is_file else list(archive.list(name))
    files += _beside(name, files, archive.list_folder(_above(name)))
    expect_own(archive, name, files)
    if not files:
        raise InputError(f"{archive.url}/{name}", "is gone", "plan the archive again")
    root = copied_to(name, folder)
    for file in files:
        inner = PurePosixPath("" if file.path == name else recording.relative(file))
        is_beside = inner.parts[:1] == ("..",)
        if _UNREAD & set(inner.parts[:-1]) or ".." in inner.parts[is_beside:]:
            continue
        target = root.parent / inner.name if is_beside else root / inner
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("wb") as stream:
            for part in archive.chunks(file.path):
                stream.write(part)
    yield from (root / one for one in passes)


def copied_to(name: str, folder: Path) -> Path:
    """Return where `download` puts the recording of that name."""
    return folder / (PurePosixPath(name).name or "recording")
