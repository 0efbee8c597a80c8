"""Convert results to values that JSON can hold, and write them."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.files import atomic_path

DIGITS = 9
"""Significant digits of numbers in result documents: a micrometre in any yard."""


def json_value(value: Any, digits: int | None = None, decimals: int | None = None) -> Any:
    """Replace NaN and infinity by None, arrays and tuples by lists, NumPy scalars by Python's, records by
    mappings, members of enumerations by their values and paths by texts, at any depth.

    digits, decimals: significant digits or decimals that floats are rounded to; all where None.
    """
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, dict):
        return {key: json_value(item, digits, decimals) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return json_value(value.tolist(), digits, decimals)
    if isinstance(value, list | tuple):
        return [json_value(item, digits, decimals) for item in value]
    if isinstance(value, Enum | Path):
        return str(value) if isinstance(value, Path) else value.value
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        shortened = value if digits is None else float(f"{value:.{digits}g}")
        return shortened if decimals is None else round(shortened, decimals)
    return value


def write_json(target: Path, content: Any, digits: int | None = None) -> None:
    """Convert with `json_value` and write the JSON, indented, completely or not at all."""
    text = json.dumps(json_value(content, digits), indent=1, allow_nan=False) + "\n"
    with atomic_path(target) as path:
        path.write_text(text, encoding="utf-8")


def json_digest(value: Any) -> str:
    """Compute SHA-256 of a JSON value, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
