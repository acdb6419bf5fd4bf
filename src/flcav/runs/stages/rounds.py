"""Rounds of stages II and III: vehicles federate with edge servers, and in stage III these with the cloud.

Both stages write a checkpoint after every round, and end with weights and a ledger in their folder.
"""

import contextlib
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flcav.federation.edge_server import EdgeServer, afford_cloud_rounds
from flcav.federation.links.link import Ask, Runtime, open_deployment, open_runtime
from flcav.federation.links.metered import Account
from flcav.federation.links.processes import ClientProcesses
from flcav.federation.links.ros_names import join_names
from flcav.federation.loop import BeforeRound, OnRound, Schedule, federate
from flcav.federation.modes.buffered import Buffers, afford_buffers
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState, RoundDivergence, measure_divergence
from flcav.federation.strategies.fedavg import average
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.interface.progress import Report
from flcav.network.clock.records import RoundTiming
from flcav.network.ledger import Ledger
from flcav.perception.agents import POLE, kind_of
from flcav.perception.client import SharedSamples, TaskClient
from flcav.perception.outcomes import score_network
from flcav.perception.weights import from_arrays, save_network, to_arrays
from flcav.runs.driving import DrivenStage
from flcav.runs.engine import Work
from flcav.runs.frames import Frames
from flcav.runs.recipe import CLOUD, EDGE
from flcav.runs.stages.cloud import CloudServer, Replay
from flcav.runs.training.checkpoints import FederationCheckpoints, load_round_network
from flcav.runs.training.learning import (
    Learning,
    Strategies,
    describe_federation,
    give_outputs,
    keep_statistics,
    load_stage_network,
    regional_weights,
)
from flcav.runs.training.timing import time_clients

if TYPE_CHECKING:
    from flcav.federation.links.flower import PartlyDeployed, RegionalDeployment
    from flcav.federation.links.topics import RosTopics

    Deployed = RegionalDeployment | PartlyDeployed | None  # vehicles of a fleet

BAG = "bag-from-round"  # prefix of the folders of ROS 2 bags
REPLAY = "cloud-replay"  # client name of the cloud's training; no region has a hyphen in its name
RunRounds = Callable[[Weights, Account, int, OnRound], LocalUpdate]  # `federate` after given rounds, partially applied


@dataclass(frozen=True)
class RegionStart:
    """The start of a region's edge server."""

    clients: Mapping[str, TaskClient]  # its vehicles, by name
    weights: Weights  # at the start of its first round: those of pretraining, or after stage II those of stage II
    earlier: int  # earlier rounds with the same vehicles, which count against a privacy budget
    edge_rounds: int = 1  # in a cloud round


class RoundsOver(Exception):
    """Raised to end the rounds of a stage before their planned number."""


class Conduct:
    """The conduct of a stage's rounds: by default all clients take part, to the planned end; extras override it."""

    @property
    def within(self) -> frozenset[str]:
        """The clients at the edge server itself, whose messages do not use the radio."""
        return frozenset()

    @property
    def vacant(self) -> bool:
        """Whether there are no participants."""
        return False

    @property
    def over(self) -> bool:
        """Whether no further round is to begin."""
        return False

    def choose(self, samples: Mapping[str, Sequence[Any]]) -> Mapping[str, Sequence[Any]]:
        """Return the samples of the participants, by client."""
        return samples

    def enlist(self, clients: Mapping[str, Trainable]) -> Mapping[str, Trainable]:
        """Return the clients of the rounds, possibly wrapped."""
        return clients

    def resume(
        self, folder: Path, clients: Mapping[str, Trainable], deployed: Any, account: Account, done: int
    ) -> None:
        """Resume after `done` rounds, whose weights are in `folder`; clients may be `deployed`."""

    def follow(self, number: int, weights: Weights, ask: Ask) -> None:
        """Observe the weights after a round; `ask` sends requests to the clients."""

    def foresee(self, records: tuple[RoundTiming, ...], region: str) -> "Conduct":
        """Return the conduct of rounds with the simulated times in `records`."""
        return self

    def run(
        self, run: RunRounds, start: Weights, account: Account, on_round: OnRound, state: FederationState, done: int
    ) -> None:
        """Run the rounds after `done`, which begin with the weights `start`."""
        run(start, account, done, on_round)

    def report(self, work: Work, settings: Any, rounds: int, deployed: "Deployed") -> dict[str, Any]:
        """Return rows of the stage's result after its rounds; `rounds`: their planned number."""
        return {}


