"""Read processes' memory, and return freed memory to the system."""

from __future__ import annotations

import ctypes
import mmap
from collections.abc import Callable
from functools import cache
from pathlib import Path


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


def trim_heap() -> None:
    """Trim the heap: glibc keeps freed memory in a pool for each thread, large pictures too, so that several
    threads hold a few hundred MB of nothing. Does nothing where the C library is another.
    """
    _trim()(0)


@cache
def _trim() -> Callable[[int], int]:
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError, TypeError):
        return lambda _: 0
    return lambda pad: int(trim(pad))
