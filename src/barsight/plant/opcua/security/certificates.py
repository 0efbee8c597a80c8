"""Make the server's own certificate, and check client certificates against the trust list."""

from __future__ import annotations

import datetime
import ipaddress
import os
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.core.files import atomic_path

with extra("opcua"):
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import rsa
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_Parsed = TypeVar("_Parsed")
_DAYS = 3650
MIN_KEY_BITS = 2048
MAX_CERTIFICATE_BYTES = 65536


@dataclass(frozen=True)
class OwnCertificate:
    """Files of the server's certificate (DER) and its private key (PEM)."""

    certificate: Path
    key: Path


def own_certificate(folder: Path, uri: str, host: str) -> OwnCertificate:
    """Find the server's certificate in `folder`, or make a self-signed one.

    uri: application URI, which the certificate contains. The key file is readable by its owner only. Also
    creates `trusted/` and `revoked/`. Raises InputError if only one of the two files exists.
    """
    for name in ("", "trusted", "revoked"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    own = OwnCertificate(folder / "own.der", folder / "own-key.pem")
    existing = [path for path in (own.certificate, own.key) if path.exists()]
    if len(existing) == 1:
        raise InputError(folder, f"holds {existing[0].name} only", "restore the other file, or remove it")
    if not existing:
        certificate, key = make_certificate(uri, "Barsight", [host, socket.gethostname(), "localhost"])
        with (
            atomic_path(own.key) as path,
            os.fdopen(os.open(path, os.O_CREAT | os.O_WRONLY, 0o600), "wb") as f,
        ):
            f.write(key)
        with atomic_path(own.certificate) as path:
            path.write_bytes(certificate)
    return own


def make_certificate(uri: str, name: str, hosts: list[str], days: float = _DAYS) -> tuple[bytes, bytes]:
    """Make a self-signed certificate of an OPC UA application; return it (DER) and its key (PEM)."""
    key = rsa.generate_private_key(public_exponent=65537, key_size=MIN_KEY_BITS)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    names = [x509.UniformResourceIdentifier(uri), *map(_host_name, dict.fromkeys(hosts))]
    usage = x509.KeyUsage(
        digital_signature=True, content_commitment=True, key_encipherment=True, data_encipherment=True,
        key_agreement=False, key_cert_sign=True, crl_sign=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
            critical=False,
        )
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return certificate.public_bytes(serialization.Encoding.DER), secret


def judge_certificate(folder: Path, certificate: x509.Certificate, uri: str | None) -> str | None:
    """Check a client's certificate against the trust list; return the status code's name if it is refused.

    A certificate is trusted if it is in `trusted/` (DER or PEM) or was issued by an authority there, and
    isn't on a CRL in `revoked/`. Both are read at each connection, so changes need no restart.
    """
    now = datetime.datetime.now(datetime.UTC)
    if not certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc:
        return "BadCertificateTimeInvalid"
    key = certificate.public_key()
    if not isinstance(key, rsa.RSAPublicKey) or key.key_size < MIN_KEY_BITS:
        return "BadCertificatePolicyCheckFailed"
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return "BadCertificateUriInvalid"
    if uri is not None and uri not in names.get_values_for_type(x509.UniformResourceIdentifier):
        return "BadCertificateUriInvalid"
    trusted = _read_all(folder / "trusted", x509.load_der_x509_certificate, x509.load_pem_x509_certificate)
    if not any(certificate == one or _issued(certificate, one) for one in trusted):
        return "BadCertificateUntrusted"
    for crl in _read_all(folder / "revoked", x509.load_der_x509_crl, x509.load_pem_x509_crl):
        listed = crl.get_revoked_certificate_by_serial_number(certificate.serial_number)
        if crl.issuer == certificate.issuer and listed is not None:
            return "BadCertificateRevoked"
    return None


def _host_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _issued(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    try:
        if not authority.extensions.get_extension_for_class(x509.BasicConstraints).value.ca:
            return False
        certificate.verify_directly_issued_by(authority)
    except (x509.ExtensionNotFound, ValueError, TypeError, InvalidSignature):
        return False
    now = datetime.datetime.now(datetime.UTC)
    return authority.not_valid_before_utc <= now <= authority.not_valid_after_utc


def _read_all(
    folder: Path, der: Callable[[bytes], _Parsed], pem: Callable[[bytes], _Parsed]
) -> list[_Parsed]:
    """Read all parsable files of a folder; a file that is not a certificate or CRL has no effect."""
    read: list[_Parsed] = []
    for path in sorted(folder.glob("*")):
        if path.suffix not in (".der", ".pem", ".crl", ".crt", ".cer") or not path.is_file():
            continue
        with path.open("rb") as file:
            content = file.read(MAX_CERTIFICATE_BYTES)
        try:
            read.append(pem(content) if content.lstrip().startswith(b"-----BEGIN") else der(content))
        except ValueError:
            continue
    return read
