"""Federated learning: the round loop, and a round from weights to weights. Edge and cloud are two uses of it.

`federate` repeats `Server.run_round`. A round calls the clients that take part, sends them the weights and their local
work, checks every update as it arrives, combines those that count, and keeps a record. Flower carries the messages;
its own strategies sample clients from the global random state, multiply integer buffers by floats, and skip a whole
round where one client fails.
"""

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from cryptography import x509
from flwr.app import ConfigRecord, Message, MessageType, RecordDict
from flwr.serverapp import Grid

from flcav.config import InputError
from flcav.federation.acceptance import Expected, NoSamples, ReplyRefused, extra_forms, read_norm, read_update
from flcav.federation.checks import check_federation, check_weights
from flcav.federation.client import kept_records
from flcav.federation.exchange import Attendance, ClientFailed, Intake
from flcav.federation.links.link import ANSWER_S, Ask, Runtime, open_link
from flcav.federation.links.metered import Account, open_account
from flcav.federation.modes.buffered import Buffering, Buffers, afford_buffers, is_spent, take_turns
from flcav.federation.modes.masked import SecureRound
from flcav.federation.privacy import (
    account_epsilon,
    affordable_rounds,
    average_privately,
    derive_key,
    expected_clients,
    find_noise,
    least_participations,
)
from flcav.federation.rules import Rules
from flcav.federation.secure.messages import TooFewClients
from flcav.federation.secure.parties import SumLost
from flcav.federation.state import SERVER, FederationState, RoundRecord
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.fedavg import NoShares, average_inversely
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.strategy import Exchanges, Stateful, find_weigher
from flcav.federation.trainable import Distiller, LocalUpdate, Trainable, Weights, forms_of, learned_names
from flcav.federation.wire import (
    ARRAYS,
    ASK,
    CENTRE,
    CONFIG,
    COUNT,
    EXTRA,
    NORM,
    SEND,
    Arrived,
    LocalWork,
    list_events,
    to_arrays,
)
from flcav.statistics.streams import derive_seed

EVERYBODY = Rules()
WHOLE = (1, 1.0)  # samples and loss of the one update that a strategy is given where the server averages them itself
BeforeRound = Callable[[int, Weights], None]  # called with the round's number and the weights that it begins with
AskAfter = Callable[[int, Weights, Ask], None]  # called with number, aggregated weights and a way to ask clients
OnRound = Callable[[int, Weights, float | None], None]  # called with number, aggregated weights and mean training loss
AnswerT = TypeVar("AnswerT")
logging.getLogger("flwr").setLevel(logging.ERROR)  # Flower logs each message; a stage reports its rounds


@dataclass(frozen=True)
class Schedule:
    """Number of rounds, local steps per round, and a learning rate that decays geometrically over the rounds."""

    rounds: int  # in all, those already done included
    steps: int  # local optimiser steps per round
    learning_rate: float  # in the first round
    final_learning_rate: float  # in the last round, where there are several
    seed: int  # of the federation; each round derives its own

    def work(self, round_: int) -> LocalWork:
        """Return the local work of round `round_`, counted from 1."""
        progress = (round_ - 1) / max(self.rounds - 1, 1)
        rate = self.learning_rate * (self.final_learning_rate / self.learning_rate) ** progress
        return LocalWork(round_, self.steps, rate, derive_seed(self.seed, "round", round_))


def _do_nothing(*_: object) -> None:
    pass


