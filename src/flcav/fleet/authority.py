"""The certificate authority of a fleet, which certifies the keys of vehicles and servers (X.509).

Its folder on the operator's host has `ca.crt` and `ca.key`, the registry `registry.sqlite`, and the keys of the servers
and of the publisher that signs apps. Only the authority's certificate leaves it.
"""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from flcav.config import InputError
from flcav.fleet.keys import (
    AUTHORITY,
    certificate_of,
    load_key,
    make_key,
    private_pem,
    read_request,
    requested_name,
    write_private,
)
from flcav.fleet.registry import BUSY_S, RegisteredVehicle, VehicleRegistry
from flcav.storage.files import write_bytes

AUTHORITY_KEY, REGISTRY = "ca.key", "registry.sqlite"
SERVER, SERVER_KEY = "server.crt", "server.key"
AUTHORITY_YEARS, VEHICLE_DAYS = 10, 365
LOOPBACK_HOSTS = "127.0.0.1", "localhost"
DAY = timedelta(days=1)


@dataclass(frozen=True)
class Authority:
    """A certificate authority: key, certificate, and registry of vehicles."""

    folder: Path
    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate
    registry: VehicleRegistry

    def register(self, request: Path, days: float = VEHICLE_DAYS) -> bytes:
        """Register a new vehicle by its signing request, and return its certificate (PEM).

        days: validity. Raises `InputError` where the identifier or the key is registered already, or the request is
        invalid.
        """
        signing_request = read_request(request)
        made = self._certify(signing_request, timedelta(days=days))
        self.registry.register(_describe(made, signing_request))
        return made.public_bytes(serialization.Encoding.PEM)

    def rotate(self, request: Path, days: float = VEHICLE_DAYS) -> bytes:
        """Return the certificate (PEM) of a registered vehicle's new key, for `days`; the old one is void at once."""
        signing_request = read_request(request)
        made = self._certify(signing_request, timedelta(days=days))
        self.registry.rotate(_describe(made, signing_request))
        return made.public_bytes(serialization.Encoding.PEM)

    def certify_server(self, hosts: tuple[str, ...]) -> None:
        """Write key and certificate of the servers with the names and addresses `hosts` to the authority's folder."""
        key = make_key()
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "server")])
        valid = self.certificate.not_valid_after_utc - datetime.now(UTC)
        made = certificate_of(key.public_key(), name, self.certificate.subject, valid, hosts, self.key.public_key())
        made = made.add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        write_private(self.folder / SERVER_KEY, private_pem(key))
        signed = made.sign(self.key, hashes.SHA384())
        write_bytes(self.folder / SERVER, signed.public_bytes(serialization.Encoding.PEM))

    def _certify(self, request: x509.CertificateSigningRequest, valid: timedelta) -> x509.Certificate:
        vehicle = requested_name(request)
        key = request.public_key()
        assert isinstance(key, ec.EllipticCurvePublicKey)
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, vehicle)])
        made = certificate_of(key, name, self.certificate.subject, valid, (), self.key.public_key())
        for extension, critical in (
            (x509.BasicConstraints(False, None), True),
            (x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH]), False),
        ):
            made = made.add_extension(extension, critical)
        return made.sign(self.key, hashes.SHA384())


def _describe(made: x509.Certificate, request: x509.CertificateSigningRequest) -> RegisteredVehicle:
    spki = request.public_key().public_bytes(
        serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    begin, end = int(made.not_valid_before_utc.timestamp()), int(made.not_valid_after_utc.timestamp())
    return RegisteredVehicle(requested_name(request), made.fingerprint(hashes.SHA256()).hex(), spki, begin, end)


def found_authority(folder: Path, hosts: tuple[str, ...] = ()) -> Authority:
    """Create and return an authority in `folder`, whose servers are reached by `hosts` and the loopback.

    Raises `InputError` where the folder has one already.
    """
    if (folder / AUTHORITY).exists() or (folder / REGISTRY).exists():
        raise InputError(f"{folder}: has an authority already")
    key = make_key()
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "flcav fleet authority")])
    made = certificate_of(key.public_key(), name, name, AUTHORITY_YEARS * 365 * DAY)
    uses = dict.fromkeys(
        (
            "digital_signature",
            "content_commitment",
            "key_encipherment",
            "data_encipherment",
            "key_agreement",
            "encipher_only",
            "decipher_only",
        ),
        False,
    )
    usage = x509.KeyUsage(key_cert_sign=True, crl_sign=True, **uses)
    made = made.add_extension(x509.BasicConstraints(True, 0), critical=True).add_extension(usage, critical=True)
    certificate = made.sign(key, hashes.SHA384())
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)
    write_private(folder / AUTHORITY_KEY, private_pem(key))
    write_bytes(folder / AUTHORITY, certificate.public_bytes(serialization.Encoding.PEM))
    registry = VehicleRegistry.create(folder / REGISTRY, certificate.fingerprint(hashes.SHA256()).hex())
    authority = Authority(folder, key, certificate, registry)
    authority.certify_server((*LOOPBACK_HOSTS, *hosts))
    return authority


def open_authority(folder: Path) -> Authority:
    """Return the authority in `folder`; raises `InputError` if there is none, or its files do not belong together."""
    certificate = load_certificate(folder)
    key = load_key(folder / AUTHORITY_KEY)
    if key.public_key() != certificate.public_key():
        raise InputError(f"{folder}: {AUTHORITY_KEY} is the key of another authority than {AUTHORITY}'s")
    registry = open_registry(folder)
    if (folder / SERVER).exists():
        try:
            server = x509.load_pem_x509_certificate((folder / SERVER).read_bytes())
            server.verify_directly_issued_by(certificate)
        except (InvalidSignature, ValueError):
            raise InputError(f"{folder / SERVER}: is from another authority than {AUTHORITY}") from None
    return Authority(folder, key, certificate, registry)


def open_registry(folder: Path, busy_s: float = BUSY_S) -> VehicleRegistry:
    """Return the registry of the authority in `folder`; raises `InputError` if it is another authority's.

    busy_s: timeout of its calls where another process has locked it [s].
    """
    return VehicleRegistry.open(folder / REGISTRY, load_certificate(folder).fingerprint(hashes.SHA256()).hex(), busy_s)


def load_certificate(folder: Path) -> x509.Certificate:
    """Return the certificate of the authority in `folder`; raises `InputError` if there is none."""
    if not (folder / AUTHORITY).exists():
        raise InputError(f"{folder}: has no authority; make one with flcav fleet init {folder}")
    try:
        return x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes())
    except ValueError:
        raise InputError(f"{folder / AUTHORITY}: is no certificate (PEM)") from None
