"""Keys and signing requests of a fleet's parties. A private key is made where it is used, and never leaves that place.

Vehicles use one elliptic-curve key (NIST P-384) for TLS and for Flower's node authentication, so that the sending node
of a message and the certificate of its connection belong to the same vehicle.
"""

import os
import re
from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from flcav.config import InputError
from flcav.interface.wording import make_printable
from flcav.storage.files import write_bytes

KEY, FLOWER_KEY, REQUEST, CERTIFICATE, AUTHORITY = "key.pem", "flower.key", "vehicle.csr", "vehicle.crt", "ca.crt"
NEXT = "next"  # folder with key and request of a rotation, until its certificate is installed
LOOPBACK_KEY, LOOPBACK = "loopback.key", "loopback.crt"  # of a vehicle's forwarder, for its SuperNode
IDENTIFIER = re.compile(r"[a-z0-9][a-z0-9._-]{0,61}[a-z0-9]|[a-z0-9]")
LARGEST_REQUEST = 1 << 16  # bytes


def check_identifier(name: str) -> str:
    """Return a valid identifier of a vehicle; raises `InputError` for any other text, such as a path."""
    if not IDENTIFIER.fullmatch(name) or ".." in name:
        raise InputError(
            f"vehicle '{make_printable(name, 80)}': an identifier has 1 to 63 of a-z 0-9 . _ - and no other characters"
        )
    return name


def write_private(path: Path, data: bytes) -> None:
    """Write a secret to `path`, atomically, and readable only by its owner."""
    # the file is created with its final mode: no moment at which others could read it
    before = os.umask(0o077)
    try:
        write_bytes(path, data)
    finally:
        os.umask(before)


def make_key() -> ec.EllipticCurvePrivateKey:
    """Return a new private key on NIST's curve P-384."""
    return ec.generate_private_key(ec.SECP384R1())


def private_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    """Return a private key as PEM (PKCS #8), the format of TLS libraries."""
    pem, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    return key.private_bytes(pem, pkcs8, serialization.NoEncryption())


def load_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """Return the private elliptic-curve key (PEM) at `path`; raises `InputError` if it is none."""
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: is no private key ({error})") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise InputError(f"{path}: an elliptic-curve key is wanted")
    return key


def public_der(key: ec.EllipticCurvePublicKey) -> bytes:
    """Return a public key as DER (SubjectPublicKeyInfo, RFC 5280)."""
    return key.public_bytes(serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)


def public_pem(der: bytes) -> bytes:
    """Return a public key, given as DER, as PEM, which identifies a node in Flower."""
    pem, spki = serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    return serialization.load_der_public_key(der).public_bytes(pem, spki)


def request_certificate(folder: Path, vehicle: str) -> Path:
    """Make a vehicle's key in `folder`, and return the path of its signing request (PKCS #10) to the authority.

    If the vehicle has a certificate already, the new key and its request are in `folder`/next until `take_certificate`.
    """
    check_identifier(vehicle)
    at = folder / NEXT if (folder / CERTIFICATE).exists() else folder
    key = make_key()
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, vehicle)])
    request = x509.CertificateSigningRequestBuilder().subject_name(name).sign(key, hashes.SHA384())
    write_private(at / KEY, private_pem(key))
    openssh = serialization.PrivateFormat.OpenSSH
    write_private(at / FLOWER_KEY, key.private_bytes(serialization.Encoding.PEM, openssh, serialization.NoEncryption()))
    write_bytes(at / REQUEST, request.public_bytes(serialization.Encoding.PEM))
    return at / REQUEST


def check_certificate(folder: Path) -> None:
    """Raise `InputError` unless the vehicle in `folder` has an unexpired certificate of its key."""
    try:
        certificate = x509.load_pem_x509_certificate((folder / CERTIFICATE).read_bytes())
    except ValueError:
        raise InputError(f"{folder / CERTIFICATE}: is no certificate (PEM)") from None
    except FileNotFoundError:
        raise InputError(f"{folder}: has no certificate yet; flcav fleet install takes it") from None
    if certificate.public_key() != load_key(folder / KEY).public_key():
        raise InputError(f"{folder / CERTIFICATE}: is for another key than {folder / KEY}")
    if certificate.not_valid_after_utc < datetime.now(UTC):
        raise InputError(
            f"{folder / CERTIFICATE}: is expired since {certificate.not_valid_after_utc:%Y-%m-%dT%H:%M:%SZ}"
        )


