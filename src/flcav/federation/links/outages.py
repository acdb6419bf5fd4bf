"""A Flower grid with network outages: nodes absent at the begin of a round, and updates lost in transit."""

from collections.abc import Iterable, Iterator, Mapping

from flwr.app import ConfigRecord, Error, Message, RecordDict
from flwr.serverapp import Grid

from flcav.federation.links.in_process import wire_bytes
from flcav.federation.links.metered import Account, Outage
from flcav.federation.links.wrapped import WrappedGrid
from flcav.federation.wire import ARRAYS, CONFIG, LOST, LOST_BY_NETWORK


class LossyGrid(WrappedGrid):
    """Grid that answers for the nodes which `account.outages` has lost in a round, with the reason as an error.

    Nothing reaches a node that is not there. The bytes of an update that broke off are entered as far as they came;
    what comes before training, such as keys, arrives. A node whose update will break off is told so with the message,
    in the place of the acknowledgement that it would miss afterwards.
    """

    def __init__(self, grid: Grid, account: Account, names: Mapping[int, str]) -> None:
        """Lose nodes of `grid`; `names` are the clients' names by node id."""
        self._grid, self._account, self._names = grid, account, names
        self._asked: dict[str, Message] = {}  # by id, where an answer is awaited
        self._answers: dict[str, Message] = {}  # of nodes that are not there

    def _find_outage(self, message: Message) -> tuple[Outage | None, int, str]:
        """Return the outage of the node that a message is to, if any, the message's round and the node's name."""
        round_ = int(message.content.config_records[CONFIG]["round"])  # type: ignore[arg-type]
        name = self._names[message.metadata.dst_node_id]
        return self._account.outages.get((round_, name)), round_, name

    def _is_away(self, message: Message) -> bool:
        outage, _, _ = self._find_outage(message)
        return outage is not None and outage.sent_bytes is None

    def _fail(self, message: Message) -> Message:
        outage, _, _ = self._find_outage(message)
        assert outage is not None
        return Message(Error(code=LOST_BY_NETWORK, reason=outage.reason), reply_to=message)

    def _tell(self, message: Message) -> Message:
        """Return a message as its node gets it: with a note where the answer will not arrive."""
        if self._find_outage(message)[0] is not None:
            message.content = RecordDict({**message.content, LOST: ConfigRecord()})  # others share the content
        return message

    def _cut(self, reply: Message, message: Message) -> Message:
        """Return a reply as it arrives: an error where it is an update and breaks off."""
        outage, round_, name = self._find_outage(message)
        if outage is None or not reply.has_content() or ARRAYS not in reply.content.array_records:
            return reply
        account, size = self._account, min(outage.sent_bytes or 0, wire_bytes(reply.content))
        account.ledger.enter(account.describe("up", round_, name, size))
        return self._fail(message)

    def push_messages(self, messages: Iterable[Message]) -> list[str]:
        """Send messages to the nodes that are there, and return the ids of all."""
        ids = []
        for message in messages:
            if self._is_away(message):
                ids.append(f"away-{len(self._answers)}-{message.metadata.dst_node_id}")
                self._answers[ids[-1]] = self._fail(message)
            else:
                ids += self._grid.push_messages([self._tell(message)])
                self._asked[ids[-1]] = message
        return ids

    def pull_messages(self, message_ids: Iterable[str]) -> list[Message]:
        """Return the replies as they arrive."""
        found = []
        for identifier in message_ids:
            if identifier in self._answers:
                found.append(self._answers.pop(identifier))
            else:
                message = self._asked.pop(identifier)
                found += [self._cut(reply, message) for reply in self._grid.pull_messages([identifier])]
        return found

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        """Yield the replies as they arrive, then the errors of nodes that are not there."""
        asked: dict[int, Message] = {}
        away = []

        def reachable() -> Iterator[Message]:
            for message in messages:
                if self._is_away(message):
                    away.append(message)
                else:
                    asked[message.metadata.dst_node_id] = message
                    yield self._tell(message)

        for reply in self._grid.send_and_receive(reachable(), timeout=timeout):
            yield self._cut(reply, asked[reply.metadata.src_node_id])
        yield from map(self._fail, away)
