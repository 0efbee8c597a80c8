"""Write outputs whole or not at all: a temporary name beside the target, then a rename."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import count
from pathlib import Path

from barsight.core.errors import InputError, OutputError

LAST = ("lifts.json", "odometry.json", "report.html", "result.json")
"""Files that are removed first and written last: others depend on them, so a folder without them isn't
complete.
"""


def expect_output(target: Path, *suffixes: str) -> None:
    """Raise `OutputError` early for a file that couldn't be written or has another suffix."""
    if target.suffix not in suffixes:
        raise OutputError(f"{target}: end its name in {' or '.join(suffixes)}")
    if not target.absolute().parent.is_dir():
        raise OutputError(f"{target}: there is no folder {target.parent}; make it or name another")


def lies_within(path: Path, folder: Path) -> bool:
    """Check whether `path` is `folder` or inside it, following links; a link to itself is taken as it is."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


@contextlib.contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """Yield a temporary path beside `target`; on success it becomes `target`, on any failure it is gone.

    `OutputError` where the folder isn't there, `target` is a pipe or a device, or the system refuses to
    write.
    """
    with _prepared(target) as (temporary,):
        yield temporary


@contextlib.contextmanager
def atomic_paths(*targets: Path) -> Iterator[tuple[Path, ...]]:
    """Yield temporary paths for files of one folder; on success all of them appear, on any failure none.

    They are moved one right after the other. The first of `targets` is moved last, since it is the result
    that the others refer to.
    """
    for target in targets:
        if target.is_dir():
            raise OutputError(f"{target}: is a folder; name a file")
    with _prepared(*targets) as temporary:
        yield temporary


@contextlib.contextmanager
def _prepared(*targets: Path) -> Iterator[tuple[Path, ...]]:
    first = targets[0]
    if not first.parent.exists():
        raise OutputError(f"{first}: there is no folder {first.parent}; make it or name another")
    with translated_os_errors(first):
        for target in targets:
            if target.exists() and not target.is_file() and not target.is_dir():
                raise OutputError(f"{target}: is not a regular file but a pipe or a device; name a file")
        with _staging(first.absolute()) as folder, _shown(folder, first.absolute().parent):
            temporary = tuple(folder / target.name for target in targets)
            yield temporary
            for made, target in zip(reversed(temporary), reversed(targets), strict=True):
                made.replace(target)


@contextlib.contextmanager
def atomic_directory(target: Path, *, replace: bool = False, owned: tuple[str, ...] = ()) -> Iterator[Path]:
    """Yield a fresh folder beside `target`; its files become `target`'s on success, are gone on failure.

    Where `target` exists, `replace` moves the new files over its own of the same names, removes those of the
    names in `owned` that have no successor and leaves others alone; without it an existing non-empty
    `target` is an `OutputError`. Files are moved one by one: the old ones of LAST are removed before the
    first move and the new ones come last, so that a kill in between leaves a folder that lacks them, and no
    folder of two runs that looks whole.
    """
    target = target.absolute()
    with translated_os_errors(target):
        if not replace:
            expect_empty(target, can_overwrite=bool(owned))
        else:
            _expect_no_file(target)
        made = [folder for folder in target.parents if not folder.exists()]
        target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with translated_os_errors(target), _staging(target) as staging, _shown(staging, target):
            yield staging
            if not replace:
                # Another run may have written there in the meantime.
                expect_empty(target, can_overwrite=bool(owned))
            if target.is_dir():
                _move_files(staging, target, owned)
            else:
                staging.replace(target)
    finally:
        if not target.exists():
            for folder in made:
                with contextlib.suppress(OSError):
                    folder.rmdir()


def _move_files(staging: Path, target: Path, owned: tuple[str, ...]) -> None:
    fresh = {path.name: path for path in staging.iterdir()}
    stale = (set(owned) - fresh.keys()) | (set(LAST) & fresh.keys())
    for name in sorted(stale, key=_turn, reverse=True):
        if not (target / name).is_dir():
            (target / name).unlink(missing_ok=True)
    for name in sorted(fresh, key=_turn):
        _replace(fresh[name], target / name)


def _turn(name: str) -> int:
    return LAST.index(name) if name in LAST else -1


@contextlib.contextmanager
def changed_folder(target: Path) -> Iterator[Path]:
    """Yield a folder that shows the files of `target`. On success, all that was written into it is moved
    to `target`.
    """
    with atomic_directory(target, replace=True) as staging:
        shown = {path.name: path.absolute() for path in target.iterdir()}
        for name, path in shown.items():
            (staging / name).symlink_to(path)
        try:
            yield staging
        except InputError as error:
            inside = error.path.is_relative_to(staging)
            path = target / error.path.relative_to(staging) if inside else error.path
            raise type(error)(path, error.problem, error.remedy) from error
        for name in shown:
            if (staging / name).is_symlink():
                (staging / name).unlink()


@contextlib.contextmanager
def _shown(staging: Path, folder: Path) -> Iterator[None]:
    """Name the file that the user asked for where one in the temporary folder couldn't be written."""
    try:
        yield
    except OutputError as error:
        text = str(error)
        if str(staging) not in text:
            raise
        raise OutputError(text.replace(str(staging), str(folder))) from error


