"""Read processes' memory, bound what freed memory they keep, and return it to the system."""

from __future__ import annotations

import ctypes
import mmap
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

_ARENA_MAX = "MALLOC_ARENA_MAX", -8, 2
_MMAP_THRESHOLD = "MALLOC_MMAP_THRESHOLD_", -3, 16 * 2**20
"""glibc's settings: name in the environment, number [mallopt(3)], value."""


def peak_memory_mib() -> float:
    """Return the most that this process has held so far; NaN where the system doesn't tell."""
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def resident_bytes(pid: int | None = None) -> int:
    """Read the resident memory of a process, this one by default; 0 where it is gone or the system doesn't
    tell.
    """
    try:
        pages = Path(f"/proc/{'self' if pid is None else pid}/statm").read_text(encoding="ascii").split()[1]
    except (OSError, IndexError):
        return 0
    return int(pages) * mmap.PAGESIZE


def bound_heap() -> None:
    """Bound the freed memory that this process and those it begins keep: glibc makes a heap for each thread,
    and keeps there what several threads freed. Two heaps are enough for two cores, and blocks of 16 MiB and
    more aren't kept at all: a tenth less for a measurement. What the environment sets stands.
    """
    for name, number, value in (_ARENA_MAX, _MMAP_THRESHOLD):
        if name not in os.environ:
            os.environ[name] = str(value)
            _heap("mallopt")(number, value)


def trim_heap() -> None:
    """Trim the heap: glibc keeps freed memory in a pool for each thread, large pictures too, so that several
    threads hold a few hundred MB of nothing. Does nothing where the C library is another.
    """
    _heap("malloc_trim")(0)


@cache
def _heap(name: str) -> Callable[..., int]:
    """Find a function of glibc; one that does nothing where the C library is another."""
    try:
        function = getattr(ctypes.CDLL(None), name)
    except (OSError, AttributeError, TypeError):
        return lambda *_: 0
    return lambda *numbers: int(function(*numbers))
