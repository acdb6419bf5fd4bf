"""The grid of a deployed federation: its nodes are vehicles of a fleet, reached through Flower's SuperLink.

If the SuperLink is killed, Flower aborts the run; the server then starts another one, and repeats the requests without
an answer. It also repeats a request whose vehicle came back, may have lost a message, or has been silent for long.
Since vehicles keep their last answer, the weights are the same as without disturbances.

Where training has a time limit, answers have one, too: the server gives up on a vehicle that hangs, and so cannot
enforce the limit itself. It neither asks nor awaits a vehicle whose certificate is no longer in force.
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

STARTING_S = 120.0  # timeout of a SuperLink's return [s]
REJOIN_S = 180.0  # timeout of a vehicle that the network lost [s]
ALLOWANCE_S, SLOWEST_MBPS = 60.0, 1.0  # beyond the time to train: polls and a fork [s]; slowest link [Mbit/s]
LOOK_S = 0.5  # between queries of the registry [s]
LONGEST = 500  # characters shown of a vehicle's error
BUSY_S = 0.1  # timeout of a query of a registry locked by another process [s]
AGAIN_S = 150.0  # before a request without an answer is repeated; doubled each time [s]
POLL_S, PAUSE_S = 0.2, 1.0  # between queries of answers; before an absent vehicle is asked again [s]
RAISED = 2  # Flower's error code of an app that raised an exception, with its message as the reason
FULL = re.compile(rf"\[Errno (?:{errno.ENOSPC}|{errno.EDQUOT}|{errno.EFBIG})\] ([A-Z][A-Za-z ]*)")
TRANSPORT = (3, 4, 5, 8)  # Flower's error codes of unavailable messages and nodes, and of a crashed app
SPARE_BYTES, CLIENT_BYTES = 1 << 16, 512  # of the largest answer: besides arrays; per client


class DeployedGrid(LinkGrid):
    """A grid of deployed vehicles, which starts another run when Flower aborts one."""

    def __init__(
        self,
        folder: Path,
        link: SuperLink,
        names: Mapping[int, str],
        vehicles: Mapping[int, RegisteredVehicle],
        account: Account,
        limit_s: float | None = None,
    ) -> None:
        """Connect to nodes of the fleet in `folder`, given the clients' `names` and the registered `vehicles` by node.

        limit_s: time limit of training in a round [s]; None: none.
        """
        self._folder, self._link, self.names, self._vehicles, self._account = folder, link, names, vehicles, account
        self._limit_s = limit_s
        self.authority = load_certificate(folder)
        self._largest = 0  # largest request to train so far [bytes]
        self._rounds: tuple[RoundProgress, ...] = ()
        self._waits: dict[str, str] = {}  # reason of waiting, by client
        self._gone: dict[str, str] = {}  # reason of exclusion from the federation, by client
        self._silent: set[int] = set()  # nodes that were given up and have not answered since
        self._look = 0.0  # time of the next query of the registry [s]
        self._begin()

    def _begin(self) -> None:
        self._link.wait(STARTING_S)
        self._run = self._link.begin()
        self._run.identify()
        self._grid: Grid = self._run.grid

    def _renew(self) -> None:
        """Start another run as soon as the SuperLink is available."""
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
        """Write a completed round to the fleet's folder, for `flcav fleet status`."""
        about = time.time(), len(record.clients), record.failed, record.loss, record.epsilon, record.empty
        self._rounds = (*self._rounds, RoundProgress(record.round, *about))
        self._waits = {}
        self._tell()

    def _tell(self) -> None:
        account, link = self._account, self._account.link
        used, left = account.ledger.used_mb(link), account.ledger.left_mb(link)
        progress = FederationProgress(
            account.stage, account.task, link, used, left, self._rounds, self._waits, self._gone
        )
        with contextlib.suppress(OSError):  # a full disk must not end the federation
            progress.save(self._folder)

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
        """Yield the replies in the order of the messages; those beyond their grants become errors.

        Nodes that claim to have withheld an answer for its size come last. `BudgetExceeded` is raised if the claim is
        plausible: another client's answer was larger than the grant or, if there is none, the largest possible one is.
        timeout: of all replies together [s].
        """
        asked = {message.metadata.dst_node_id: message for message in messages}
        exchange = _Exchange(self._count_losses())
        kept = list[int]()
        largest = 0
        # one answer per node; those that arrive before their turn wait here
        answers: dict[int, Message] = {}
        end = time.monotonic() + (timeout or float("inf"))
        late_s = self._limit_answers(asked.values())
        self._look = 0.0
        for node, message in asked.items():
            while node not in answers:
                self._strike(asked, answers)
                try:
                    due = [number for number in asked if number not in answers and exchange.is_due(number)]
                    if due:
                        self._push(exchange, {number: asked[number] for number in due})
                    self._pull(exchange, asked, answers)
                    self._give_up(exchange, late_s, asked, answers)
                except SuperLinkLost:
                    self._renew()
                    exchange = _Exchange(self._count_losses(), exchange.granted)
                if node not in answers:
                    if time.monotonic() > end:
                        yield from self._judge(exchange, {number: asked[number] for number in kept}, largest)
                        return
                    exchange.notice(self._count_losses())
                    time.sleep(POLL_S)
            reply = answers.pop(node)
            answers[node] = message  # marks the node as answered
            if reply.has_error() and reply.error.code == OVER_BUDGET:
                kept.append(node)
                continue
            if reply.has_content():
                size = wire_bytes(reply.content)
                if size > exchange.granted[node]:
                    excess = f"an answer of {size} bytes, where {exchange.granted[node]} were granted"
                    reply = Message(Error(RAISED, excess), reply_to=message)
                else:
                    largest = max(largest, size)
            yield reply
        yield from self._judge(exchange, {number: asked[number] for number in kept}, largest)

    def _judge(self, exchange: "_Exchange", kept: Mapping[int, Message], largest: int) -> Iterator[Message]:
        """Yield an error per node that claims to have withheld its answer; raise `BudgetExceeded` if that is plausible.

        kept: requests to these nodes, by node. largest: size of the largest answer received [bytes].
        """
        for node, message in kept.items():
            granted = exchange.granted[node]
            if granted < (largest or self._most_bytes):
                name = self.names[node]
                link = self._account.link
                raise BudgetExceeded(
                    f"{name}: an answer of more than the {granted} bytes that are left on the {link} uplink"
                )
            yield Message(Error(RAISED, f"no answer, as if {granted} bytes were too few for it"), reply_to=message)

    @property
    def _most_bytes(self) -> int:
        """Return an upper bound on the size of an answer to a request to train so far [bytes].

        It is the weights, times two for 16-bit numbers masked in 32 bits, times two for coordinates or a strategy's
        further arrays, plus the entries of secure aggregation per client.
        """
        return 4 * self._largest + CLIENT_BYTES * len(self.names) + SPARE_BYTES

    def _limit_answers(self, messages: Iterable[Message]) -> float:
        """Return the timeout of answers: training, allowance, and transmission of request and answer [s]."""
        if self._limit_s is None:
            return float("inf")
        contents = {id(message.content): message.content for message in messages}.values()  # many share one
        size_mb = max(map(wire_bytes, contents), default=0) / 1e6
        return self._limit_s + ALLOWANCE_S + 2 * 8 * size_mb / SLOWEST_MBPS

    def _strike(self, asked: Mapping[int, Message], answers: dict[int, Message]) -> None:
        """Add errors for the nodes whose certificate is no longer in force; look at most every `LOOK_S`."""
        if time.monotonic() < self._look:
            return
        self._look = time.monotonic() + LOOK_S
        try:
            with contextlib.closing(open_registry(self._folder, BUSY_S)) as registry:
                found = {node: registry.find(vehicle.fingerprint) for node, vehicle in self._vehicles.items()}
        except (InputError, OSError):  # locked by another process, or damaged, which others report
            return
        for node, vehicle in found.items():
            state = "not registered" if vehicle is None else vehicle.describe_state()
            if state == "registered":
                continue
            name = self.names[node]
            why = f"the certificate of {self._vehicles[node].name} is {state}"
            if node in asked and node not in answers:
                answers[node] = Message(Error(LOST_BY_NETWORK, why), reply_to=asked[node])
            if name not in self._gone:
                self._gone[name] = why
                self._waits.pop(name, None)
                self._tell()

    def _give_up(
        self, exchange: "_Exchange", late_s: float, asked: Mapping[int, Message], answers: dict[int, Message]
    ) -> None:
        """Add errors for the nodes without an answer in time."""
        for node, message in asked.items():
            if node not in answers and exchange.waited_s(node) > late_s:
                self._silent.add(node)
                answers[node] = Message(Error(RAISED, f"it had not answered after {late_s:.0f} s"), reply_to=message)

    def _push(self, exchange: "_Exchange", due: Mapping[int, Message]) -> None:
        """Send requests to nodes, with the granted sizes of their answers."""
        left = min(max(0, int(self._account.ledger.left_mb(self._account.link) * 1e6)), 2**62)
        sent = []
        for node, message in due.items():
            content = {**message.content}
            trains = message.metadata.message_type == MessageType.TRAIN
            if trains:
                self._largest = max(self._largest, wire_bytes(message.content))
            most = min(left, self._most_bytes) if trains else left if GRANT in content else 2**62
            # a repeated request keeps its first grant: the vehicle then sends the same answer
            granted = exchange.granted.setdefault(node, most)
            if trains or GRANT in content:
                content[GRANT] = ConfigRecord({GRANTED: granted})
            sent.append(Message(RecordDict(content), node, message.metadata.message_type))
        for identifier, node in zip(self._grid.push_messages(sent), due, strict=True):
            exchange.sent(node, identifier)

    def _pull(self, exchange: "_Exchange", asked: Mapping[int, Message], answers: dict[int, Message]) -> None:
        """Add the answers that have arrived; an unavailable node is asked again later."""
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
        """Return by node how often a request may have been lost: activations, and losses at the SuperLink."""
        found = read_traffic(self._folder).vehicles
        there = {node: found[seen.name] for node, seen in self._vehicles.items() if seen.name in found}
        return {node: seen.activations + seen.lost for node, seen in there.items()}


