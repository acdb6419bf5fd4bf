"""Who and what a running fleet refuses: each against the proxy, the SuperLink and the vehicles that are up."""

import base64
import contextlib
import os
import signal
import socket
import ssl
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import httpx
import numpy as np
import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from flwr.app import Message, MessageType, RecordDict
from flwr.proto.control_pb2 import ListRunsRequest
from flwr.proto.fleet_pb2 import ActivateNodeRequest, ActivateNodeResponse, PullMessagesRequest
from flwr.proto.node_pb2 import Node
from waiting import LONGEST_S, wait_for

from flcav.config import InputError
from flcav.fleet import superlink
from flcav.fleet.authority import found_authority, open_authority
from flcav.fleet.fl_request import PATH, make_request
from flcav.fleet.forwarder import send_request
from flcav.fleet.keys import (
    AUTHORITY,
    CERTIFICATE,
    KEY,
    load_key,
    request_certificate,
    take_certificate,
)
from flcav.fleet.status import read_fleet_status
from flcav.fleet.supervisor import read_processes
from flcav.fleet.traffic import read_traffic
from flcav.fleet.up import VEHICLES, read_ready

PROTOBUF = {"content-type": "application/protobuf", "accept": "application/protobuf"}


@pytest.fixture(scope="module")
def authority(deployment):
    return open_authority(deployment.folder)


def a_vehicle(authority, folder, name, days=1.0):
    """Return the folder of a vehicle with a certificate of this authority."""
    take_certificate(
        folder, authority.register(request_certificate(folder, name), days), (authority.folder / AUTHORITY).read_bytes()
    )
    return folder


def tls_of(folder, authority):
    """Return the TLS settings of a vehicle (None: without a certificate) that trusts the servers of an authority."""
    context = ssl.create_default_context(cafile=str(authority / AUTHORITY))
    if folder is not None:
        context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    return context


def reach(deployment, folder=None, authority=None):
    """Return a client of the proxy with a vehicle's certificate (None: without one)."""
    context = tls_of(folder, authority or deployment.folder)
    url = f"https://{read_ready(deployment.folder).proxy}"
    return httpx.Client(base_url=url, verify=context, trust_env=False, timeout=LONGEST_S)


def signed_headers(key: ec.EllipticCurvePrivateKey, late_s: float = 0.0) -> dict[str, str]:
    """Return Flower's headers of a node, as its SuperNode signs them where its clock is `late_s` behind."""
    from cryptography.hazmat.primitives import hashes
    from flwr.supercore.date import now

    public = key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    stamp = (now() - timedelta(seconds=late_s)).isoformat()
    signature = key.sign(stamp.encode(), ec.ECDSA(hashes.SHA256()))
    encode = lambda data: base64.b64encode(data).decode()  # noqa: E731
    return {**PROTOBUF, "flwr-public-key": encode(public), "flwr-signature": encode(signature), "flwr-timestamp": stamp}


def activate(client, key, late_s=0.0):
    """Return the answer to a node's first call, with Flower's signature by `key`."""
    public = key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    asked = ActivateNodeRequest(public_key=public, heartbeat_interval=30.0)
    return client.post(
        "/v1/fleet/activate-node", content=asked.SerializeToString(), headers=signed_headers(key, late_s)
    )


def node_of(deployment, name):
    """Return Flower's node of a vehicle."""
    vehicles = open_authority(deployment.folder).registry.list_vehicles()
    return Node(node_id=next(own.node for own in vehicles if own.name == name) or 0)


def wait_enrolled(deployment, name):
    """Wait until a vehicle has a node."""
    wait_for(
        lambda: any(
            own.name == name and own.node is not None
            for own in open_authority(deployment.folder).registry.list_vehicles()
        )
    )


def wait_refused(deployment, who, why):
    """Wait until the proxy has told of a refusal."""
    wait_for(
        lambda: any(each.startswith(who) and each.endswith(why) for each in read_traffic(deployment.folder).refused)
    )


def test_registered_vehicle_comes_in_and_a_revoked_one_is_out_at_once(deployment, authority, tmp_path):
    own = a_vehicle(authority, tmp_path, "in-and-out")
    wait_enrolled(deployment, "in-and-out")
    with reach(deployment, own) as client:
        answer = activate(client, load_key(own / KEY))
        assert answer.status_code == 200
        assert ActivateNodeResponse.FromString(answer.content).node_id
        authority.registry.revoke("in-and-out", "stolen")
        again = activate(client, load_key(own / KEY))  # on the connection that is open
    assert (again.status_code, again.text) == (401, "the certificate of in-and-out is revoked")
    wait_refused(deployment, "", "in-and-out is revoked")


