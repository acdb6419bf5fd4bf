"""Signing keys of a party: elliptic-curve keys on NIST's P-256, in PEM files.

The same key signs a candidate's folder (OpenSSF Model Signing) and a repository's metadata (The Update Framework).
"""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from flcav.config import InputError, check_is_file

if TYPE_CHECKING:
    from securesystemslib.signer import CryptoSigner

SHORT = 16  # hexadecimal digits in a key's name


@dataclass(frozen=True)
class PublicKey:
    """A public key in canonical PEM text, so that equal keys have equal names, whatever their encoding was."""

    pem: str  # SubjectPublicKeyInfo, as this module writes it

    @property
    def short(self) -> str:
        """Return the key's name: the first digits of the SHA-256 of its PEM text."""
        return hashlib.sha256(self.pem.encode()).hexdigest()[:SHORT]


@dataclass(frozen=True)
class PrivateKey:
    """A private key in memory."""

    key: ec.EllipticCurvePrivateKey

    @property
    def public(self) -> PublicKey:
        """Return the public key."""
        return PublicKey(_pem(self.key.public_key()))

    def signer(self) -> "CryptoSigner":
        """Return the key as a signer of metadata."""
        from securesystemslib.signer import CryptoSigner

        return CryptoSigner(self.key)


def generate_key(path: Path) -> PrivateKey:
    """Write a new private key to `path`, readable only by its owner, and its public key to `path` with suffix .pub."""
    key = ec.generate_private_key(ec.SECP256R1())
    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(text)
    path.with_suffix(".pub").write_text(_pem(key.public_key()))
    return PrivateKey(key)


def read_private_key(path: Path) -> PrivateKey:
    """Return the private key in a PEM file; raises `InputError` if there is none, or one on another curve."""
    check_is_file(path)
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except (ValueError, TypeError):
        raise InputError(f"{path}: holds no private key that can be read (PEM, without a password)") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.curve.name != "secp256r1":
        raise InputError(f"{path}: holds a key of another kind, and one of the curve P-256 is wanted")
    return PrivateKey(key)


def read_public_key(path: Path) -> PublicKey:
    """Return the public key in a PEM file; raises `InputError` if there is none, or one on another curve."""
    check_is_file(path)
    return parse_public_key(path.read_bytes(), str(path))


def parse_public_key(pem: bytes, origin: str) -> PublicKey:
    """Return the public key in a PEM text, encoded canonically; raises as `read_public_key`."""
    try:
        key = serialization.load_pem_public_key(pem)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise InputError(f"{origin}: holds no public key (PEM)") from None
    if not isinstance(key, ec.EllipticCurvePublicKey) or key.curve.name != "secp256r1":
        raise InputError(f"{origin}: holds a key of another kind, and one of the curve P-256 is wanted")
    return PublicKey(_pem(key))


def check_distinct(keys: Sequence[PublicKey], whose: str) -> None:
    """Raise `InputError` where `keys` contain a key twice, which would count one owner as two."""
    names = [key.pem for key in keys]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise InputError(f"the key {keys[number].short} is given twice among {whose}: signatures of two are wanted")


def _pem(key: ec.EllipticCurvePublicKey) -> str:
    return key.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo).decode()
