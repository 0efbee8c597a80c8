"""Read frozen settings from TOML files (cattrs), with one line for whatever is wrong with the file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

import cattrs

from barsight.core.errors import BarsightError, ConfigError, InputError
from barsight.core.settings.renamed import refuse_old_keys

Settings = TypeVar("Settings")


def read_settings(path: Path, kind: type[Settings], help_at: str, flag: str) -> Settings:
    """Read settings of `kind` from a TOML file over the defaults.

    help_at: where the keys are explained; flag: which flag named the file. Raises InputError for a file that
    can't be read and ConfigError for a key or value that can't be.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise InputError(path, "no such file", f"check the path given to {flag}") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(path, f"is no TOML file: {error}", help_at) from error
    try:
        refuse_old_keys(content)
        return _converter().structure(content, kind)
    except Exception as error:
        own = _own_error(error)
        if own is not None:
            raise ConfigError(f"{path}: {own}") from error
        if isinstance(error, cattrs.BaseValidationError):
            first = cattrs.transform_error(error)[0].removesuffix(" @ $").replace(" @ $.", " at ")
            raise ConfigError(f"{path}: {first}; {help_at}") from error
        raise


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(forbid_extra_keys=True)
    converter.register_structure_hook(float, _number)
    converter.register_structure_hook(int, _whole)
    converter.register_structure_hook(bool, _flag)
    converter.register_structure_hook(Path, lambda value, _: Path(value))
    return converter


def _number(value: Any, _: type) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{value!r} is not a number")
    return float(value)


def _whole(value: Any, _: type) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{value!r} is not a whole number")
    return value


def _flag(value: Any, _: type) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{value!r} is neither true nor false")
    return value


def _own_error(error: BaseException) -> BarsightError | None:
    """Find our own failed check inside a group of errors."""
    if isinstance(error, BarsightError):
        return error
    if isinstance(error, BaseExceptionGroup):
        for inner in error.exceptions:
            found = _own_error(inner)
            if found is not None:
                return found
    return None
