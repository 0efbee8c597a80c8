"""Sign files with an Ed25519 key, so that openssl and others can verify them, and verify them."""

from __future__ import annotations

from pathlib import Path

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.core.files import atomic_path
from barsight.core.reading.bounded_reading import read_bytes

MAX_KEY_BYTES, MAX_SIGNED_BYTES = 10_000, 1 << 28
PUBLIC = "take the signer's: openssl pkey -in key.pem -pubout -out public.pem"
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
    signature = signature_of(path)
    with atomic_path(signature) as made:
        made.write_bytes(loaded.sign(read_bytes(path, MAX_SIGNED_BYTES)))
    return signature


def signature_of(path: Path) -> Path:
    """Return the path of a file's signature."""
    return path.with_name(f"{path.name}.sig")


def is_signed(path: Path, key: Path) -> bool | None:
    """Check that a file is as it was signed with a key; None without a signature. key: the public key (PEM).

    Raises InputError if the key can't be used or a file can't be read.
    """
    with extra("signing"):
        from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
        from cryptography.hazmat.primitives.serialization import load_pem_public_key
    try:
        loaded = load_pem_public_key(read_bytes(key, MAX_KEY_BYTES, PUBLIC))
    except (ValueError, UnsupportedAlgorithm) as error:
        raise InputError(key, "is not a readable public key", PUBLIC) from error
    if not isinstance(loaded, Ed25519PublicKey):
        raise InputError(key, "is not an Ed25519 key", PUBLIC)
    signature = signature_of(path)
    if not signature.exists():
        return None
    try:
        loaded.verify(read_bytes(signature, MAX_KEY_BYTES), read_bytes(path, MAX_SIGNED_BYTES))
    except InvalidSignature:
        return False
    return True
