"""The app of a deployed vehicle: the client app of `federation.client`, with the assignment in the vehicle's folder.

Messages may reach different processes, and a Flower node loses its state when it is killed. The client's state is
therefore in the vehicle's folder, with its last answer: if a request is repeated, since a process on the way was
stopped, the same answer is sent again, and nothing is trained or spent twice.
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
NETWORK = "network.bin"  # file of a client's network (FedMD): DIGEST.network.bin
HEAD = struct.Struct(">32sQ")  # digest of the last request, bytes of the state; then the state and the last answer


@dataclass(frozen=True)
class Assignment:
    """The assignment of a vehicle to a federation: its client, and the rules that it holds the server to.

    Every federation has another name, since a vehicle answers a round once per federation.
    """

    federation: str  # identifier
    client: str  # name, from which the seed of its training is derived
    trainable: Trainable
    strategy: Strategy
    rules: Rules
    secret: Secret | None = field(default=None, repr=False)  # of local noise
    spent: int = 0  # rounds of earlier federations that count against its privacy budget
    state: dict[str, Weights] = field(default_factory=dict)  # client state from earlier rounds, by key

    def save(self, folder: Path) -> None:
        """Write the assignment to a vehicle's folder, and delete states of earlier federations."""
        for path in folder.glob(f"*.{STATE}"):
            path.unlink(missing_ok=True)
        write_private(folder / ASSIGNMENT, pickle.dumps(self))


@lru_cache(maxsize=1)
def _load(path: Path, changed_ns: int, size: int) -> Assignment:
    return pickle.loads(path.read_bytes())  # a file of the vehicle itself


def load_assignment(folder: Path) -> Assignment:
    """Return the assignment of the vehicle in `folder`, from the module in its settings or the file in its folder.

    The file is read once per process, unless it changes. Raises `InputError` where the module has no such client.
    """
    if (folder / SETTINGS).exists() and (named := load_settings(folder).client):
        return load_named("client", named, {}, Assignment)
    found = (folder / ASSIGNMENT).stat()
    return _load(folder / ASSIGNMENT, found.st_mtime_ns, found.st_size)


def load_identity(folder: Path) -> Identity:
    """Return key and certificates of the vehicle in `folder`, for secure aggregation.

    Raises `InputError` where its certificate is missing or not in force.
    """
    check_certificate(folder)
    certificate, authority = (
        x509.load_pem_x509_certificate((folder / name).read_bytes()) for name in (CERTIFICATE, AUTHORITY)
    )
    return Identity(load_key(folder / KEY), certificate, authority)


def preload_assignment(folder: Path) -> None:
    """Read a vehicle's assignment, if there is one, so that forks of this process have it and its modules in memory."""
    with contextlib.suppress(Exception):  # the app reports the error in place of its answer
        load_assignment(folder)


def make_vehicle_app() -> "VehicleApp":
    """Return the app of the vehicle whose folder the environment names."""
    return VehicleApp(Path(os.environ[FOLDER]))


class VehicleApp(ClientApp):
    """A client app that keeps its state and its last answer in a vehicle's folder."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder

    def __call__(self, message: Message, context: Context) -> Message:
        """Return the client's answer, or the last answer where the same request comes again.

        An answer larger than the server's grant is withheld and replaced by an error with the code `OVER_BUDGET`.
        """
        assigned = load_assignment(self._folder)
        clients = {assigned.client: assigned.trainable}
        secrets = {} if assigned.secret is None else {assigned.client: assigned.secret}
        identity = None if assigned.rules.secure is None else load_identity(self._folder)
        app = client_app(
            limit_time(clients, assigned.rules.limits.train_s),
            assigned.strategy,
            assigned.rules,
            secrets,
            assigned.spent,
            identity,
        )
        content = message.content
        grant = None
        if GRANT in content:
            grant = int(content.config_records[GRANT][GRANTED])  # type: ignore[arg-type]
            message.content = RecordDict({key: each for key, each in content.items() if key != GRANT})
        # the digest excludes the grant, which differs when a request is repeated
        digest = RequestDigests(None).digest(message.content)
        last, state, answer = self._read(assigned)
        answered = answer
        digests_before = _digests(state)
        asks_again = message.metadata.message_type == MessageType.TRAIN and last == digest
        if not asks_again:
            here = Context(context.run_id, context.node_id, {PARTITION: 0}, state, {})
            reply = app(message, here)
            if reply.has_error():
                return reply
            answer = reply.content
            # state and answer are one atomic write, before the answer leaves
            if message.metadata.message_type == MessageType.TRAIN:
                self._write(assigned, digest, here.state, answer)
            elif OWN_DIGESTS in answer:
                self._keep_network(here.state, digests_before)
                self._write(assigned, last, here.state, answered)
        if grant is not None and (size := wire_bytes(answer)) > grant:
            return Message(Error(OVER_BUDGET, f"an answer of {size} bytes, and {grant} are left"), reply_to=message)
        return Message(answer, reply_to=message)

    def _read(self, assigned: Assignment) -> tuple[bytes, RecordDict, RecordDict]:
        """Return the digest of the last request, the state after it, and the answer."""
        try:
            data = (self._folder / f"{assigned.federation}.{STATE}").read_bytes()
        except FileNotFoundError:
            state = RecordDict({key: to_array_record(arrays) for key, arrays in assigned.state.items()})
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

    def _keep_network(self, state: RecordDict, before: list[str]) -> None:
        """Write the client's network, whose digest the server gets, for later federations that resume with it.

        before: digests before. The latest of these networks is kept, too: the server may stop before its checkpoint.
        """
        digests = _digests(state)
        write_private(self._folder / f"{digests[0]}.{NETWORK}", pack_records(RecordDict({OWN: state[OWN]})))
        for digest in {*before} - {*digests}:
            (self._folder / f"{digest}.{NETWORK}").unlink(missing_ok=True)

    def _write(self, assigned: Assignment, digest: bytes, state: RecordDict, answer: RecordDict) -> None:
        kept, sent = map(pack_records, (state, answer))
        write_private(self._folder / f"{assigned.federation}.{STATE}", HEAD.pack(digest, len(kept)) + kept + sent)


def _digests(state: RecordDict) -> list[str]:
    """Return the digests of a client's networks that the server has, latest first."""
    return [each.tobytes().hex() for each in read_arrays(state, OWN_DIGESTS).values()] if OWN_DIGESTS in state else []
