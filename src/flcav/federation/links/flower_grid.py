"""The grid of a deployed federation: its nodes are vehicles of a fleet, reached through Flower's SuperLink.

Where the SuperLink was killed, Flower gives the run up; then the server begins another one, and asks those again whose
answers have not come. A vehicle whose node came back, or that may have lost a message, is asked again, and so is one
that has been silent for long. Since vehicles keep their last answer, the weights are those of a federation that nothing
happened to.

Where training has a time limit, so have answers: a vehicle that hangs, and cannot keep the limit itself, is given up.
One whose certificate is no longer in force is neither asked nor waited for.
"""

import contextlib
import errno
import re
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from flwr.app import ConfigRecord, Error, Message, MessageType, RecordDict
from flwr.serverapp import Grid

from flcav.config import InputError
from flcav.federation.links.in_process import LinkGrid, wire_bytes
from flcav.federation.links.metered import Account
from flcav.federation.state import RoundRecord
from flcav.federation.wire import GRANT, GRANTED, LOST_BY_NETWORK, OVER_BUDGET
from flcav.fleet.authority import load_certificate, open_registry
from flcav.fleet.registry import RegisteredVehicle
from flcav.fleet.status import FederationProgress, RoundProgress
from flcav.fleet.superlink import SuperLink, SuperLinkLost
from flcav.fleet.traffic import read_traffic
from flcav.interface.wording import make_printable
from flcav.network.ledger import BudgetExceeded

STARTING_S = 120.0  # for a SuperLink to come back
REJOIN_S = 180.0  # that a vehicle is waited for which the network lost
ALLOWANCE_S, SLOWEST_MBPS = 60.0, 1.0  # beyond the time to train: for polls and a fork; of the way there and back
LOOK_S = 0.5  # between looks at the registry
LONGEST = 500  # characters of a vehicle's words
BUSY_S = 0.1  # that a look waits for a registry which another process holds
AGAIN_S = 150.0  # after which a vehicle that has not answered is asked again, then after twice as long, and so on
POLL_S, PAUSE_S = 0.2, 1.0  # between looks for answers; before a vehicle that was not there is asked again
RAISED = 2  # Flower's error code of an app that raised an exception, whose words are the reason
FULL = re.compile(rf"\[Errno (?:{errno.ENOSPC}|{errno.EDQUOT}|{errno.EFBIG})\] ([A-Z][A-Za-z ]*)")
TRANSPORT = (3, 4, 5, 8)  # Flower's error codes of messages and nodes that are not available, and of a crashed app
SPARE_BYTES, CLIENT_BYTES = 1 << 16, 512  # of the largest answer, beside arrays; of what it has for each client


