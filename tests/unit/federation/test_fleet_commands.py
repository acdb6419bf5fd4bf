"""`flcav fleet`: what an operator and a vehicle type, and what is refused in a sentence."""

import contextlib
import json
import os
import socket
import sqlite3
import stat
import threading
from functools import partial
from pathlib import Path

import httpx
import pytest
import uvicorn
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from flcav.cli.main import run as command
from flcav.fleet import authority
from flcav.fleet.authority import open_authority, open_registry
from flcav.fleet.keys import request_certificate, take_certificate
from flcav.fleet.page import make_page
from flcav.fleet.releases import KeptReport, ReleaseReport
from flcav.fleet.status import FederationProgress, RoundProgress, read_fleet_status
from flcav.fleet.traffic import ProxyTraffic
from flcav.fleet.vehicle import VehicleSettings


@pytest.fixture
def flcav(capsys):
    def call(*arguments):
        with pytest.raises(SystemExit) as stopped:
            command(["fleet", *map(str, arguments)])
        said = capsys.readouterr()
        return stopped.value.code, said.out, said.err

    return call


@pytest.fixture
def fleet(flcav, tmp_path):
    assert flcav("init", tmp_path / "fleet", "--host", "192.0.2.1")[0] == 0
    return tmp_path / "fleet"


def register(flcav, fleet, own, name, *options, how="register"):
    assert flcav("key", own, "--vehicle", name)[0] == 0
    request = own / "next/vehicle.csr" if (own / "next").exists() else own / "vehicle.csr"
    code, said, _ = flcav(how, fleet, request, "--out", own.parent / f"{name}.crt", *options)
    assert code == 0
    given = flcav(
        *("install", own, own.parent / f"{name}.crt", "--authority", fleet / "ca.crt"),
        *("--trusted", fleet / "trusted.yaml", "--server", "192.0.2.1:9443"),
    )
    assert given[0] == 0
    return said


def test_from_the_key_to_the_revocation(flcav, fleet, tmp_path):
    said = register(flcav, fleet, tmp_path / "vehicle", "cav-1")
    assert "cav-1 registered, until " in said
    assert json.loads((tmp_path / "vehicle/vehicle.json").read_text())["server"] == "192.0.2.1:9443"
    before = json.loads(flcav("list", fleet, "--json")[1])["vehicles"][0]
    register(flcav, fleet, tmp_path / "vehicle", "cav-1", how="rotate")
    after = json.loads(flcav("list", fleet, "--json")[1])["vehicles"][0]
    assert (before["name"], after["name"]) == ("cav-1", "cav-1")
    assert before["fingerprint"] != after["fingerprint"]
    assert flcav("revoke", fleet, "cav-1", "--reason", "stolen")[1] == "cav-1: revoked\n"
    assert flcav("list", fleet)[1].startswith("cav-1 revoked, until ")
    trail = flcav("list", fleet, "--audit")[1].splitlines()
    assert [line.split()[1] for line in trail] == ["found", "register", "rotate", "revoke"]
    assert trail[-1].endswith(" stolen")


def test_what_is_refused_in_a_sentence(flcav, fleet, tmp_path):
    register(flcav, fleet, tmp_path / "vehicle", "cav-1")
    (tmp_path / "other").mkdir()
    assert flcav("init", tmp_path / "other/fleet")[0] == 0
    for name in ("ca.crt", "ca.key"):
        (tmp_path / "other/fleet" / name).write_bytes((fleet / name).read_bytes())
    (tmp_path / "garbled").mkdir()
    (tmp_path / "garbled/ca.crt").write_text("none")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        refused = {
            ("init", fleet): "has an authority already",
            ("up", fleet, "--port", port): f"127.0.0.1:{port}: cannot be listened on (Address already in use)",
            ("up", fleet, "--vehicles", 0): "0 is not in the range 1<=x<=64",
            ("up", tmp_path / "other/fleet"): "registry of another authority",
            ("up", tmp_path / "none"): "no such folder",
            ("status", tmp_path / "none"): "has no authority",
            ("list", tmp_path / "garbled"): "ca.crt: is no certificate (PEM)",
            ("vehicle", fleet): "is no vehicle's folder",
            ("revoke", fleet, "cav-9"): "has no certificate in force",
            ("key", tmp_path / "x", "--vehicle", "../x"): "an identifier has",
            ("register", fleet, fleet / "ca.crt", "--out", tmp_path / "crt"): "is no signing request",
            ("register", fleet, tmp_path / "vehicle/vehicle.csr", "--out", tmp_path / "crt"): "is registered already",
        }
        for arguments, sentence in refused.items():
            code, _, said = flcav(*arguments)
            assert code == 2, arguments
            assert sentence in said
            assert said.count("\n") == 1
    assert not (tmp_path / "crt").exists()
    assert not (tmp_path / "x").exists()


def refused(ended) -> str:
    """Return the sentence of a command that was refused."""
    code, _, said = ended
    assert code == 2
    assert said.count("\n") == 1
    return said


