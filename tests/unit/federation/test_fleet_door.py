"""The running proxy before a SuperLink that only notes what reaches it: what it passes on, and what it keeps out."""

import base64
import contextlib
import re
import shutil
import socket
import sqlite3
import ssl
import threading
import time

import httpx
import pytest
from flwr.proto.fleet_pb2 import ActivateNodeRequest, DeactivateNodeRequest, PushMessagesRequest
from flwr.proto.message_pb2 import Message, Metadata
from flwr.proto.node_pb2 import Node

from flcav.fleet import mutual_tls, proxy, relay
from flcav.fleet.authority import SERVER, SERVER_KEY, found_authority
from flcav.fleet.keys import AUTHORITY, CERTIFICATE, KEY, request_certificate, take_certificate
from flcav.fleet.mutual_tls import HANDSHAKES, LARGEST_HEADER, OF_EACH, find_superfluous, serve_https
from flcav.fleet.relay import CALLS, FLEET, LARGEST_CALL, MOST_HEADERS, name_key
from flcav.fleet.traffic import read_traffic

NODES = {"cav-1": 11, "cav-2": 22}
REQUIRED = ["host: x", "content-type: application/protobuf"]


async def answer_slowly():
    yield b"done"


class Running:
    """A proxy in a thread, with two vehicles, and what reached the SuperLink."""

    def __init__(self, folder):
        self.authority, self.folder, self.reached = found_authority(folder / "fleet"), folder / "fleet", []
        for name in NODES:
            certificate = self.authority.register(request_certificate(folder / name, name))
            take_certificate(folder / name, certificate, (self.folder / AUTHORITY).read_bytes())
        self.vehicles = {own.name: own for own in self.authority.registry.list_vehicles()}
        for name, node in NODES.items():
            self.authority.registry.set_node(self.vehicles[name].fingerprint, node)
        self.contexts = {}
        for name in NODES:
            self.contexts[name] = ssl.create_default_context(cafile=str(self.folder / AUTHORITY))
            self.contexts[name].load_cert_chain(folder / name / CERTIFICATE, folder / name / KEY)
        link = httpx.AsyncClient(transport=httpx.MockTransport(self._note), base_url="https://link")
        self.app = proxy.FleetProxy(link, self.folder)
        keys = self.folder / SERVER, self.folder / SERVER_KEY, self.folder / AUTHORITY
        self.server = serve_https(self.app, "127.0.0.1", 0, *keys, self.app.find_owner)
        self._thread = threading.Thread(target=self.server.run)

    def _note(self, request):
        self.reached.append(request)
        return httpx.Response(200, content=answer_slowly(), headers={"content-length": "4"})

    def __enter__(self):
        self._thread.start()
        while not self.server.started:
            time.sleep(0.01)
        self.address = self.server.servers[0].sockets[0].getsockname()
        return self

    def __exit__(self, *_):
        self.server.should_exit = True
        self._thread.join()

    def connect(self, name="cav-1"):
        return self.contexts[name].wrap_socket(socket.create_connection(self.address, 10), server_hostname="127.0.0.1")

    def header(self, name="cav-1"):
        return "flwr-public-key: " + name_key(self.vehicles[name])[1].decode()

    def send(self, lines, body=b"", name="cav-1", line=f"POST {FLEET}pull-messages HTTP/1.1"):
        """Return the status and the sentence of the answer to a request written by hand; 0: the connection ended."""
        with self.connect(name) as door:
            head = "\r\n".join([line, *REQUIRED, *lines]) + "\r\n\r\n"
            with contextlib.suppress(OSError):
                door.sendall(head.encode("latin-1") + body)
            return read_answer(door)


def read_answer(door):
    answer, size = b"", None
    with contextlib.suppress(OSError):
        while size is None or len(answer.partition(b"\r\n\r\n")[2]) < int(size[1]):
            if not (piece := door.recv(65536)):
                break
            answer += piece
            size = re.search(rb"content-length: (\d+)\r\n(.*\r\n)*\r\n", answer)
    return int(answer[9:12] or 0), answer.partition(b"\r\n\r\n")[2].decode()


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    with Running(tmp_path_factory.mktemp("door")) as found:
        yield found


