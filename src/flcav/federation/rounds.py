"""Synchronous federated rounds as a Flower strategy: who trains, whose updates count, and how they are combined.

Flower's own strategies sample nodes from the global random state, multiply integer buffers by floats, and skip a whole
round where one client fails.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from flwr.app import ArrayRecord, ConfigRecord, Message, MessageType, MetricRecord, RecordDict
from flwr.serverapp import Grid
from flwr.serverapp.strategy import Strategy as FlowerStrategy
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.federation.acceptance import Expected, ReplyRefused, extra_forms, read_masked, read_norm, read_update
from flcav.federation.attendance import Attendance, ClientFailed
from flcav.federation.encoding import unflatten
from flcav.federation.noise import derive_key
from flcav.federation.privacy import account_epsilon, average_privately, expected_clients
from flcav.federation.records import (
    ARRAYS,
    ASK,
    CENTRE,
    CONFIG,
    COUNT,
    EXTRA,
    LOSS,
    LOST_BY_NETWORK,
    NORM,
    SAMPLES,
    SEND,
    VECTOR,
    LocalWork,
    to_arrays,
    to_weights,
)
from flcav.federation.rules import Rules, SecureAggregation
from flcav.federation.secure.masks import to_values
from flcav.federation.secure.messages import SecureSum, TooFewClients
from flcav.federation.secure.parties import SumLost, settle_complaints
from flcav.federation.state import SERVER, FederationState, RoundRecord
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedavg import RunningMean, average
from flcav.federation.strategies.strategy import Averages, Exchanges, Stateful, find_weigher
from flcav.federation.trainable import LocalUpdate, Weights, forms_of, learned_names

OnRound = Callable[[int, Weights, float | None], None]  # aggregated round, its weights, mean training loss
AnswerT = TypeVar("AnswerT")
WHOLE = (1, 1.0)  # samples and loss of the one update that a strategy is given where the server averages them itself
ANSWER_S = 3600.0  # that answers are waited for where nodes are elsewhere; Flower's own limit for updates
Away = Callable[[int], Mapping[str, str]]  # of a round, by client why it is not there when the round begins


class Intake:
    """The usable updates of a round: all of them or, where a strategy needs no more, their mean as they come in."""

    def __init__(self, weigher: Averages | None) -> None:
        """Add up by the weights of `weigher`; None: keep every update."""
        self._weigher, self._mean = weigher, RunningMean()
        self._extra: dict[str, NDArray[np.number]] = {}  # sums of the arrays beside the weights
        self.updates: dict[str, LocalUpdate] = {}  # by client, where they are kept
        self.samples: dict[str, int] = {}  # by client
        self.losses: dict[str, float] = {}  # by client

    def add(self, client: str, update: LocalUpdate) -> None:
        """Add a client's update."""
        self.samples[client], self.losses[client] = update.samples, update.loss
        if self._weigher is None:
            self.updates[client] = update
            return
        self._mean.add(update.weights, self._weigher.weigh(update))
        for name, array in update.extra.items():
            self._extra[name] = self._extra.get(name, 0.0) + array.astype(np.float64)

    @property
    def combinable(self) -> list[LocalUpdate]:
        """Return what a strategy is given: all updates, or one that stands for them; none where none came."""
        if self._weigher is None or not self.samples:
            return [*self.updates.values()]
        return [LocalUpdate(self._mean.mean(), sum(self.samples.values()), 0.0, extra=self._extra)]

    def mean_loss(self) -> float | None:
        """Return the mean loss weighted by samples; None where no update came."""
        return float(np.average([*self.losses.values()], weights=[*self.samples.values()])) if self.samples else None


