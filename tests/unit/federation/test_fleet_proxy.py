"""Whom the proxy lets in, and how it names what is wrong."""

import base64

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization

from flcav.fleet.authority import found_authority
from flcav.fleet.keys import CERTIFICATE, load_key, public_der, request_certificate, take_certificate
from flcav.fleet.proxy import describe_clock, find_caller, node_key
from flcav.fleet.registry import RegisteredVehicle


@pytest.fixture
def vehicle(tmp_path):
    """Return the registry, the certificate (DER) and the key of a vehicle."""
    authority, own = found_authority(tmp_path / "fleet"), tmp_path / "cav-1"
    take_certificate(
        own, authority.register(request_certificate(own, "cav-1")), (tmp_path / "fleet/ca.crt").read_bytes()
    )
    certificate = x509.load_pem_x509_certificate((own / CERTIFICATE).read_bytes())
    return authority.registry, certificate.public_bytes(serialization.Encoding.DER), load_key(own / "key.pem")


def test_who_calls(vehicle):
    registry, certificate, _ = vehicle
    found = find_caller(registry, certificate)
    assert isinstance(found, RegisteredVehicle)
    assert found.name == "cav-1"
    assert find_caller(registry, certificate, found.expires) == "the certificate of cav-1 is expired"
    assert find_caller(registry, certificate + b"\0") == "the certificate is not registered"
    assert find_caller(registry, None) == "a certificate is wanted"
    registry.revoke("cav-1")
    assert find_caller(registry, certificate) == "the certificate of cav-1 is revoked"


def test_key_in_flowers_header(vehicle):
    _, _, key = vehicle
    pem = key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    assert node_key(base64.b64encode(pem)) == public_der(key.public_key())
    for header in (b"", b"!", base64.b64encode(b"no key"), pem):
        assert node_key(header) == b""


@pytest.mark.parametrize(
    ("stamp", "told"),
    [
        ("2026-01-01T00:00:00+00:00", "its clock is 86400 s behind"),
        ("2026-01-03T00:00:00+00:00", "its clock is 86400 s ahead"),
        ("2026-01-02T00:01:00+00:00", "does not know its key"),
        ("yesterday", "has no time"),
        ("é", "has no time"),
    ],
)
def test_clock(stamp, told):
    now = 1767312000.0  # 2 January 2026, UTC
    assert told in describe_clock(stamp.encode(), now)