@pytest.fixture(autouse=True)
def nothing_before(running):
    running.reached.clear()


def body_of(call, node):
    if call == "deactivate-node":
        return DeactivateNodeRequest(node_id=node).SerializeToString()
    asked = CALLS[call](node=Node(node_id=node))
    if call == "push-messages":
        asked.messages_list.append(Message(metadata=Metadata(src_node_id=node)))  # type: ignore[attr-defined]
    return asked.SerializeToString()


def send_body(running, call, body):
    lines = [running.header(), f"content-length: {len(body)}"]
    return running.send(lines, body, line=f"POST {FLEET}{call} HTTP/1.1")


def test_what_is_passed_on_is_what_was_checked(running):
    body = body_of("pull-messages", 11) + b"\xf8\x07\x01"  # and a field that Flower does not know
    more = ["X-Forwarded-For: 1.2.3.4", "flwr_public_key: x", "Flwr-Timestamp: 2026-01-01", "cookie: a", "accept: */*"]
    line = f"POST {FLEET}%70ull-messages?x=1 HTTP/1.1"
    assert running.send([running.header(), *more, f"content-length: {len(body)}"], body, line=line) == (200, "done")
    (request,) = running.reached
    assert request.url.raw_path.decode() == f"{FLEET}pull-messages"
    assert request.content == body_of("pull-messages", 11)
    protobuf, key = "application/protobuf", name_key(running.vehicles["cav-1"])[1].decode()
    assert dict(request.headers) == {
        **{"host": "link", "connection": "keep-alive", "content-type": protobuf, "accept": protobuf},
        **{"flwr-timestamp": "2026-01-01", "flwr-public-key": key, "content-length": str(len(request.content))},
    }


@pytest.mark.parametrize(
    "lines",
    [
        ["{2}", "{1}"],
        ["{1}", "{2}"],
        ["{1}", "{1}"],
        ["FLWR-Public-Key:{2}", "{1}"],
        ["{1}", "flwr-timestamp: a", "Flwr-Timestamp: a"],
        ["{1}", "host: y"],
        ["{1}", "x-any: a", "x-any: b"],
        ["{1}, {2}"],
        ["{1},{1}"],
        ["{1}\r\n {2}"],
        ["flwr_public_key: {1}"],
        ["flwr-public-key : {1}"],
        [" {1}"],
        ["{2}"],
        ["flwr-public-key: \xe9"],
        ["{1}", "flwr-signature: \xe9"],
        ["{1}", "flwr-signature: a\x01b"],
        ["{1}", "flwr-signature: " + "a" * 600],
        ["{1}", "transfer-encoding: chunked"],
        ["{1}", "content-length: 5", "transfer-encoding: chunked"],
        ["{1}", "content-length: 5", "content-length: 6"],
        ["{1}", "content-type: application/json"],
        [],
    ],
    ids=repr,
)
def test_headers_of_another_vehicle_or_of_two_meanings(lines, running):
    own, other = running.header("cav-1"), running.header("cav-2")
    values = (
        (own, other) if not any(each.startswith(("flwr", "FLWR")) for each in lines[:1]) else (own[17:], other[17:])
    )
    sent = [each.replace("{1}", values[0]).replace("{2}", values[1]) for each in lines]
    told = [] if any("length" in each or "chunked" in each for each in sent) else ["content-length: 5"]
    status, _ = running.send([*sent, *told], body_of("pull-messages", 11)[:5].ljust(5, b"\0"))
    assert status in (400, 401, 411)
    assert running.reached == []


