"""Federated learning: the loop over rounds, and a single round from weights to weights, for edge and cloud alike.

`federate` repeats `Server.run_round`. A round calls the clients that take part, sends them the weights and their local
work, checks every update as it arrives, combines those that count, and keeps a record. Flower carries the messages;
its strategies sample clients from the global random state, multiply integer buffers by floats, and skip a whole
round where one client fails.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypedDict, Unpack

import numpy as np
from cryptography import x509

from flcav.config import InputError
from flcav.federation.acceptance import Expected, extra_forms
from flcav.federation.checks import check_federation
from flcav.federation.client import ClientAgreement, kept_records
from flcav.federation.exchange import Attendance, ClientFailed, Exchange, Intake, OpenRound
from flcav.federation.links.link import Ask, Link, Runtime, open_link
from flcav.federation.links.metered import Account, open_account
from flcav.federation.modes import buffered, drawn, masked, plain
from flcav.federation.modes.buffered import Buffering, Buffers, afford_buffers, fill_in_turns
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
from flcav.federation.strategies.fedavg import NoShares
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.strategy import Exchanges, Stateful
from flcav.federation.trainable import (
    Distiller,
    LocalUpdate,
    Trainable,
    Weights,
    check_weights,
    forms_of,
    learned_names,
)
from flcav.federation.upload import decode_model, encode_model, restore_model
from flcav.federation.wire import LocalWork
from flcav.statistics.streams import derive_seed

EVERYBODY = Rules()
WHOLE = (1, 1.0)  # samples and loss of the single update passed to a strategy where the server has averaged already
BeforeRound = Callable[[int, Weights], None]  # called with the round's number and its initial weights
AskAfter = Callable[[int, Weights, Ask], None]  # called with number, aggregated weights and a way to ask clients
OnRound = Callable[[int, Weights, float | None], None]  # called with number, aggregated weights and mean training loss
logging.getLogger("flwr").setLevel(logging.ERROR)  # Flower logs each message; a stage reports its rounds


@dataclass(frozen=True)
class Schedule:
    """Number of rounds, local steps per round, and a learning rate that decays geometrically over the rounds."""

    rounds: int  # total number, including those already done
    steps: int  # local optimiser steps per round
    learning_rate: float  # in the first round
    final_learning_rate: float  # in the last round, where there are several
    seed: int  # of the federation; every round derives another one from it

    def work(self, round_: int) -> LocalWork:
        """Return the local work of round `round_`, counted from 1."""
        progress = (round_ - 1) / max(self.rounds - 1, 1)
        rate = self.learning_rate * (self.final_learning_rate / self.learning_rate) ** progress
        return LocalWork(round_, self.steps, rate, derive_seed(self.seed, "round", round_))


def _do_nothing(*_: object) -> None:
    pass


class FederationOptions(TypedDict, total=False):
    """Keyword arguments of `federate`, which describes them; their defaults are those of `FederationTerms`."""

    strategy: Strategy
    rules: Rules
    state: FederationState | None
    done: int
    earlier: int
    before_round: BeforeRound
    ask_after: AskAfter
    on_round: OnRound
    runtime: Runtime | None
    centre: Weights | None
    distiller: Distiller | None
    buffers: Buffers | None


@dataclass(frozen=True)
class FederationTerms:
    """Terms of a federation: its strategy and rules, what came before it, and what is called between its rounds."""

    strategy: Strategy = FEDAVG
    rules: Rules = EVERYBODY
    state: FederationState | None = None
    done: int = 0
    earlier: int = 0
    before_round: BeforeRound = _do_nothing
    ask_after: AskAfter = _do_nothing
    on_round: OnRound = _do_nothing
    runtime: Runtime | None = None
    centre: Weights | None = None
    distiller: Distiller | None = None
    buffers: Buffers | None = None


def federate(
    clients: Mapping[str, Trainable],
    weights: Weights,
    schedule: Schedule,
    account: Account | None = None,
    **options: Unpack[FederationOptions],
) -> LocalUpdate:
    """Run rounds `done + 1 .. schedule.rounds` of a federation, by default of federated averaging.

    In a round every client trains, unless `rules` say otherwise, and `strategy` combines their updates (McMahan et
    al., AISTATS 2017, algorithm 1). To resume, pass the same clients, strategy, rules and schedule (its `rounds` are
    those of the whole federation, on which a decaying learning rate depends), the weights and the number that
    `on_round` received after the last round, and the state after it; without that state a `Stateful` strategy starts
    afresh. Noise that is not seeded is drawn with secrets kept in `state`: without it a federation can neither be
    repeated nor resumed to the same weights. A privacy budget limits the number of rounds; where the rules give no
    noise, it is the least with which the budget affords all of them. Where epsilon relies on secret draws of clients,
    records and ledger do not name them. A round in which no client has samples leaves the weights unchanged and is
    marked `empty`; the federation ends after `rules.empty_rounds` of them in a row.

    Args:
        clients: by name; one is looked up when it is to train, and no more updates are in memory than the strategy
            needs.
        weights: of the initial model, arrays by name.
        schedule: number of rounds, local steps, learning rates and seed.
        account: the ledger in which every message is entered, and the clients that the network loses; None: no budget.
        options: by name, each with a default, see below.

    Options:
        strategy: how updates are combined, and how clients correct their training.
        rules: client selection, form of the updates, privacy, and the least number of updates.
        state: what server and clients keep between rounds, changed in place, with a record of every round.
        done: number of rounds already completed.
        earlier: number of rounds of previous federations with the same clients and rules; they count against a privacy
            budget, and round-robin selection continues after them.
        before_round: called before each round.
        ask_after: called after each round and before `on_round`, to ask questions of clients that are `Answers`.
        on_round: called after each round, when `state` is that after the round.
        runtime: where clients train: None: in this process; `ClientProcesses` of the same clients; Flower's simulation
            on Ray. The weights do not depend on it.
        centre: weights to which the proximal term of `rules.personal` pulls the clients.
        distiller: the server's network under `FedMD`, whose clients send outputs: after a round it learns from their
            mean, which is sent down in the next one; in the first it sends its present outputs.
        buffers: for `FedBuff`, the rounds by a clock; None: clients are equally fast, and messages take no time. The
            federation ends before an update that would exceed a budget, which is not sent.

    Returns:
        The weights after the last round, and that round's number of samples of all clients and their mean training
        loss, weighted by samples; if there is no round to run, `weights`, 0 samples and a loss of 0.

    Raises `BudgetExceeded` where a message would exceed a budget. Raises `ClientFailed` where clients raised or sent
    invalid updates, and fewer are left than `rules` ask for (by default half of those asked); `TooFewClients` where
    fewer are left than secure aggregation needs, though the network lost none and none is without samples. Both carry
    the weights after the last completed round, `reached`. Raises `InputError` where there are no clients, `weights` are
    not finite arrays, `rules` and `strategy` do not go together, or `strategy` changes names, shapes or types of the
    arrays.

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
    terms, account, names = FederationTerms(**options), account or open_account(), [*clients]
    check_federation(clients, terms.strategy, terms.rules)
    check_weights(weights, "weights to begin with")
    state = terms.state or FederationState()
    sent = weights if terms.distiller is None else state.server or terms.distiller.outputs(weights)
    terms.rules.upload.check_layers(sent)
    rules, rounds, buffering = _limit_rounds(terms, names, schedule.rounds, account)
    if rounds <= terms.done or _is_over(state, rules):
        return LocalUpdate(weights, 0, 0.0)
    account = replace(account, concealed=rules.hides_draws)
    rules = rules.settle_threshold(names, certified=getattr(terms.runtime, "deployed", False))
    secrets = {party: state.keep_secret(party) for party in rules.secret_parties(names) if party in clients}
    before = (
        buffering.buffers.least_before
        if buffering
        else least_participations(rules.selection, len(names), terms.earlier)
    )
    agreed = ClientAgreement(terms.strategy, rules, secrets, before)
    with open_link(clients, terms.runtime, account, agreed, state.clients) as link:
        server = FederationServer(
            *(link.grid, link.names, terms.strategy, rules, schedule.work, state, terms.earlier, terms.centre),
            *(account.find_away, buffering, link.authority),
        )
        for number in range(terms.done + 1, rounds + 1):
            terms.before_round(number, weights)
            weights, sent = _run_round(server, link, terms, number, weights, sent)
            terms.ask_after(number, weights, link.ask)
            terms.on_round(number, weights, state.records[-1].loss)
            if _is_over(state, rules):
                break
    last = state.records[-1]
    return LocalUpdate(weights, last.samples, last.loss or 0.0)


