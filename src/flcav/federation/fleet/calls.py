"""Calls of Flower's nodes as the proxy passes them on: checked against a vehicle's certificate, and written anew.

Flower reads the first of repeated headers, and believes the node id in a body. So nothing that a vehicle sent is passed
on as it came: of the headers those in `HEADERS`, each once, the public key being the registry's; of the body what was
parsed.
"""

import re
from base64 import b64encode
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from flwr.proto.fab_pb2 import GetFabRequest
from flwr.proto.fleet_pb2 import (
    ActivateNodeRequest,
    DeactivateNodeRequest,
    PullMessagesRequest,
    PushMessagesRequest,
)
from flwr.proto.heartbeat_pb2 import SendNodeHeartbeatRequest
from flwr.proto.message_pb2 import ConfirmMessageReceivedRequest, PullObjectRequest, PushObjectRequest
from flwr.proto.run_pb2 import GetRunRequest
from google.protobuf.message import DecodeError, Message

from flcav.federation.fleet.keys import public_pem
from flcav.federation.fleet.registry import Vehicle
from flcav.federation.fleet.relay import Refused

FLEET = "/v1/fleet/"
CALLS: Mapping[str, type[Message]] = {
    "activate-node": ActivateNodeRequest,
    "deactivate-node": DeactivateNodeRequest,
    "send-node-heartbeat": SendNodeHeartbeatRequest,
    "pull-messages": PullMessagesRequest,
    "push-messages": PushMessagesRequest,
    "get-run": GetRunRequest,
    "get-fab": GetFabRequest,
    "push-object": PushObjectRequest,
    "pull-object": PullObjectRequest,
    "confirm-message-received": ConfirmMessageReceivedRequest,
}  # of a node; registering one is the authority's
NODE_KEY = b"flwr-public-key"  # PEM in base 64
SIGNED_AT = b"flwr-timestamp"  # when the node signed
SENT = (SIGNED_AT, b"flwr-signature", b"flwr-package-name", b"flwr-package-version", b"flwr-component-name")
PROTOBUF = ((b"content-type", b"application/protobuf"), (b"accept", b"application/protobuf"))
VALUE = re.compile(rb"[!-~](?:[ -~]{0,510}[!-~])?")  # of a header
MOST_HEADERS = 40
LONGEST_NAME = 200  # characters of an identifier in a body
LARGEST_OBJECT, LARGEST_CALL = 16_000_000, 4_000_000  # bytes of a body; Flower cuts arrays into pieces of 5 MiB

Headers = Sequence[tuple[bytes, bytes]]


def check_headers(headers: Headers) -> dict[bytes, bytes]:
    """Return headers by their names in lower case; raises `Refused` for repeated ones, or a body of unknown length."""
    if len(headers) > MOST_HEADERS:
        raise Refused(431, f"more than {MOST_HEADERS} headers")
    name, count = Counter(name.lower() for name, _ in headers).most_common(1)[0] if headers else (b"", 0)
    if count > 1:
        raise Refused(400, f"the header {name.decode('latin-1')} comes {count} times")
    found = {name.lower(): value for name, value in headers}
    if b"transfer-encoding" in found:
        raise Refused(411, "the length of the body is wanted before it")
    return found


def largest_body(call: str) -> int:
    """Return how many bytes the body of a call may have."""
    return LARGEST_OBJECT if call == "push-object" else LARGEST_CALL


def choose_headers(headers: Mapping[bytes, bytes], names: Iterable[bytes] = SENT) -> list[tuple[bytes, bytes]]:
    """Return the headers that are passed on, of these `names`; raises `Refused` for a value that is not plain ASCII."""
    if headers.get(b"content-type", b"") != PROTOBUF[0][1]:
        raise Refused(415, "a body of another type than application/protobuf")
    chosen = [(name, headers[name]) for name in names if name in headers]
    for name, value in chosen:
        if not VALUE.fullmatch(value):
            raise Refused(400, f"the header {name.decode()} is no plain text, or too long")
    return [*PROTOBUF, *chosen]


def name_key(vehicle: Vehicle) -> tuple[bytes, bytes]:
    """Return Flower's header of a vehicle's key, as the registry has it."""
    return NODE_KEY, b64encode(public_pem(vehicle.public_key))


def check_body(call: str, body: bytes, vehicle: Vehicle) -> bytes:
    """Return the body of a vehicle's call written anew.

    Raises `Refused` where it is of another call, or names another node or key than the vehicle's own.
    """
    try:
        asked = CALLS[call].FromString(body)
    except DecodeError:
        raise Refused(400, f"the body is none of {call}") from None
    asked.DiscardUnknownFields()
    _check_texts(asked)
    if isinstance(asked, ActivateNodeRequest):
        if asked.public_key != public_pem(vehicle.public_key):
            raise Refused(401, "the key to activate is not the certificate's")
        return asked.SerializeToString()
    if vehicle.node is None:
        raise Refused(503, "the vehicle is being enrolled")
    node = asked if isinstance(asked, DeactivateNodeRequest) else asked.node  # type: ignore[attr-defined]
    named = {node.node_id}
    if isinstance(asked, PushMessagesRequest):
        for message in asked.messages_list:
            _check_texts(message.metadata)
            named.add(message.metadata.src_node_id)
    if named != {vehicle.node}:
        raise Refused(401, "the node in the body is not the certificate's")
    return asked.SerializeToString()


def _check_texts(message: Message) -> None:
    """Refuse identifiers that are none, which Flower would write to its log."""
    for field, value in message.ListFields():
        texts = [value] if isinstance(value, str) else value if field.type == field.TYPE_STRING else ()
        if not all(text.isprintable() and len(text) <= LONGEST_NAME for text in texts):
            raise Refused(400, f"{field.name} is no identifier")