@contextlib.contextmanager
def _staging(target: Path) -> Iterator[Path]:
    """Yield an empty folder beside `target` that no other run uses, and remove what is left of it.

    Its name is the same each time, so that the next run finds what a killed one left and removes it. Whoever
    works in it holds a lock on it, which ends with the process, however that ends; another run meanwhile
    takes the next name. A folder of another user, or a link, is left alone. Where the system has no such
    locks, as Windows, nothing is written.
    """
    if find_spec("fcntl") is None:
        raise OutputError(f"{target}: can't be locked on this system; write it on Linux or macOS")
    names = (target.with_name(f".{target.name[:40]}.{turn}part") for turn in _turns())
    staging, held = next((path, held) for path in names if (held := _taken(path)) is not None)
    try:
        yield staging
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        os.close(held)


def _turns() -> Iterator[str]:
    yield ""
    yield from (f"{turn}." for turn in count(2))


def _taken(staging: Path) -> int | None:
    """Make the folder, or empty it where a killed run left it; return its locked descriptor. None where
    another run or user has it.
    """
    import fcntl

    with contextlib.suppress(FileExistsError):
        staging.mkdir()
    try:
        held = os.open(staging, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return None  # its run has just ended
    except OSError:
        if staging.parent.exists() and (staging.is_symlink() or not staging.is_dir()):
            return None
        raise
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        found = staging.lstat()
        if found.st_uid == os.geteuid() and os.path.samestat(found, os.fstat(held)):
            for path in staging.iterdir():
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
            return held
    except (BlockingIOError, FileNotFoundError):
        pass
    os.close(held)
    return None


@contextlib.contextmanager
def held_folder(folder: Path) -> Iterator[None]:
    """Hold a folder for this process alone; one that isn't there is made, and removed if it stays empty.

    A killed process holds nothing. Raises OutputError if another process holds it.
    """
    import fcntl

    _expect_no_file(folder)
    made = [one for one in (folder, *folder.parents) if not one.exists()]
    with contextlib.ExitStack() as stack:
        for one in reversed(made):
            stack.callback(_remove_if_empty, one)
        with translated_os_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            stack.callback(os.close, held)
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                told = "another run is writing there; name another folder, or end that run"
                raise OutputError(f"{folder}: {told}") from error
        yield


def is_held(folder: Path) -> bool:
    """Check whether a process holds a folder."""
    import fcntl

    try:
        held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(held, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(held)
    return False


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()


@contextlib.contextmanager
def translated_os_errors(target: Path) -> Iterator[None]:
    """Translate refusals by the operating system (full disk, no permission) into one `OutputError` line.

    Raises `InputError` for another file that may not be read. Other errors are translated only if they name
    the temporary file, which the user doesn't know.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, PermissionError) and not _belongs(error.filename, target):
            raise InputError(
                error.filename, "no permission to read it", "ask its owner or copy it"
            ) from error
        advice = {
            errno.ENOSPC: "the disk is full; free some space or name another folder",
            errno.EDQUOT: "the disk quota is used up; free some space or name another folder",
            errno.EACCES: "no permission to write there; name another folder",
            errno.EPERM: "no permission to write there; name another folder",
            errno.EROFS: "the file system is read-only; name another folder",
            errno.ENOTDIR: "a part of the path is a file; name another folder",
            errno.EEXIST: "a part of the path is a file; name another folder",
            errno.EISDIR: "is a folder; name a file",
            errno.EFBIG: "the file grew past the size limit; free some space or raise the limit",
            errno.ENAMETOOLONG: "the name is too long; name another folder",
        }.get(error.errno or 0)
        if error.errno is None and "written" in str(error):
            # NumPy's writer says how many items it wrote and drops the system's reason.
            advice = "the disk or a quota is full: a file could not be written completely; free some space"
        if advice is None and _is_temporary(error.filename, target):
            advice = f"nothing can be written there ({error.strerror}); name another folder"
        if advice is None:
            raise
        raise OutputError(f"{target}: {advice}") from error


def _belongs(name: object, target: Path) -> bool:
    """Check whether the file is `target`, inside it, above it, or one of our temporary files beside it."""
    if not isinstance(name, str):
        return True
    path, target = Path(name).absolute(), target.absolute()
    if target.is_relative_to(path) or path.is_relative_to(target):
        return True
    beside = path.is_relative_to(target.parent)
    return beside and _is_temporary(target.parent / path.relative_to(target.parent).parts[0], target)


def _is_temporary(name: object, target: Path) -> bool:
    """Check whether the name is that of the temporary file or folder beside `target`."""
    path, target = Path(str(name)), target.absolute()
    return path.absolute().parent == target.parent and path.name.startswith(f".{target.name[:40]}.")


def expect_empty(target: Path, *, can_overwrite: bool = False) -> None:
    """Raise `OutputError` if `target` is a file or a folder that isn't empty.

    can_overwrite: the caller has an option to overwrite, which the message names.
    """
    _expect_no_file(target)
    if target.is_dir() and any(target.iterdir()):
        remedy = "or overwrite it (--overwrite)" if can_overwrite else "or remove it"
        raise OutputError(f"{target}: exists and is not empty; name another folder {remedy}")


def _expect_no_file(target: Path) -> None:
    if target.exists() and not target.is_dir():
        raise OutputError(f"{target}: is a file; name a folder")


def _replace(source: Path, target: Path) -> None:
    if target.is_dir() and not target.is_symlink():
        shutil.rmtree(target)
    source.replace(target)
