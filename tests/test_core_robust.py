"""Scatter and level of values with gross errors."""

import warnings
from typing import Any

import numpy as np
import pytest

from barsight.core.linalg.robust import nan_medians, running_median


def test_a_running_median_is_that_of_the_rows_about_each() -> None:
    values = np.random.default_rng(0).normal(size=(40, 9))
    values[::7] += 100
    ends = np.pad(values, ((3, 3), (0, 0)), mode="edge")
    wanted = [np.median(ends[row : row + 7], axis=0) for row in range(40)]
    np.testing.assert_array_equal(running_median(values, 7), wanted)


@pytest.mark.parametrize("rows", [1, 2, 5, 40])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_medians_of_columns_are_numpys(rows: int, kind: type[np.floating[Any]]) -> None:
    values = np.random.default_rng(rows).normal(size=(rows, 60)).astype(kind)
    values[np.random.default_rng(9).random(values.shape) < 0.4] = np.nan
    values[0, :5] = -np.inf
    found = nan_medians(values)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        np.testing.assert_array_equal(found, np.nanmedian(values, axis=0))
    assert found.dtype == kind