def _limit_rounds(
    terms: FederationTerms, names: Sequence[str], rounds: int, account: Account
) -> tuple[Rules, int, Buffering | None]:
    """Return the rules with the noise for the planned rounds, the number that a budget affords, and their buffers."""
    rules = terms.rules
    if isinstance(terms.strategy, FedBuff):
        buffers = terms.buffers or fill_in_turns(names, terms.strategy.buffer, rounds)
        afforded = min(rounds, afford_buffers(buffers, rules.privacy))
        return rules, afforded, Buffering(terms.strategy, buffers, account)
    if rules.privacy is None:
        return rules, rounds, None
    privacy = find_noise(rules.privacy, rules.selection, len(names), terms.earlier + rounds)
    afforded = affordable_rounds(privacy, rules.selection, names, rounds, terms.earlier)
    return rules.model_copy(update={"privacy": privacy}), afforded, None


def _run_round(
    server: "FederationServer", link: Link, terms: FederationTerms, number: int, weights: Weights, sent: Weights
) -> tuple[Weights, Weights]:
    """Return the weights after a round and the next downlink: these weights or, in distillation, mean outputs."""
    state = server.state
    kept = kept_records(server.strategy, server.rules)
    try:
        combined = server.run_round(number, sent)
    except (ClientFailed, TooFewClients) as error:
        error.reached = weights
        raise
    state.clients = link.read_states(kept) if kept else state.clients
    if terms.distiller is None:
        weights = combined
    elif not state.records[-1].empty:
        weights = _imitate(terms.distiller, terms.strategy, weights, combined, server.work(number))
        state.server = {name: np.asarray(array) for name, array in combined.items()}
    link.follow(state.records[-1])
    return weights, combined


