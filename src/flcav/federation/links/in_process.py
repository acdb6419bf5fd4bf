"""A Flower grid within one process: a message reaches the client app by a function call, without sockets or daemons.

Uses private parts of Flower (pinned to 1.42): the process-wide task identity, the empty run record, the id of a
message, and the serialised form of a record and of an array. Those of a deployment are in `fleet.superlink`. A training
in this process cannot be interrupted: a client that exceeds its time limit is left behind in a thread (`limit_time`).
"""

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from flwr.app import Array, ArrayRecord, ConfigRecord, Context, Message, MessageType, MetricRecord, RecordDict
from flwr.app.user_config import UserConfig
from flwr.clientapp import ClientApp
from flwr.common.serde import recorddict_to_proto
from flwr.proto.recorddict_pb2 import Array as ProtoArray
from flwr.serverapp import Grid
from flwr.supercore.run import Run
from flwr.supercore.task_identity import TaskIdentity

from flcav.federation.client import PARTITION
from flcav.federation.rules import Rules
from flcav.federation.state import ClientStates
from flcav.federation.trainable import (
    LocalUpdate,
    Trainable,
    Update,
    Weights,
    answer_question,
    count_samples,
    learned_names,
)
from flcav.federation.upload import Upload
from flcav.federation.wire import (
    ARRAYS,
    EXTRA,
    LOSS,
    METRICS,
    SAMPLES,
    encode_update,
    read_arrays,
    refuse_request,
    to_array_record,
)
from flcav.network.ledger import BudgetExceeded

RUN_ID, SERVER_NODE = 1, 1
FIRST_NODE = 2  # id of the first client
WHOLE = Upload()  # whole updates
UNMETERED = "messages of a federation go by send_and_receive"


def wire_bytes(content: RecordDict) -> int:
    """Return the size of a message's content in Flower's serialisation [bytes].

    Arrays are counted by the rules of Protocol Buffers, since serialising a large network takes longer than a local
    step. A field is its tag, its length and its content; empty ones are left out, but for records.
    """
    others, total = RecordDict(), 0
    for key, record in content.items():
        if not isinstance(record, ArrayRecord):
            others[key] = record
        else:
            arrays = sum(_nested(_text(name) + _nested(_array_bytes(array))) for name, array in record.items())
            total += _nested(_text(key) + _nested(arrays))
    return total + recorddict_to_proto(others).ByteSize()


def _array_bytes(array: Array) -> int:
    head = ProtoArray(dtype=array.dtype, shape=array.shape, stype=array.stype).ByteSize()
    return head + (_nested(len(array.data)) if array.data else 0)


def _text(text: str) -> int:
    return _nested(len(text.encode())) if text else 0