class Rounds(FlowerStrategy):
    """Flower strategy of a federation: in each round clients train, and `strategy` combines their updates.

    `rules` say who takes part, what is sent and what is kept private; `work` gives the local training of a round by its
    number; numbers continue after the `done` rounds. `names` are the clients' names by node. `earlier` is the number of
    rounds of earlier federations with the same clients, which privacy is accounted with and after which the turns of
    round-robin go on. `state` is changed in place; `on_round` is called after each aggregation. `centre` is the model
    that clients are pulled to, if any. `away` tells who is not there when a round begins: they take no part in it.
    """

    def __init__(
        self,
        strategy: Strategy,
        rules: Rules,
        work: Callable[[int], LocalWork],
        names: Mapping[int, str],
        state: FederationState,
        done: int,
        earlier: int,
        on_round: OnRound,
        centre: Weights | None = None,
        away: Away = lambda _: {},
    ) -> None:
        self._strategy, self._rules, self._work, self._names = strategy, rules, work, names
        self._state, self._done, self._earlier, self._on_round = state, done, earlier, on_round
        self._centre, self._away = centre, away
        self._nodes = {name: node for node, name in names.items()}
        self._expected = Expected(rules, {})  # of the updates of this round
        self._here = Attendance()  # of this round
        self._drawn: dict[str, float] = {}  # of unbiased selection: probability of the clients that were drawn
        self._secure: SecureSum | None = None  # of this round
        self._begin: Callable[[list[str]], list[Message]]  # masks among clients, of this round
        self._grid: Grid  # of this round
        self._shares: dict[str, float] = {}  # of unbiased selection: of all samples, by client

    def summary(self) -> None:
        """Log nothing: the stage's own records hold the settings."""

    def configure_train(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Return one training message per chosen client: the round's weights and its local work.

        Under importance selection all clients train and report the norm of their update, and those that are drawn are
        asked to send it. Under other unbiased selections all first report their number of samples. Where fewer take
        part than `least_clients`, nobody is asked to send an update.
        """
        start = to_weights(arrays)
        work, records = self._work(self._done + server_round), {ARRAYS: arrays}
        sent = self._strategy.send(self._state.server) if isinstance(self._strategy, Exchanges) else {}
        if sent:
            records[EXTRA] = to_arrays(sent)
        self._expected = Expected(self._rules, start, extra_forms(self._strategy, self._rules, start, sent))
        if self._centre is not None:
            records[CENTRE] = to_arrays({name: self._centre[name] for name in learned_names(self._centre)})
        selection, local = self._rules.selection, work.record()
        chosen = selection.choose([*self._names.values()], work.round, self._draws_by(work), self._earlier)
        asked = [*self._names.values()] if selection.unbiased else chosen
        self._here = Attendance(asked, chosen, self._away(work.round))
        if selection.unbiased:
            self._draw_unbiased(grid, local)
        if selection.rule == "importance":
            requests = self._address(chosen, {**records, CONFIG: local, ASK: ConfigRecord({ASK: NORM})})
            self._drawn = selection.draw(
                self._receive_norms(chosen, grid.send_and_receive(requests, timeout=ANSWER_S)), work.seed
            )
            self._here.chosen, records = [*self._drawn], {ASK: ConfigRecord({ASK: SEND})}
        self._here.count(self._rules)
        if self._here.shortage is not None:
            return []
        if self._rules.secure is not None:
            self._grid = grid
            self._begin = partial(self._begin_securely, grid, {**records, CONFIG: local}, self._rules.secure)
            return self._begin(self._here.chosen)
        return self._address(self._senders, {**records, CONFIG: local})

    @property
    def _senders(self) -> list[str]:
        """Return who is asked for an update: all that are chosen, or of an unbiased selection those who reported."""
        return [*self._drawn] if self._rules.selection.weighs else self._here.chosen

    def _draws_by(self, work: LocalWork) -> int:
        """Return the seed that the clients of a round are drawn by: that of the round, or one that nobody knows."""
        if not self._rules.hides_draws:
            return work.seed
        return int.from_bytes(self._key("selection", work), "little")

    def _key(self, purpose: str, work: LocalWork) -> bytes:
        return derive_key(self._state.keep_secret(SERVER), purpose, work.round, work.seed)

    def _draw_unbiased(self, grid: Grid, local: ConfigRecord) -> None:
        """Ask all clients for their numbers of samples; note the shares, and the probabilities of those chosen."""
        names = [*self._names.values()]
        requests = self._address(names, {CONFIG: local, ASK: ConfigRecord({ASK: COUNT})})
        self._receive_norms(names, grid.send_and_receive(requests, timeout=ANSWER_S))
        reported = [name for name in self._here.chosen if name in self._shares]
        self._drawn = dict.fromkeys(reported, self._rules.selection.inclusion_probability(len(names)))

    def _begin_securely(
        self, grid: Grid, records: dict[str, Any], how: SecureAggregation, clients: list[str]
    ) -> list[Message]:
        """Exchange keys and shares among clients, and return the messages to those who are left.

        Nobody is sent a message where too few are left.
        """

        def exchange(
            asks: Mapping[str, ConfigRecord], read: Callable[[str, RecordDict], AnswerT]
        ) -> dict[str, AnswerT]:
            asked = [each for name, ask in asks.items() for each in self._address([name], {CONFIG: local, ASK: ask})]
            return dict(self._read([*asks], grid.send_and_receive(asked, timeout=ANSWER_S), read))

        local = records[CONFIG]
        self._secure = SecureSum(exchange, how.needed(len(self._here.chosen)))
        try:
            asks = self._secure.agree(clients)
        except TooFewClients as error:
            self._here.shortage, asks = error, {}
        return [each for name, ask in asks.items() for each in self._address([name], {**records, ASK: ask})]

    def _address(self, clients: Iterable[str], records: dict[str, Any]) -> Iterator[Message]:
        content = RecordDict(records)
        for client in clients:
            yield Message(content=content, message_type=MessageType.TRAIN, dst_node_id=self._nodes[client])

    def aggregate_train(
        self, server_round: int, replies: Iterable[Message]
    ) -> tuple[ArrayRecord | None, MetricRecord | None]:
        """Return the aggregated weights, and as metrics the number of samples and the mean loss weighted by samples.

        Where who was drawn is to stay secret, the record has nothing of the clients, and both numbers are 0.

        Where fewer are left than the strategy needs, or the network lost clients and fewer are left than secure
        aggregation needs, or where fewer take part than secure aggregation or `least_clients` asks for and none failed,
        or where clients revealed shares that leave no way to the sum, the weights stay as they were, and the record
        names those who were chosen as failed, with the reason; where nobody was drawn it names nobody.
        Raises `ClientFailed` where fewer clients than are wanted sent a usable update, or where fewer take part than
        are wanted and clients failed to report, `TooFewClients` where so few are left for secure aggregation,
        ValueError where the strategy returns arrays of other names, shapes or types.
        """
        number, here = self._done + server_round, self._here
        received = Intake(None) if here.shortage else self._receive(replies)
        here.check(self._rules, self._strategy, number)
        try:
            if here.shortage is not None:
                raise here.shortage
            weights = self._combine(received, number)
        except (ClientFailed, TooFewClients, SumLost) as error:
            if isinstance(error, TooFewClients) and not (here.lost or here.few):
                raise
            weights, received = self._expected.start, Intake(None)
            here.failed |= {name: str(error) for name in here.chosen if name not in here.failed}
        loss, epsilon = received.mean_loss(), None
        if self._rules.privacy is not None:
            rounds, names = self._earlier + number, [*self._names.values()]
            epsilon = account_epsilon(self._rules.privacy, self._rules.selection, names, rounds)
        samples = sum(received.samples.values())
        record = RoundRecord(number, tuple(received.samples), here.failed, epsilon, loss, samples)
        if self._rules.hides_draws:
            record = RoundRecord(number, (), epsilon=epsilon)
        self._state.records.append(record)
        self._on_round(number, weights, record.loss)
        return to_arrays(weights), MetricRecord({SAMPLES: record.samples, LOSS: record.loss or 0.0})

    def _receive_norms(self, asked: Iterable[str], replies: Iterable[Message]) -> dict[str, float]:
        """Return the norms of the clients' updates times their shares of all samples, by client in node order."""
        told = dict(self._read(asked, replies, lambda _, content: read_norm(content, self._rules)))
        total = sum(samples for _, samples in told.values())
        self._shares = {name: samples / max(total, 1) for name, (_, samples) in told.items()}
        return {name: norm * self._shares[name] for name, (norm, _) in told.items()}

    def _read(
        self, asked: Iterable[str], replies: Iterable[Message], read: Callable[[str, RecordDict], AnswerT]
    ) -> Iterator[tuple[str, AnswerT]]:
        """Yield by client, in the order in which they were asked, what `read` makes of its name and its reply.

        Clients that fail, and those whose reply is refused, are noted with the reason.
        """
        for name, message in self._in_order(asked, replies):
            try:
                found = read(name, message.content)
            except ReplyRefused as error:
                self._here.failed[name] = str(error)
            else:
                yield name, found

    def _in_order(self, asked: Iterable[str], replies: Iterable[Message]) -> Iterator[tuple[str, Message]]:
        """Yield the replies with content by client, in the order in which they were asked; note the failures.

        Replies that come in that order are yielded as they come, and not kept.
        """
        awaited = deque(self._nodes[name] for name in asked)
        early: dict[int, Message] = {}
        for message in chain(replies, [None]):
            if message is not None:
                early[message.metadata.src_node_id] = message
            while awaited and (message is None or awaited[0] in early):
                node = awaited.popleft()
                found, name = early.pop(node, None), self._names[node]
                if found is None:
                    self._here.failed.setdefault(name, "no answer")  # or what it failed by before
                elif found.has_error():
                    self._here.failed[name] = str(found.error.reason)
                    self._here.lost |= {name} if found.error.code == LOST_BY_NETWORK else set()
                else:
                    yield name, found

    def _receive(self, replies: Iterable[Message]) -> Intake:
        """Return the usable updates, and note what is wrong with the others."""
        if self._secure is not None:
            return self._receive_masked(self._secure, replies)
        plain = self._rules.privacy is None and not self._rules.selection.weighs
        received = Intake(find_weigher(self._strategy) if plain else None)
        for name, update in self._read(self._senders, replies, lambda _, content: read_update(content, self._expected)):
            received.add(name, update)
        return received

    def _receive_masked(self, secure: SecureSum, replies: Iterable[Message]) -> Intake:
        """Return the masked updates.

        Where shares that one client sealed for another do not open, the round is begun anew without the liars.
        """
        received, complaints, here, peers = Intake(None), {}, self._here, secure.peers

        def read(name: str, content: RecordDict) -> LocalUpdate | Sequence[str]:
            return read_masked(content, self._expected, [peer for peer in peers if peer != name])

        for name, answer in self._read(here.chosen, replies, read):
            if isinstance(answer, LocalUpdate):
                received.add(name, answer)
            else:
                complaints[name] = answer
        if not complaints:
            return received
        here.failed |= settle_complaints(complaints)
        again = self._begin([name for name in peers if name not in here.failed])
        return Intake(None) if here.shortage else self._receive(self._grid.send_and_receive(again, timeout=ANSWER_S))

    def _average_securely(self, updates: Mapping[str, LocalUpdate], how: SecureAggregation) -> Weights:
        """Return start + (sum of the clients' changes) / their number; the sum is all that is unmasked."""
        assert self._secure is not None
        masked = {name: np.asarray(update.weights[VECTOR], np.uint32) for name, update in updates.items()}
        summed, liars = self._secure.finish(masked)
        self._here.failed |= liars
        total = to_values(summed, how.largest, len(self._secure.peers))
        return unflatten(total / len(updates), self._expected.start, self._rules)

    def _combine(self, received: Intake, number: int) -> Weights:
        """Return the weights after round `number`, and change the strategy's state."""
        privacy, start, updates, each = self._rules.privacy, self._expected.start, received.updates, received.combinable
        if self._rules.secure is not None:
            each = [LocalUpdate(self._average_securely(updates, self._rules.secure), *WHOLE)]
        elif privacy is not None and not privacy.local:
            sent = self._rules.upload.exchanged(start)
            names = [name for name in learned_names(start) if name in sent]
            expected = float(len(self._here.chosen))
            if self._rules.selection.rule == "poisson":  # by chance more or fewer come
                expected = expected_clients(self._rules.selection, [*self._names.values()])
            work = self._work(number)
            key = None if privacy.seeded else self._key("noise", work)
            mean = average_privately(start, each, names, privacy, expected, work.seed, key)
            each = [LocalUpdate(mean, *WHOLE)]
        elif self._rules.selection.weighs and updates:
            weights = {name: self._shares[name] / self._drawn[name] for name in updates}
            each = [LocalUpdate(average_inversely(start, updates, weights), *WHOLE)]
        if not each:
            return start
        name = type(self._strategy).__name__
        try:
            if isinstance(self._strategy, Stateful):
                weights, after = self._strategy.step(start, each, self._state.server, len(self._names))
                self._state.server = {name: np.asarray(array) for name, array in after.items()}
            else:
                weights = self._strategy.combine(start, each)
        except ValueError as error:
            raise InputError(f"strategy {name}, round {number}: {error}") from error
        if forms_of(weights) != forms_of(start):
            raise InputError(f"{name} returned arrays of other names, shapes or types than the round started from")
        return weights

    def configure_evaluate(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Return no messages: vehicles have no ground truth for an evaluation."""
        return []

    def aggregate_evaluate(self, server_round: int, replies: Iterable[Message]) -> MetricRecord | None:
        """Return None: clients do not evaluate."""
        return None


def average_inversely(start: Weights, updates: Mapping[str, LocalUpdate], weights: Mapping[str, float]) -> Weights:
    """Return start + sum_i weights_i (w_i - start) of learned arrays; of all others the mean of the updates.

    With weights_i = share_i / probability_i it is the unbiased (Horvitz-Thompson) estimate of the mean of all clients.
    """
    names = learned_names(start)
    moved: dict[str, Any] = {name: np.zeros(start[name].shape) for name in names}
    for client, update in updates.items():
        for name in names:
            moved[name] += weights[client] * (update.weights[name].astype(np.float64) - start[name])
    mean = average([update.weights for update in updates.values()], [*weights.values()])
    return mean | {name: (start[name] + array).astype(start[name].dtype) for name, array in moved.items()}