@pytest.mark.parametrize(("late_s", "told"), [(86400, "86400 s behind"), (-86400, "86400 s ahead")])
def test_clock_that_is_off_is_named_and_comes_in_once_corrected(late_s, told, deployment):
    own = deployment.folder / VEHICLES / "vehicle-003"
    with reach(deployment, own) as client:
        assert activate(client, load_key(own / KEY), late_s).status_code == 401
        assert activate(client, load_key(own / KEY)).status_code in (200, 412)  # 412: it is in, as its own node is
    wait_refused(deployment, "vehicle-003: ", told)


def test_expired(deployment, authority, tmp_path):
    own = a_vehicle(authority, tmp_path, "short-lived", days=8 / 86400)
    with reach(deployment, own) as client:
        assert activate(client, load_key(own / KEY)).status_code != 401  # but it may not be enrolled yet

        def call_late():  # on the same connection: TLS has looked at the date when it began
            answer = activate(client, load_key(own / KEY))
            return answer if answer.status_code == 401 else None

        late = wait_for(call_late, every_s=1.0)
    assert (late.status_code, late.text) == (401, "the certificate of short-lived is expired")
    with reach(deployment, own) as client, pytest.raises(httpx.TransportError):
        activate(client, load_key(own / KEY))


def test_fl_request_sent_twice(deployment):
    """Also to a proxy that was killed and started anew, and by another vehicle that has captured it."""
    server = read_ready(deployment.folder).proxy
    one, another = (deployment.folder / VEHICLES / name for name in ("vehicle-001", "vehicle-002"))
    asked = make_request("weather", 2.5, 12, (10.0, -3.0))
    earlier = read_fleet_status(deployment.folder).requests
    send_request(one, server, asked)
    with pytest.raises(InputError, match="a request with this nonce came before"):
        send_request(one, server, asked)
    before = read_processes(deployment.folder)["proxy"]
    os.kill(before, signal.SIGKILL)

    def is_refused():
        try:
            with pytest.raises(InputError, match="a request with this nonce came before"):
                send_request(another, server, asked)
        except OSError:  # the proxy is starting
            return False
        return True

    wait_for(is_refused)
    assert read_processes(deployment.folder)["proxy"] != before
    came = [each for each in read_fleet_status(deployment.folder).requests if each not in earlier]
    assert [(each.vehicle, each.request) for each in came] == [(one.name, asked)]


def test_fl_request_that_is_old_or_none(deployment):
    own = deployment.folder / VEHICLES / "vehicle-001"
    asked = make_request("weather", 2.5, 12, (10.0, -3.0))
    with pytest.raises(InputError, match="the request is 400 s old"):
        send_request(own, read_ready(deployment.folder).proxy, replace(asked, time=asked.time - 400))
    with reach(deployment, own) as client:
        for content in (b"{}", bytes(10**6)):
            assert client.post(PATH, content=content).status_code == 400
    with reach(deployment) as client, pytest.raises(httpx.TransportError):
        client.post(PATH, content=asked.as_bytes())


def test_unregistered(deployment, authority, tmp_path):
    """A certificate that the authority has signed, and that is in no registry: as after a loss of the registry."""
    other = found_authority(tmp_path / "other")
    request = request_certificate(tmp_path / "v", "unknown")
    from flcav.fleet.authority import Authority

    forged = Authority(tmp_path / "other", authority.key, authority.certificate, other.registry)
    take_certificate(tmp_path / "v", forged.register(request), (deployment.folder / AUTHORITY).read_bytes())
    with reach(deployment, tmp_path / "v") as client:
        answer = activate(client, load_key(tmp_path / "v" / KEY))
    assert (answer.status_code, answer.text) == (401, "the certificate is not registered")


def test_another_authority(deployment, tmp_path):
    other = found_authority(tmp_path / "other")
    own = a_vehicle(other, tmp_path / "v", "vehicle-001")
    with reach(deployment, own) as client, pytest.raises(httpx.TransportError):
        activate(client, load_key(own / KEY))
    with reach(deployment, authority=tmp_path / "other") as client, pytest.raises(httpx.ConnectError):
        client.post("/v1/fleet/pull-messages")  # a vehicle of another fleet does not trust this one


def test_call_without_the_certificate(deployment):
    """A vehicle's call is captured, and sent again at once: Flower's signature alone would let it pass for minutes."""
    own = deployment.folder / VEHICLES / "vehicle-001"
    headers, body = signed_headers(load_key(own / KEY)), PullMessagesRequest(node=node_of(deployment, own.name))
    captured = {"url": "/v1/fleet/pull-messages", "headers": headers, "content": body.SerializeToString()}
    for _ in range(2):
        with reach(deployment, own) as client:
            assert client.post(**captured).status_code == 200
    with reach(deployment) as client, pytest.raises(httpx.TransportError):
        client.post(**captured)