def take_certificate(folder: Path, certificate: bytes, authority: bytes) -> None:
    """Install the certificate of a vehicle's key and the authority's (PEM) in its `folder`, and put a new key in use.

    Raises `InputError` where the certificate is for another key.
    """
    at = folder / NEXT if (folder / NEXT / KEY).exists() else folder
    try:
        given = x509.load_pem_x509_certificate(certificate).public_key()
        x509.load_pem_x509_certificate(authority)
    except ValueError:
        raise InputError(f"{folder}: what is given as the certificate, or as the authority's, is none (PEM)") from None
    if given != load_key(at / KEY).public_key():
        raise InputError(f"{folder}: the certificate is for another key than {at / KEY}")
    for name in (KEY, FLOWER_KEY, REQUEST):
        if at != folder:
            (at / name).replace(folder / name)
    if at != folder:
        at.rmdir()
    write_bytes(folder / CERTIFICATE, certificate)
    write_bytes(folder / AUTHORITY, authority)


def read_request(path: Path) -> x509.CertificateSigningRequest:
    """Return a signing request; raises `InputError` if the file is none, or is not signed with its key."""
    with path.open("rb") as file:
        data = file.read(LARGEST_REQUEST + 1)
    try:
        request = x509.load_pem_x509_csr(data)
    except ValueError:
        raise InputError(f"{path}: is no signing request (PKCS #10, PEM)") from None
    if not isinstance(request.public_key(), ec.EllipticCurvePublicKey) or not request.is_signature_valid:
        raise InputError(f"{path}: is not signed by the elliptic-curve key that it is for")
    return request


def requested_name(request: x509.CertificateSigningRequest) -> str:
    """Return the vehicle's identifier in a signing request; raises `InputError` if there is none."""
    names = request.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return check_identifier(str(names[0].value) if len(names) == 1 else "")


def make_loopback(folder: Path) -> None:
    """Make key and self-signed certificate (127.0.0.1) of a vehicle's forwarder, which its SuperNode trusts."""
    key = make_key()
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "forwarder")])
    made = certificate_of(key.public_key(), name, name, timedelta(days=3650), hosts=("127.0.0.1", "localhost"))
    write_private(folder / LOOPBACK_KEY, private_pem(key))
    write_bytes(folder / LOOPBACK, made.sign(key, hashes.SHA384()).public_bytes(serialization.Encoding.PEM))


def certificate_of(
    key: ec.EllipticCurvePublicKey,
    subject: x509.Name,
    issuer: x509.Name,
    valid: timedelta,
    hosts: tuple[str, ...] = (),
    issuer_key: ec.EllipticCurvePublicKey | None = None,
) -> x509.CertificateBuilder:
    """Return the builder of a certificate (X.509) of `key`, valid from now on.

    hosts: names and addresses of a server. issuer_key: that will sign it; None: `key` itself.
    """
    begin = datetime.now(UTC).replace(microsecond=0)
    made = x509.CertificateBuilder(issuer, subject, key, x509.random_serial_number(), begin, begin + valid)
    made = made.add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    by = x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key or key)
    made = made.add_extension(by, critical=False)
    if hosts:
        names = [x509.IPAddress(ip) if (ip := _address(host)) else x509.DNSName(host) for host in hosts]
        made = made.add_extension(x509.SubjectAlternativeName(names), critical=False)
    return made


def _address(host: str) -> IPv4Address | IPv6Address | None:
    try:
        return ip_address(host)
    except ValueError:
        return None


def fingerprint_of(certificate: bytes) -> str:
    """Return the SHA-256 fingerprint of a certificate (PEM), hexadecimal."""
    return x509.load_pem_x509_certificate(certificate).fingerprint(hashes.SHA256()).hex()
