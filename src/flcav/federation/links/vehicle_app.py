"""The app of a deployed vehicle: the client app of `federation.client`, with the assignment in the vehicle's folder.

Every message may find another process, and Flower's node forgets all when it is killed. So what the client keeps is in
the vehicle's folder, with its last answer: where the same request comes again, after a process on its way was stopped,
the same answer goes out, and nothing is trained or spent twice.
"""

import contextlib
import os
import pickle
import struct
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from cryptography import x509
from flwr.app import Context, Error, Message, MessageType, RecordDict
from flwr.clientapp import ClientApp

from flcav.config import InputError
from flcav.federation.client import OWN, OWN_DIGESTS, PARTITION, client_app
from flcav.federation.conduct import RequestDigests
from flcav.federation.links.in_process import limit_time, wire_bytes
from flcav.federation.privacy import Secret
from flcav.federation.rules import Rules
from flcav.federation.secure.parties import Identity
from flcav.federation.strategies import Strategy
from flcav.federation.trainable import Trainable, Weights
from flcav.federation.wire import (
    GRANT,
    GRANTED,
    OVER_BUDGET,
    pack_records,
    read_arrays,
    to_array_record,
    unpack_records,
)
from flcav.fleet.keys import AUTHORITY, CERTIFICATE, KEY, check_certificate, load_key, write_private
from flcav.fleet.vehicle import FOLDER, SETTINGS, load_settings
from flcav.plugins import load_named

ASSIGNMENT, STATE = "assignment.pickle", "state.bin"
NETWORK = "network.bin"  # ends the name of a file with a client's own network, which begins with its digest
HEAD = struct.Struct(">32sQ")  # digest of the last request, bytes of the state; then the state and the last answer


@dataclass(frozen=True)
class Assignment:
    """What a vehicle takes part in: its own data, and the rules that it holds the server to.

    The name of the federation is another one in each: a round is answered once in a federation.
    """

    federation: str  # identifier
    client: str  # name, of which the seed of its training is derived
    trainable: Trainable
    strategy: Strategy
    rules: Rules
    secret: Secret | None = field(default=None, repr=False)  # that local noise is drawn by
    spent: int = 0  # rounds of earlier federations that count against its privacy budget
    state: dict[str, Weights] = field(default_factory=dict)  # what it has kept from earlier rounds

    def save(self, folder: Path) -> None:
        """Write it to a vehicle's folder, without what is left there of earlier federations."""
        for path in folder.glob(f"*.{STATE}"):
            path.unlink(missing_ok=True)
        write_private(folder / ASSIGNMENT, pickle.dumps(self))


@lru_cache(maxsize=1)
def _load(path: Path, changed_ns: int, size: int) -> Assignment:
    return pickle.loads(path.read_bytes())  # the vehicle's own file


def load_assignment(folder: Path) -> Assignment:
    """Return the assignment of the vehicle in `folder`: that of its own module, or the file in its folder.

    It is read once a process, unless it has changed. Raises `InputError` where its own client is none.
    """
    if (folder / SETTINGS).exists() and (own := load_settings(folder).client):
        return load_named("client", own, {}, Assignment)
    found = (folder / ASSIGNMENT).stat()
    return _load(folder / ASSIGNMENT, found.st_mtime_ns, found.st_size)


def load_identity(folder: Path) -> Identity:
    """Return key and certificates of the vehicle in `folder`, by which it masks updates.

    Raises `InputError` where it has none that are in force.
    """
    check_certificate(folder)
    own, authority = (x509.load_pem_x509_certificate((folder / name).read_bytes()) for name in (CERTIFICATE, AUTHORITY))
    return Identity(load_key(folder / KEY), own, authority)


def preload_assignment(folder: Path) -> None:
    """Read a vehicle's assignment, if there is one, so that forks of this process have it, and the modules it needs."""
    with contextlib.suppress(Exception):  # the app says what is wrong, in the place of its answer
        load_assignment(folder)


