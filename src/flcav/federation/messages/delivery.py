"""Delivery of replies in a round: each arrives, is lost with its client, or misses the deadline."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain

from flwr.app import Message, RecordDict

from flcav.federation.messages.records import LOST_BY_NETWORK


@dataclass(frozen=True)
class Arrived:
    """A client's reply."""

    client: str
    content: RecordDict


@dataclass(frozen=True)
class Lost:
    """A client that failed, or was lost by the network."""

    client: str
    reason: str
    by_network: bool


@dataclass(frozen=True)
class TimedOut:
    """A client that has not answered in time."""

    client: str


Event = Arrived | Lost | TimedOut


def list_events(awaited: Iterable[str], replies: Iterable[Message], names: Mapping[int, str]) -> Iterator[Event]:
    """Yield what becomes of the clients that are `awaited`, in that order: so results do not depend on who is faster.

    Replies that come in that order are yielded as they come, and not kept. `names` are the clients' names by node.
    """
    nodes = {name: node for node, name in names.items()}
    left, early = deque(nodes[name] for name in awaited), dict[int, Message]()
    for message in chain(replies, [None]):
        if message is not None:
            early[message.metadata.src_node_id] = message
        while left and (message is None or left[0] in early):
            node = left.popleft()
            found, client = early.pop(node, None), names[node]
            if found is None:
                yield TimedOut(client)
            elif found.has_error():
                yield Lost(client, str(found.error.reason), found.error.code == LOST_BY_NETWORK)
            else:
                yield Arrived(client, found.content)