def federate(
    clients: Mapping[str, Trainable],
    weights: Weights,
    schedule: Schedule,
    account: Account | None = None,
    *,
    strategy: Strategy = FEDAVG,
    rules: Rules = EVERYBODY,
    state: FederationState | None = None,
    done: int = 0,
    earlier: int = 0,
    before_round: BeforeRound = _do_nothing,
    ask_after: AskAfter = _do_nothing,
    on_round: OnRound = _do_nothing,
    runtime: Runtime | None = None,
    centre: Weights | None = None,
    distiller: Distiller | None = None,
    buffers: Buffers | None = None,
) -> LocalUpdate:
    """Run rounds `done + 1 .. schedule.rounds` of a federation, by default of federated averaging.

    In each round every client trains, unless `rules` say otherwise, and `strategy` combines their updates (McMahan et
    al., AISTATS 2017, algorithm 1). To resume, pass the same strategy and rules, the weights and the number of the last
    round that `on_round` was given, and the state after it. Noise that is not seeded is drawn by secrets, which are
    kept in `state`: without it no federation can be repeated, nor gone on with to the same weights. Under a privacy
    budget the last rounds are those that it affords; without noise it is that for all of them. Where epsilon rests on
    secret draws of clients, records and ledger do not name them. A round in which no client has samples leaves the
    weights as they are and is marked `empty`; `rules.empty_rounds` of them in a row are the last.

    Args:
        clients: by name; a client is asked for when it is to train, and of updates no more are in memory than the
            strategy needs.
        weights: of the model that the first round begins with, arrays by name.
        schedule: number of rounds, local steps, learning rates and seed.
        account: the ledger that every message is entered in, and whom the network loses; None: nobody counts.
        strategy: how updates are combined, and how clients correct their training.
        rules: who takes part, what is sent, what is kept private, and how many are needed.
        state: what server and clients keep between rounds, changed in place, with a record of every round.
        done: number of rounds that are over.
        earlier: number of rounds of federations before this one with the same clients and rules, which count against
            a privacy budget, and after which the turns of round-robin go on.
        before_round: called before each round.
        ask_after: called after each round and before `on_round`, to ask clients that `Answers`.
        on_round: called after each round; `state` is then that of the round.
        runtime: where clients train: None: in this process; `ClientProcesses` of the same clients; Flower's simulation
            on Ray. The weights are the same.
        centre: weights that clients are pulled to by the `personal` of the rules.
        distiller: the server's network under `FedMD`, whose clients send outputs: after a round it learns from their
            mean, which is sent down in the next one; in the first it sends its own.
        buffers: of `FedBuff`, the rounds by a clock; None: clients are equally fast, and messages take no time. It ends
            where an update would exceed a budget, which is not sent.

    Returns:
        The weights after the last round, and of that round the number of samples of all clients and their mean training
        loss, weighted by samples; without a round to run `weights`, 0 samples and a loss of 0.

    Raises `BudgetExceeded` where a message would exceed a budget, `ClientFailed` where clients raised or sent what is
    no update, and fewer are left than `rules` ask for (by default half of those asked), `TooFewClients` where fewer are
    left than secure aggregation needs, though `account` lost none and none is without samples; both have the weights
    after the last round that came to an end, `reached`. Raises `InputError` where there are no clients, `weights` are
    no finite arrays, `rules` or `strategy` ask for what they cannot do, or `strategy` changes names, shapes or types of
    the arrays.

    >>> import numpy as np
    >>> from flcav import federate
    >>> from flcav.federation import LocalUpdate, Schedule
    >>> class Vehicle:  # of a task: flcav.perception.TaskClient
    ...     def __init__(self, samples):
    ...         self.samples = samples
    ...     def train(self, weights, *, steps, learning_rate, seed):
    ...         return LocalUpdate({"w": weights["w"] + self.samples}, self.samples, loss=0.0)
    >>> schedule = Schedule(rounds=1, steps=1, learning_rate=0.1, final_learning_rate=0.1, seed=0)
    >>> vehicles = {"cav0": Vehicle(1), "cav1": Vehicle(3)}
    >>> federate(vehicles, {"w": np.zeros(2)}, schedule).weights["w"]
    array([2.5, 2.5])
    """
    check_federation(clients, strategy, rules)
    check_weights(weights, "weights to begin with")
    state, account, rounds, names = state or FederationState(), account or open_account(), schedule.rounds, [*clients]
    sent = _find_sent(weights, state, distiller)
    rules.upload.check_layers(sent)
    buffering = None
    if isinstance(strategy, FedBuff):
        buffers = buffers or take_turns(names, strategy.buffer, rounds)
        buffering = Buffering(strategy, buffers, account)
        rounds = min(rounds, afford_buffers(buffers, rules.privacy))
    elif rules.privacy is not None:
        privacy = find_noise(rules.privacy, rules.selection, len(names), earlier + rounds)
        rules = rules.model_copy(update={"privacy": privacy})
        rounds = affordable_rounds(privacy, rules.selection, names, rounds, earlier)
    if rounds <= done or _is_over(state, rules):
        return LocalUpdate(weights, 0, 0.0)
    kept, account = kept_records(strategy, rules), replace(account, concealed=rules.hides_draws)
    rules = rules.settle_threshold(names, certified=getattr(runtime, "deployed", False))
    secrets = {party: state.keep_secret(party) for party in rules.secret_parties(names) if party in clients}
    spent = least_participations(rules.selection, len(names), earlier) if buffers is None else buffers.least_before
    with open_link(clients, runtime, account, strategy, rules, state.clients, secrets, spent) as link:
        server = Server(
            *(link.grid, link.names, strategy, rules, schedule.work, state, earlier, centre, account.find_away),
            buffering,
            link.authority,
        )
        for number in range(done + 1, rounds + 1):
            before_round(number, weights)
            try:
                combined = server.run_round(number, sent)
            except (ClientFailed, TooFewClients) as error:
                error.reached = weights
                raise
            state.clients = link.read_states(kept) if kept else state.clients
            if distiller is None:
                weights = combined
            elif not state.records[-1].empty:
                weights = _imitate(distiller, strategy, weights, combined, schedule.work(number))
                state.server = {name: np.asarray(array) for name, array in combined.items()}
            link.follow(state.records[-1])
            ask_after(number, weights, link.ask)
            on_round(number, weights, state.records[-1].loss)
            sent = combined
            if _is_over(state, rules):
                break
    last = state.records[-1]
    return LocalUpdate(weights, last.samples, last.loss or 0.0)


