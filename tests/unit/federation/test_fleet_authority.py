"""The authority of a fleet: its certificates as OpenSSL reads them, its registry, and what it refuses."""

import shutil
import sqlite3
import stat
import subprocess
import time
from typing import Any, cast

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from flcav.config import InputError
from flcav.fleet import up
from flcav.fleet.authority import REGISTRY, found_authority, open_authority, open_registry
from flcav.fleet.keys import (
    AUTHORITY,
    CERTIFICATE,
    FLOWER_KEY,
    KEY,
    NEXT,
    check_identifier,
    load_key,
    request_certificate,
    take_certificate,
)
from flcav.fleet.registry import RegisteredVehicle


@pytest.fixture
def authority(tmp_path):
    return found_authority(tmp_path / "fleet", ("127.0.0.1", "fleet.example"))


@pytest.fixture
def vehicle(authority, tmp_path):
    """Return the folder of a registered vehicle."""
    own = tmp_path / "vehicle"
    certify(authority.register, own, "cav-1", authority)
    return own


def certify(how, own, name, authority, **options):
    take_certificate(own, how(request_certificate(own, name), **options), (authority.folder / AUTHORITY).read_bytes())


def openssl(*arguments):
    return subprocess.run(["openssl", *map(str, arguments)], capture_output=True, text=True, check=False)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="OpenSSL's command is not here")
def test_openssl_accepts_the_certificates(authority, vehicle):
    ca = authority.folder / AUTHORITY
    for purpose, certificate in (("sslclient", vehicle / CERTIFICATE), ("sslserver", authority.folder / "server.crt")):
        assert openssl("verify", "-x509_strict", "-CAfile", ca, "-purpose", purpose, certificate).returncode == 0
    assert openssl("verify", "-CAfile", ca, "-purpose", "sslserver", vehicle / CERTIFICATE).returncode != 0
    assert (
        openssl(
            "verify", "-CAfile", ca, "-verify_hostname", "fleet.example", authority.folder / "server.crt"
        ).returncode
        == 0
    )
    text = openssl("x509", "-in", vehicle / CERTIFICATE, "-noout", "-subject", "-fingerprint", "-sha256").stdout
    assert "CN = cav-1" in text or "CN=cav-1" in text
    found = authority.registry.find(text.rpartition("=")[2].strip().replace(":", "").lower())
    assert found is not None
    assert found.name == "cav-1"


