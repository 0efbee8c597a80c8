"""Kernels compile, with a cache or without; rows are found by number."""

import numba.core.caching
import numpy as np
import pytest

from barsight.core.arrays import kernel, rows_by_number


def test_a_kernel_compiles_where_no_cache_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])

    @kernel()
    def doubled(value: float) -> float:
        return 2 * value

    assert doubled(np.float64(1.5)) == 3.0


def test_rows_by_number() -> None:
    assert rows_by_number(np.empty(0)) == {}
    found = rows_by_number(np.array([3.0, 1.0, 3.0, -2.0, 1.0]))
    assert {number: rows.tolist() for number, rows in found.items()} == {-2: [3], 1: [1, 4], 3: [0, 2]}
