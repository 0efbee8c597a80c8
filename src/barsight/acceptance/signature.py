"""Sign a certificate's digest with an Ed25519 key, and check a signature."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.core.reading.bounded_reading import open_regular

ALGORITHM = "Ed25519"
MAX_KEY_BYTES = 100_000
REMEDY = "make one with: openssl genpkey -algorithm ed25519 -out key.pem"


def sign(digest: str, key: Path) -> dict[str, str]:
    """Sign a digest (hex) with a private key (PEM, without a password).

    Raises InputError for a file that holds no such key, ConfigError where the extra isn't installed.
    """
    with extra("acceptance"):
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
        from cryptography.hazmat.primitives.serialization import load_pem_private_key
    try:
        private = load_pem_private_key(_read(key), None)
    except (ValueError, TypeError) as error:
        raise InputError(key, "holds no private key without a password (PEM)", REMEDY) from error
    if not isinstance(private, Ed25519PrivateKey):
        raise InputError(key, f"holds no {ALGORITHM} key", REMEDY)
    return {
        "algorithm": ALGORITHM,
        "public_key": private.public_key().public_bytes_raw().hex(),
        "signature": private.sign(digest.encode()).hex(),
    }


def is_signed_by(digest: str, signature: dict[str, Any] | None, public_key: Path) -> bool:
    """Check that a digest was signed with the private key of this public one (PEM). Raises as `sign`."""
    with extra("acceptance"):
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
        from cryptography.hazmat.primitives.serialization import load_pem_public_key
    try:
        public = load_pem_public_key(_read(public_key))
    except ValueError as error:
        raise InputError(public_key, "holds no public key (PEM)", REMEDY) from error
    if not isinstance(public, Ed25519PublicKey):
        raise InputError(public_key, f"holds no {ALGORITHM} key", REMEDY)
    try:
        public.verify(bytes.fromhex(str((signature or {}).get("signature", ""))), digest.encode())
    except (InvalidSignature, ValueError):
        return False
    return True


def _read(path: Path) -> bytes:
    with open_regular(path, REMEDY, max_bytes=MAX_KEY_BYTES) as file:
        content: bytes = file.read()
    return content
