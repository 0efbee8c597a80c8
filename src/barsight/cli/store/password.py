"""Read a password from the terminal."""

from __future__ import annotations

import getpass
import sys

from barsight.core.errors import ConfigError


def ask_password() -> str:
    """Ask twice for a password; if the input is not a terminal, read its first line. Raises ConfigError."""
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\n")
    password = getpass.getpass("password: ")
    if getpass.getpass("again: ") != password:
        raise ConfigError("the two passwords differ")
    return password
