"""Messages of secure aggregation: the client's replies, and the server's side of a round."""

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from cryptography import x509
from flwr.app import ConfigRecord, Context, Message, RecordDict

from flcav.config import shorten
from flcav.federation import wire
from flcav.federation.acceptance import ReplyRefused, read_entry
from flcav.federation.rules import SecureAggregation
from flcav.federation.secure.parties import (
    SEALED_BYTES,
    Identity,
    PublicKeys,
    SecureClient,
    SignedKeys,
    check_certified,
    find_liars,
    find_vehicle,
    unmask_sum,
)
from flcav.federation.secure.primitives import SHARE_BYTES, Vector, add_vectors, is_public_key
from flcav.federation.trainable import Weights

SURVIVORS, DROPPED, THRESHOLD = "survivors", "dropped", "threshold"  # entries of the server's messages
SECRETS = "secrets"  # record of a node's state: the `SecureClient` of a round

AnswerT = TypeVar("AnswerT")


class ExchangeStep(Protocol):
    """The exchange of one step of the protocol: requests to clients, and their parsed replies."""

    def __call__(
        self, asks: Mapping[str, ConfigRecord], read: Callable[[str, RecordDict], AnswerT]
    ) -> dict[str, AnswerT]:
        """Return `read`(name, reply) by client, for clients with a valid reply."""
        ...


class TooFewClients(OSError):
    """Fewer clients are left than secure aggregation needs."""

    reached: Weights | None = None  # weights after the last completed round; set by `federate`


def answer_secretly(
    message: Message, context: Context, name: str, how: SecureAggregation, round_: int, identity: Identity | None = None
) -> Message:
    """Return a client's reply to the server's request for keys, for shares, or to unmask.

    identity: with which the client signs its keys of the round; it then only accepts keys of certified peers; None: it
    has no authority. Raises ValueError for a request that would reveal more than `how` and the protocol allow.
    """
    asked = message.content.config_records[wire.ASK]
    if asked[wire.ASK] == wire.KEYS:
        client = SecureClient.draw(name)
        record = ConfigRecord({wire.CIPHERS: client.keys.cipher, wire.MASKS: client.keys.mask})
        if identity is not None:
            record[wire.CERTIFICATES], record[wire.SIGNATURES] = identity.sign(name, round_, client.keys)
    elif asked[wire.ASK] == wire.SHARES:
        client = _recall(context)
        peers = _peers(asked)
        threshold = _number(asked[THRESHOLD])
        if identity is not None:
            check_certified(identity.authority, round_, _signed(asked, peers))
        if threshold < (needed := how.needed(len(peers), certified=identity is not None)):
            raise ValueError(f"a threshold of {threshold} of {len(peers)} clients: {needed} are agreed on")
        sealed = client.share(peers, threshold)
        record = ConfigRecord({wire.NAMES: [*sealed], wire.SHARES: [*sealed.values()]})
    else:
        client = _recall(context)
        shares = client.reveal(_strings(asked[SURVIVORS]), _strings(asked[DROPPED]))
        record = ConfigRecord({wire.NAMES: [*shares], wire.SHARES: [*shares.values()]})
    _keep(context, client)
    return Message(RecordDict({wire.ASK: record}), reply_to=message)


def complain(message: Message, context: Context) -> Message | None:
    """Return a client's complaint about shares in the request that do not open; None if all open."""
    client = _recall(context)
    odd = client.take(_named(message.content.config_records[wire.ASK]))
    _keep(context, client)
    return Message(RecordDict({wire.ASK: ConfigRecord({wire.NAMES: odd})}), reply_to=message) if odd else None


def mask_update(context: Context, update: Vector) -> Vector:
    """Return a client's masked update, after it has opened the shares of its peers."""
    return _recall(context).mask(update)


