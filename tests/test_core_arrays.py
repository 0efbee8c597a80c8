"""Kernels compile, with a cache or without."""

import numba.core.caching
import numpy as np
import pytest

from barsight.core.arrays import kernel


def test_a_kernel_compiles_where_no_cache_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])

    @kernel()
    def doubled(value: float) -> float:
        return 2 * value

    assert doubled(np.float64(1.5)) == 3.0