def _nested(length: int) -> int:
    """Return the bytes of a field of this length: its tag, its length in groups of seven bits, and itself."""
    return 1 + max(1, -(-length.bit_length() // 7)) + length


def update_bytes(weights: Weights, upload: Upload = WHOLE, *, exchanging: bool = False) -> int:
    """Return the size of a client's update with these weights in Flower's serialisation [bytes].

    `exchanging`: with an array beside each that is learned, as a strategy's clients send them that `Exchanges` arrays.
    """
    sent, _ = encode_update(LocalUpdate(weights, 0, 0.0), weights, Rules(upload=upload), {}, 0)
    records = {ARRAYS: to_array_record(sent.weights), METRICS: MetricRecord({SAMPLES: 0, LOSS: 0.0})}
    if exchanging:
        names = [name for name in learned_names(weights) if name in upload.exchanged(weights)]
        records[EXTRA] = to_array_record({name: weights[name] for name in names})
    return wire_bytes(RecordDict(records))


@contextlib.contextmanager
def keep_identity() -> Iterator[None]:
    """Restore Flower's process-wide identity in the end: that of an outer federation."""
    names = ("_run_id", "_node_id", "_task_id")
    before = {name: getattr(TaskIdentity, name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(TaskIdentity, name, value)


@contextlib.contextmanager
def _server_identity() -> Iterator[None]:
    """Give messages created inside the server's identity."""
    with keep_identity():
        TaskIdentity.run_id, TaskIdentity.node_id, TaskIdentity.task_id = RUN_ID, SERVER_NODE, 1
        yield


class LinkGrid(Grid):
    """Flower grid whose nodes are a federation's clients, and whose messages all go by `send_and_receive`."""

    names: Mapping[int, str]  # of the clients, by node
    _flower_run = Run.create_empty(RUN_ID)

    def get_node_ids(self) -> list[int]:
        """Return the ids of the nodes, in the order of the clients."""
        return [*self.names]

    def create_message(
        self, content: RecordDict, message_type: str, dst_node_id: int, group_id: str, ttl: float | None = None
    ) -> Message:
        """Return a message from the server to a node."""
        return Message(content, dst_node_id, message_type, ttl=ttl, group_id=group_id)

    def set_run(self, run: Run) -> None:
        """Set Flower's record of the run."""
        self._flower_run = run

    @property
    def run(self) -> Run:
        """Return Flower's record of the run."""
        return self._flower_run

    def read_states(self, keys: Iterable[str]) -> ClientStates:
        """Return the arrays that clients keep between rounds under these records, by client and record."""
        wanted = tuple(keys)
        found: ClientStates = {}
        for reply in self.send_and_receive(Message(RecordDict(), node, MessageType.QUERY) for node in self.names):
            if reply.has_content():
                own = {key: read_arrays(reply.content, key) for key in wanted if key in reply.content}
                found |= {self.names[reply.metadata.src_node_id]: own} if own else {}
        return {name: found[name] for name in self.names.values() if name in found}

    def push_messages(self, messages: Iterable[Message]) -> Iterable[str]:
        """Raise NotImplementedError: a message whose answer is fetched later would pass ledger and outages by."""
        raise NotImplementedError(UNMETERED)

    def pull_messages(self, message_ids: Iterable[str]) -> Iterable[Message]:
        """Raise NotImplementedError, as `push_messages` does."""
        raise NotImplementedError(UNMETERED)


class EmbeddedGrid(LinkGrid):
    """Flower grid whose nodes are in this process; a context manager.

    A node exists while it answers, and what it keeps for later rounds beyond that.
    """

    def __init__(
        self,
        app: ClientApp,
        names: Sequence[str],
        states: Mapping[str, Mapping[str, Weights]] = {},
        at_once: int = 1,
    ) -> None:
        """Register a node for each of `names`; its config has its place among them, as in Flower's simulation.

        `states` are the arrays that nodes have kept from earlier rounds, by node and record. `at_once` nodes answer at
        the same time, each in a thread; replies come in the order of the messages all the same.
        """
        self._app, self._at_once = app, at_once
        self.names = dict(enumerate(names, FIRST_NODE))
        nodes = {name: node for node, name in self.names.items()}
        self._states = {
            nodes[name]: RecordDict({key: to_array_record(arrays) for key, arrays in own.items()})
            for name, own in states.items()
            if name in nodes
        }
        self._sent = 0
        self._identity = _server_identity()

    def __enter__(self) -> "EmbeddedGrid":
        self._identity.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        self._identity.__exit__(None, None, None)

    def read_states(self, keys: Iterable[str]) -> ClientStates:
        """Return the arrays that clients keep between rounds under these records, by client and record."""
        found: ClientStates = {}
        for node, state in sorted(self._states.items()):
            for key in keys:
                if key in state:
                    found.setdefault(self.names[node], {})[key] = read_arrays(state, key)
        return found

    def _number(self, message: Message) -> None:
        self._sent += 1
        message.metadata.__dict__["_message_id"] = f"{RUN_ID}-{self._sent}"

    def _deliver(self, message: Message) -> Message:
        """Return a node's reply; an exception in the client app is an error reply, but `BudgetExceeded` is raised."""
        node = message.metadata.dst_node_id
        shared = message.content  # by all nodes: a change by one client app must not reach the next
        message.content = RecordDict({key: _copied(record) for key, record in shared.items()})
        config: UserConfig = {PARTITION: node - FIRST_NODE, "num-partitions": len(self.names)}
        context = Context(RUN_ID, node, config, self._states.pop(node, None) or RecordDict(), {})
        try:
            return self._app(message, context)
        except BudgetExceeded:
            raise
        except Exception as error:
            return refuse_request(message, repr(error))
        finally:
            message.content = shared
            if context.state:
                self._states[node] = context.state

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        """Yield the replies in the order of the messages, as soon as each is there; raises what a node raises.

        At most `at_once` messages are under way, or answered and not taken yet.
        """
        if self._at_once == 1:  # in this thread: others have thread counts of their own
            for message in messages:
                self._number(message)
                yield self._deliver(message)
            return
        under_way: deque[Future[Message]] = deque()
        with ThreadPoolExecutor(self._at_once) as threads:
            try:
                for message in messages:
                    self._number(message)
                    under_way.append(threads.submit(self._deliver, message))
                    if len(under_way) == self._at_once:
                        yield under_way.popleft().result()
                while under_way:
                    yield under_way.popleft().result()
            finally:
                for each in under_way:
                    each.cancel()


def _copied(record):
    return ConfigRecord(dict(record)) if isinstance(record, ConfigRecord) else type(record)(dict(record))


ResultT = TypeVar("ResultT")

_busy: dict[int, threading.Thread] = {}  # by identity of a client, which its thread holds: what was left behind


class ClientLate(OSError):
    """A client did not end its training within its time."""

    def __init__(self, limit_s: float | None) -> None:
        super().__init__(f"it had not trained after {limit_s:g} s")


class NamedClients(Mapping[str, Trainable]):
    """Clients by name, each of which `find` returns when it is asked for."""

    def __init__(self, names: Iterable[str], find: Callable[[str], Trainable]) -> None:
        self._names, self._find = dict.fromkeys(names), find

    def __getitem__(self, name: str) -> Trainable:
        if name not in self._names:
            raise KeyError(name)
        return self._find(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def limit_time(clients: Mapping[str, Trainable], limit_s: float | None) -> Mapping[str, Trainable]:
    """Return clients that train in a thread each, and raise `ClientLate` after `limit_s` of wall time; None: as long
    as they take.

    A training that is left behind goes on until it ends, or the program does; until then its client refuses another
    one, so that no client trains twice at a time. What it returns is lost.
    """
    return clients if limit_s is None else NamedClients(clients, lambda name: _Timed(clients[name], limit_s))


class _Timed:
    def __init__(self, client: Trainable, limit_s: float) -> None:
        self._client, self._limit_s = client, limit_s

    def train(self, weights: Weights, **how: Any) -> Update:
        return self._within(lambda: self._client.train(weights, **how))

    def count_samples(self, steps: int) -> int:
        return self._within(lambda: count_samples(self._client, steps))

    def answer(self, question: str, arrays: Weights) -> Weights:
        return self._within(lambda: answer_question(self._client, question, arrays))

    def _within(self, do: Callable[[], ResultT]) -> ResultT:
        if (earlier := _busy.get(id(self._client))) is not None and earlier.is_alive():
            raise ClientLate(self._limit_s)
        done: Future[ResultT] = Future()

        def work() -> None:
            try:
                done.set_result(do())
            except BaseException as error:
                done.set_exception(error)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        thread.join(self._limit_s)
        if not thread.is_alive():
            return done.result()
        _busy[id(self._client)] = thread
        raise ClientLate(self._limit_s)