def _is_over(state: FederationState, rules: Rules) -> bool:
    """Return whether a federation ends before its last round: over a budget, or since too many rounds were empty."""
    most = rules.empty_rounds
    empty = most is not None and len(state.records) >= most and all(each.empty for each in state.records[-most:])
    return empty or is_spent(state)


def _find_sent(weights: Weights, state: FederationState, distiller: Distiller | None) -> Weights:
    """Return what the first round sends down: the weights, or outputs on shared samples, those of the last round."""
    return weights if distiller is None else state.server or distiller.outputs(weights)


def _imitate(distiller: Distiller, strategy: Strategy, network: Weights, outputs: Weights, work: LocalWork) -> Weights:
    """Return the weights of the server's network after it has learned from the clients' mean `outputs`."""
    if not isinstance(strategy, FedMD):
        raise InputError(f"{type(strategy).__name__} combines weights, and a distiller learns from outputs")
    seed = derive_seed(work.seed, "server")
    return distiller.imitate(network, outputs, steps=strategy.steps, learning_rate=work.learning_rate, seed=seed)


@dataclass
class Round:
    """A round under way: its local work, what it began with, who takes part, and what updates must look like."""

    work: LocalWork
    start: Weights
    here: Attendance
    expected: Expected  # of the updates
    sent: Weights  # a strategy's arrays beside the weights
    shares: dict[str, float] = field(default_factory=dict)  # of unbiased selection: of all samples, by client
    told: dict[str, float] = field(default_factory=dict)  # norms of updates, by client
    drawn: dict[str, float] = field(default_factory=dict)  # of unbiased selection: probability of the clients drawn
    masked: SecureRound | None = None  # of secure aggregation


