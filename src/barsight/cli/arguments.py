"""Command lines from functions and frozen settings (tyro), and settings from TOML files (cattrs)."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import cattrs
import tyro

from barsight.core.errors import BarsightError, ConfigError, InputError

Settings = TypeVar("Settings")


def call(command: Callable[..., None], name: str, arguments: Sequence[str]) -> None:
    """Parse `arguments` by the function's signature and call it; wrong usage exits with 2."""
    tyro.cli(command, prog=f"barsight {name}", args=list(arguments), compact_help=False)


def config_path(arguments: Sequence[str]) -> Path | None:
    """The FILE of `--config FILE` or `--config=FILE`, needed before the other flags are read."""
    for number, argument in enumerate(arguments):
        if argument == "--config" and number + 1 < len(arguments):
            return Path(arguments[number + 1])
        if argument.startswith("--config="):
            return Path(argument.partition("=")[2])
    return None


def load_settings(path: Path | None, kind: type[Settings]) -> Settings:
    """Settings of `kind` from a TOML file over the defaults; the defaults where there is no file.

    Raises InputError for a file that can't be read and ConfigError for a key or value that can't be.
    """
    if path is None:
        return kind()
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise InputError(path, "no such file", "check the path given to --config") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(
            path, f"is no TOML file: {error}", "barsight measure --help lists the settings"
        ) from error
    try:
        return _converter().structure(content, kind)
    except Exception as error:
        own = _own_error(error)
        if own is not None:
            raise ConfigError(f"{path}: {own}") from error
        if isinstance(error, cattrs.BaseValidationError):
            first = cattrs.transform_error(error)[0].removesuffix(" @ $").replace(" @ $.", " at ")
            raise ConfigError(f"{path}: {first}; barsight measure --help lists the settings") from error
        raise


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(forbid_extra_keys=True)
    converter.register_structure_hook(float, _number)
    converter.register_structure_hook(int, _whole)
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


def _own_error(error: BaseException) -> BarsightError | None:
    """The check of our own that failed somewhere inside a group of errors."""
    if isinstance(error, BarsightError):
        return error
    if isinstance(error, BaseExceptionGroup):
        for inner in error.exceptions:
            found = _own_error(inner)
            if found is not None:
                return found
    return None