def test_private_keys_stay_with_their_owner(authority, vehicle):
    """Nobody else may read them, and nothing of a vehicle's key is in the authority's folder."""
    for path in (vehicle / KEY, vehicle / FLOWER_KEY, authority.folder / "ca.key", authority.folder / "server.key"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    secret = load_key(vehicle / KEY).private_numbers().private_value.to_bytes(48, "big")
    for path in authority.folder.rglob("*"):
        assert not path.is_file() or secret not in path.read_bytes()
    from cryptography.hazmat.primitives.serialization import load_ssh_private_key

    flower = load_ssh_private_key((vehicle / FLOWER_KEY).read_bytes(), None)
    assert isinstance(flower, ec.EllipticCurvePrivateKey)
    assert flower.private_numbers() == load_key(vehicle / KEY).private_numbers()


def test_rotation(authority, vehicle):
    before, key = open_registry(authority.folder).list_vehicles()[0], (vehicle / KEY).read_bytes()
    request = request_certificate(vehicle, "cav-1")
    assert request.parent == vehicle / NEXT
    assert (vehicle / KEY).read_bytes() == key  # in use until the certificate is there
    take_certificate(vehicle, authority.rotate(request), (authority.folder / AUTHORITY).read_bytes())
    assert (vehicle / KEY).read_bytes() != key
    assert not (vehicle / NEXT).exists()
    assert authority.registry.find(before.fingerprint).describe_state() == "replaced"
    assert [own.describe_state() for own in authority.registry.list_vehicles()] == ["registered"]


def test_revoked_and_expired(authority, vehicle, tmp_path):
    authority.registry.revoke("cav-1", "stolen")
    with pytest.raises(InputError, match="has no certificate in force"):
        authority.registry.revoke("cav-1")
    assert authority.registry.list_vehicles()[0].describe_state() == "revoked"
    certify(authority.register, tmp_path / "short", "cav-2", authority, days=1 / 86400)
    own = authority.registry.list_vehicles()[1]
    assert own.describe_state(own.expires - 1) == "registered"
    assert own.describe_state(own.expires) == "expired"


def test_audit_trail_cannot_be_changed(authority, vehicle):
    authority.registry.revoke("cav-1", "stolen")
    trail = [(entry.action, entry.vehicle, entry.reason) for entry in authority.registry.list_audit()]
    assert trail == [("found", "", ""), ("register", "cav-1", ""), ("revoke", "cav-1", "stolen")]
    connection = sqlite3.connect(authority.folder / "registry.sqlite")
    for change in ("DELETE FROM audit", "UPDATE audit SET vehicle = 'cav-2'"):
        with pytest.raises(sqlite3.IntegrityError, match="not changed"):
            connection.execute(change)
    connection.close()


def test_identifier_and_key_are_unique(authority, vehicle, tmp_path):
    with pytest.raises(InputError, match="is registered already"):
        authority.register(request_certificate(tmp_path / "twin", "cav-1"))
    with pytest.raises(InputError, match="its key is in the registry already"):
        authority.rotate(vehicle / "vehicle.csr")
    with pytest.raises(InputError, match="is not registered"):
        authority.rotate(request_certificate(tmp_path / "other", "cav-9"))
    assert len(authority.registry.list_audit()) == 2  # nothing of what was refused


@pytest.mark.parametrize("name", ["", "../x", "a/b", "A", "a..b", "x" * 64, "-a", "a\n", "é"])
def test_identifiers_that_are_none(name):
    with pytest.raises(InputError, match="an identifier has"):
        check_identifier(name)


def test_request_that_is_not_signed_by_its_key(authority, tmp_path):
    """A request whose name was changed after it was signed; one that is none; one of megabytes."""
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization

    request = request_certificate(tmp_path / "v", "cav-1")
    der = x509.load_pem_x509_csr(request.read_bytes()).public_bytes(serialization.Encoding.DER)
    request.write_bytes(
        x509.load_der_x509_csr(der.replace(b"cav-1", b"cav-2")).public_bytes(serialization.Encoding.PEM)
    )
    with pytest.raises(InputError, match="is not signed by"):
        authority.register(request)
    for data in (b"no request", b"x" * 10_000_000):
        request.write_bytes(data)
        with pytest.raises(InputError, match="is no signing request"):
            authority.register(request)
    assert authority.registry.list_vehicles() == []


def test_folder_of_another_authority(authority, tmp_path):
    other = found_authority(tmp_path / "other")
    with pytest.raises(InputError, match="has an authority already"):
        found_authority(other.folder)
    before = (other.folder / AUTHORITY).read_bytes()
    (other.folder / AUTHORITY).write_bytes((authority.folder / AUTHORITY).read_bytes())
    with pytest.raises(InputError, match="the key of another authority"):
        open_authority(other.folder)
    with pytest.raises(InputError, match="the registry of another authority"):
        open_registry(other.folder)
    (other.folder / AUTHORITY).write_bytes(before)
    (other.folder / "server.crt").write_bytes((authority.folder / "server.crt").read_bytes())
    with pytest.raises(InputError, match="from another authority"):
        open_authority(other.folder)
    with pytest.raises(InputError, match="has no authority"):
        open_authority(tmp_path / "empty")


@pytest.mark.parametrize("kept", [AUTHORITY, REGISTRY])
def test_what_is_left_of_an_authority_is_not_written_over(tmp_path, kept: str):
    (tmp_path / kept).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / kept).write_bytes(b"a key")
    with pytest.raises(InputError, match="has an authority already"):
        found_authority(tmp_path)
    assert (tmp_path / kept).read_bytes() == b"a key"


def test_certificate_for_another_key(authority, vehicle, tmp_path):
    request_certificate(tmp_path / "w", "cav-2")
    with pytest.raises(InputError, match="for another key"):
        take_certificate(tmp_path / "w", (vehicle / CERTIFICATE).read_bytes(), (vehicle / AUTHORITY).read_bytes())
    assert not (tmp_path / "w" / CERTIFICATE).exists()


def test_ten_thousand_vehicles(authority):
    """A register, a revoke and a look-up take milliseconds; the bounds are for a busy machine."""
    registry, end = authority.registry, int(time.time()) + 1000
    make = lambda i: RegisteredVehicle(f"v{i:05d}", f"{i:064x}", i.to_bytes(8, "big"), 0, end)  # noqa: E731
    with registry._change() as cursor:
        for i in range(10_000):
            registry._insert(cursor, make(i), "register")
    begun = time.process_time()
    for i in range(50):
        registry.register(make(20_000 + i))
        registry.revoke(f"v{i:05d}")
        assert registry.find(f"{i:064x}").state == "revoked"
    assert (time.process_time() - begun) / 50 < 0.02
    begun = time.process_time()
    assert len(registry.list_vehicles()) == 10_050
    assert time.process_time() - begun < 1.0


def test_a_vehicle_that_registers_while_others_are_enrolled_is_enrolled_next(authority, vehicle, tmp_path, monkeypatch):
    monkeypatch.setattr(up, "CHECK_S", 0.0)
    enrolled = []

    class Link:
        def enrol(self, registry):
            enrolled.append([each.name for each in registry.list_vehicles()])
            if len(enrolled) == 1:
                authority.register(request_certificate(tmp_path / "late", "cav-2"))

    state = up._Enrolment(authority.folder)
    for _ in range(4):
        time.sleep(0.11)  # the pause after a first look
        assert state.update(cast(Any, Link()))
    assert enrolled == [["cav-1"], ["cav-1", "cav-2"]]  # once for each change
