"""Flower in this process: messages are handed to the client app by a call; no sockets, no daemons.

The only module that touches what Flower does not promise (pinned to 1.41): the process-global task identity, the empty
run record, a message's id, and the wire form of a record.
"""

import contextlib
from collections.abc import Iterable, Iterator, Mapping

from flwr.app import ConfigRecord, Context, Error, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp
from flwr.common.serde import recorddict_to_proto
from flwr.serverapp import Grid
from flwr.supercore.run import Run
from flwr.supercore.task_identity import TaskIdentity

from flcav.federation.records import ARRAYS, LOSS, METRICS, SAMPLES, to_arrays
from flcav.federation.trainable import Weights
from flcav.network.ledger import BudgetExceeded

RUN_ID, SERVER_NODE, CLIENT_APP_RAISED = 1, 1, 2
FIRST_NODE = 2


def wire_bytes(content: RecordDict) -> int:
    """Return the size of a message's content as Flower serialises it [bytes]."""
    return recorddict_to_proto(content).ByteSize()


def update_bytes(weights: Weights) -> int:
    """Return the size of a client's update with such weights as Flower serialises it [bytes]."""
    return wire_bytes(RecordDict({ARRAYS: to_arrays(weights), METRICS: MetricRecord({SAMPLES: 0, LOSS: 0.0})}))


@contextlib.contextmanager
def _server_identity() -> Iterator[None]:
    """Messages made inside carry the server's identity; what stood there before (a nested federation's) comes back."""
    names = ("_run_id", "_node_id", "_task_id")
    before = {name: getattr(TaskIdentity, name) for name in names}
    TaskIdentity.run_id, TaskIdentity.node_id, TaskIdentity.task_id = RUN_ID, SERVER_NODE, 1
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(TaskIdentity, name, value)


class EmbeddedGrid(Grid):
    """A Flower grid whose nodes live in this process; use it as a context manager."""

    def __init__(self, app: ClientApp, nodes: Mapping[str, Mapping[str, str]]) -> None:
        """Register one node per name in `nodes`, in their order, with its node config."""
        self._app = app
        self.names = dict(enumerate(nodes, FIRST_NODE))
        self._contexts = {
            node: Context(RUN_ID, node, dict(nodes[name]), RecordDict(), {}) for node, name in self.names.items()
        }
        self._replies: dict[str, Message] = {}
        self._sent = 0
        self._run = Run.create_empty(RUN_ID)
        self._identity = _server_identity()

    def __enter__(self) -> "EmbeddedGrid":
        self._identity.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        self._identity.__exit__(None, None, None)

    def set_run(self, run: Run) -> None:
        """Take Flower's record of the run."""
        self._run = run

    @property
    def run(self) -> Run:
        """Return Flower's record of the run."""
        return self._run

    def create_message(
        self, content: RecordDict, message_type: str, dst_node_id: int, group_id: str, ttl: float | None = None
    ) -> Message:
        """Return a message from the server to a node."""
        return Message(content, dst_node_id, message_type, ttl=ttl, group_id=group_id)

    def get_node_ids(self) -> list[int]:
        """Return the ids of the registered nodes, in registration order."""
        return list(self._contexts)

    def push_messages(self, messages: Iterable[Message]) -> list[str]:
        """Deliver each message to its node and keep the reply; an exception in the app becomes an error reply."""
        ids = []
        for message in messages:
            self._sent += 1
            identifier = f"{RUN_ID}-{self._sent}"
            message.metadata.__dict__["_message_id"] = identifier
            # Strategies share one RecordDict between nodes: what one app changes must not reach the next.
            message.content = RecordDict({key: _copied(record) for key, record in message.content.items()})
            try:
                answer = self._app(message, self._contexts[message.metadata.dst_node_id])
            except BudgetExceeded:
                raise
            except Exception as error:
                answer = Message(Error(code=CLIENT_APP_RAISED, reason=repr(error)), reply_to=message)
            self._replies[identifier] = answer
            ids.append(identifier)
        return ids

    def pull_messages(self, message_ids: Iterable[str]) -> list[Message]:
        """Return the replies that are there, each once."""
        return [self._replies.pop(identifier) for identifier in message_ids if identifier in self._replies]

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> list[Message]:
        """Deliver messages one after another and return their replies."""
        return [reply for message in messages for reply in self.pull_messages(self.push_messages([message]))]


def _copied(record):
    return ConfigRecord(dict(record)) if isinstance(record, ConfigRecord) else type(record)(dict(record))