@dataclass(frozen=True)
class StageFederation:
    """The federation of a stage: the state at its start, its schedule, and its folder.

    Without a cloud, the vehicles of one region federate with their edge server; with one, edge servers with the cloud.
    """

    learning: Learning
    network: Any  # with the server's weights at the start
    regions: Mapping[str, RegionStart]
    schedule: Schedule  # of the server's rounds
    strategies: Strategies
    book: Ledger
    folder: Path  # of checkpoints, weights and ledger
    report: Report
    start_share: float = 0.0  # share of the weights of `network` in the result, in [0, 1]
    cloud: CloudServer | None = None
    shared: SharedSamples | None = None  # samples on which vehicles send outputs, instead of weights
    validation: Mapping[str, Frames] = field(default_factory=dict)  # frames to score after every round, by region
    relabel: BeforeRound | None = None  # changes the clients' labels before every round of stage II
    conduct: Conduct = field(default_factory=Conduct)  # of the rounds of stage II
    first_loss: float | None = None  # first loss of stage II, if it is over: divergence is measured by it

    @property
    def within(self) -> frozenset[str]:
        """The clients whose messages do not use the radio: at the edge server itself, and roadside units."""
        clients = {name for start in self.regions.values() for name in start.clients}
        return self.conduct.within | {name for name in clients if kind_of(name.rpartition("/")[2]) == POLE}

    def afford(self, rules: Rules, rounds: int, buffers: Mapping[str, Buffers]) -> int:
        """Return the number of `rounds` that the privacy budget affords in every region; all without a budget."""
        for region, start in self.regions.items() if rules.privacy is not None else ():
            k = start.edge_rounds
            if region in buffers:
                rounds = min(rounds, afford_buffers(buffers[region], rules.privacy) // k)
            else:
                rounds = min(rounds, afford_cloud_rounds(rules, [*start.clients], rounds, k, start.earlier))
        return rounds

    def score(self, round_: int) -> Mapping[str, float]:
        """Return the scores by region of the network that a federation of `round_` rounds would end with."""
        task = self.learning.task
        averaged = self.learning.training.average_rounds
        reached = load_round_network(task, self.network, self.folder, round_, averaged, self.start_share)
        return {
            name: score_network(task, reached, split.data, split.vehicles) for name, split in self.validation.items()
        }

    def list_vehicles(self, region: str) -> Mapping[str, Trainable]:
        """Return the clients of a region's edge server, by name."""
        start = self.regions[region]
        return start.clients if self.shared is None else give_outputs(start.clients, self.shared, start.weights)

    def prepare(self, clients: Mapping[str, Trainable], where: Runtime | None, number: int, weights: Weights) -> None:
        """Relabel the clients' samples before a round, where labels change, and pass them on to the runtime `where`."""
        if self.relabel is not None:
            self.relabel(number, weights)
            if isinstance(where, ClientProcesses):
                where.renew(clients)

    def open_replay(self, cloud: CloudServer) -> dict[str, Trainable]:
        """Return the cloud's training on samples of stage I by its client name, if there is any.

        Its number of samples, at least 1, gives it the right share if all vehicles take part in a round.
        """
        if cloud.replay is None:
            return {}
        steps = self.learning.training.local_steps
        share = cloud.replay_share
        clients = (client for start in self.regions.values() for client in start.clients.values())
        samples = sum(client.count_samples(steps) for client in clients)
        # Averages weigh clients by samples: x / (x + samples) = share.
        return {REPLAY: Replay(cloud.replay, max(round(samples * share / (1 - share)), 1))}

    def open_topics(self, topics: str | None, done: int) -> "RosTopics | None":
        """Return the ROS 2 topics, with their bag, of the rounds after `done`; None where messages stay in memory."""
        if topics is None:
            return None
        from flcav.federation.links.topics import RosTopics

        bag = self.folder / f"{BAG}{done + 1}"
        shutil.rmtree(bag, ignore_errors=True)  # of rounds that a kill undid
        return RosTopics(join_names(topics, f"seed{self.learning.seed}", self.folder.name), bag=bag)

    def open_servers(
        self,
        driven: DrivenStage,
        account: Account,
        done: int,
        states: Mapping[str, FederationState],
        runtime: Runtime | None,
    ) -> dict[str, EdgeServer]:
        """Return the edge servers by region, after `done` cloud rounds, with their `states`.

        Edge servers train one after another, with their vehicles on the `runtime`.
        """
        return {
            region: EdgeServer(
                self.list_vehicles(region),
                start.edge_rounds,
                account,
                start.weights,
                cloud_rounds_done=done,
                strategy=self.strategies.edge,
                rules=driven.rules,
                state=states[region],
                earlier=start.earlier,
                runtime=runtime,
                distiller=self.shared,
                buffers=driven.buffers.get(region),
            )
            for region, start in self.regions.items()
        }


@dataclass(frozen=True)
class Whereabouts:
    """The place where the vehicles of a federation train: this process, others, or a deployed fleet."""

    runtime: str = "embedded"  # one of `RUNTIMES`
    processes: int = 1  # number of processes, or of actors
    fleet: str = ""  # folder of a fleet that is up; "": one is brought up for the duration
    vehicles: Mapping[str, int] = field(default_factory=dict)  # numbers of vehicles by region of that fleet
    timed: bool = False  # whether training times are kept, see `read_times`, unless the draw of clients is secret
    deployed: "RegionalDeployment | None" = None  # the connected vehicles of that fleet

    @contextlib.contextmanager
    def reach(self, clients: list[str]) -> Iterator["Whereabouts"]:
        """Yield a copy with the deployed vehicles connected, if these clients train on a fleet."""
        if self.runtime != "flower":
            yield self
            return
        with open_deployment(clients, Path(self.fleet) if self.fleet else None, self.vehicles) as deployed:
            yield replace(self, deployed=deployed)


def federate_stage(
    own: StageFederation, driven: DrivenStage, where: Whereabouts = Whereabouts()
) -> tuple[tuple[float | None, ...], int | None]:
    """Run the rounds of a stage, write weights and ledger, and return the mean training loss by round.

    If the training diverges, it stops with the weights of the last sound round, whose number is returned as well (None:
    those of the last round). `driven`: the rounds as simulated on the radio network; a vehicle whose connection is lost
    is missing from its round, while the cloud needs all edge servers. A privacy budget may end the rounds before
    the schedule does, and so may any budget in asynchronous rounds. Where rules make arrays personal, the weights hold
    the mean of the regions' arrays, and the regions' models are written to the same folder, as are regional models.
    """
    learning, task, cloud, rules = own.learning, own.learning.task, own.cloud, driven.rules
    state, states = FederationState(), {region: FederationState() for region in own.regions if cloud is not None}
    afforded, schedule = own.afford(rules, own.schedule.rounds, driven.buffers), own.schedule
    if cloud is not None:
        schedule = replace(schedule, rounds=afforded)  # learning rates decay over these rounds
        rules.check_personal(to_arrays(own.network))
    server = EDGE if cloud is None else CLOUD
    checkpoints = FederationCheckpoints(
        task,
        own.folder,
        own.book,
        own.report,
        {server: state, **{f"{EDGE}/{region}": edge for region, edge in states.items()}},
        describe_federation(own.strategies.edge if cloud is None else own.strategies, rules),
        schedule.rounds,
        rules.privacy,
        own.score if own.validation else None,
        own.first_loss,
    )
    start, done = checkpoints.resume(to_arrays(own.network))
    named = {EDGE if cloud is None else f"{EDGE}/{region}": start for region, start in own.regions.items()}
    checkpoints.keep_secrets({name: rules.secret_parties([*region.clients]) for name, region in named.items()})
    everybody = {name: client for region in own.regions for name, client in own.list_vehicles(region).items()}
    if where.timed and not rules.hides_draws:  # times would reveal which clients were drawn
        everybody = time_clients(everybody, own.folder)
    clients, within = own.conduct.enlist(everybody), own.within
    wireless = Account(own.book, server, task.name, "wireless", driven.outages, within)
    far = where.deployed and where.deployed.beside(within)
    own.conduct.resume(own.folder, clients, far, wireless, done)
    opened = contextlib.nullcontext(far) if far else open_runtime(where.runtime, clients, where.processes)
    with checkpoints.refusals(), opened as runtime, checkpoints.divergence(), contextlib.suppress(RoundsOver):
        if own.conduct.over or checkpoints.kept is not None:
            raise RoundsOver
        servers = {} if cloud is None else own.open_servers(driven, wireless, done, states, runtime)
        keep = partial(_keep_round, own, servers, state, checkpoints)
        if cloud is not None:
            parties = {**servers, **own.open_replay(cloud)}
            strategy = own.strategies.cloud
            if cloud.distil is not None:
                strategy = cloud.distil(lambda: schedule.work(len(state.records) + 1))  # records are of combined rounds
            how: dict[str, Any] = {"strategy": strategy, "rules": rules.of_servers()}
            how["runtime"] = own.open_topics(cloud.topics, done)
            wireline = Account(own.book, CLOUD, task.name, "wireline", within=frozenset({REPLAY}))
            federate(parties, start, schedule, wireline, state=state, done=done, on_round=keep, **how)
        elif done < afforded:
            run = _lay_out(own, driven, clients, runtime, state)
            own.conduct.run(run, start, wireless, keep, state, done)
    losses = checkpoints.finish(own.network, learning.training.average_rounds, own.start_share)
    if cloud is not None and rules.personal:
        _save_regional_models(learning, own.folder, {} if checkpoints.kept is not None else states, own.regions)
    return losses, checkpoints.kept


def _lay_out(
    stage: StageFederation,
    driven: DrivenStage,
    clients: Mapping[str, Trainable],
    runtime: "Runtime | PartlyDeployed | None",
    state: FederationState,
) -> RunRounds:
    """Return the function that runs the rounds of a region's vehicles, from given weights after given rounds."""
    ((region, at),) = stage.regions.items()

    def run(weights: Weights, account: Account, done: int, on_round: OnRound) -> LocalUpdate:
        return federate(
            clients,
            weights,
            stage.schedule,
            account,
            strategy=stage.strategies.edge,
            rules=driven.rules,
            state=state,
            done=done,
            earlier=at.earlier,
            before_round=partial(stage.prepare, clients, runtime),
            ask_after=stage.conduct.follow,
            on_round=on_round,
            runtime=runtime,
            distiller=stage.shared,
            buffers=driven.buffers.get(region),
        )

    return run


def _keep_round(
    stage: StageFederation,
    servers: Mapping[str, EdgeServer],
    state: FederationState,
    checkpoints: FederationCheckpoints,
    number: int,
    weights: Weights,
    loss: float | None,
) -> None:
    """Write the checkpoint after a round; in stage III also the divergence of the regions, and their statistics.

    The checkpoint has the mean of the regions' personal arrays. Raises `RoundsOver` where no further round is to begin.
    """
    regions = [*servers.values()]
    if len(regions) > 1:
        both = ([edge.begun for edge in regions], [edge.trained for edge in regions])
        divergence = RoundDivergence(*(measure_divergence(models) for models in both))
        state.records[-1] = replace(state.records[-1], divergence=divergence)
    for region, server in servers.items() if stage.cloud is not None and stage.cloud.keeps_statistics else ():
        keep_statistics(server.trained, stage.folder, region)
    personal = [edge.state.personal for edge in regions if edge.state.personal and edge.rules.personal_arrays]
    checkpoints.save(number, {**weights, **(average(personal, [1.0] * len(personal)) if personal else {})}, loss)
    if stage.conduct.over or checkpoints.kept is not None:
        raise RoundsOver


def _save_regional_models(
    learning: Learning, folder: Path, states: Mapping[str, FederationState], regions: Iterable[str]
) -> None:
    """Write the regions' personalised models: the common weights with the arrays that edge servers keep, if any."""
    for region in regions:
        model = load_stage_network(learning.task, folder)
        from_arrays(model, {**to_arrays(model), **(states[region].personal if region in states else {})})
        save_network(learning.task, model, folder / regional_weights(region))
