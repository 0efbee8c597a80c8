"""Read the memory of processes, limit the freed memory that they keep, and return it to the system."""

from __future__ import annotations

import ctypes
import mmap
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

_ARENA_MAX = "MALLOC_ARENA_MAX", -8, 2
_MMAP_THRESHOLD = "MALLOC_MMAP_THRESHOLD_", -3, 16 * 2**20
"""A setting of glibc: its name in the environment, its number [mallopt(3)], its value."""


def peak_memory_mib() -> float:
    """Return the peak resident memory of this process, MiB; NaN if the system doesn't report it."""
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def resident_bytes(pid: int | None = None) -> int:
    """Read the resident memory of a process, by default this one; 0 if it is gone or the system doesn't
    report it.
    """
    try:
        pages = Path(f"/proc/{'self' if pid is None else pid}/statm").read_text(encoding="ascii").split()[1]
    except (OSError, IndexError):
        return 0
    return int(pages) * mmap.PAGESIZE


def bound_heap() -> None:
    """Limit the freed memory that this process and its children keep.

    glibc makes a heap per thread and keeps in it what several threads have freed. Two heaps are enough for
    two cores, and blocks of 16 MiB and more are returned at once: a tenth less for a measurement. Values set
    in the environment stay.
    """
    for name, number, value in (_ARENA_MAX, _MMAP_THRESHOLD):
        if name not in os.environ:
            os.environ[name] = str(value)
            _heap("mallopt")(number, value)


def trim_heap() -> None:
    """Return freed memory to the system.

    glibc keeps a pool per thread, for large pictures too, so several threads may hold a few hundred MB that
    nobody uses. Does nothing with another C library.
    """
    _heap("malloc_trim")(0)


@cache
def _heap(name: str) -> Callable[..., int]:
    """Find a function of glibc; with another C library, one that does nothing."""
    try:
        function = getattr(ctypes.CDLL(None), name)
    except (OSError, AttributeError, TypeError):
        return lambda *_: 0
    return lambda *numbers: int(function(*numbers))
