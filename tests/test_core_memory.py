"""Freed memory goes back to the system."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from barsight.core.memory import resident_bytes, trim_heap


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads Linux's count of resident pages")
def test_what_was_freed_between_things_that_stay_is_given_back() -> None:
    """400 arrays of 100 kB from the heap, every tenth of which stays."""
    arrays = [np.ones(12_500) for _ in range(400)]
    stay = arrays[::10]
    before = resident_bytes()
    del arrays
    trim_heap()
    assert resident_bytes() < before - 20 * 2**20
    assert sum(one.sum() for one in stay) == 40 * 12_500


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads Linux's count of resident pages")
def test_a_process_that_is_gone_holds_nothing() -> None:
    assert resident_bytes(os.getpid()) > 2**20 < resident_bytes()
    assert resident_bytes(0) == resident_bytes(2**30) == 0


HEAPS = """
import ctypes
import sys
import threading
from barsight.core.memory import bound_heap
bound_heap()
ready = threading.Barrier(7)
def work():
    kept = [bytes(100_000) for _ in range(9)]
    ready.wait()
    ready.wait()
for _ in range(6):
    threading.Thread(target=work).start()
ready.wait()
libc = ctypes.CDLL(None)
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
libc.fflush(None)
ready.wait()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks glibc")
@pytest.mark.parametrize(("asked", "expected"), [(None, 2), ("3", 3)])
def test_threads_share_two_heaps_unless_the_user_says_otherwise(asked: str | None, expected: int) -> None:
    own = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    own |= {"MALLOC_ARENA_MAX": asked} if asked else {}
    told = subprocess.run([sys.executable, "-c", HEAPS], env=own, check=True, capture_output=True, text=True)
    assert told.stdout.count("<heap nr=") == expected
