"""Stage II: the vehicles of a region federate with their edge server."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from flcav.federation.privacy import count_affordable
from flcav.federation.rules import Rules
from flcav.federation.runtimes.choice import open_runtime
from flcav.federation.runtimes.metered import Account, Outage
from flcav.federation.runtimes.processes import ClientProcesses
from flcav.federation.stages import Schedule, federate, federate_outputs
from flcav.federation.state import FederationState
from flcav.federation.strategies import Strategy
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.interface.progress import Report
from flcav.network.ledger import Ledger
from flcav.perception.client import TaskClient
from flcav.perception.distillation import SharedSamples
from flcav.perception.outcomes import score_network
from flcav.perception.weights import to_arrays
from flcav.pipeline.federations.rounds import FederationCheckpoints, load_round_network
from flcav.pipeline.federations.timing import time_clients
from flcav.pipeline.frames import Frames
from flcav.pipeline.learning import Learning
from flcav.pipeline.planning.course import Driven, Replanning
from flcav.pipeline.recipe import EDGE
from flcav.pipeline.stages.clients import describe_federation, give_outputs

OnStart = Callable[[int, Weights], None]  # called before a round with its number and weights; changes the clients


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
    before_round: OnStart | None = None

    @property
    def start_share(self) -> float:
        """Return the share of the network's own weights in the result: none in further rounds."""
        return 0.0 if self.earlier else self.learning.training.start_share

    def score(self, round_: int) -> Mapping[str, float]:
        """Return the scores, by region, of the network that a federation of so many rounds ends with."""
        task, averaged = self.learning.task, self.learning.training.average_rounds
        reached = load_round_network(task, self.network, self.folder, round_, averaged, self.start_share)
        return {name: score_network(task, reached, own.data, own.vehicles) for name, own in self.validation.items()}

    def afford(self, rules: Rules, rounds: int) -> int:
        """Return as many of `rounds` as the privacy budget affords; without one all."""
        if rules.privacy is None:
            return rounds
        return count_affordable(rules.privacy, rules.selection, [*self.clients], rounds, self.earlier)


def federate_edge(
    federation: EdgeFederation,
    rules: Rules,
    outages: Mapping[tuple[int, str], Outage] = {},
    *,
    replanning: Replanning | None = None,
    processes: int = 1,
    runtime: str = "embedded",
    timed: bool = False,
) -> tuple[float | None, ...]:
    """Run the rounds of stage II of a region; write weights and ledger, return each round's loss.

    A privacy budget may end it before the schedule's end. Vehicles train in so many `processes` of a `runtime` of
    `RUNTIMES`, to the same weights; where that is `timed`, their times are kept, see `read_times`,
    unless nobody is to know who was drawn. The vehicles that
    `outages` name by round are lost in it. Under `replanning` the number of rounds, who joins them and who is lost are
    those of the plan before each.
    """
    own, learning = federation, federation.learning
    state, schedule = FederationState(), own.schedule
    identity, scored = describe_federation(own.strategy, rules), own.score if own.validation else None
    checkpoints = FederationCheckpoints(
        learning.task, own.folder, own.book, own.report, {EDGE: state}, identity, scored, rules.privacy
    )
    start, done = checkpoints.resume(to_arrays(own.network))
    checkpoints.keep_secrets({EDGE: rules.secret_parties([*own.clients])})
    account = Account(own.book, EDGE, learning.task.name, "wireless", outages)
    how: Any = {"strategy": own.strategy, "state": state, "earlier": own.earlier}
    run, clients = (
        (federate, own.clients)
        if own.shared is None
        else (partial(federate_outputs, own.shared), give_outputs(own.clients, own.shared, to_arrays(own.network)))
    )
    clients = time_clients(clients, own.folder) if timed and not rules.hides_draws else clients
    with checkpoints.refusals(), open_runtime(runtime, clients, processes) as where:
        how["runtime"] = where

        def begin(number: int, weights: Weights) -> None:
            if own.before_round is not None:
                own.before_round(number, weights)
                if isinstance(where, ClientProcesses):
                    where.renew(clients)

        if replanning is None:
            save, last = checkpoints.make_saver(schedule.rounds), own.afford(rules, schedule.rounds)

            def keep(round_: int, weights: Weights, loss: float | None) -> None:
                save(round_, weights, loss)
                if round_ < last:
                    begin(round_ + 1, weights)

            if done < last:
                begin(done + 1, start)
                run(clients, start, schedule, account, **how, rules=rules, done=done, on_round=keep)
        else:
            course = replanning.course

            def run_round(weights: Weights, number: int, driven: Driven) -> LocalUpdate | None:
                if own.afford(rules, number) < number:
                    return None
                begin(number, weights)
                ending, lossy = course.schedule(schedule, number), replace(account, outages=driven.outages)
                keep = checkpoints.make_saver(course.rounds)
                given: Any = {**how, "rules": driven.rules, "done": number - 1, "on_round": keep}
                return run(clients, weights, ending, lossy, **given)

            replanning.run(start, done, checkpoints.scores, run_round)
    checkpoints.finish(own.network, len(checkpoints.losses), learning.training.average_rounds, own.start_share)
    return tuple(checkpoints.losses)
