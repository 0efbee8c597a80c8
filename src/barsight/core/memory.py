"""Memory that was freed, given back to the system."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache


def give_back() -> None:
    """Return what was freed: glibc keeps it in a pool for each thread, large pictures too, so that several
    threads hold a few hundred MB of nothing. Does nothing where the C library is another."""
    _trim()(0)


@cache
def _trim() -> Callable[[int], int]:
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError, TypeError):
        return lambda _: 0
    return lambda pad: int(trim(pad))
