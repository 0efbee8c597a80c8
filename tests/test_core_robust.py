"""Scatter and level of values with gross errors."""

import numpy as np

from barsight.core.linalg.robust import running_median


def test_a_running_median_is_that_of_the_rows_about_each() -> None:
    values = np.random.default_rng(0).normal(size=(40, 9))
    values[::7] += 100
    ends = np.pad(values, ((3, 3), (0, 0)), mode="edge")
    wanted = [np.median(ends[row : row + 7], axis=0) for row in range(40)]
    np.testing.assert_array_equal(running_median(values, 7), wanted)
