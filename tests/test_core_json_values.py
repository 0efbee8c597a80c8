import math

import numpy as np

from barsight.core.json_values import json_value


def test_what_json_lacks_becomes_null_at_any_depth() -> None:
    values = {
        "a": (math.nan, np.float64(-np.inf)),
        "b": np.array([[1.5, np.nan]]),
        "c": [None, True, "NaN", 7],
    }
    assert json_value(values) == {"a": [None, None], "b": [[1.5, None]], "c": [None, True, "NaN", 7]}
    assert type(json_value(np.int64(3))) is int


def test_floats_keep_their_significant_digits() -> None:
    value = 1234.5678901234
    assert json_value({"x": [value, -value / 1e9]}, 9) == {"x": [1234.56789, -1.23456789e-06]}
    assert json_value(value) == value
    assert json_value((value, np.nan, 7), decimals=3) == [1234.568, None, 7]
