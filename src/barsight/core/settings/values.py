"""Build frozen settings from plain values, and check them by the types that their fields state."""

from __future__ import annotations

import difflib
import math
import os
import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from barsight.core.errors import ConfigError
from barsight.core.settings.renamed import refuse_old_keys

Settings = TypeVar("Settings")
MAX_VALUE = 2**31 - 1
MAX_NAME_BYTES = 255
"""Maximum length of the name of a file or folder on Linux, macOS and Windows."""
OVER_0, UNDER_1 = math.nextafter(0, 1), math.nextafter(1, 0)
POSITIVE, NOT_NEGATIVE, SHARE = (OVER_0, math.inf), (0.0, math.inf), (0.0, 1.0)
"""Ranges that `expect_ranges` takes, like (lowest, highest)."""


def build_settings(content: Any, kind: type[Settings], name: str = "settings") -> Settings:
    """Build settings of `kind` from nested mappings over the defaults; parts that have their kind already
    stay.

    name: of `content` itself. Raises ConfigError naming a setting that doesn't exist, is missing, or has an
    invalid value.
    """
    if isinstance(content, Mapping):
        refuse_old_keys(content)
        built: Settings = _built(content, kind, "")
    else:
        built = checked_value(content, kind, name)
    return built


def checked_value(value: Any, kind: Any, name: str) -> Any:
    """Convert a value to its type: mappings to records, lists to tuples, texts to paths. Raises ConfigError
    that names it.
    """
    if get_origin(kind) in (Union, types.UnionType):
        if value is None:
            return None
        (kind,) = (one for one in get_args(kind) if one is not types.NoneType)
    if get_origin(kind) is Literal:
        expect_choice(name, value, get_args(kind))
        return value
    if get_origin(kind) is tuple:
        return _tuple(value, get_args(kind), name)
    if is_dataclass(kind):
        if isinstance(value, Mapping):
            return _built(value, kind, f"{name}.")
        if isinstance(value, kind):  # type: ignore[arg-type]
            expect_values(value, f"{name}.")
            return value
        raise ConfigError(f"{name} is {value!r}; give its fields by name")
    return _plain(value, kind, name)


def expect_values(settings: Any, prefix: str = "") -> None:
    """Raise ConfigError naming a setting, nested ones included, that isn't of its type, not one of its
    choices, NaN, or too large.
    """
    record: Any = type(settings)
    for name, kind in _types_of(record).items():
        value = getattr(settings, name)
        if isinstance(value, Mapping) and isinstance(kind, type):
            raise ConfigError(f"{prefix}{name} is {value!r}; give a {kind.__name__}")
        checked_value(value, kind, f"{prefix}{name}")


def expect_choice(name: str, value: Any, choices: tuple[Any, ...]) -> None:
    """Raise ConfigError if a value isn't one of the choices."""
    if not isinstance(value, tuple(map(type, choices))) or value not in choices:
        *most, last = map(str, choices)
        raise ConfigError(f"{name} is {value!r}; choose {', '.join(most)}{' or ' if most else ''}{last}")


def expect_ranges(settings: Any, section: str, **ranges: tuple[float, float]) -> None:
    """Raise ConfigError naming the first setting outside its range (lowest, highest).

    Each value of a tuple is checked; None passes.
    """
    for name, (low, high) in ranges.items():
        value = getattr(settings, name)
        values = value if isinstance(value, tuple) else (value,)
        if not all(one is None or low <= one <= high for one in values):
            raise ConfigError(f"{section}{name} must {_told(low, high)}, not {value}")


def expect(holds: bool, sentence: str) -> None:
    """Raise ConfigError with the sentence unless it holds."""
    if not holds:
        raise ConfigError(sentence)


def _told(low: float, high: float) -> str:
    if math.isinf(high):
        return "be positive" if low == OVER_0 else f"be at least {low:g}"
    return f"lie in {low:g}...{high:g}" if low != OVER_0 else f"lie over 0 and up to {high:g}"


@cache
def _types_of(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}


def _built(content: Mapping[str, Any], kind: Any, prefix: str) -> Any:
    known = _types_of(kind)
    for key in content:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, 1)
            told = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
            raise ConfigError(f"there is no setting {prefix}{key}; {told}")
    for field in fields(kind):
        if field.name not in content and field.default is field.default_factory is MISSING:
            raise ConfigError(f"{prefix}{field.name} is missing")
    return kind(**{key: checked_value(value, known[key], f"{prefix}{key}") for key, value in content.items()})


def _tuple(value: Any, kinds: tuple[Any, ...], name: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)) and not (isinstance(value, np.ndarray) and value.ndim == 1):
        raise ConfigError(f"{name} is {value!r}; give a list")
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(value) != len(kinds):
        raise ConfigError(f"{name} has {len(value)} value{'s' * (len(value) != 1)}; give {len(kinds)}")
    return tuple(checked_value(one, kind, name) for one, kind in zip(value, kinds, strict=True))


def _plain(value: Any, kind: Any, name: str) -> Any:
    """Return a number, flag, text or path."""
    accepted: Any
    accepted, wanted = {
        float: (Real, "a number"), int: (Integral, "a whole number"), bool: (bool, "true or false"),
        str: (str, "text in quotes"), Path: ((str, os.PathLike), "a path"),
    }[kind]  # fmt: skip
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise ConfigError(f"{name} is {value!r}; give {wanted}")
    if kind is int and abs(value) > MAX_VALUE:
        raise ConfigError(f"{name} is over the most, {MAX_VALUE}")
    if kind is Path and "\0" in str(value):
        raise ConfigError(f"{name} is {value!r}; give a path without a NUL character")
    if kind is Path and any(len(os.fsencode(part)) > MAX_NAME_BYTES for part in Path(value).parts):
        raise ConfigError(f"{name} has a file name of more than {MAX_NAME_BYTES} bytes")
    try:
        made = kind(value)
    except OverflowError:
        raise ConfigError(f"{name} is too large; give a number") from None
    if kind is float and not math.isfinite(made):
        raise ConfigError(f"{name} is {made}; give a number")
    return made