def test_expired_certificate_of_a_vehicle_on_this_machine(flcav, fleet):
    own, authority = fleet / "vehicles/vehicle-001", open_authority(fleet)
    given = authority.register(request_certificate(own, "vehicle-001"), days=1 / 86400)
    take_certificate(own, given, (fleet / "ca.crt").read_bytes())
    threading.Event().wait(1.1)
    code, _, said = flcav("up", fleet, "--vehicles", 1)
    assert code == 2
    assert "the certificate of 'vehicle-001' is expired; flcav fleet rotate gives another" in said
    VehicleSettings("127.0.0.1:1", 1, 2).save(own)
    assert refused(flcav("vehicle", own)).startswith(f"flcav: {own / 'vehicle.crt'}: is expired since 20")
    (own / "vehicle.crt").write_bytes((fleet / "ca.crt").read_bytes())
    assert "is for another key than" in refused(flcav("vehicle", own))
    (own / "vehicle.crt").write_text("none")
    assert "vehicle.crt: is no certificate (PEM)" in refused(flcav("vehicle", own))
    (own / "vehicle.crt").unlink()
    assert "has no certificate yet" in refused(flcav("vehicle", own))


def test_nobody_else_may_write_what_is_made(flcav, tmp_path):
    """Whatever the umask: a new folder, and one that everybody could write to."""
    before = os.umask(0)
    try:
        (tmp_path / "there").mkdir()
        for folder in (tmp_path / "deep/fleet", tmp_path / "there"):
            os.umask(0)
            assert flcav("init", folder)[0] == 0
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
            modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()}
            private = {"ca.key", "server.key", "publisher.key"}
            assert {modes[name] for name in private} == {0o600}
            assert {mode for name, mode in modes.items() if name not in private} == {0o644}
        assert stat.S_IMODE((tmp_path / "deep").stat().st_mode) == 0o755
    finally:
        os.umask(before)


@pytest.mark.parametrize("arguments", [("revoke", "cav-1"), ("register", "vehicle.csr", "--out", "crt")])
def test_registry_that_another_process_holds(arguments, flcav, fleet, tmp_path, monkeypatch):
    register(flcav, fleet, tmp_path / "vehicle", "cav-1")
    request_certificate(tmp_path, "cav-2")
    monkeypatch.setattr(authority, "open_registry", partial(open_registry, busy_s=0.1))
    monkeypatch.chdir(tmp_path)
    with contextlib.closing(sqlite3.connect(fleet / "registry.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        code, _, said = flcav(arguments[0], fleet, *arguments[1:])
    told = "registry.sqlite: the registry cannot be used (another process holds it; try again)\n"
    assert (code, said) == (1, f"flcav: {fleet}/{told}")
    assert not (tmp_path / "crt").exists()


def test_escapes_of_vehicles_do_not_reach_the_terminal(flcav, fleet, tmp_path):
    """Of a signing request, a reason, a refused call, a release report, and of clients that failed or are late."""
    odd = "\x1b[2J\x1b]0;owned\x07\u202efine\ncav-2: registered\r" + "x" * 3000
    register(flcav, fleet, tmp_path / "vehicle", "cav-1")
    assert flcav("revoke", fleet, "cav-1", "--reason", odd)[0] == 0
    traffic = ProxyTraffic()
    traffic.refuse("cav-1", odd)
    traffic.save(fleet)
    KeptReport("cav-1", 0.0, 0, ReleaseReport("objects", 1, 1, odd)).save(fleet)
    rounds = (RoundProgress(1, 0.0, 2, {"cav": odd}),)
    FederationProgress("edge", "weather", "wireless", 1.0, 2.0, rounds, {"cav": odd}, {"cav": odd}).save(fleet)
    key = ec.generate_private_key(ec.SECP384R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, odd[:60])])
    signed = x509.CertificateSigningRequestBuilder().subject_name(name).sign(key, hashes.SHA384())
    (tmp_path / "csr").write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    said = [
        flcav("status", fleet),
        flcav("list", fleet, "--audit"),
        flcav("register", fleet, tmp_path / "csr", "--out", tmp_path / "crt"),
    ]
    assert [code for code, _, _ in said] == [0, 0, 2]
    for _, out, err in said:
        lines = (out + err).splitlines()
        assert not [line for line in lines if not line.isprintable() or len(line) > 1300 or line.startswith("cav-2")]
    assert all("\\x1b[2J" in out + err for _, out, err in said)
    page = json.dumps(read_fleet_status(fleet).as_json(), ensure_ascii=False)
    assert page.isprintable()
    assert "x" * 300 not in page


def test_page(flcav, fleet):
    """The page is served for this host alone, and has what the status says."""
    traffic = ProxyTraffic()
    traffic.count("vehicle-001", "push-object", 5, 7, (50, 70), 200)
    traffic.refuse("<script>", "a certificate is wanted")
    traffic.save(fleet)
    server = uvicorn.Server(uvicorn.Config(make_page(fleet), port=0, log_level="warning", log_config=None))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        threading.Event().wait(0.02)
    port = server.servers[0].sockets[0].getsockname()[1]
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False) as client:
        page, status = client.get("/"), client.get("/status.json")
        assert client.get("/status.json", headers={"host": "evil.example"}).status_code == 400
    server.should_exit = True
    thread.join()
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert status.json()["refused"] == ["<script>: a certificate is wanted"]
    assert status.json()["proxy"] is None
    assert Path(fleet / "traffic.json").exists()
