"""Hierarchical federated learning: stage II, vehicles with their edge server; stage III, edge servers with the cloud.

Both stages run the same loop, `federate`. The clients of stage III are edge servers, and the local training of an edge
server is k rounds of federation with the vehicles of its region (Wang et al., IEEE Network 37(3), 2023).
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from flwr.app import ArrayRecord
from flwr.clientapp import ClientApp
from flwr.serverapp import Grid
from flwr.serverapp.strategy import Result

from flcav.config import InputError
from flcav.federation.client import check_arguments, client_app, kept_records
from flcav.federation.privacy import affordable_rounds, count_affordable, find_noise, least_participations
from flcav.federation.records import LOSS, SAMPLES, LocalWork, to_arrays, to_weights
from flcav.federation.rounds import OnRound, Rounds
from flcav.federation.rules import RegionalModels, Rules, SecureAggregation
from flcav.federation.runtimes.deadline import TimedClients
from flcav.federation.runtimes.embedded import EmbeddedGrid
from flcav.federation.runtimes.metered import Account, BudgetedGrid, MeteredGrid
from flcav.federation.runtimes.outages import LossyGrid
from flcav.federation.runtimes.processes import ClientProcesses, RemoteClients
from flcav.federation.state import FederationState, ReadStates
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.strategy import Corrects, Exchanges, Robust, needs_known_number
from flcav.federation.trainable import Counts, Distiller, LocalUpdate, Trainable, Weights
from flcav.federation.upload import name_like
from flcav.statistics.streams import derive_seed

if TYPE_CHECKING:
    from flcav.federation.runtimes.simulation import RaySimulation

EVERYBODY = Rules()
logging.getLogger("flwr").setLevel(logging.ERROR)  # Flower logs each round; a stage reports its own


@dataclass(frozen=True)
class Schedule:
    """Number of rounds, local steps per round, and a learning rate that decays geometrically over the rounds."""

    rounds: int  # in all, those already done included
    steps: int  # local optimiser steps per round
    learning_rate: float  # in the first round
    final_learning_rate: float  # in the last round, where there are several
    seed: int  # of the federation; each round derives its own
    planned: tuple[int, ...] = ()  # before each round, the number of rounds by the plan of then; others: `rounds`

    def work(self, round_: int) -> LocalWork:
        """Return the local work of round `round_`, counted from 1.

        Its rate is that of its place among all rounds by the plan before it; the rate never rises.
        """
        whole = (*self.planned[:round_], *(self.rounds,) * (round_ - len(self.planned)))
        progress = max((number - 1) / max(rounds - 1, 1) for number, rounds in enumerate(whole, start=1))
        rate = self.learning_rate * (self.final_learning_rate / self.learning_rate) ** progress
        return LocalWork(round_, self.steps, rate, derive_seed(self.seed, "round", round_))


def _ignore(round_: int, weights: Weights, loss: float | None) -> None:
    pass


def federate(
    clients: Mapping[str, Trainable],
    weights: Weights,
    schedule: Schedule,
    account: Account,
    *,
    strategy: Strategy = FEDAVG,
    rules: Rules = EVERYBODY,
    state: FederationState | None = None,
    done: int = 0,
    earlier: int = 0,
    on_round: OnRound = _ignore,
    runtime: "ClientProcesses | RaySimulation | None" = None,
    centre: Weights | None = None,
) -> LocalUpdate:
    """Run rounds `done + 1 .. schedule.rounds` of a federation, starting from `weights`.

    Returns the weights after the last round, and of that round the number of samples of all clients and their mean
    training loss, weighted by samples; without a round to run, `weights`, 0 samples and a loss of 0. In each round
    every client trains, unless `rules` say otherwise, and `strategy` combines their updates: by default federated
    averaging (McMahan et al., AISTATS 2017, algorithm 1). `on_round` is called after each round with its number,
    weights and mean loss; `state` is then that of the round, with a record of it. Every message is entered in the
    ledger of `account`. To resume, pass the same strategy and rules, the weights and the number of the last round that
    `on_round` was given, and the state after it. Noise that is not seeded is drawn by secrets, which are kept in
    `state`: without it no federation can be repeated, nor gone on with to the same weights.

    Under a privacy budget the last rounds are those that it affords; without noise it is that for all of them.
    `earlier` is the number of rounds of federations before this one, with the same clients and rules, which count
    against that budget, and after which the turns of round-robin go on. Where epsilon rests on secret draws of
    clients, records and ledger do not name them. Clients
    train in this process, or several at a time in a `runtime`: `ClientProcesses` of the same clients, or Flower's
    simulation on Ray; the weights are the same. Clients are pulled to `centre`, where there is one, by the `personal`
    of the rules. `clients` is asked for a client when it is to train; of updates no more are in memory than the
    strategy needs.

    Raises `BudgetExceeded` where a message would exceed a budget, `ClientFailed` where clients raised or sent what is
    no update, and fewer are left than `rules` ask for (by default half of those asked), `TooFewClients` where fewer are
    left than secure aggregation needs, though `account` lost none, `InputError` where there are no clients, or `rules`
    or `strategy` ask for what they cannot do, ValueError where `strategy` changes names, shapes or types of the arrays.

    >>> import numpy as np
    >>> from flcav import Ledger, federate
    >>> from flcav.federation import Account, LocalUpdate, Schedule
    >>> from flcav.network import Budget
    >>> class Vehicle:  # of a task: flcav.perception.TaskClient
    ...     def __init__(self, samples):
    ...         self.samples = samples
    ...     def train(self, weights, *, steps, learning_rate, seed):
    ...         return LocalUpdate({"w": weights["w"] + self.samples}, self.samples, loss=0.0)
    >>> ledger = Ledger(Budget(wireless_mb=1.0, wireline_mb=0.0))
    >>> schedule = Schedule(rounds=1, steps=1, learning_rate=0.1, final_learning_rate=0.1, seed=0)
    >>> vehicles = {"cav0": Vehicle(1), "cav1": Vehicle(3)}
    >>> federate(vehicles, {"w": np.zeros(2)}, schedule, Account(ledger, "edge", "toy", "wireless")).weights["w"]
    array([2.5, 2.5])
    """
    check_federation(clients, strategy, rules)
    rules.upload.check_layers(weights)
    rounds, names = schedule.rounds, [*clients]
    if rules.privacy is not None:
        privacy = find_noise(rules.privacy, rules.selection, len(names), earlier + rounds)
        rules = rules.model_copy(update={"privacy": privacy})
        rounds = affordable_rounds(privacy, rules.selection, names, rounds, earlier)
    if rounds <= done:
        return LocalUpdate(weights, 0, 0.0)
    state = FederationState() if state is None else state
    account = replace(account, concealed=rules.hides_draws)
    results: list[Result] = []

    def serve(grid: Grid, nodes: Mapping[int, str], read_states: ReadStates) -> None:
        def keep(round_: int, aggregated: Weights, loss: float | None) -> None:
            if kept:
                state.clients = read_states(kept)
            on_round(round_, aggregated, loss)

        app = Rounds(strategy, rules, schedule.work, nodes, state, done, earlier, keep, centre, account.find_away)
        lossy = LossyGrid(grid, account, nodes) if account.outages else grid
        link = MeteredGrid(BudgetedGrid(lossy, account, nodes), account, nodes)
        results.append(app.start(link, to_arrays(weights), rounds - done))

    kept = kept_records(strategy, rules)
    secrets = {party: state.keep_secret(party) for party in rules.secret_parties(names) if party in clients}
    how: Any = {
        "strategy": strategy,
        "rules": rules,
        "secrets": secrets,
        "spent": least_participations(rules.selection, len(names), earlier),
    }
    limit_s = rules.limits.train_s

    def make_app(trained: Mapping[str, Trainable]) -> ClientApp:
        return client_app(trained if limit_s is None else TimedClients(trained, limit_s), **how)

    if isinstance(runtime, ClientProcesses):
        with EmbeddedGrid(
            client_app(RemoteClients(clients, runtime, limit_s), **how), names, state.clients, runtime.count
        ) as grid:
            serve(grid, grid.names, grid.read_states)
    elif runtime is None:
        with EmbeddedGrid(make_app(clients), names, state.clients) as grid:
            serve(grid, grid.names, grid.read_states)
    else:
        runtime.run(clients, make_app, state.clients, serve)
    arrays: ArrayRecord = results[0].arrays
    metrics = results[0].train_metrics_clientapp[rounds - done]
    return LocalUpdate(to_weights(arrays), int(metrics[SAMPLES]), float(metrics[LOSS]))  # type: ignore[arg-type]


def federate_outputs(
    distiller: Distiller,
    clients: Mapping[str, Trainable],
    weights: Weights,
    schedule: Schedule,
    account: Account,
    *,
    strategy: FedMD,
    state: FederationState,
    rules: Rules = EVERYBODY,
    done: int = 0,
    earlier: int = 0,
    on_round: OnRound = _ignore,
    runtime: "ClientProcesses | RaySimulation | None" = None,
) -> LocalUpdate:
    """Run rounds of a federation whose clients send outputs: as `federate`, with the server's network for the weights.

    After a round the server's network learns from the mean of the clients' outputs, which are sent down in the next
    one; in the first it sends its own. They are kept in `state`.
    """
    network = weights

    def keep(round_: int, outputs: Weights, loss: float | None) -> None:
        nonlocal network
        state.server = {name: np.asarray(array) for name, array in outputs.items()}
        work = schedule.work(round_)
        rate, seed = work.learning_rate, derive_seed(work.seed, "server")
        network = distiller.imitate(network, outputs, steps=strategy.steps, learning_rate=rate, seed=seed)
        on_round(round_, network, loss)

    begin = state.server or distiller.outputs(weights)
    asked = (clients, begin, schedule, account)
    how: Any = {"strategy": strategy, "state": state, "rules": rules, "done": done, "earlier": earlier}
    found = federate(*asked, **how, on_round=keep, runtime=runtime)
    return replace(found, weights=network)


def check_federation(clients: Mapping[str, Trainable], strategy: Strategy, rules: Rules) -> None:
    """Raise `InputError` where these clients cannot federate by this strategy and these rules."""
    if not clients:
        raise InputError("a federation of 0 clients: nobody trains")
    if rules.selection.predicts:
        raise InputError("selection: a deadline needs 'seconds', the predicted time of a round by client")
    check_rules(strategy, rules, [*clients])
    if isinstance(strategy, Corrects):
        check_arguments(clients, strategy.correct({}, {}).arguments(), type(strategy).__name__)
    if isinstance(strategy, FedMD):
        check_arguments(clients, ["own", "imitation_steps"], "FedMD")
    if rules.upload.layers:
        check_arguments(clients, ["layers"], f"layers {', '.join(rules.upload.layers)}:")
    if rules.selection.unbiased:
        for name, client in clients.items():
            if not isinstance(client, Counts):
                told = f"and {name} ({type(client).__name__}) has no 'count_samples'"
                raise InputError(f"selection: unbiased weights need clients that count their samples, {told}")
    if isinstance(rules.personal, RegionalModels):
        check_arguments(clients, ["proximal", "centre"], "personal:")


def check_rules(strategy: Strategy, rules: Rules, names: Sequence[str]) -> None:
    """Raise `InputError` where a strategy and rules do not go together, or not with so many clients."""
    told, selection = type(strategy).__name__, rules.selection
    selection.check_clients(names)
    planned = selection.rule == "planned"
    any_number = planned or selection.rule in ("poisson", "importance")  # all at most; too few make no update
    chosen = len(names) if any_number else len(selection.choose(names, 1, 0))
    if short := rules.tell_shortage(chosen):
        raise InputError(short)
    single = isinstance(strategy, Robust | Exchanges)  # looks at each update
    if selection.weighs:
        if single:
            kind = "unbiased" if selection.unbiased else "importance"
            raise InputError(f"{told} looks at each update, and {kind} selection gives each a weight of its own")
        if rules.privacy is not None and selection.rule == "importance":
            raise InputError("privacy: importance selection reads norms of the updates, which no noise covers")
    if selection.unbiased and (alike := _count_alike(strategy, rules)):
        raise InputError(f"selection: {alike} has clients count the same, and 'unbiased' weighs them by samples")
    if rules.privacy is not None and rules.privacy.amplified(selection) and isinstance(rules.least_clients, int):
        raise InputError(
            f"privacy: epsilon of {selection.rule} selection rests on secret draws, and rounds without an update for a "
            "number of 'least_clients' would tell of them"
        )
    if isinstance(strategy, FedMD):
        _check_outputs(rules)
    if isinstance(rules.personal, RegionalModels) and isinstance(strategy, Corrects):
        raise InputError(f"{told} corrects local steps, and so does the pull of regional models, 'personal'")
    if rules.privacy is not None and planned:
        raise InputError("privacy: rounds of a plan have other numbers of clients, and noise is for one number")
    if isinstance(strategy, Robust):
        if selection.rule not in ("poisson", "planned"):
            strategy.check_clients(chosen)
        elif needs_known_number(strategy):
            raise InputError(f"{told} needs a known number of clients, and {selection.rule} selection has any")
    if rules.secure is not None:
        _check_secure(told, rules, rules.secure, chosen, single)
    if rules.privacy is not None:
        if isinstance(strategy, Exchanges):
            raise InputError(f"{told} sends further arrays beside the weights, which the noise does not cover")
        if rules.privacy.where == "central" and single:
            raise InputError(f"{told} looks at each update, and central noise covers their sum alone")


def _count_alike(strategy: Strategy, rules: Rules) -> str | None:
    """Return what has all clients count the same, whatever their samples; None where nothing does."""
    alike = {"FedMD": isinstance(strategy, FedMD), "privacy": rules.privacy, "secure aggregation": rules.secure}
    return next((name for name, there in alike.items() if there), None)


def _check_outputs(rules: Rules) -> None:
    if rules.upload.layers:
        raise InputError("FedMD sends class probabilities, and 'upload.layers' names arrays of weights")
    if isinstance(rules.personal, RegionalModels):
        raise InputError("FedMD's vehicles have networks of their own, which regional models, 'personal', cannot pull")
    if rules.privacy is not None:
        raise InputError("FedMD sends class probabilities, and noise is for changes of weights")


def _check_secure(told: str, rules: Rules, secure: SecureAggregation, chosen: int, single: bool) -> None:
    needed = secure.needed(chosen)
    if single:
        raise InputError(f"{told} looks at each update, and secure aggregation shows their sum alone")
    if rules.selection.rule in ("poisson", "importance"):
        raise InputError(f"secure aggregation needs a known number of clients, and {rules.selection.rule} draws any")
    if rules.upload.compression != "none":
        raise InputError(f"secure aggregation sums integers of 32 bits, and {rules.upload.compression} sends others")
    if rules.privacy is not None and rules.privacy.where == "central":
        raise InputError("secure aggregation goes with local noise: a server that adds noise clips each update first")
    if not max(chosen / 2, 1) < needed <= chosen:
        raise InputError(
            f"secure.threshold: more than half of the {chosen} clients of a round, 2 or more, and not {needed}"
        )


def afford_cloud_rounds(rules: Rules, names: Sequence[str], rounds: int, edge_rounds: int, earlier: int) -> int:
    """Return how many of `rounds` cloud rounds, of `edge_rounds` edge rounds each, a region's privacy budget affords.

    names: the region's clients, who took part in `earlier` rounds.
    """
    if rules.privacy is None or rounds == 0:
        return rounds
    return count_affordable(rules.privacy, rules.selection, names, rounds * edge_rounds, earlier) // edge_rounds


def edge_seeds(schedule: Schedule, cloud_round: int, region: str, edge_rounds: int) -> list[int]:
    """Return the seeds of a region's edge rounds in a cloud round of `schedule`, as `EdgeServer` derives them."""
    seed, done = derive_seed(schedule.work(cloud_round).seed, region), (cloud_round - 1) * edge_rounds
    own = Schedule(done + edge_rounds, 0, 1.0, 1.0, seed)
    return [own.work(done + number).seed for number in range(1, edge_rounds + 1)]