def _is_over(state: FederationState, rules: Rules) -> bool:
    """Return whether a federation ends before its last round: over a budget, or since too many rounds were empty."""
    most = rules.empty_rounds
    empty = most is not None and len(state.records) >= most and all(each.empty for each in state.records[-most:])
    return empty or state.spent


def _imitate(distiller: Distiller, strategy: Strategy, network: Weights, outputs: Weights, work: LocalWork) -> Weights:
    """Return the weights of the server's network after it has learned from the clients' mean `outputs`."""
    if not isinstance(strategy, FedMD):
        raise InputError(f"{type(strategy).__name__} combines weights, and a distiller learns from outputs")
    seed = derive_seed(work.seed, "server")
    return distiller.imitate(network, outputs, steps=strategy.steps, learning_rate=work.learning_rate, seed=seed)


@dataclass(frozen=True)
class FederationServer(Exchange):
    """The server of a federation, which runs rounds with its clients over a Flower grid."""

    strategy: Strategy
    rules: Rules
    work: Callable[[int], LocalWork]  # local training of a round, by its number
    state: FederationState  # changed in place
    earlier: int = 0  # rounds of previous federations
    centre: Weights | None = None  # centre of the proximal term
    away: Callable[[int], Mapping[str, str]] = lambda _: {}  # clients absent when a round begins, with the reason
    buffering: Buffering | None = None  # of a strategy whose rounds are buffers
    authority: x509.Certificate | None = None  # of the clients' fleet

    def run_round(self, number: int, start: Weights) -> Weights:
        """Return the weights after round `number`, which begins with `start`; a record is added to the state.

        The weights are unchanged, and the record lists the chosen clients as failed, with the reason, where

        - fewer clients are left than the strategy needs,
        - the network lost clients, and fewer are left than secure aggregation needs,
        - fewer take part than secure aggregation or `least_clients` asks for, and none failed,
        - clients revealed shares by which the sum cannot be unmasked,
        - no client with samples and a positive weight is left, or none was drawn.

        Raises `ClientFailed` where too few clients sent a usable update, or where too few take part and clients failed
        to report; `TooFewClients` where too few are left for secure aggregation; `InputError` where the strategy
        refuses the updates or returns arrays of other names, shapes or types.
        """
        round_ = self._call(number, start)  # who takes part, and what is sent down
        updates = self._collect(round_)  # what is sent, and checked as it arrives
        round_.here.check(self.rules, self.strategy, number)  # whether enough is left
        try:
            weights = self._combine(round_, updates)  # how it is combined
        except (ClientFailed, TooFewClients, SumLost, NoShares) as error:
            round_.here.excuse(error)
            weights, updates = round_.start, Intake()
        self._keep(round_, updates)  # what is kept
        return weights if round_.model is None else restore_model(weights, round_.start, start)

    def _call(self, number: int, start: Weights) -> OpenRound:
        """Return the round with its chosen clients, those of them that are absent, and the model that they get.

        What its form loses is not lost to the server: `run_round` adds the round's change to the whole model.
        """
        work = self.work(number)
        selection = self.rules.selection
        clients = [*self.names.values()]
        if self.buffering is not None:
            self.state.server = self.buffering.keep_version(number, start, self.state.server)
            return OpenRound(work, self.buffering.attend(number, clients), Expected(self.rules, start))
        sent = self.strategy.send(self.state.server) if isinstance(self.strategy, Exchanges) else {}
        # amplification by sampling holds only against observers who cannot repeat the draw: a secret seeds it
        seed = int.from_bytes(self._key("selection", work), "little") if self.rules.hides_draws else work.seed
        chosen = selection.choose(clients, number, seed, self.earlier)
        here = Attendance(clients if selection.unbiased else chosen, chosen, self.away(number))
        model = encode_model(start) if self.rules.download == "int8" else None
        start = start if model is None else decode_model(model)
        expected = Expected(self.rules, start, extra_forms(self.strategy, self.rules, start, sent))
        return OpenRound(work, here, expected, sent, self.centre, model)

    def _key(self, purpose: str, work: LocalWork) -> bytes:
        return derive_key(self.state.keep_secret(SERVER), purpose, work.round, work.seed)

    def _collect(self, round_: OpenRound) -> Intake:
        """Return the accepted updates, by the mode of the round."""
        if self.buffering is not None:
            return buffered.collect(self, round_, self.buffering, self.state.server, self.work)
        if self.rules.secure is not None:
            return masked.collect(self, round_, self.authority)
        if self.rules.selection.weighs:
            return drawn.collect(self, round_)
        return plain.collect(self, round_, self.strategy)

    def _combine(self, round_: OpenRound, received: Intake) -> Weights:
        """Return the weights after a round, and update the strategy's state; raises the shortage if there is one."""
        if round_.here.shortage is not None:
            raise round_.here.shortage
        start = round_.start
        updates = received.combinable
        privacy = self.rules.privacy
        if received.average is not None:
            updates = [LocalUpdate(received.average(), *WHOLE)]
        elif privacy is not None and not privacy.local:
            updates = [LocalUpdate(self._average_privately(round_, updates), *WHOLE)]
        if not updates:
            return start
        with plain.refusing(self.strategy, round_.work.round):
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

    def _average_privately(self, round_: OpenRound, updates: Sequence[LocalUpdate]) -> Weights:
        """Return the weights after the noisy mean of clipped changes, of all arrays that are learned and sent."""
        privacy, selection, work = self.rules.privacy, self.rules.selection, round_.work
        assert privacy is not None
        sent = self.rules.upload.exchanged(round_.start)
        names = [name for name in learned_names(round_.start) if name in sent]
        expected = float(len(round_.here.chosen))
        if selection.rule == "poisson":  # the number that comes is random: divide by its mean
            expected = expected_clients(selection, [*self.names.values()])
        key = None if privacy.seeded else self._key("noise", work)
        return average_privately(round_.start, updates, names, privacy, expected, work.seed, key)

    def _keep(self, round_: OpenRound, received: Intake) -> None:
        """Add the record of a round to the state; where the draw of clients is secret, it does not name them."""
        number = round_.work.round
        epsilon = None
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