@dataclass(frozen=True)
class Server:
    """Server of a federation: it runs rounds with the clients at the far end of a Flower grid."""

    grid: Grid
    names: Mapping[int, str]  # of the clients, by node
    strategy: Strategy
    rules: Rules
    work: Callable[[int], LocalWork]  # local training of a round, by its number
    state: FederationState  # changed in place
    earlier: int = 0  # rounds of federations before
    centre: Weights | None = None  # that clients are pulled to
    away: Callable[[int], Mapping[str, str]] = lambda _: {}  # by client why it is not there when a round begins
    buffering: Buffering | None = None  # of a strategy whose rounds are buffers
    authority: x509.Certificate | None = None  # of the clients' fleet

    def run_round(self, number: int, start: Weights) -> Weights:
        """Return the weights after round `number`, which begins with `start`; a record is added to the state.

        Where fewer clients are left than the strategy needs, or the network lost clients and fewer are left than secure
        aggregation needs, or where fewer take part than secure aggregation or `least_clients` asks for and none failed,
        or where clients revealed shares that leave no way to the sum, the weights stay as they were, and the record
        names those who were chosen as failed, with the reason; where nobody was drawn it names nobody. So it is where
        clients have no samples, or no weight for the strategy, and nobody is left. Raises
        `ClientFailed` where fewer clients than are wanted sent a usable update, or where fewer take part than are
        wanted and clients failed to report, `TooFewClients` where so few are left for secure aggregation, `InputError`
        where the strategy refuses the updates or returns arrays of other names, shapes or types.
        """
        round_ = self._call(number, start)  # who takes part
        updates = self._collect(round_)  # what is sent, and checked as it arrives
        round_.here.check(self.rules, self.strategy, number)  # whether enough is left
        try:
            weights = self._combine(round_, updates)  # how it is combined
        except (ClientFailed, TooFewClients, SumLost, NoShares) as error:
            round_.here.excuse(error)
            weights, updates = start, Intake()
        self._keep(round_, updates)  # what is kept
        return weights

    def _call(self, number: int, start: Weights) -> Round:
        """Return the round with the clients that are chosen for it, and those of them that are away."""
        work, selection, clients = self.work(number), self.rules.selection, [*self.names.values()]
        if self.buffering is not None:
            self.state.server = self.buffering.keep_version(number, start, self.state.server)
            return Round(work, start, self.buffering.attend(number, clients), Expected(self.rules, start, {}), {})
        sent = self.strategy.send(self.state.server) if isinstance(self.strategy, Exchanges) else {}
        seed = int.from_bytes(self._key("selection", work), "little") if self.rules.hides_draws else work.seed
        chosen = selection.choose(clients, number, seed, self.earlier)
        here = Attendance(clients if selection.unbiased else chosen, chosen, self.away(number))
        extra = extra_forms(self.strategy, self.rules, start, sent)
        return Round(work, start, here, Expected(self.rules, start, extra), sent)

    def _key(self, purpose: str, work: LocalWork) -> bytes:
        return derive_key(self.state.keep_secret(SERVER), purpose, work.round, work.seed)

    def _collect(self, round_: Round) -> Intake:
        """Send the weights and the local work to those who take part; return the updates that count.

        Under importance selection all clients train and report the norm of their update, and those that are drawn are
        asked to send it. Under other unbiased selections all first report their number of samples. Where fewer take
        part than `least_clients`, nobody is asked to send an update.
        """
        here, selection, local = round_.here, self.rules.selection, {CONFIG: round_.work.record()}
        if self.buffering is not None:
            kept, number = self.state.server, round_.work.round
            return self.buffering.collect(number, here, round_.start, kept, self.rules, self.work, self._ask)
        records = {ARRAYS: to_arrays(round_.start)} | ({EXTRA: to_arrays(round_.sent)} if round_.sent else {})
        if self.centre is not None:
            records[CENTRE] = to_arrays({name: self.centre[name] for name in learned_names(self.centre)})
        request, wanted = RecordDict({**records, **local}), here.chosen
        if selection.unbiased:
            self._read_norms(round_, here.asked, RecordDict({**local, ASK: ConfigRecord({ASK: COUNT})}))
            wanted = [name for name in here.chosen if name in round_.shares]
            round_.drawn = dict.fromkeys(wanted, selection.inclusion_probability(len(here.asked)))
        elif selection.rule == "importance":
            asking = RecordDict({**records, **local, ASK: ConfigRecord({ASK: NORM})})
            round_.drawn = selection.draw(self._read_norms(round_, here.chosen, asking), round_.work.seed)
            here.chosen = wanted = [*round_.drawn]
            request = RecordDict({ASK: ConfigRecord({ASK: SEND}), **local})
        here.count(self.rules)
        if here.shortage is not None:
            return Intake()
        if self.rules.secure is not None:
            about = self.rules.secure, round_.expected, here, round_.work.round, {**records, **local}, self._ask
            round_.masked = SecureRound(*about, self.authority)
            return round_.masked.collect()
        plain = self.rules.privacy is None and not selection.weighs
        updates = Intake(find_weigher(self.strategy) if plain else None)
        told = round_.told if selection.rule == "importance" else {}
        read = lambda name, content: read_update(content, round_.expected, told.get(name))  # noqa: E731
        for name, update in self._ask(here, dict.fromkeys(wanted, request), read):
            with self._refusing(round_):
                updates.add(name, update)
        return updates

    def _ask(
        self,
        here: Attendance,
        requests: Mapping[str, RecordDict],
        read: Callable[[str, RecordDict], AnswerT],
        awaited: list[str] | None = None,
    ) -> Iterator[tuple[str, AnswerT]]:
        """Send each client its request, and yield by client, in their order, what `read` makes of its reply.

        Clients that are lost, do not answer or whose reply is refused are noted `here`, with the reason. `awaited`: who
        is to answer, where that is more than are sent a request.
        """
        nodes = {name: node for node, name in self.names.items()}
        messages = (Message(content, nodes[name], MessageType.TRAIN) for name, content in requests.items())
        replies = self.grid.send_and_receive(messages, timeout=ANSWER_S)
        for event in list_events(requests if awaited is None else awaited, replies, self.names):
            if not isinstance(event, Arrived):
                here.note(event)
                continue
            try:
                answer = read(event.client, event.content)
            except ReplyRefused as error:
                here.failed[event.client] = str(error)
                here.idle |= {event.client} if isinstance(error, NoSamples) else set()
            else:
                yield event.client, answer

    def _read_norms(self, round_: Round, clients: list[str], request: RecordDict) -> dict[str, float]:
        """Return the norms of the clients' updates times their shares of all samples, by client in node order."""
        told = dict(self._ask(round_.here, dict.fromkeys(clients, request), lambda _, c: read_norm(c, self.rules)))
        total, round_.told = (
            sum(samples for _, samples in told.values()),
            {name: own for name, (own, _) in told.items()},
        )
        round_.shares = {name: samples / max(total, 1) for name, (_, samples) in told.items()}
        return {name: norm * round_.shares[name] for name, (norm, _) in told.items()}

    def _combine(self, round_: Round, received: Intake) -> Weights:
        """Return the weights after a round, and change the strategy's state; raises why there is no update."""
        if round_.here.shortage is not None:
            raise round_.here.shortage
        start, updates = round_.start, self._average_first(round_, received)
        if not updates:
            return start
        with self._refusing(round_):
            if isinstance(self.strategy, Stateful):
                weights, after = self.strategy.step(start, updates, self.state.server, len(self.names))
                self.state.server = {name: np.asarray(array) for name, array in after.items()}
            else:
                weights = self.strategy.combine(start, updates)
        name = type(self.strategy).__name__
        if forms_of(weights) != forms_of(start):
            raise InputError(f"{name} returned arrays of other names, shapes or types than the round started from")
        check_weights(weights, f"strategy {name}, round {round_.work.round}")
        return weights

    @contextlib.contextmanager
    def _refusing(self, round_: Round) -> Iterator[None]:
        """Raise `InputError` where the strategy cannot combine updates; `NoShares` where it gives none a weight."""
        try:
            yield
        except NoShares:
            raise
        except ValueError as error:
            name = type(self.strategy).__name__
            raise InputError(f"strategy {name}, round {round_.work.round}: {error}") from error

    def _average_first(self, round_: Round, received: Intake) -> list[LocalUpdate]:
        """Return what the strategy combines: the updates or, under masks, central noise or weights, their one mean."""
        privacy, start, work = self.rules.privacy, round_.start, round_.work
        if round_.masked is not None:
            return [LocalUpdate(round_.masked.average(received.updates), *WHOLE)]
        if privacy is not None and not privacy.local:
            sent = self.rules.upload.exchanged(start)
            names = [name for name in learned_names(start) if name in sent]
            expected = float(len(round_.here.chosen))
            if self.rules.selection.rule == "poisson":  # by chance more or fewer come
                expected = expected_clients(self.rules.selection, [*self.names.values()])
            key = None if privacy.seeded else self._key("noise", work)
            mean = average_privately(start, received.combinable, names, privacy, expected, work.seed, key)
            return [LocalUpdate(mean, *WHOLE)]
        if self.rules.selection.weighs and received.updates:
            weights = {name: round_.shares[name] / round_.drawn[name] for name in received.updates}
            return [LocalUpdate(average_inversely(start, received.updates, weights), *WHOLE)]
        return received.combinable

    def _keep(self, round_: Round, received: Intake) -> None:
        """Add the record of a round to the state; where who was drawn is to stay secret, it has nothing of clients."""
        number, epsilon = round_.work.round, None
        if self.buffering is not None:
            self.state.server = self.buffering.keep_version(number + 1, {}, self.state.server)
        if self.rules.privacy is not None and self.buffering is not None:
            epsilon = self.buffering.buffers.epsilon(self.rules.privacy, number)
        elif self.rules.privacy is not None:
            rounds, names = self.earlier + number, [*self.names.values()]
            epsilon = account_epsilon(self.rules.privacy, self.rules.selection, names, rounds)
        record = RoundRecord(number, (), epsilon=epsilon)
        if not self.rules.hides_draws:
            about = (round_.here.failed, epsilon, received.mean_loss(), sum(received.samples.values()))
            empty = bool(round_.here.idle) and not received.samples
            record = RoundRecord(number, tuple(received.samples), *about, empty=empty)
        self.state.records.append(record)