def test_call_of_another_vehicle(deployment):
    """The same captured call, on the connection of another registered vehicle."""
    key, body = load_key(deployment.folder / VEHICLES / "vehicle-001" / KEY), PullMessagesRequest()
    body.node.CopyFrom(node_of(deployment, "vehicle-001"))
    with reach(deployment, deployment.folder / VEHICLES / "vehicle-002") as client:
        answer = client.post("/v1/fleet/pull-messages", content=body.SerializeToString(), headers=signed_headers(key))
    assert (answer.status_code, answer.text) == (401, "the node's key is not the certificate's")


def test_recorded_call_of_another_vehicle_beside_the_own_key(deployment):
    """A header that comes twice: the first is another vehicle's, of a recorded call, the last the own certificate's."""
    one, two = (load_key(deployment.folder / VEHICLES / name / KEY) for name in ("vehicle-001", "vehicle-002"))
    recorded, own = signed_headers(one), signed_headers(two)["flwr-public-key"]
    body = PullMessagesRequest(node=node_of(deployment, "vehicle-001")).SerializeToString()
    with reach(deployment, deployment.folder / VEHICLES / "vehicle-002") as client:
        twice = client.post(
            "/v1/fleet/pull-messages", content=body, headers=[*recorded.items(), ("flwr-public-key", own)]
        )
        body_alone = client.post("/v1/fleet/pull-messages", content=body, headers=signed_headers(two))
    assert (twice.status_code, twice.text) == (400, "the header flwr-public-key comes 2 times")
    assert (body_alone.status_code, body_alone.text) == (401, "the node in the body is not the certificate's")


def test_idle_connections_keep_nobody_out(deployment):
    """Of one vehicle, and of strangers before TLS: more than the proxy has room for; another is answered, in time."""
    host, _, port = read_ready(deployment.folder).proxy.rpartition(":")
    proxy = read_processes(deployment.folder)["proxy"]
    context, before = tls_of(deployment.folder / VEHICLES / "vehicle-002", deployment.folder), resident_mb(proxy)
    with contextlib.ExitStack() as stack:
        for number in range(400):
            door = stack.enter_context(socket.create_connection((host, int(port)), 30))
            if number % 5 == 0:
                with contextlib.suppress(OSError):
                    stack.enter_context(context.wrap_socket(door, server_hostname=host))
        assert len(list(Path(f"/proc/{proxy}/fd").iterdir())) < 340
        assert resident_mb(proxy) - before < 60
        own = deployment.folder / VEHICLES / "vehicle-001"
        with reach(deployment, own) as client:
            assert activate(client, load_key(own / KEY)).status_code in (200, 412)
    assert read_processes(deployment.folder)["proxy"] == proxy


def resident_mb(pid):
    """Return the memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.parametrize(
    "path",
    [
        "/v1/control/list-runs",
        "/v1/control/start-run",
        "/v1/runtime/acquire-task",
        "/v1/fleet/register-node",
        "/v1/fleet/../control/list-runs",
        "/v1/fleet/%2e%2e/control/list-runs",
        "/v1/fleet/pull-messages/../../control/list-runs",
        "//v1/control/list-runs",
        "/health",
        "/docs",
    ],
)
def test_control_side(path, deployment):
    own = deployment.folder / VEHICLES / "vehicle-001"
    with reach(deployment, own) as client:
        url = httpx.URL(str(client.base_url).rstrip("/")).copy_with(raw_path=path.encode())
        headers = signed_headers(load_key(own / KEY))
        answer = client.post(url, content=ListRunsRequest().SerializeToString(), headers=headers)
    assert answer.status_code == 403
    assert "is no call of a vehicle's" in answer.text


def ask(deployment, app, signature):
    """Return what a vehicle answers to a message of a run with this app."""
    run = deployment.link.begin(app, signature)
    run.identify()
    node = node_of(deployment, "vehicle-001").node_id
    sent = run.grid.push_messages([Message(RecordDict(), node, MessageType.QUERY)])
    (found,) = wait_for(lambda: [*run.grid.pull_messages(sent)])
    run.end()
    return found


def test_tampered_app(deployment, tmp_path):
    """An app whose signature is of another one, one without a signature, and one that somebody else has signed."""
    mark = tmp_path / "ran"
    evil = superlink.build_bundle(f"open({str(mark)!r}, 'w').close()\n{superlink.CLIENT}")
    superlink.make_publisher(tmp_path)
    for signature in (
        superlink.sign_bundle(deployment.folder, superlink.build_bundle()),
        {},
        superlink.sign_bundle(tmp_path, evil),
    ):
        answer = ask(deployment, evil, signature)
        assert answer.has_error()
        assert answer.error.code == 7  # INVALID_FAB
    assert not mark.exists()


def test_signed_app_runs(deployment, clients, weights):
    """What the tests before have refused does not keep the vehicles from their publisher's app."""
    from flcav.federation.loop import Schedule, federate

    schedule = Schedule(1, 1, 0.1, 0.1, 3)
    expected, found = (federate(clients, weights, schedule, runtime=each).weights for each in (None, deployment))
    np.testing.assert_array_equal(expected["w"], found["w"])
