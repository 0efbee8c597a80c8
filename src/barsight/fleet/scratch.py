"""Provide temporary folders for tasks, and remove those left by dead ones."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import barsight
from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.core.files import translated_os_errors

with extra("fleet"):
    import psutil

MIN_AGE_S = 60.0
"""Minimum age in seconds of a folder to remove: a younger one may not state its owner yet."""


def scratch_root() -> Path:
    """Return this user's folder for all tasks of this machine. Raises InputError if it belongs to others."""
    root = Path(tempfile.gettempdir()) / f"barsight-fleet-{os.getuid()}"
    with translated_os_errors(root), contextlib.suppress(FileExistsError):
        root.mkdir(mode=0o700)
    found = root.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise InputError(root, "is not a folder that only this user may write to", "remove it, or set TMPDIR")
    return root


@contextlib.contextmanager
def scratch_folder(key: str) -> Iterator[Path]:
    """Yield an empty folder, named after its owner's machine, process and start, and remove it at the end.

    Folders left by dead tasks are removed first.
    """
    sweep()
    name = f"{key[:16]}-{_machine()}-{os.getpid()}-{psutil.Process().create_time():.2f}-"
    with translated_os_errors(scratch_root()):
        folder = Path(tempfile.mkdtemp(prefix=name, dir=scratch_root()))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def sweep(min_age_s: float = MIN_AGE_S) -> int:
    """Remove this user's old folders whose owner ran on this machine and has ended; return their number."""
    count = 0
    for folder in scratch_root().iterdir():
        parts = folder.name.split("-")
        if not folder.is_dir() or folder.is_symlink() or len(parts) != 5 or parts[1] != _machine():
            continue
        with contextlib.suppress(OSError, ValueError):
            is_old = time.time() - folder.stat().st_mtime >= min_age_s
            if is_old and not _lives(int(parts[2]), float(parts[3])):
                shutil.rmtree(folder)
                count += 1
    return count


def _machine() -> str:
    """Name this machine, as several may share the disk with the temporary files."""
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


def _lives(pid: int, started: float) -> bool:
    try:
        return bool(abs(psutil.Process(pid).create_time() - started) < 1.0)
    except psutil.Error:
        return False


def compile_once() -> None:
    """Compile the kernels of a measurement once per machine: one process compiles, others wait."""
    package = Path(barsight.__file__).parent
    stamp = max(int(path.stat().st_mtime) for path in package.rglob("*.py"))
    mark = scratch_root() / f"kernels-{_machine()}-{barsight.__version__}-{stamp}"
    with (scratch_root() / "kernels.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if mark.exists():
            return
        load = "from barsight.core.compiling.ahead import load_kernels; load_kernels('measure')"
        if subprocess.run([sys.executable, "-P", "-c", load], stderr=subprocess.DEVNULL).returncode == 0:
            mark.touch()
