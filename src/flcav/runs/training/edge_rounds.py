"""Rounds of a region's vehicles with their edge server, from a network to the weights and the ledger in a folder."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors.numpy import load_file

from flcav.federation.buffered_rounds import Buffers, afford_buffers
from flcav.federation.privacy import count_affordable
from flcav.federation.rounds import BeforeRound, OnRound, Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.runtimes.link import Runtime, open_questions, open_runtime
from flcav.federation.runtimes.metered import Account, Outage
from flcav.federation.runtimes.processes import ClientProcesses
from flcav.federation.state import FederationState
from flcav.federation.strategies import Strategy
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.interface.progress import Report
from flcav.network.ledger import Ledger
from flcav.perception.client import TaskClient
from flcav.perception.distillation import SharedSamples
from flcav.perception.outcomes import score_network
from flcav.perception.weights import to_arrays
from flcav.runs.frames import Frames
from flcav.runs.recipe import EDGE
from flcav.runs.results.groups import Term
from flcav.runs.training.checkpoints import FederationCheckpoints, load_round_network, round_path
from flcav.runs.training.groups import GroupWatch, Levelled
from flcav.runs.training.leads import federate_led
from flcav.runs.training.learning import Learning, describe_federation, give_outputs
from flcav.runs.training.timing import time_clients

if TYPE_CHECKING:
    from flcav.federation.runtimes.deployed import RegionalDeployment


@dataclass(frozen=True)
class EdgeFederation:
    """A region's federation: what its rounds begin with, and where they are kept."""

    learning: Learning
    network: Any  # that the rounds begin with
    clients: Mapping[str, TaskClient]  # vehicles, by name
    schedule: Schedule
    strategy: Strategy
    earlier: int  # rounds with the same vehicles before, which a privacy budget counts
    book: Ledger
    folder: Path  # of checkpoints, weights and ledger
    report: Report
    validation: Mapping[str, Frames] = field(default_factory=dict)  # scored after each round, by region
    shared: SharedSamples | None = None  # that vehicles send outputs on, instead of weights
    relabel: BeforeRound | None = None  # changes the clients' labels before each round
    watch: GroupWatch | None = None  # over a group, which dissolves when its loss has levelled off
    terms: tuple[Term, ...] = ()  # of the leads of an ad hoc group; none: an edge server leads
    roadside: frozenset[str] = frozenset()  # clients at the edge server itself, whose messages cross no radio

    @property
    def start_share(self) -> float:
        """Return the share of the network's own weights in the result: none in further rounds."""
        return 0.0 if self.earlier else self.learning.training.start_share

    def score(self, round_: int) -> Mapping[str, float]:
        """Return the scores, by region, of the network that a federation of so many rounds ends with."""
        task, averaged = self.learning.task, self.learning.training.average_rounds
        reached = load_round_network(task, self.network, self.folder, round_, averaged, self.start_share)
        return {name: score_network(task, reached, own.data, own.vehicles) for name, own in self.validation.items()}

    def afford(self, rules: Rules, rounds: int, buffers: Buffers | None = None) -> int:
        """Return as many of `rounds` as the privacy budget affords; without one all."""
        if rules.privacy is None:
            return rounds
        if buffers is not None:
            return min(rounds, afford_buffers(buffers, rules.privacy))
        return count_affordable(rules.privacy, rules.selection, [*self.clients], rounds, self.earlier)

    def prepare(self, clients: Mapping[str, Trainable], where: Runtime | None, number: int, weights: Weights) -> None:
        """Have the clients' samples labelled again before a round, where labels change, and hand them on to `where`."""
        if self.relabel is not None:
            self.relabel(number, weights)
            if isinstance(where, ClientProcesses):
                where.renew(clients)


def federate_edge(
    federation: EdgeFederation,
    rules: Rules,
    outages: Mapping[tuple[int, str], Outage] = {},
    *,
    buffers: Buffers | None = None,
    processes: int = 1,
    runtime: str = "embedded",
    timed: bool = False,
    deployed: "RegionalDeployment | None" = None,
) -> tuple[float | None, ...]:
    """Run the rounds of stage II of a region; write weights and ledger, return each round's loss.

    A privacy budget may end it before the schedule's end, and of asynchronous rounds, `buffers`, each budget. Vehicles
    train in so many `processes` of a `runtime` of `RUNTIMES`, or where they are `deployed`, to the same weights; units
    of the edge server itself then train in this process. Where that is `timed`, their times are kept, see `read_times`,
    unless nobody is to know who was drawn. The vehicles that `outages` name by round are lost in it.
    """
    own, learning, state = federation, federation.learning, FederationState()
    far = None if deployed is None else deployed.beside(own.roadside)
    checkpoints = FederationCheckpoints(
        learning.task,
        own.folder,
        own.book,
        own.report,
        {EDGE: state},
        describe_federation(own.strategy, rules),
        own.schedule.rounds,
        rules.privacy,
        own.score if own.validation else None,
    )
    start, done = checkpoints.resume(to_arrays(own.network))
    checkpoints.keep_secrets({EDGE: rules.secret_parties([*own.clients])})
    clients: Mapping[str, Trainable] = own.clients
    if own.shared is not None:
        clients = give_outputs(own.clients, own.shared, to_arrays(own.network))
    if timed and not rules.hides_draws:
        clients = time_clients(clients, own.folder)
    account = Account(own.book, EDGE, learning.task.name, "wireless", outages, own.roadside)
    if own.watch is not None:
        clients = own.watch.enlist(clients)
        with open_questions(clients, far if done else None, account) as ask:
            for number in range(1, done + 1):
                reached = load_file(round_path(own.folder, number))
                own.watch.note(own.watch.hear(ask, reached, counted=False))
    asking: Any = {} if own.watch is None else {"ask_after": partial(own.watch.follow, own.book)}
    opened = contextlib.nullcontext(far) if far else open_runtime(runtime, clients, processes)
    with checkpoints.refusals(), opened as where, contextlib.suppress(Levelled):
        if own.watch is not None and own.watch.over:
            raise Levelled
        if done < own.afford(rules, own.schedule.rounds, buffers):
            keep = partial(_keep_round, own.watch, checkpoints)

            def run(weights: Weights, account: Account, done: int, on_round: OnRound) -> LocalUpdate:
                return federate(
                    clients,
                    weights,
                    own.schedule,
                    account,
                    strategy=own.strategy,
                    rules=rules,
                    state=state,
                    done=done,
                    earlier=own.earlier,
                    before_round=partial(own.prepare, clients, where),
                    on_round=on_round,
                    runtime=where,
                    distiller=own.shared,
                    buffers=buffers,
                    **asking,
                )

            if own.terms:
                federate_led(run, start, account, own.terms, keep, state=state, done=done)
            else:
                run(start, account, done, keep)
    return checkpoints.finish(own.network, learning.training.average_rounds, own.start_share)


def _keep_round(
    watch: GroupWatch | None, checkpoints: FederationCheckpoints, number: int, weights: Weights, loss: float | None
) -> None:
    """Keep a round; raises `Levelled` where the group is to dissolve."""
    checkpoints.save(number, weights, loss)
    if watch is not None and watch.over:
        raise Levelled
