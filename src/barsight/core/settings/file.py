"""Read frozen settings from TOML files, with one line for whatever is wrong with the file."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from barsight.core.errors import ConfigError, InputError
from barsight.core.reading.bounded_reading import read_toml
from barsight.core.settings.values import build_settings

Settings = TypeVar("Settings")


def read_settings(path: Path, kind: type[Settings], help_at: str, argument: str) -> Settings:
    """Read settings of `kind` from a TOML file over the defaults.

    help_at: page that explains the keys. argument: the argument that named the file. Raises InputError for a
    file that can't be read and ConfigError for an unknown key or an invalid value.
    """
    if not path.exists():
        raise InputError(path, "no such file", f"check the path given as {argument}")
    content = read_toml(path, help_at)
    try:
        return build_settings(content, kind)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}; {help_at}") from error