def _in_plain_words(reply: Message, message: Message) -> Message:
    """Return a reply; an error gets an app's code, whatever the vehicle sent, and a printable reason."""
    if not reply.has_error():
        return reply
    code = OVER_BUDGET if reply.error.code == OVER_BUDGET else RAISED
    return Message(Error(code, make_printable(str(reply.error.reason), LONGEST)), reply_to=message)


def _excuse(reply: Message) -> str | None:
    """Return the reason of a transient failure to answer: the vehicle was absent, or its disk is full; else None."""
    if not reply.has_error():
        return None
    if reply.error.code in TRANSPORT:
        return make_printable(str(reply.error.reason), LONGEST)
    if reply.error.code == RAISED and (full := FULL.search(str(reply.error.reason))):
        return f"no room on the vehicle's disk: {full[1]}"
    return None


class _Exchange:
    """The state of an exchange in a run: requests sent, and when to repeat them."""

    def __init__(self, losses: Mapping[int, int], granted: Mapping[int, int] = {}) -> None:
        self.granted = dict(granted)  # size of an answer by node [bytes]
        self.nodes: dict[str, int] = {}  # by id of the outstanding message
        self._losses = dict(losses)
        self._due: dict[int, float] = {}  # time at which to repeat a request, by node [s]
        self._patience: dict[int, float] = {}  # interval of the next repetition, by node [s]
        self._lost: dict[int, float] = {}  # time since which a node is unavailable [s]
        self._begun: dict[int, float] = {}  # time of the first request, by node [s]

    def is_due(self, node: int) -> bool:
        return time.monotonic() >= self._due.get(node, 0.0)

    def is_late(self, node: int) -> bool:
        return node in self._lost and time.monotonic() > self._lost[node] + REJOIN_S

    def sent(self, node: int, identifier: str) -> None:
        self.nodes[identifier] = node
        self._due[node] = time.monotonic() + self._patience.get(node, AGAIN_S)
        self._patience[node] = 2 * self._patience.get(node, AGAIN_S)
        self._begun.setdefault(node, time.monotonic())

    def waited_s(self, node: int) -> float:
        return time.monotonic() - self._begun.get(node, float("inf"))

    def lost(self, node: int) -> None:
        self._lost.setdefault(node, time.monotonic())
        self._due[node] = time.monotonic() + PAUSE_S

    def notice(self, losses: Mapping[int, int]) -> None:
        """Note losses at nodes: their requests are repeated, and the answers will be the same."""
        for node, count in losses.items():
            if count > self._losses.get(node, count) and node in self._due:
                self._due[node] = time.monotonic() + PAUSE_S
        self._losses = dict(losses)