def make_vehicle_app() -> "VehicleApp":
    """Return the app of the vehicle whose folder the environment names."""
    return VehicleApp(Path(os.environ[FOLDER]))


class VehicleApp(ClientApp):
    """Client app that keeps its state and its last answer in a vehicle's folder."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder

    def __call__(self, message: Message, context: Context) -> Message:
        """Return the client's answer, the last one again where it was asked the same.

        An answer over the bytes that the server grants is kept: it is an error of code `OVER_BUDGET` instead.
        """
        own = load_assignment(self._folder)
        clients = {own.client: own.trainable}
        secrets = {} if own.secret is None else {own.client: own.secret}
        identity = None if own.rules.secure is None else load_identity(self._folder)
        app = client_app(
            limit_time(clients, own.rules.limits.train_s), own.strategy, own.rules, secrets, own.spent, identity
        )
        content, grant = message.content, None
        if GRANT in content:
            grant = int(content.config_records[GRANT][GRANTED])  # type: ignore[arg-type]
            message.content = RecordDict({key: each for key, each in content.items() if key != GRANT})
        digest = RequestDigests(None).digest(message.content)
        last, state, answer = self._read(own)
        answered, told = answer, _digests(state)
        asks_again = message.metadata.message_type == MessageType.TRAIN and last == digest
        if not asks_again:
            here = Context(context.run_id, context.node_id, {PARTITION: 0}, state, {})
            reply = app(message, here)
            if reply.has_error():
                return reply
            answer = reply.content
            if message.metadata.message_type == MessageType.TRAIN:
                self._write(own, digest, here.state, answer)
            elif OWN_DIGESTS in answer:
                self._keep_network(here.state, told)
                self._write(own, last, here.state, answered)
        if grant is not None and (size := wire_bytes(answer)) > grant:
            return Message(Error(OVER_BUDGET, f"an answer of {size} bytes, and {grant} are left"), reply_to=message)
        return Message(answer, reply_to=message)

    def _read(self, own: Assignment) -> tuple[bytes, RecordDict, RecordDict]:
        """Return the digest of the last request, the state after it and the answer."""
        try:
            data = (self._folder / f"{own.federation}.{STATE}").read_bytes()
        except FileNotFoundError:
            state = RecordDict({key: to_array_record(arrays) for key, arrays in own.state.items()})
            if digests := _digests(state):
                network = self._folder / f"{digests[0]}.{NETWORK}"
                if not network.exists():
                    raise InputError("its network of the last round is no longer in the vehicle's folder") from None
                state[OWN] = unpack_records(network.read_bytes())[OWN]
            return b"", state, RecordDict()
        digest, size = HEAD.unpack_from(data)
        parts = data[HEAD.size : HEAD.size + size], data[HEAD.size + size :]
        state, answer = map(unpack_records, parts)
        return digest, state, answer

    def _keep_network(self, state: RecordDict, told: list[str]) -> None:
        """Write the client's network, of which the server gets the digest, for later federations that resume with it.

        told: digests before. Of those the last one is kept, too: the server may be stopped before it has a checkpoint.
        """
        digests = _digests(state)
        write_private(self._folder / f"{digests[0]}.{NETWORK}", pack_records(RecordDict({OWN: state[OWN]})))
        for digest in {*told} - {*digests}:
            (self._folder / f"{digest}.{NETWORK}").unlink(missing_ok=True)

    def _write(self, own: Assignment, digest: bytes, state: RecordDict, answer: RecordDict) -> None:
        kept, sent = map(pack_records, (state, answer))
        write_private(self._folder / f"{own.federation}.{STATE}", HEAD.pack(digest, len(kept)) + kept + sent)


def _digests(state: RecordDict) -> list[str]:
    """Return the digests of a client's networks that the server has got, the last one first."""
    return [each.tobytes().hex() for each in read_arrays(state, OWN_DIGESTS).values()] if OWN_DIGESTS in state else []
