"""Certified keys of masks: a client signs its public keys of a round with the key that its fleet's authority certified.

A server that brings its own keys in the place of clients' would take off the masks that it has in common with them. So
clients share secrets with certified vehicles alone. That a signature is of an older round is no matter: masks are added
for those whose shares open, which they have sealed for the keys of this round.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import decode_dss_signature, encode_dss_signature
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID

from flcav.config import shorten
from flcav.federation.secure.parties import PublicKeys

SignedKeys = tuple[PublicKeys, bytes, bytes]  # with certificate (DER) and signature (ECDSA)
HALF_BYTES = 48  # of a signature by a key on NIST's curve P-384


@dataclass(frozen=True)
class Identity:
    """A client's certified key, its certificate and that of the authority of its fleet (X.509)."""

    key: ec.EllipticCurvePrivateKey = field(repr=False)
    certificate: x509.Certificate
    authority: x509.Certificate

    def sign(self, name: str, round_: int, keys: PublicKeys) -> tuple[bytes, bytes]:
        """Return the certificate (DER) and the signature (ECDSA, 96 bytes) of a client's public keys in a round."""
        signed = decode_dss_signature(self.key.sign(_signed(name, round_, keys), ec.ECDSA(hashes.SHA384())))
        return self.certificate.public_bytes(Encoding.DER), b"".join(each.to_bytes(HALF_BYTES) for each in signed)


def find_vehicle(authority: x509.Certificate, round_: int, name: str, signed: SignedKeys) -> str:
    """Return the vehicle, certified by the authority, that has signed a client's public keys of a round.

    Raises ValueError where none has.
    """
    try:
        return _verify(authority, round_, name, *signed)
    except (InvalidSignature, UnsupportedAlgorithm, TypeError, ValueError) as error:
        why = str(error) or "another signature"
        raise ValueError(f"keys that no certified vehicle has signed: {why}") from None


def check_certified(authority: x509.Certificate, round_: int, clients: Mapping[str, SignedKeys]) -> None:
    """Raise ValueError where the keys of a round are not signed by certified vehicles, another one for each client."""
    vehicles: dict[str, str] = {}
    for name, signed in clients.items():
        try:
            vehicle = find_vehicle(authority, round_, name, signed)
        except ValueError as error:
            raise ValueError(f"{shorten(name)} takes part with {error}") from None
        if (other := vehicles.setdefault(vehicle, name)) != name:
            raise ValueError(f"{shorten(name)} takes part with keys of the vehicle of {shorten(other)}")


def _verify(
    authority: x509.Certificate, round_: int, name: str, keys: PublicKeys, certificate: bytes, signature: bytes
) -> str:
    if not certificate or len(signature) != 2 * HALF_BYTES:
        raise ValueError("a certificate or a signature is missing")
    found = x509.load_der_x509_certificate(certificate)
    found.verify_directly_issued_by(authority)
    if not found.not_valid_before_utc <= datetime.now(UTC) <= found.not_valid_after_utc:
        raise ValueError("the certificate is not in force")
    key = found.public_key()
    uses = [each.value for each in found.extensions if isinstance(each.value, x509.ExtendedKeyUsage)]
    if not (isinstance(key, ec.EllipticCurvePublicKey) and uses and ExtendedKeyUsageOID.CLIENT_AUTH in uses[0]):
        raise ValueError("the certificate is no vehicle's")
    halves = (int.from_bytes(each) for each in (signature[:HALF_BYTES], signature[HALF_BYTES:]))
    key.verify(encode_dss_signature(*halves), _signed(name, round_, keys), ec.ECDSA(hashes.SHA384()))
    return found.subject.rfc4514_string()


def _signed(name: str, round_: int, keys: PublicKeys) -> bytes:
    return json.dumps(["flcav masks", name, round_]).encode() + keys.cipher + keys.mask
