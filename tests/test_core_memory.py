"""Freed memory goes back to the system."""

from __future__ import annotations

import os
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
