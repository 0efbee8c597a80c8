"""Convert results to values that JSON can hold."""

from __future__ import annotations

import hashlib
import json
import math
from typing import Any

import numpy as np

DIGITS = 9
"""Significant digits of a result's documents: a micrometre in any yard."""


def json_value(value: Any, digits: int | None = None, decimals: int | None = None) -> Any:
    """Replace NaN and infinity by None, arrays and tuples by lists, NumPy scalars by Python's, at any depth.

    digits, decimals: significant digits or decimals that floats are rounded to; all where None.
    """
    if isinstance(value, dict):
        return {key: json_value(item, digits, decimals) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return json_value(value.tolist(), digits, decimals)
    if isinstance(value, list | tuple):
        return [json_value(item, digits, decimals) for item in value]
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        shortened = value if digits is None else float(f"{value:.{digits}g}")
        return shortened if decimals is None else round(shortened, decimals)
    return value


def json_digest(value: Any) -> str:
    """Compute SHA-256 of a JSON value, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
