"""Flower grids that enforce the budgets of a ledger before a message is sent, and enter it there; they wrap others."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from flwr.app import Message
from flwr.serverapp import Grid

from flcav.federation.links.in_process import wire_bytes
from flcav.federation.links.wrapped import WrappedGrid
from flcav.federation.wire import CONFIG
from flcav.network.ledger import Direction, Ledger, LedgerEntry, Link, LinkMegabytes

UNDISCLOSED = "undisclosed"  # in the place of a client's name
UNLIMITED_MB = 1e12  # budget of whoever does not count


@dataclass(frozen=True)
class Outage:
    """A client that the network loses in a round."""

    reason: str  # e.g. "out of coverage"
    sent_bytes: int | None = None  # of its update, until it broke off; None: it was not there when the round began


@dataclass(frozen=True)
class Account:
    """The ledger, stage, task and link that messages are entered under, and what the link loses."""

    ledger: Ledger
    stage: str  # of training, as in the ledger's entries
    task: str  # its name
    link: Link  # wireless or wireline
    outages: Mapping[tuple[int, str], Outage] = field(default_factory=dict)  # by round and client
    within: frozenset[str] = frozenset()  # clients in the server itself, whose messages cross no link
    concealed: bool = False  # whether nobody is to know who was drawn: entries have a client's region alone

    def find_away(self, round_: int) -> dict[str, str]:
        """Return by client why it is not there when a round begins: all that take no part in it."""
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


class BudgetedGrid(WrappedGrid):
    """Grid whose nodes keep a reply that is over the budget of the uplink: `BudgetExceeded` is raised in its stead.

    It stands at the near end of the link, `MeteredGrid` at the far end. Where nodes are elsewhere, as on Ray, both are
    at the far end.
    """

    def __init__(self, grid: Grid, account: Account, names: Mapping[int, str]) -> None:
        """Hold the nodes of `grid` to the budget of `account`; `names` are the clients' names by node id."""
        self._grid, self._account, self._names = grid, account, names
        self._round = 0

    def _checked(self, reply: Message) -> Message:
        if reply.has_content():
            name = self._names[reply.metadata.src_node_id]
            if name in self._account.within:
                return reply
            self._account.ledger.check(self._account.describe("up", self._round, name, wire_bytes(reply.content)))
        return reply

    def _noted(self, messages: Iterable[Message]) -> Iterator[Message]:
        for message in messages:
            self._round = _round(message)
            yield message

    def push_messages(self, messages: Iterable[Message]) -> list[str]:
        """Send messages; return their ids."""
        return list(self._grid.push_messages(self._noted(messages)))

    def pull_messages(self, message_ids: Iterable[str]) -> list[Message]:
        """Return replies within the budget; raises `BudgetExceeded` for another one."""
        return [self._checked(reply) for reply in self._grid.pull_messages(message_ids)]

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        """Yield the replies as they come; raises `BudgetExceeded` for one over the budget."""
        yield from map(self._checked, self._grid.send_and_receive(self._noted(messages), timeout=timeout))


class MeteredGrid(WrappedGrid):
    """Grid that meters another one: a downlink entry for each message to a node, an uplink entry for each reply."""

    def __init__(self, grid: Grid, account: Account, names: Mapping[int, str]) -> None:
        """Meter `grid` on `account`; `names` are the clients' names by node id."""
        self._grid, self._account, self._names = grid, account, names
        self._round = 0

    def _enter(self, direction: Direction, round_: int, size: int, node: int) -> None:
        account, self._round = self._account, round_
        if self._names[node] not in account.within:
            account.ledger.enter(account.describe(direction, round_, self._names[node], size))

    def push_messages(self, messages: Iterable[Message]) -> list[str]:
        """Send messages, entering each as downlink first; return their ids."""
        messages = list(messages)
        for message in messages:
            self._enter("down", _round(message), wire_bytes(message.content), message.metadata.dst_node_id)
        return list(self._grid.push_messages(messages))

    def pull_messages(self, message_ids: Iterable[str]) -> list[Message]:
        """Return replies, entering each as uplink first; raises `BudgetExceeded` where one would exceed a budget."""
        replies = list(self._grid.pull_messages(message_ids))
        for message in replies:
            if message.has_content():
                self._enter("up", self._round, wire_bytes(message.content), message.metadata.src_node_id)
        return replies

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        """Yield the replies as they come, entering message and reply; the first reply over a budget ends the round.

        A message is entered when it is sent or, while another one has no reply yet, with its own reply: so the entries
        do not depend on how many are under way. Nothing is sent before the first reply is asked for.
        """
        waiting: dict[int, tuple[int, int]] = {}  # round and bytes of messages that are not entered, by node
        open_: set[int] = set()  # nodes that have not answered

        def noted() -> Iterator[Message]:
            content, size = None, 0
            for message in messages:
                if message.content is not content:  # many messages share one
                    content, size = message.content, wire_bytes(message.content)
                node = message.metadata.dst_node_id
                waiting[node] = _round(message), size
                if not open_:
                    self._enter("down", *waiting.pop(node), node)
                open_.add(node)
                yield message

        for reply in self._grid.send_and_receive(noted(), timeout=timeout):
            node = reply.metadata.src_node_id
            open_.remove(node)
            if node in waiting:
                self._enter("down", *waiting.pop(node), node)
            if reply.has_content():
                self._enter("up", self._round, wire_bytes(reply.content), node)
            yield reply
        for node, about in waiting.items():
            self._enter("down", *about, node)


def _round(message: Message) -> int:
    return int(message.content.config_records[CONFIG]["round"])  # type: ignore[arg-type]
