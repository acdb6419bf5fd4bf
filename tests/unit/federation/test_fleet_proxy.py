"""Whom the proxy lets in, how it names what is wrong, and that servers of a fleet start with keys that are theirs."""

import base64
import itertools
import os
import ssl
import sys
import time
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization

from flcav.fleet import vehicle as vehicle_module
from flcav.fleet.authority import found_authority
from flcav.fleet.forwarder import run_forwarder
from flcav.fleet.keys import CERTIFICATE, LOOPBACK, load_key, public_der, request_certificate, take_certificate
from flcav.fleet.proxy import describe_clock, find_caller, node_key, run_proxy
from flcav.fleet.registry import RegisteredVehicle
from flcav.fleet.vehicle import POLLED, VehicleSettings, run_supernode


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


@pytest.mark.parametrize("which", ["forwarder", "proxy"])
def test_servers_have_the_key_of_their_certificate(which, vehicle, tmp_path, monkeypatch):
    """OpenSSL takes the two that a server is started with, and no key of another certificate."""
    own, started = tmp_path / "cav-1", []

    def start(app, host, port, certificate, key, *_):
        started.append((host, port))
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(certificate, key)
        return SimpleNamespace(run=lambda: None)

    monkeypatch.setattr(f"flcav.fleet.{which}.serve_https", start)
    VehicleSettings("127.0.0.1:3", 1, 2).save(own)
    if which == "forwarder":
        run_forwarder(own, 1, "127.0.0.1:3", own / POLLED)
    else:
        run_proxy(tmp_path / "fleet", "127.0.0.1", 1, "127.0.0.1:2")
    assert started == [("127.0.0.1", 1)]


def test_a_vehicle_s_node_trusts_its_own_forwarder(vehicle, tmp_path, monkeypatch):
    own, settings = tmp_path / "cav-1", VehicleSettings("127.0.0.1:3", 1, 2)
    settings.save(own)
    monkeypatch.setattr("sys.argv", [])
    monkeypatch.setattr(import_module("flwr.supernode.cli.flower_supernode"), "flower_supernode", lambda: None)
    run_supernode(own, settings)
    options = dict(itertools.pairwise(sys.argv))
    trusted = x509.load_pem_x509_certificate(Path(options["--root-certificates"]).read_bytes())
    assert trusted == x509.load_pem_x509_certificate((own / LOOPBACK).read_bytes())
    assert (options["--superlink"], options["--port"]) == ("127.0.0.1:1", "2")
    assert serialization.load_ssh_private_key(Path(options["--auth-supernode-private-key"]).read_bytes(), None)


@pytest.mark.parametrize(
    ("lasts_s", "code", "polls", "answered"), [(0, 0, False, True), (0, 1, False, False), (60, 0, True, False)]
)
def test_an_app_is_ended_when_its_node_asks_for_another_message(lasts_s, code, polls, answered, tmp_path, monkeypatch):
    def fork(node, token):
        if not (child := os.fork()):
            time.sleep(lasts_s)
            os._exit(code)
        if polls:
            (tmp_path / POLLED).touch()
        return child

    monkeypatch.setattr(vehicle_module, "_fork", fork)
    monkeypatch.setattr(vehicle_module, "EXIT_S", 0.2)
    begun = time.monotonic()
    assert vehicle_module._run_app("node", "token", tmp_path / POLLED) is answered
    assert time.monotonic() < begun + 30
