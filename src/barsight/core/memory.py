"""Read this process's peak memory, and return freed memory to the system."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache


def peak_memory_mib() -> float:
    """Return the most that this process has held so far; NaN where the system doesn't tell."""
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


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
