from __future__ import annotations

import json
import math
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from barsight.core.json_values import json_value, write_json


def test_what_json_lacks_becomes_null_at_any_depth() -> None:
    values = {
        "a": (math.nan, np.float64(-np.inf)),
        "b": np.array([[1.5, np.nan]]),
        "c": [None, True, "NaN", 7],
    }
    assert json_value(values) == {"a": [None, None], "b": [[1.5, None]], "c": [None, True, "NaN", 7]}
    assert type(json_value(np.int64(3))) is int


class Side(Enum):
    LEFT = "left"


@dataclass(frozen=True)
class Shown:
    side: Side
    at: Path
    inside: tuple[Shown, ...] = ()
    far_m: float = math.inf


def test_records_enumerations_and_paths_become_plain(tmp_path: Path) -> None:
    one = Shown(Side.LEFT, Path("a/b"), (Shown(Side.LEFT, Path("c"), far_m=1.0),))
    inner = {"side": "left", "at": "c", "inside": [], "far_m": 1.0}
    assert json_value(one) == {"side": "left", "at": "a/b", "inside": [inner], "far_m": None}
    write_json(tmp_path / "one.json", one)
    assert json.loads((tmp_path / "one.json").read_text(encoding="utf-8")) == json_value(one)


def test_floats_keep_their_significant_digits() -> None:
    value = 1234.5678901234
    assert json_value({"x": [value, -value / 1e9]}, 9) == {"x": [1234.56789, -1.23456789e-06]}
    assert json_value(value) == value
    assert json_value((value, np.nan, 7), decimals=3) == [1234.568, None, 7]
