"""A Flower grid within one process: a message reaches the client app by a function call, without sockets or daemons.

It uses private parts of Flower (pinned to 1.42): the process-wide task identity, the empty run record, the id of a
message, and the serialisation of records and arrays. Those of a deployment are in `fleet.superlink`. A training in this
process cannot be interrupted: a client that exceeds its time limit keeps running in a thread (`limit_time`).
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

    Sizes of arrays are computed from the encoding of Protocol Buffers, since serialising a large network takes longer
    than a local step. A field consists of tag, length and content; empty fields are left out, except records.
    """
    others = RecordDict()
    total = 0
    for key, record in content.items():
        if not isinstance(record, ArrayRecord):
            others[key] = record
        else:
            arrays = sum(_nested(_text(name) + _nested(_array_bytes(array))) for name, array in record.items())
            total += _nested(_text(key) + _nested(arrays))
    return total + recorddict_to_proto(others).ByteSize()


def _array_bytes(array: Array) -> int:
    # in Protocol Buffers an empty bytes field takes no space, not even its tag
    head = ProtoArray(dtype=array.dtype, shape=array.shape, stype=array.stype).ByteSize()
    return head + (_nested(len(array.data)) if array.data else 0)


def _text(text: str) -> int:
    return _nested(len(text.encode())) if text else 0


def _nested(length: int) -> int:
    """Return the size of a field with content of this length [bytes]: tag, length as a varint, and content."""
    return 1 + max(1, -(-length.bit_length() // 7)) + length


def update_bytes(weights: Weights, upload: Upload = WHOLE, *, exchanging: bool = False) -> int:
    """Return the size of a client's update with these weights in Flower's serialisation [bytes].

    exchanging: with a further array per learned one, as clients of a strategy in `Exchanges` send them.
    """
    sent, _ = encode_update(LocalUpdate(weights, 0, 0.0), weights, Rules(upload=upload), {}, 0)
    records = {ARRAYS: to_array_record(sent.weights), METRICS: MetricRecord({SAMPLES: 0, LOSS: 0.0})}
    if exchanging:
        names = [name for name in learned_names(weights) if name in upload.exchanged(weights)]
        records[EXTRA] = to_array_record({name: weights[name] for name in names})
    return wire_bytes(RecordDict(records))


@contextlib.contextmanager
def keep_identity() -> Iterator[None]:
    """Restore Flower's process-wide identity, that of an outer federation, at the end."""
    names = ("_run_id", "_node_id", "_task_id")
    before = {name: getattr(TaskIdentity, name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(TaskIdentity, name, value)


@contextlib.contextmanager
def _server_identity() -> Iterator[None]:
    """Give messages created in the context the server's identity."""
    with keep_identity():
        TaskIdentity.run_id, TaskIdentity.node_id, TaskIdentity.task_id = RUN_ID, SERVER_NODE, 1
        yield


class LinkGrid(Grid):
    """A Flower grid whose nodes are a federation's clients, and whose messages all go by `send_and_receive`."""

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
        """Return the client states with these keys, by client and key."""
        wanted = tuple(keys)
        found: ClientStates = {}
        for reply in self.send_and_receive(Message(RecordDict(), node, MessageType.QUERY) for node in self.names):
            if reply.has_content():
                state = {key: read_arrays(reply.content, key) for key in wanted if key in reply.content}
                found |= {self.names[reply.metadata.src_node_id]: state} if state else {}
        return {name: found[name] for name in self.names.values() if name in found}

    def push_messages(self, messages: Iterable[Message]) -> Iterable[str]:
        """Raise NotImplementedError: messages with replies fetched later would bypass ledger and outages."""
        raise NotImplementedError(UNMETERED)

    def pull_messages(self, message_ids: Iterable[str]) -> Iterable[Message]:
        """Raise NotImplementedError, as `push_messages` does."""
        raise NotImplementedError(UNMETERED)


class EmbeddedGrid(LinkGrid):
    """A Flower grid whose nodes are in this process; a context manager.

    Between messages only the states of nodes exist.
    """

    def __init__(
        self,
        app: ClientApp,
        names: Sequence[str],
        states: Mapping[str, Mapping[str, Weights]] = {},
        at_once: int = 1,
    ) -> None:
        """Register a node per name; its config has its index among them, as in Flower's simulation.

        states: client states from earlier rounds, by client and key. at_once: number of nodes that answer at the same
        time, in threads; replies come in the order of the messages all the same.
        """
        self._app, self._at_once = app, at_once
        self.names = dict(enumerate(names, FIRST_NODE))
        nodes = {name: node for node, name in self.names.items()}
        self._states = {
            nodes[name]: RecordDict({key: to_array_record(arrays) for key, arrays in state.items()})
            for name, state in states.items()
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
        """Return the client states with these keys, by client and key."""
        found: ClientStates = {}
        for node, state in sorted(self._states.items()):
            for key in keys:
                if key in state:
                    found.setdefault(self.names[node], {})[key] = read_arrays(state, key)
        return found

    def _number(self, message: Message) -> None:
        # numbered in order, so that equal runs have equal messages
        self._sent += 1
        message.metadata.__dict__["_message_id"] = f"{RUN_ID}-{self._sent}"

    def _deliver(self, message: Message) -> Message:
        """Return a node's reply; an exception in the client app becomes an error reply, except `BudgetExceeded`."""
        node = message.metadata.dst_node_id
        # the client app gets shallow copies: the arrays themselves are immutable bytes
        shared = message.content  # by all nodes: changes by one client app must not reach the next
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
        """Yield the replies in the order of the messages, as soon as they are available; raises what a node raises.

        At most `at_once` messages are in flight, or answered and not yet consumed. timeout: not
        applied in this process, where `limit_time` limits a training.
        """
        if self._at_once == 1:  # in this thread: other threads have other thread counts
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

_busy: dict[int, threading.Thread] = {}  # late trainings by id() of the client, which its thread keeps alive


class ClientLate(OSError):
    """A client exceeded its time to train."""

    def __init__(self, limit_s: float | None) -> None:
        super().__init__(f"it had not trained after {limit_s:g} s")


class NamedClients(Mapping[str, Trainable]):
    """Clients by name, looked up by `find` when they are needed."""

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
    """Return clients that train in threads, and raise `ClientLate` after `limit_s` [s] of wall time; None: no limit.

    A late training continues until it or the program ends; until then its client refuses another one, so that no client
    trains twice at a time. Its result is lost.
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
