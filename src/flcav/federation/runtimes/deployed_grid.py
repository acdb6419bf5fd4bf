"""The grid of a deployed federation: its nodes are vehicles of a fleet, reached through Flower's SuperLink.

Where the SuperLink was killed, Flower gives the run up; then the server begins another one, and asks those again whose
answers have not come. A vehicle whose node came back is asked again, too. Since vehicles keep their last answer, the
weights are those of a federation that nothing happened to.
"""

import contextlib
import errno
import re
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from flwr.app import ConfigRecord, Error, Message, MessageType, RecordDict
from flwr.serverapp import Grid

from flcav.federation.fleet.status import Followed, FollowedRound
from flcav.federation.fleet.superlink import SuperLink, SuperLinkLost
from flcav.federation.fleet.traffic import read_traffic
from flcav.federation.messages.records import GRANT, GRANTED, LOST_BY_NETWORK, OVER_BUDGET, read_arrays
from flcav.federation.runtimes.metered import Account
from flcav.federation.runtimes.wrapped import WrappedGrid
from flcav.federation.state import ClientStates, RoundRecord
from flcav.network.ledger import BudgetExceeded

STARTING_S = 120.0  # for a SuperLink to come back
REJOIN_S = 180.0  # that a vehicle is waited for which the network lost
POLL_S, PAUSE_S = 0.2, 1.0  # between looks for answers; before a vehicle that was not there is asked again
RAISED = 2  # Flower's error code of an app that raised an exception, whose words are the reason
FULL = re.compile(rf"\[Errno (?:{errno.ENOSPC}|{errno.EDQUOT}|{errno.EFBIG})\] ([A-Z][A-Za-z ]*)")
TRANSPORT = (3, 4, 5, 8)  # Flower's error codes of messages and nodes that are not available, and of a crashed app


