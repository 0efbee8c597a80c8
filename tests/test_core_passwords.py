"""Passwords' digests."""

import hashlib
from typing import Any

import pytest

from barsight.core.passwords import password_digest


def test_a_digest_without_memory_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> bytes:
        raise ValueError("[digital envelope routines] malloc failure")

    assert len(password_digest("a long password", b"salt")) == 128
    monkeypatch.setattr(hashlib, "scrypt", refuse)
    with pytest.raises(MemoryError):
        password_digest("a long password", b"salt")
