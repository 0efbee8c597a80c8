"""Freed memory goes back to the system."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from barsight.core.memory import trim_heap


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads Linux's count of resident pages")
def test_what_was_freed_between_things_that_stay_is_given_back() -> None:
    """400 arrays of 100 kB from the heap, every tenth of which stays."""

    def resident_mib() -> float:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * 4096 / 2**20

    arrays = [np.ones(12_500) for _ in range(400)]
    stay = arrays[::10]
    before = resident_mib()
    del arrays
    trim_heap()
    assert resident_mib() < before - 20
    assert sum(one.sum() for one in stay) == 40 * 12_500