@dataclass
class EdgeServer:
    """A region's edge server as a client of the cloud: its local training is k edge rounds with its vehicles."""

    vehicles: Mapping[str, Trainable]  # of the region, by name
    edge_rounds: int  # k >= 1, per cloud round
    account: Account  # of the wireless link
    own: Weights  # the region's model at the end of stage II
    cloud_rounds_done: int = 0
    strategy: Strategy = FEDAVG  # of aggregation in the region
    rules: Rules = EVERYBODY  # of the region's rounds
    state: FederationState = field(default_factory=FederationState)  # of the region's rounds
    earlier: int = 0  # rounds of stage II, which a privacy budget counts
    runtime: ClientProcesses | None = None  # where the vehicles train; None: in this process
    distiller: Distiller | None = None  # where vehicles send outputs
    begun: Weights = field(default_factory=dict)  # that its last cloud round began with
    trained: Weights = field(default_factory=dict)  # that the edge rounds of that came to

    def train(
        self, weights: Weights, *, steps: int, learning_rate: float, seed: int, layers: Sequence[str] = ()
    ) -> LocalUpdate:
        """Return the update of the region after k edge rounds from the cloud's `weights`; raises as `federate` does.

        The first cloud round starts from the server's own stage II model instead: the cloud has not averaged yet, and
        its model is older. Arrays that are personal to the region go on from where they were, whatever the cloud's are;
        of regional models these are all, and vehicles are pulled to the cloud's from the second cloud round on.
        Edge rounds are numbered consecutively over the cloud rounds. `layers` are those of the rules, which vehicles
        keep to. Under central noise the region counts by its number of vehicles, whoever took part.
        """
        start = {**weights, **self.state.personal} if self.cloud_rounds_done else self.own
        regional = isinstance(self.rules.personal, RegionalModels)
        centre = weights if regional and self.cloud_rounds_done else None
        done = self.cloud_rounds_done * self.edge_rounds
        schedule = Schedule(done + self.edge_rounds, steps, learning_rate, learning_rate, seed)
        self.cloud_rounds_done += 1  # also of a round that fails here, and counts for the cloud
        asked = (self.vehicles, start, schedule, self.account)
        how: Any = {"strategy": self.strategy, "rules": self.rules, "state": self.state, "done": done}
        how |= {"earlier": self.earlier, "runtime": self.runtime}
        if self.distiller is None:
            found = federate(*asked, **how, centre=centre)
        else:
            self.state.server = {}  # begins with the outputs of the cloud's network
            found = federate_outputs(self.distiller, *asked, **how)
        self.begun, self.trained = start, found.weights
        names = [*found.weights] if regional else name_like(found.weights, self.rules.personal_arrays)
        self.state.personal = {name: np.asarray(found.weights[name]) for name in names}
        if self.rules.privacy is not None and not self.rules.privacy.local:  # no noise covers numbers of samples
            return replace(found, samples=len(self.vehicles))
        return replace(found, samples=max(found.samples, 1))  # the cloud averages also where the network lost everybody
