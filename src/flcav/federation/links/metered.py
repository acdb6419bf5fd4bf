"""The metered link: a Flower grid around another one, which applies ledger, budget and outages of the network."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from flwr.app import ConfigRecord, Error, Message, RecordDict
from flwr.serverapp import Grid

from flcav.federation.links.in_process import LinkGrid, wire_bytes
from flcav.federation.wire import ARRAYS, CONFIG, LOST, LOST_BY_NETWORK
from flcav.network.ledger import Direction, Ledger, LedgerEntry, Link, LinkMegabytes

UNDISCLOSED = "undisclosed"  # in place of a client's name
UNLIMITED_MB = 1e12  # budget of a federation without one [MB]


@dataclass(frozen=True)
class Outage:
    """A client that the network loses in a round."""

    reason: str  # e.g. "out of coverage"
    sent_bytes: int | None = None  # of its update before the interruption; None: absent when the round began


@dataclass(frozen=True)
class Account:
    """The account of a link: its ledger, the stage, task and link of its entries, and its outages."""

    ledger: Ledger
    stage: str  # of training, as in the ledger's entries
    task: str  # its name
    link: Link  # wireless or wireline
    outages: Mapping[tuple[int, str], Outage] = field(default_factory=dict)  # by round and client
    within: frozenset[str] = frozenset()  # clients in the server's process, whose messages cross no link
    concealed: bool = False  # whether the draw of clients is secret: entries then only name a client's region

    def find_away(self, round_: int) -> dict[str, str]:
        """Return the clients that are absent when a round begins and take no part in it, with the reason."""
        lost = self.outages.items()
        return {name: each.reason for (number, name), each in lost if number == round_ and each.sent_bytes is None}

    def describe(self, direction: Direction, round_: int, client: str, size: int) -> LedgerEntry:
        """Return the entry of a message of `size` bytes."""
        if self.concealed:
            region, slash, _ = client.rpartition("/")
            client = f"{region}{slash}{UNDISCLOSED}"
        return LedgerEntry(self.stage, self.task, self.link, direction, round_, client, size)


def open_account() -> Account:
    """Return the account of a federation without a budget."""
    return Account(Ledger(LinkMegabytes(UNLIMITED_MB, UNLIMITED_MB)), "edge", "federation", "wireless")


class MeteredGrid(LinkGrid):
    """A grid that meters the messages of another one, enforces the budget, and applies the network's outages.

    Every message to a node is a downlink entry of the ledger, every reply an uplink entry. A reply over the budget is
    neither passed on nor entered: `BudgetExceeded` is raised instead. Nodes in `account.outages` of a round are
    replaced by an error with the reason. No message reaches an absent node; of an interrupted update, the transmitted
    bytes are entered; replies before training, such as keys, arrive. The request to a node whose update will be
    interrupted says so, which stands for the acknowledgement that it would miss later.
    """

    def __init__(self, grid: Grid, account: Account, names: Mapping[int, str]) -> None:
        """Meter `grid` on `account`; `names` are the clients' names by node id."""
        self._grid, self._account, self.names = grid, account, names

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        """Yield the replies as they arrive, then the errors of absent nodes.

        A message is entered when it is sent or, while another reply is outstanding, together with its reply, so that
        the order of entries does not depend on the number of messages in flight. Nothing is sent before the first reply
        is requested. The first reply over a budget ends the exchange: raises `BudgetExceeded`. timeout: [s].
        """
        asked: dict[int, Message] = {}
        waiting: dict[int, tuple[int, int]] = {}  # round and bytes of messages not entered yet, by node
        open_: set[int] = set()  # nodes that have not answered
        away: list[Message] = []

        def sent() -> Iterator[Message]:
            content, size = None, 0
            for message in messages:
                if message.content is not content:  # many messages share one
                    content, size = message.content, wire_bytes(message.content)
                node = message.metadata.dst_node_id
                waiting[node] = _round(message), size
                if not open_:
                    self._enter("down", node, *waiting.pop(node))
                open_.add(node)
                outage = self._find_outage(message)
                if outage is not None and outage.sent_bytes is None:
                    away.append(message)
                    continue
                if outage is not None:
                    message.content = RecordDict({**message.content, LOST: ConfigRecord()})  # others share the content
                asked[node] = message
                yield message

        def arrived() -> Iterator[Message]:
            for reply in self._grid.send_and_receive(sent(), timeout=timeout):
                yield self._cut(reply, asked[reply.metadata.src_node_id])
            yield from map(self._fail, away)

        for reply in arrived():
            node = reply.metadata.src_node_id
            number = 0
            size = 0
            counts = reply.has_content() and self.names[node] not in self._account.within
            if counts:
                number, size = _round(asked[node]), wire_bytes(reply.content)
                # refused before the downlink that waits is entered; `_enter` checks again
                self._account.ledger.check(self._account.describe("up", number, self.names[node], size))
            open_.remove(node)
            if node in waiting:
                self._enter("down", node, *waiting.pop(node))
            if counts:
                self._enter("up", node, number, size)
            yield reply
        for node, about in waiting.items():
            self._enter("down", node, *about)

    def _enter(self, direction: Direction, node: int, round_: int, size: int) -> None:
        if (name := self.names[node]) not in self._account.within:
            self._account.ledger.enter(self._account.describe(direction, round_, name, size))

    def _find_outage(self, message: Message) -> Outage | None:
        """Return the outage of a message's receiver in its round."""
        return self._account.outages.get((_round(message), self.names[message.metadata.dst_node_id]))

    def _fail(self, message: Message) -> Message:
        """Return an error in place of the reply to a message, with the reason of the outage."""
        outage = self._find_outage(message)
        assert outage is not None
        return Message(Error(code=LOST_BY_NETWORK, reason=outage.reason), reply_to=message)

    def _cut(self, reply: Message, message: Message) -> Message:
        """Return a reply or, for an interrupted update, an error."""
        outage = self._find_outage(message)
        if outage is None or not reply.has_content() or ARRAYS not in reply.content.array_records:
            return reply
        account = self._account
        size = min(outage.sent_bytes or 0, wire_bytes(reply.content))
        name = self.names[message.metadata.dst_node_id]
        account.ledger.enter(account.describe("up", _round(message), name, size))
        return self._fail(message)


def _round(message: Message) -> int:
    return int(message.content.config_records[CONFIG]["round"])  # type: ignore[arg-type]