class SecureSum:
    """The server's side of secure aggregation in one round: its requests, and the unmasked sum."""

    def __init__(
        self, exchange: ExchangeStep, threshold: int, round_: int, authority: x509.Certificate | None = None
    ) -> None:
        """Talk to clients by `exchange`; `threshold` of them must be left at every step.

        authority: certificate of the clients' authority; None: keys of the round are not signed.
        """
        self._exchange, self._threshold, self._round, self._authority = exchange, threshold, round_, authority
        self._keys: dict[str, PublicKeys] = {}
        self._peers: list[str] = []

    def agree(self, chosen: list[str]) -> dict[str, ConfigRecord]:
        """Exchange keys and shares among the chosen clients; return the request for a masked update, by client left.

        Raises `TooFewClients`.
        """
        signed, vehicles = dict[str, SignedKeys](), dict[str, str]()

        def read(name: str, content: RecordDict) -> PublicKeys:
            found = read_keys(content)
            if self._authority is not None:
                try:
                    vehicle = find_vehicle(self._authority, self._round, name, found)
                except ValueError as error:
                    raise ReplyRefused(str(error)) from None
                if (other := vehicles.setdefault(vehicle, name)) != name:
                    raise ReplyRefused(f"keys of the vehicle of {other}")
                signed[name] = found
            return found[0]

        self._keys = self._exchange({name: ConfigRecord({wire.ASK: wire.KEYS}) for name in chosen}, read)
        self._check(len(self._keys), "sent keys")
        ask = {
            wire.ASK: wire.SHARES,
            wire.NAMES: [*self._keys],
            wire.CIPHERS: [keys.cipher for keys in self._keys.values()],
            wire.MASKS: [keys.mask for keys in self._keys.values()],
            THRESHOLD: self._threshold,
        }
        if signed:
            ask |= {
                wire.CERTIFICATES: [each[1] for each in signed.values()],
                wire.SIGNATURES: [each[2] for each in signed.values()],
            }
        sealed = self._exchange(
            dict.fromkeys(self._keys, ConfigRecord(ask)),
            lambda name, content: read_shares(content, [each for each in self._keys if each != name], SEALED_BYTES),
        )
        self._peers = [*sealed]
        self._check(len(sealed), "shared their secrets")
        asks = {}
        for name in sealed:
            others = [other for other in sealed if other != name]
            shares = [sealed[other][name] for other in others]
            asks[name] = ConfigRecord({wire.ASK: wire.MASKED, wire.NAMES: others, wire.SHARES: shares})
        return asks

    @property
    def peers(self) -> list[str]:
        """Return the clients that share masks; their number determines the step of the fixed-point numbers."""
        return self._peers

    def finish(self, masked: Mapping[str, Vector]) -> tuple[Vector, dict[str, str]]:
        """Return the sum of the `masked` updates, by client, and the clients that revealed wrong shares, with reasons.

        Raises `TooFewClients`, and `SumLost` where wrong shares make the sum unrecoverable.
        """
        survivors = [*masked]
        dropped = [name for name in self._peers if name not in masked]
        self._check(len(survivors), "sent an update")
        ask = ConfigRecord({wire.ASK: wire.UNMASK, SURVIVORS: survivors, DROPPED: dropped})
        shares = self._exchange(
            dict.fromkeys(survivors, ask),
            lambda _, content: read_shares(content, [*survivors, *dropped], SHARE_BYTES),
        )
        self._check(len(shares), "helped to unmask the sum")
        about = add_vectors(masked.values()), self._keys, survivors, dropped
        # wrong shares are only searched for where the sum does not come out: that takes much longer
        try:
            return unmask_sum(*about, shares), {}
        except OverflowError:
            liars = find_liars(self._keys, shares, self._threshold)
            return unmask_sum(*about, {name: each for name, each in shares.items() if name not in liars}), liars

    def _check(self, left: int, did: str) -> None:
        if left < self._threshold:
            raise TooFewClients(f"secure aggregation: {left} clients {did}, and {self._threshold} are needed")


def _keep(context: Context, client: SecureClient) -> None:
    fields: dict[str, Any] = {**vars(client), "keys": vars(client.keys)}
    fields["peers"] = {name: vars(keys) for name, keys in client.peers.items()}
    text = json.dumps(fields, default=lambda secret: base64.b64encode(secret).decode())
    context.state[SECRETS] = ConfigRecord({SECRETS: text})


def _recall(context: Context) -> SecureClient:
    fields = json.loads(str(context.state.config_records[SECRETS][SECRETS]))
    for name in ("cipher", "private", "seed", "own_shares"):
        fields[name] = base64.b64decode(fields[name])

    def keys(values: Mapping[str, str]) -> PublicKeys:
        return PublicKeys(**{name: base64.b64decode(value) for name, value in values.items()})

    fields["keys"] = keys(fields["keys"])
    fields["peers"] = {name: keys(values) for name, values in fields["peers"].items()}
    fields["opened"] = {name: base64.b64decode(value) for name, value in fields["opened"].items()}
    return SecureClient(**fields)


def _named(record: ConfigRecord) -> dict[str, bytes]:
    shares: Any = record[wire.SHARES]
    return dict(zip(_strings(record[wire.NAMES]), shares, strict=True))


def _peers(record: ConfigRecord) -> dict[str, PublicKeys]:
    ciphers: Any = record[wire.CIPHERS]
    masks: Any = record[wire.MASKS]
    each = zip(_strings(record[wire.NAMES]), ciphers, masks, strict=True)
    return {name: PublicKeys(cipher, mask) for name, cipher, mask in each}


def _signed(record: ConfigRecord, peers: Mapping[str, PublicKeys]) -> dict[str, SignedKeys]:
    given: Any = (record.get(kind, [b""] * len(peers)) for kind in (wire.CERTIFICATES, wire.SIGNATURES))
    return {name: (keys, *proof) for (name, keys), *proof in zip(peers.items(), *given, strict=True)}


def _strings(value: Any) -> list[str]:
    return [str(each) for each in value]


def _number(value: Any) -> int:
    return int(value)


def read_keys(content: RecordDict) -> SignedKeys:
    """Return a client's public keys of a round, with certificate and signature, which are not verified here.

    Both are empty where the client has no authority. Raises `ReplyRefused`.
    """
    found = PublicKeys(*(read_entry(content, kind) for kind in (wire.CIPHERS, wire.MASKS)))
    if not (is_public_key(found.cipher) and is_public_key(found.mask)):
        raise ReplyRefused("keys that nobody can agree on a secret with")
    certificate, signature = (read_entry(content, kind) or b"" for kind in (wire.CERTIFICATES, wire.SIGNATURES))
    if not isinstance(certificate, bytes) or not isinstance(signature, bytes):
        raise ReplyRefused("a certificate or a signature that is not in bytes")
    return found, certificate, signature


def read_shares(content: RecordDict, owners: Sequence[str], size: int) -> dict[str, bytes]:
    """Return the shares of `size` bytes in a reply, one per name in `owners`; raises `ReplyRefused`."""
    names, shares = read_entry(content, wire.NAMES), read_entry(content, wire.SHARES)
    if not isinstance(names, list) or not isinstance(shares, list) or len(names) != len(shares):
        raise ReplyRefused(f"no shares by name, but {shorten(names)}")
    found = dict(zip(names, shares, strict=True))
    if found.keys() != {*owners} or len(names) != len(owners):
        raise ReplyRefused(f"{len(names)} shares, of {shorten(names)}, where {len(owners)} were asked for")
    if odd := [name for name, share in found.items() if not isinstance(share, bytes) or len(share) != size]:
        raise ReplyRefused(f"a share of {odd[0]} that is not of {size} bytes")
    return found
