"""Import packages that only an extra of Barsight installs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from barsight.core.errors import ConfigError


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Raise ConfigError, naming the extra to install, where an import in this block finds no package."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error.name} is not installed; run: pip install 'barsight[{name}]'") from error