class DeployedGrid(LinkGrid):
    """Grid of deployed vehicles, which begins another run where Flower has given the one before up."""

    def __init__(
        self,
        folder: Path,
        link: SuperLink,
        names: Mapping[int, str],
        vehicles: Mapping[int, RegisteredVehicle],
        account: Account,
        limit_s: float | None = None,
    ) -> None:
        """Reach nodes of the fleet in `folder` with the clients' `names`, which are `vehicles` of its registry.

        limit_s: time that a vehicle may train in a round; None: any.
        """
        self._folder, self._link, self.names, self._vehicles, self._account = folder, link, names, vehicles, account
        self._limit_s, self.authority = limit_s, load_certificate(folder)
        self._largest = 0  # request to train so far [bytes]
        self._rounds: tuple[RoundProgress, ...] = ()
        self._waits: dict[str, str] = {}  # by client why it is waited for
        self._gone: dict[str, str] = {}  # by client why it is out of the federation
        self._silent: set[int] = set()  # nodes that were given up, and have not answered since
        self._look = 0.0  # when the registry is asked next
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
        self._rounds, self._waits = (*self._rounds, RoundProgress(record.round, *about)), {}
        self._tell()

    def _tell(self) -> None:
        account, link = self._account, self._account.link
        used, left = account.ledger.used_mb(link), account.ledger.left_mb(link)
        told = FederationProgress(account.stage, account.task, link, used, left, self._rounds, self._waits, self._gone)
        with contextlib.suppress(OSError):  # the federation goes on where the disk of its display is full
            told.save(self._folder)

    def _wait_for(self, exchange: "_Exchange", node: int, reason: str) -> None:
        """Ask a node again later, and report why."""
        exchange.lost(node)
        name = self.names[node]
        if self._waits.get(name) != reason:
            self._waits[name] = reason
            self._tell()

    def end(self, failed: bool = False) -> None:
        """End the run."""
        self._run.end(failed)

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        """Yield the replies in the order of the messages, as errors those that are over their grants.

        Who says that it kept an answer for its size comes last: `BudgetExceeded` is raised where that can be, since an
        answer of another client was larger than the grant or, where none came, the largest that there can be is.
        """
        asked = {message.metadata.dst_node_id: message for message in messages}
        exchange, kept, largest = _Exchange(self._count_losses()), list[int](), 0
        answers: dict[int, Message] = {}
        end = time.monotonic() + (timeout or float("inf"))
        late_s, self._look = self._limit_answers(asked.values()), 0.0
        for node, message in asked.items():
            while node not in answers:
                self._strike(asked, answers)
                try:
                    due = [own for own in asked if own not in answers and exchange.is_due(own)]
                    if due:
                        self._push(exchange, {own: asked[own] for own in due})
                    self._pull(exchange, asked, answers)
                    self._give_up(exchange, late_s, asked, answers)
                except SuperLinkLost:
                    self._renew()
                    exchange = _Exchange(self._count_losses(), exchange.granted)
                if node not in answers:
                    if time.monotonic() > end:
                        yield from self._judge(exchange, {own: asked[own] for own in kept}, largest)
                        return
                    exchange.notice(self._count_losses())
                    time.sleep(POLL_S)
            reply = answers.pop(node)
            answers[node] = message  # answered; only its place is looked at
            if reply.has_error() and reply.error.code == OVER_BUDGET:
                kept.append(node)
                continue
            if reply.has_content():
                size = wire_bytes(reply.content)
                if size > exchange.granted[node]:
                    told = f"an answer of {size} bytes, where {exchange.granted[node]} were granted"
                    reply = Message(Error(RAISED, told), reply_to=message)
                else:
                    largest = max(largest, size)
            yield reply
        yield from self._judge(exchange, {own: asked[own] for own in kept}, largest)

    def _judge(self, exchange: "_Exchange", kept: Mapping[int, Message], largest: int) -> Iterator[Message]:
        """Yield an error for each node that says it kept its answer, or raise `BudgetExceeded` where that can be.

        kept: what these nodes were asked. largest: bytes of the answers that came.
        """
        for node, message in kept.items():
            granted = exchange.granted[node]
            if granted < (largest or self._most_bytes):
                name, link = self.names[node], self._account.link
                raise BudgetExceeded(
                    f"{name}: an answer of more than the {granted} bytes that are left on the {link} uplink"
                )
            yield Message(Error(RAISED, f"no answer, as if {granted} bytes were too few for it"), reply_to=message)

    @property
    def _most_bytes(self) -> int:
        """Return more than the bytes of any answer to a request to train so far.

        That is weights, up to twice as much for numbers of 16 bits in 32, twice that for coordinates or a strategy's
        arrays beside them, and what secure aggregation has for each client.
        """
        return 4 * self._largest + CLIENT_BYTES * len(self.names) + SPARE_BYTES

    def _limit_answers(self, messages: Iterable[Message]) -> float:
        """Return the time that answers may take: to train, the allowance, and the way of request and answer [s]."""
        if self._limit_s is None:
            return float("inf")
        contents = {id(message.content): message.content for message in messages}.values()  # many share one
        size_mb = max(map(wire_bytes, contents), default=0) / 1e6
        return self._limit_s + ALLOWANCE_S + 2 * 8 * size_mb / SLOWEST_MBPS

    def _strike(self, asked: Mapping[int, Message], answers: dict[int, Message]) -> None:
        """Answer for the nodes whose certificate is no longer in force, twice a second at most."""
        if time.monotonic() < self._look:
            return
        self._look = time.monotonic() + LOOK_S
        try:
            with contextlib.closing(open_registry(self._folder, BUSY_S)) as registry:
                found = {node: registry.find(own.fingerprint) for node, own in self._vehicles.items()}
        except (InputError, OSError):  # another process holds it, or it is damaged: its own users say so
            return
        for node, own in found.items():
            state = "not registered" if own is None else own.describe_state()
            if state == "registered":
                continue
            name, why = self.names[node], f"the certificate of {self._vehicles[node].name} is {state}"
            if node in asked and node not in answers:
                answers[node] = Message(Error(LOST_BY_NETWORK, why), reply_to=asked[node])
            if name not in self._gone:
                self._gone[name] = why
                self._waits.pop(name, None)
                self._tell()

    def _give_up(
        self, exchange: "_Exchange", late_s: float, asked: Mapping[int, Message], answers: dict[int, Message]
    ) -> None:
        """Answer for the nodes that have not answered in time."""
        for node, message in asked.items():
            if node not in answers and exchange.waited_s(node) > late_s:
                self._silent.add(node)
                answers[node] = Message(Error(RAISED, f"it had not answered after {late_s:.0f} s"), reply_to=message)

    def _push(self, exchange: "_Exchange", due: Mapping[int, Message]) -> None:
        """Send requests to nodes, with the bytes that their answers may have."""
        left, sent = min(max(0, int(self._account.ledger.left_mb(self._account.link) * 1e6)), 2**62), []
        for node, message in due.items():
            content, trains = {**message.content}, message.metadata.message_type == MessageType.TRAIN
            if trains:
                self._largest = max(self._largest, wire_bytes(message.content))
            most = min(left, self._most_bytes) if trains else left if GRANT in content else 2**62
            granted = exchange.granted.setdefault(node, most)
            if trains or GRANT in content:
                content[GRANT] = ConfigRecord({GRANTED: granted})
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
            if reason is not None and not exchange.is_late(node) and node not in self._silent:
                self._wait_for(exchange, node, reason)
            elif reason is not None:
                answers[node] = Message(Error(LOST_BY_NETWORK, reason), reply_to=asked[node])
            else:
                self._silent.discard(node)
                answers[node] = _in_plain_words(reply, asked[node])

    def _count_losses(self) -> dict[int, int]:
        """Return how often each node may have lost what it was asked: it came in anew, or the SuperLink failed it."""
        found = read_traffic(self._folder).vehicles
        there = {node: found[own.name] for node, own in self._vehicles.items() if own.name in found}
        return {node: own.activations + own.lost for node, own in there.items()}