class DeployedGrid(WrappedGrid):
    """Grid of deployed vehicles, which begins another run where Flower has given the one before up."""

    def __init__(
        self, folder: Path, link: SuperLink, names: Mapping[int, str], vehicles: Mapping[int, str], account: Account
    ) -> None:
        """Reach nodes of the fleet in `folder` with the clients' `names`, which are `vehicles` of its registry."""
        self._folder, self._link, self.names, self._vehicles, self._account = folder, link, names, vehicles, account
        self._rounds: tuple[FollowedRound, ...] = ()
        self._waits: dict[str, str] = {}  # by client why it is waited for
        self._begin()

    def _begin(self) -> None:
        self._link.wait(STARTING_S)
        self._run = self._link.begin()
        self._run.identify()
        self._grid: Grid = self._run.grid

    def _renew(self) -> None:
        """Begin another run, as soon as the SuperLink lets us."""
        self._run.end(failed=True)
        end = time.monotonic() + STARTING_S
        while True:
            try:
                return self._begin()
            except SuperLinkLost as error:
                if time.monotonic() > end:
                    raise OSError(f"{self._folder}: the SuperLink begins no run: {error}") from None
                time.sleep(PAUSE_S)

    def follow(self, record: RoundRecord) -> None:
        """Write a round that has ended to the fleet's folder, where `flcav fleet status` reads it."""
        about = time.time(), len(record.clients), record.failed, record.loss, record.epsilon, record.empty
        self._rounds, self._waits = (*self._rounds, FollowedRound(record.round, *about)), {}
        self._tell()

    def _tell(self) -> None:
        account, link = self._account, self._account.link
        used, left = account.ledger.used_mb(link), account.ledger.left_mb(link)
        told = Followed(account.stage, account.task, link, used, left, self._rounds, dict(self._waits))
        with contextlib.suppress(OSError):  # the federation goes on where the disk of its display is full
            told.save(self._folder)

    def _wait_for(self, exchange: "_Exchange", node: int, reason: str) -> None:
        """Ask a node again later, and tell why."""
        exchange.lost(node)
        name = self.names[node]
        if self._waits.get(name) != reason:
            self._waits[name] = reason
            self._tell()

    def end(self, failed: bool = False) -> None:
        """End the run."""
        self._run.end(failed)

    def get_node_ids(self) -> list[int]:
        """Return the ids of the nodes, in the order of the clients."""
        return [*self.names]

    def read_states(self, keys: Iterable[str]) -> ClientStates:
        """Return the arrays that clients keep between rounds under these records, by client and record."""
        found: ClientStates = {}
        for reply in self.send_and_receive(Message(RecordDict(), node, MessageType.QUERY) for node in self.names):
            if reply.has_content():
                own = {key: read_arrays(reply.content, key) for key in keys if key in reply.content}
                found |= {self.names[reply.metadata.src_node_id]: own} if own else {}
        return {name: found[name] for name in self.names.values() if name in found}

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        """Yield the replies in the order of the messages; raises `BudgetExceeded` where one was kept for its size."""
        asked = {message.metadata.dst_node_id: message for message in messages}
        exchange = _Exchange(self._count_losses())
        answers: dict[int, Message] = {}
        end = time.monotonic() + (timeout or float("inf"))
        for node, message in asked.items():
            while node not in answers:
                try:
                    due = [own for own in asked if own not in answers and exchange.is_due(own)]
                    if due:
                        self._push(exchange, {own: asked[own] for own in due})
                    self._pull(exchange, asked, answers)
                except SuperLinkLost:
                    self._renew()
                    exchange = _Exchange(self._count_losses())
                if node not in answers:
                    if time.monotonic() > end:
                        return
                    exchange.notice(self._count_losses())
                    time.sleep(POLL_S)
            reply = answers.pop(node)
            answers[node] = message  # answered; only its place is looked at
            if reply.has_error() and reply.error.code == OVER_BUDGET:
                raise BudgetExceeded(f"{self.names[node]}: {reply.error.reason} on the {self._account.link} uplink")
            yield reply

    def _push(self, exchange: "_Exchange", due: Mapping[int, Message]) -> None:
        """Send requests to nodes, with the bytes that their answers may have."""
        left = max(0, int(self._account.ledger.left_mb(self._account.link) * 1e6))
        grant = ConfigRecord({GRANTED: min(left, 2**62)})
        sent = []
        for node, message in due.items():
            content = {**message.content}
            if GRANT in content or message.metadata.message_type == MessageType.TRAIN:
                content[GRANT] = grant
            sent.append(Message(RecordDict(content), node, message.metadata.message_type))
        for identifier, node in zip(self._grid.push_messages(sent), due, strict=True):
            exchange.sent(node, identifier)

    def _pull(self, exchange: "_Exchange", asked: Mapping[int, Message], answers: dict[int, Message]) -> None:
        """Add the answers that have come; a node that was not available is asked again later."""
        if not exchange.nodes:
            return
        for reply in self._grid.pull_messages([*exchange.nodes]):
            node = exchange.nodes.pop(reply.metadata.reply_to_message_id, None)
            if node is None or node in answers:
                continue
            reason = _excuse(reply)
            if reason is not None and not exchange.is_late(node):
                self._wait_for(exchange, node, reason)
            elif reason is not None:
                answers[node] = Message(Error(LOST_BY_NETWORK, reason), reply_to=asked[node])
            else:
                answers[node] = reply

    def _count_losses(self) -> dict[int, int]:
        """Return how often each node may have lost what it was asked: it came in anew, or the SuperLink failed it."""
        found = read_traffic(self._folder).vehicles
        there = {node: found[name] for node, name in self._vehicles.items() if name in found}
        return {node: own.activations + own.lost for node, own in there.items()}


def _excuse(reply: Message) -> str | None:
    """Return why a vehicle could not answer, where that may pass: it was not there, or its disk is full."""
    if not reply.has_error():
        return None
    if reply.error.code in TRANSPORT:
        return str(reply.error.reason)
    if reply.error.code == RAISED and (full := FULL.search(str(reply.error.reason))):
        return f"no room on the vehicle's disk: {full[1]}"
    return None


class _Exchange:
    """Who was asked in a run, by which message, and who is to be asked again when."""

    def __init__(self, losses: Mapping[int, int]) -> None:
        self.nodes: dict[str, int] = {}  # of the messages that are out, by their ids
        self._losses = dict(losses)
        self._due: dict[int, float] = {}  # of nodes that were asked: when they are to be asked again
        self._lost: dict[int, float] = {}  # since when nodes are not available

    def is_due(self, node: int) -> bool:
        return time.monotonic() >= self._due.get(node, 0.0)

    def is_late(self, node: int) -> bool:
        return node in self._lost and time.monotonic() > self._lost[node] + REJOIN_S

    def sent(self, node: int, identifier: str) -> None:
        self.nodes[identifier], self._due[node] = node, float("inf")

    def lost(self, node: int) -> None:
        self._lost.setdefault(node, time.monotonic())
        self._due[node] = time.monotonic() + PAUSE_S

    def notice(self, losses: Mapping[int, int]) -> None:
        """Note that nodes have lost something: they are asked again, and give the same answer."""
        for node, count in losses.items():
            if count > self._losses.get(node, count) and node in self._due:
                self._due[node] = time.monotonic() + PAUSE_S
        self._losses = dict(losses)
