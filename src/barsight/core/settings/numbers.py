"""Check numeric settings of any stage."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from barsight.core.errors import ConfigError

MAX_VALUE = 2**31 - 1


def expect_numbers(settings: Mapping[str, Any], prefix: str = "") -> None:
    """Raise ConfigError naming a setting (of nested ones as `asdict` gives them) that is NaN or too large."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            expect_numbers(value, f"{prefix}{name}.")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, Mapping):
                expect_numbers(number, f"{prefix}{name}.")
            if isinstance(number, float) and not math.isfinite(number):
                raise ConfigError(f"{prefix}{name} is {number}; give a number")
            if isinstance(number, int) and abs(number) > MAX_VALUE:
                raise ConfigError(f"{prefix}{name} is {number}; the most is {MAX_VALUE}")