def _in_plain_words(reply: Message, message: Message) -> Message:
    """Return a reply; its error is the app's, whatever code a vehicle gives it, in words fit for a terminal."""
    if not reply.has_error():
        return reply
    code = OVER_BUDGET if reply.error.code == OVER_BUDGET else RAISED
    return Message(Error(code, make_printable(str(reply.error.reason), LONGEST)), reply_to=message)


def _excuse(reply: Message) -> str | None:
    """Return why a vehicle could not answer, where that may pass: it was not there, or its disk is full."""
    if not reply.has_error():
        return None
    if reply.error.code in TRANSPORT:
        return make_printable(str(reply.error.reason), LONGEST)
    if reply.error.code == RAISED and (full := FULL.search(str(reply.error.reason))):
        return f"no room on the vehicle's disk: {full[1]}"
    return None


class _Exchange:
    """Who was asked in a run, by which message, and who is to be asked again when."""

    def __init__(self, losses: Mapping[int, int], granted: Mapping[int, int] = {}) -> None:
        self.granted = dict(granted)  # bytes of an answer, by node
        self.nodes: dict[str, int] = {}  # of the messages that are out, by their ids
        self._losses = dict(losses)
        self._due: dict[int, float] = {}  # of nodes that were asked: when they are to be asked again
        self._patience: dict[int, float] = {}  # with nodes that were asked, until they are asked again [s]
        self._lost: dict[int, float] = {}  # since when nodes are not available
        self._begun: dict[int, float] = {}  # when nodes were asked first

    def is_due(self, node: int) -> bool:
        return time.monotonic() >= self._due.get(node, 0.0)

    def is_late(self, node: int) -> bool:
        return node in self._lost and time.monotonic() > self._lost[node] + REJOIN_S

    def sent(self, node: int, identifier: str) -> None:
        self.nodes[identifier], self._due[node] = node, time.monotonic() + self._patience.get(node, AGAIN_S)
        self._patience[node] = 2 * self._patience.get(node, AGAIN_S)
        self._begun.setdefault(node, time.monotonic())

    def waited_s(self, node: int) -> float:
        return time.monotonic() - self._begun.get(node, float("inf"))

    def lost(self, node: int) -> None:
        self._lost.setdefault(node, time.monotonic())
        self._due[node] = time.monotonic() + PAUSE_S

    def notice(self, losses: Mapping[int, int]) -> None:
        """Note that nodes have lost something: they are asked again, and give the same answer."""
        for node, count in losses.items():
            if count > self._losses.get(node, count) and node in self._due:
                self._due[node] = time.monotonic() + PAUSE_S
        self._losses = dict(losses)