@pytest.mark.parametrize("call", sorted({*CALLS} - {"activate-node"}))
def test_node_in_the_body(call, running):
    assert send_body(running, call, body_of(call, 11)) == (200, "done")
    for other in (body_of(call, 22), b"", body_of(call, 11) + body_of(call, 22)):
        assert send_body(running, call, other) == (401, "the node in the body is not the certificate's")
    assert send_body(running, call, b"\xff\xff") == (400, f"the body is none of {call}")
    assert len(running.reached) == 1


def test_key_and_sender_in_the_body(running):
    one, two = (base64.b64decode(name_key(running.vehicles[name])[1]) for name in NODES)
    asked = [ActivateNodeRequest(public_key=key, heartbeat_interval=30).SerializeToString() for key in (one, two)]
    assert send_body(running, "activate-node", asked[0])[0] == 200
    refused = 401, "the key to activate is not the certificate's"
    assert send_body(running, "activate-node", asked[1]) == send_body(running, "activate-node", b"") == refused
    pushed = PushMessagesRequest(node=Node(node_id=11))
    pushed.messages_list.append(Message(metadata=Metadata(src_node_id=22)))
    assert send_body(running, "push-messages", pushed.SerializeToString())[0] == 401
    assert len(running.reached) == 1


@pytest.mark.parametrize("text", ["a\x1b[2J", "a\nb", "a" * 300, "\u202e"])
def test_identifiers_that_flower_would_log(text, running):
    node, told = Node(node_id=11), "no identifier"
    for call, asked in {
        "get-fab": CALLS["get-fab"](node=node, hash_str=text),
        "pull-messages": CALLS["pull-messages"](node=node, message_ids=["a", text]),
        "push-messages": PushMessagesRequest(
            node=node, messages_list=[Message(metadata=Metadata(src_node_id=11, message_id=text))]
        ),
    }.items():
        status, why = send_body(running, call, asked.SerializeToString())
        assert (status, why.endswith(told)) == (400, True)
    assert running.reached == []


def test_a_vehicle_that_is_not_enrolled_yet_is_to_try_again(running):
    running.authority.registry.set_node(running.vehicles["cav-1"].fingerprint, None)
    assert send_body(running, "pull-messages", b"")[0] == 503
    running.authority.registry.set_node(running.vehicles["cav-1"].fingerprint, 11)


def test_what_is_too_large(running):
    many = [f"x{number}: y" for number in range(MOST_HEADERS)]
    assert running.send([running.header(), *many])[0] == 431
    assert running.send([f"x: {'a' * 3 * LARGEST_HEADER}"])[0] in (0, 400)
    told = 400, f"the message has more than {LARGEST_CALL} bytes"
    assert running.send([running.header(), f"content-length: {LARGEST_CALL + 1}"]) == told
    assert running.reached == []


def test_websocket(running):
    upgrade = ["upgrade: websocket", "connection: upgrade", "sec-websocket-key: dGhl", "sec-websocket-version: 13"]
    status, told = running.send([running.header(), *upgrade], line=f"GET {FLEET}pull-messages HTTP/1.1")
    assert (status, told) == (403, f"GET {FLEET}pull-messages is no call of a vehicle's")


def test_terminal_escapes_are_neither_kept_nor_sent_back(running):
    path = f"{FLEET}%1b]0;owned%07%1b[2J%0avehicle-001:%20online%e2%80%ae{'x' * 500}"
    status, told = running.send([running.header()], line=f"POST {path} HTTP/1.1")
    assert status == 403
    running.app._traffic.save(running.folder)
    for text in (told, *read_traffic(running.folder).refused):
        assert text.isprintable()
        assert len(text) < 250
    assert "\\x1b[2J\\nvehicle-001: online" in told


def ends(door):
    """Return whether the server has ended a connection, and waits for it."""
    try:
        return door.recv(1) == b""
    except ConnectionError:
        return True


