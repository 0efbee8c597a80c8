"""Sign files with an Ed25519 key, so that openssl and others can verify them."""

from __future__ import annotations

from pathlib import Path

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.core.files import atomic_path
from barsight.core.reading.bounded_reading import read_bytes

MAX_KEY_BYTES, MAX_SIGNED_BYTES = 10_000, 1 << 28
REMEDY = "make one: openssl genpkey -algorithm ed25519 -out key.pem"


def sign_file(path: Path, key: Path) -> Path:
    """Write the signature (64 bytes) of a file beside it, `NAME.sig`. key: a PEM file without a password.

    `openssl pkeyutl -verify -pubin -inkey public.pem -rawin -in NAME -sigfile NAME.sig` verifies it.
    Raises InputError if the key can't be used.
    """
    with extra("signing"):
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
        from cryptography.hazmat.primitives.serialization import load_pem_private_key
    try:
        loaded = load_pem_private_key(read_bytes(key, MAX_KEY_BYTES, REMEDY), password=None)
    except (ValueError, TypeError) as error:
        raise InputError(key, f"is not a readable private key ({error})", REMEDY) from error
    if not isinstance(loaded, Ed25519PrivateKey):
        raise InputError(key, "is not an Ed25519 key", REMEDY)
    signature = path.with_name(f"{path.name}.sig")
    with atomic_path(signature) as made:
        made.write_bytes(loaded.sign(read_bytes(path, MAX_SIGNED_BYTES)))
    return signature
