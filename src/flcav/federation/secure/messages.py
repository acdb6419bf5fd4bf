"""Messages of secure aggregation: the client's answers, and the server's side of a round."""

import base64
import json
from collections.abc import Callable, Mapping
from typing import Any

from flwr.app import ConfigRecord, Context, Message, RecordDict

from flcav.federation.records import ASK
from flcav.federation.secure.masks import Vector, add_vectors
from flcav.federation.secure.parties import PublicKeys, SecureClient, unmask_sum

KEYS, SHARES, MASKED, UNMASK = "keys", "shares", "masked", "unmask"  # what the server asks for, in this order
NAMES, SURVIVORS, DROPPED, THRESHOLD, CIPHERS, MASKS = "names", "survivors", "dropped", "threshold", "ciphers", "masks"
SECRETS = "secrets"  # record of a node's state: the client's own part of a round

Exchange = Callable[[Mapping[str, ConfigRecord]], dict[str, ConfigRecord]]  # asks by client; answers of those who did


class TooFewClients(OSError):
    """Fewer clients are left than secure aggregation needs."""


def answer_secretly(message: Message, context: Context, name: str) -> Message:
    """Return a client's answer to the server's request for keys, shares, or shares of others."""
    asked = message.content.config_records[ASK]
    if asked[ASK] == KEYS:
        client = SecureClient.draw(name)
        record = ConfigRecord({CIPHERS: client.keys.cipher, MASKS: client.keys.mask})
    elif asked[ASK] == SHARES:
        client = _recall(context)
        peers = _peers(asked)
        sealed = client.share(peers, _number(asked[THRESHOLD]))
        record = ConfigRecord({NAMES: [*sealed], SHARES: [*sealed.values()]})
    else:
        client = _recall(context)
        shares = client.reveal(_strings(asked[SURVIVORS]), _strings(asked[DROPPED]))
        record = ConfigRecord({NAMES: [*shares], SHARES: [*shares.values()]})
    _keep(context, client)
    return Message(RecordDict({ASK: record}), reply_to=message)


def mask_update(message: Message, context: Context, update: Vector) -> Vector:
    """Return a client's update with its masks, from the shares that the server passed on with its request."""
    asked, client = message.content.config_records[ASK], _recall(context)
    masked = client.mask(update, _named(asked))
    _keep(context, client)
    return masked


class SecureSum:
    """The server's side of one round: what it has to ask for, and the sum in the end."""

    def __init__(self, exchange: Exchange, threshold: int) -> None:
        """Ask clients by `exchange`; `threshold` of them have to be left at every step."""
        self._exchange, self._threshold = exchange, threshold
        self._keys: dict[str, PublicKeys] = {}
        self._peers: list[str] = []

    def agree(self, chosen: list[str]) -> dict[str, ConfigRecord]:
        """Exchange keys and shares among the chosen clients; return what each that is left is asked when it trains.

        Raises `TooFewClients`.
        """
        answers = self._exchange({name: ConfigRecord({ASK: KEYS}) for name in chosen})
        self._keys = {name: PublicKeys(_bytes(each[CIPHERS]), _bytes(each[MASKS])) for name, each in answers.items()}
        self._check(len(self._keys), "sent keys")
        ask = {
            ASK: SHARES,
            NAMES: [*self._keys],
            CIPHERS: [keys.cipher for keys in self._keys.values()],
            MASKS: [keys.mask for keys in self._keys.values()],
            THRESHOLD: self._threshold,
        }
        answers = self._exchange({name: ConfigRecord(ask) for name in self._keys})
        sealed = {name: _named(each) for name, each in answers.items()}
        self._peers = [*sealed]
        self._check(len(sealed), "shared their secrets")
        asks = {}
        for name in sealed:
            others = [other for other in sealed if other != name]
            shares = [sealed[other][name] for other in others]
            asks[name] = ConfigRecord({ASK: MASKED, NAMES: others, SHARES: shares})
        return asks

    @property
    def peers(self) -> int:
        """Return the number of clients that mask their updates in common, which fixes the step of their integers."""
        return len(self._peers)

    def finish(self, masked: Mapping[str, Vector]) -> Vector:
        """Return the sum of the updates of those clients who sent theirs, `masked`; raises `TooFewClients`."""
        survivors = [*masked]
        dropped = [name for name in self._peers if name not in masked]
        self._check(len(survivors), "sent an update")
        ask = ConfigRecord({ASK: UNMASK, SURVIVORS: survivors, DROPPED: dropped})
        answers = self._exchange(dict.fromkeys(survivors, ask))
        self._check(len(answers), "helped to unmask the sum")
        shares = {name: _named(answer) for name, answer in answers.items()}
        return unmask_sum(add_vectors(masked.values()), self._keys, survivors, dropped, shares)

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
    fields["sealed"] = {name: base64.b64decode(value) for name, value in fields["sealed"].items()}
    return SecureClient(**fields)


def _named(record: ConfigRecord) -> dict[str, bytes]:
    shares: Any = record[SHARES]
    return dict(zip(_strings(record[NAMES]), shares, strict=True))


def _peers(record: ConfigRecord) -> dict[str, PublicKeys]:
    ciphers: Any = record[CIPHERS]
    masks: Any = record[MASKS]
    each = zip(_strings(record[NAMES]), ciphers, masks, strict=True)
    return {name: PublicKeys(cipher, mask) for name, cipher, mask in each}


def _strings(value: Any) -> list[str]:
    return [str(each) for each in value]


def _number(value: Any) -> int:
    return int(value)


def _bytes(value: Any) -> bytes:
    return bytes(value)