@pytest.mark.parametrize("sent", [b"", b"POST / HTTP/1.1\r\nhost: x\r\nx: ", b"GET / HTTP/1.1\r\nhost: x\r\n\r\nGET"])
def test_a_connection_without_a_whole_request_ends(sent, running, monkeypatch):
    monkeypatch.setattr(mutual_tls, "HEADER_S", 0.3)
    with running.connect() as door:
        begun = time.monotonic()
        door.sendall(sent)
        if b"\r\n\r\n" in sent:
            read_answer(door)
        assert ends(door)
        assert time.monotonic() - begun < 4  # uvicorn's own limit of what is kept alive is 5 s


def test_a_body_that_does_not_come(running, monkeypatch):
    monkeypatch.setattr(relay, "QUIET_S", 0.2)
    assert running.send([running.header(), "content-length: 9"], b"a") == (408, "the message does not come")


def test_revoked_while_the_body_comes(running):
    """A call that was begun before is refused when it is whole."""
    own, body = running.vehicles["cav-2"], body_of("pull-messages", 22)
    head = [f"POST {FLEET}pull-messages HTTP/1.1", *REQUIRED, running.header("cav-2"), f"content-length: {len(body)}"]
    with running.connect("cav-2") as door, sqlite3.connect(running.folder / "registry.sqlite") as registry:
        door.sendall(("\r\n".join(head) + "\r\n\r\n").encode())
        time.sleep(0.2)
        registry.execute("UPDATE certificates SET state = 'revoked' WHERE fingerprint = ?", (own.fingerprint,))
        registry.commit()
        door.sendall(body)
        assert read_answer(door) == (401, "the certificate of cav-2 is revoked")
        registry.execute("UPDATE certificates SET state = 'registered' WHERE fingerprint = ?", (own.fingerprint,))
    assert running.reached == []


def test_too_many_connections_of_one_vehicle_and_without_a_certificate(running):
    """The oldest give way, and another vehicle is answered at once."""
    with contextlib.ExitStack() as stack:
        doors = [stack.enter_context(running.connect()) for _ in range(OF_EACH + 2)]
        assert [ends(door) for door in doors[:2]] == [True, True]
        plain = [socket.create_connection(running.address, 10) for _ in range(HANDSHAKES + 20)]
        for each in plain:
            stack.enter_context(each)
        assert running.send([running.header("cav-2")], name="cav-2")[0] == 401
        assert [ends(each) for each in plain[:10]] == [True] * 10
        last = doors[-1]
        last.sendall(f"POST {FLEET}x HTTP/1.1\r\nhost: x\r\n\r\n".encode())
        assert read_answer(last)[0] == 403


def test_who_gives_way():
    owners = {1: "a", 2: "b", 3: "a", 4: "c"}
    assert find_superfluous({}, 0, 0) is None
    assert find_superfluous(owners, 2, 4) is None
    assert find_superfluous(owners, 1, 4) == find_superfluous(owners, 2, 3) == 1
    assert find_superfluous({1: "b", 2: "a", 3: "a"}, 1, 9) == 2


@pytest.mark.parametrize("how", ["none", "text", "zeros", "no table", "a cell"])
def test_a_damaged_registry_closes_calls_until_it_is_restored(how, running, tmp_path):
    path, body = running.folder / "registry.sqlite", body_of("pull-messages", 11)
    asked = [running.header(), f"content-length: {len(body)}"]
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    shutil.copy(path, tmp_path / "kept")
    shutil.copy(path, tmp_path / "damaged")
    with contextlib.closing(sqlite3.connect(tmp_path / "damaged", isolation_level=None)) as connection:
        if how == "no table":
            connection.execute("DROP TABLE certificates")
        if how == "a cell":
            connection.execute("UPDATE certificates SET node = 'x', expires = 'y'")
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    if how in ("text", "zeros"):
        (tmp_path / "damaged").write_bytes(b"none" if how == "text" else bytes(4096))
    path.unlink() if how == "none" else (tmp_path / "damaged").replace(path)
    for _ in range(2):
        assert running.send(asked, body) == (503, "the fleet's registry cannot be read")
    (tmp_path / "kept").replace(path)
    assert running.send(asked, body) == (200, "done")
