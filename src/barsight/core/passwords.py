"""Hash passwords with a slow function, and check the names of accounts."""

from __future__ import annotations

import hashlib
import re

from barsight.core.errors import ConfigError

MIN_PASSWORD = 10
_MAX_BYTES = 1024
_COST = {"n": 2**15, "r": 8, "p": 1, "maxmem": 2**26}
"""Cost parameters of scrypt: 32 MiB and some 80 ms per password."""
_NAME = re.compile(r"[\w.@-]{1,60}")


def password_digest(password: str, salt: bytes) -> str:
    """Compute scrypt's digest of 64 bytes (hex). Raises MemoryError where the system has no 32 MiB."""
    try:
        return hashlib.scrypt(password.encode()[:_MAX_BYTES], salt=salt, dklen=64, **_COST).hex()
    except ValueError as error:  # OpenSSL's, of costs that are right
        raise MemoryError from error


def expect_password(password: str) -> None:
    """Raise ConfigError for a password that is too short."""
    if len(password) < MIN_PASSWORD:
        raise ConfigError(f"a password has at least {MIN_PASSWORD} characters")


def is_account_name(name: str) -> bool:
    """Check for 1 to 60 letters, digits and . _ @ -."""
    return _NAME.fullmatch(name) is not None
