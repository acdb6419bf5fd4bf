"""Rounds of stages II and III: vehicles federate with edge servers, and in stage III these with the cloud.

Both stages end with weights and a ledger in their folder, by way of checkpoints after each round.
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
from flcav.federation.trainable import LocalUpdate, Trainable, Update, Weights
from flcav.interface.progress import Report
from flcav.network.clock.records import RoundTiming
from flcav.network.ledger import Ledger
from flcav.perception.client import SharedSamples, TaskClient
from flcav.perception.outcomes import score_network
from flcav.perception.weights import from_arrays, save_network, to_arrays
from flcav.runs.driving import DrivenStage
from flcav.runs.engine import Work
from flcav.runs.frames import Frames
from flcav.runs.recipe import CLOUD, EDGE
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

BAG = "bag-from-round"  # begins the names of the folders of ROS 2 bags
REPLAY = "cloud-replay"  # the cloud's own training among the edge servers; no region has a hyphen in its name
RunRounds = Callable[[Weights, Account, int, OnRound], LocalUpdate]  # `federate` after so many rounds, with the rest


@dataclass(frozen=True)
class RegionStart:
    """The start of a region's edge server."""

    clients: Mapping[str, TaskClient]  # its vehicles, by name
    weights: Weights  # that its first round begins with: of stage II, or before it of pretraining
    earlier: int  # rounds before with the same vehicles, which a privacy budget counts
    edge_rounds: int = 1  # in a cloud round


@dataclass(frozen=True)
class Replay:
    """The cloud's own training on what it was sent in stage I, which counts for a given number of samples."""

    client: TaskClient
    samples: int

    def train(self, weights: Weights, **how: Any) -> Update:
        """Return the update of `TaskClient.train`, with that number."""
        return replace(self.client.train(weights, **how), samples=self.samples)


@dataclass(frozen=True)
class CloudServer:
    """What the cloud does in stage III besides averaging."""

    keeps_statistics: bool = False  # whether each region's statistics of batch normalisation are written, too
    replay: TaskClient | None = None  # its own training on the samples of stage I
    replay_share: float = 0.0  # of that in each of its averages
    topics: str | None = None  # ROS namespace by which edge servers and cloud exchange messages; None: in memory


class RoundsOver(Exception):
    """The rounds of a stage end before their planned number."""


class Conduct:
    """The conduct of a stage's rounds: here all clients take part, to the planned end. Extras of a run change that."""

    @property
    def within(self) -> frozenset[str]:
        """Return the clients at the edge server itself, whose messages cross no radio."""
        return frozenset()

    @property
    def vacant(self) -> bool:
        """Return whether the conduct has no participants."""
        return False

    @property
    def over(self) -> bool:
        """Return whether no further round is to begin."""
        return False

    def choose(self, samples: Mapping[str, Sequence[Any]]) -> Mapping[str, Sequence[Any]]:
        """Return the samples of those who take part, by client."""
        return samples

    def enlist(self, clients: Mapping[str, Trainable]) -> Mapping[str, Trainable]:
        """Return the clients as the rounds have them."""
        return clients

    def resume(
        self, folder: Path, clients: Mapping[str, Trainable], deployed: Any, account: Account, done: int
    ) -> None:
        """Take up the conduct after `done` rounds, whose weights are in `folder`; clients may be `deployed`."""

    def follow(self, number: int, weights: Weights, ask: Ask) -> None:
        """Take note of the weights after a round, for which the clients may be asked."""

    def foresee(self, records: tuple[RoundTiming, ...], region: str) -> "Conduct":
        """Return the conduct of rounds that are driven as `records` have it."""
        return self

    def run(
        self, run: RunRounds, start: Weights, account: Account, on_round: OnRound, state: FederationState, done: int
    ) -> None:
        """Run the rounds after `done`, which begin with the weights `start`."""
        run(start, account, done, on_round)

    def report(self, work: Work, settings: Any, rounds: int, deployed: "Deployed") -> dict[str, Any]:
        """Return rows of the stage's result after its rounds, of which so many were planned."""
        return {}


@dataclass(frozen=True)
class StageFederation:
    """The federation of a stage: what its rounds begin with, and where they are kept.

    Without a cloud it is that of one region's vehicles with their edge server, else of edge servers with the cloud.
    """

    learning: Learning
    network: Any  # that the server begins with
    regions: Mapping[str, RegionStart]
    schedule: Schedule  # of the server's rounds
    strategies: Strategies
    book: Ledger
    folder: Path  # of checkpoints, weights and ledger
    report: Report
    start_share: float = 0.0  # of the weights of `network` in the result
    cloud: CloudServer | None = None
    shared: SharedSamples | None = None  # that vehicles send outputs on, instead of weights
    validation: Mapping[str, Frames] = field(default_factory=dict)  # scored after each round, by region
    relabel: BeforeRound | None = None  # changes the clients' labels before each round of stage II
    conduct: Conduct = field(default_factory=Conduct)  # of the rounds of stage II
    first_loss: float | None = None  # of stage II, where it is over: a training diverges by it

    def afford(self, rules: Rules, rounds: int, buffers: Mapping[str, Buffers]) -> int:
        """Return as many of `rounds` as the privacy budget affords in every region; without one all."""
        for region, own in self.regions.items() if rules.privacy is not None else ():
            k = own.edge_rounds
            if region in buffers:
                rounds = min(rounds, afford_buffers(buffers[region], rules.privacy) // k)
            else:
                rounds = min(rounds, afford_cloud_rounds(rules, [*own.clients], rounds, k, own.earlier))
        return rounds

    def score(self, round_: int) -> Mapping[str, float]:
        """Return the scores, by region, of the network that a federation of so many rounds ends with."""
        task, averaged = self.learning.task, self.learning.training.average_rounds
        reached = load_round_network(task, self.network, self.folder, round_, averaged, self.start_share)
        return {name: score_network(task, reached, own.data, own.vehicles) for name, own in self.validation.items()}

    def list_vehicles(self, region: str) -> Mapping[str, Trainable]:
        """Return the clients of a region's edge server, by name."""
        own = self.regions[region]
        return own.clients if self.shared is None else give_outputs(own.clients, self.shared, own.weights)

    def prepare(self, clients: Mapping[str, Trainable], where: Runtime | None, number: int, weights: Weights) -> None:
        """Have the clients' samples labelled again before a round, where labels change, and hand them on to `where`."""
        if self.relabel is not None:
            self.relabel(number, weights)
            if isinstance(where, ClientProcesses):
                where.renew(clients)

    def open_replay(self, cloud: CloudServer) -> dict[str, Trainable]:
        """Return the cloud's training on samples of stage I by its client name, if there is any.

        It counts for so many samples, one at least, that its share is right where all vehicles take part in a round.
        """
        if cloud.replay is None:
            return {}
        steps, share = self.learning.training.local_steps, cloud.replay_share
        samples = sum(each.count_samples(steps) for own in self.regions.values() for each in own.clients.values())
        return {REPLAY: Replay(cloud.replay, max(round(samples * share / (1 - share)), 1))}

    def open_topics(self, topics: str | None, done: int) -> "RosTopics | None":
        """Return the topics of the rounds after `done`, and their bag; None where messages stay in memory."""
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
        """Return the edge servers by region, after `done` cloud rounds; `states` are theirs.

        The vehicles of one after another train, where `runtime` says.
        """
        return {
            region: EdgeServer(
                self.list_vehicles(region),
                own.edge_rounds,
                account,
                own.weights,
                cloud_rounds_done=done,
                strategy=self.strategies.edge,
                rules=driven.rules,
                state=states[region],
                earlier=own.earlier,
                runtime=runtime,
                distiller=self.shared,
                buffers=driven.buffers.get(region),
            )
            for region, own in self.regions.items()
        }


@dataclass(frozen=True)
class Whereabouts:
    """Where the vehicles of a federation train: in this process, in others, or on a deployed fleet."""

    runtime: str = "embedded"  # one of `RUNTIMES`
    processes: int = 1  # in so many, or actors
    fleet: str = ""  # folder of the fleet that is up; "": one is brought up for as long
    vehicles: Mapping[str, int] = field(default_factory=dict)  # of each region of that fleet
    timed: bool = False  # whether their times are kept, see `read_times`, unless nobody is to know who was drawn
    deployed: "RegionalDeployment | None" = None  # the vehicles of that fleet, once it is reached

    @contextlib.contextmanager
    def reach(self, clients: list[str]) -> Iterator["Whereabouts"]:
        """Yield this with the deployed vehicles connected, if there is a fleet for these clients."""
        if self.runtime != "flower":
            yield self
            return
        with open_deployment(clients, Path(self.fleet) if self.fleet else None, self.vehicles) as deployed:
            yield replace(self, deployed=deployed)


def federate_stage(
    own: StageFederation, driven: DrivenStage, where: Whereabouts = Whereabouts()
) -> tuple[tuple[float | None, ...], int | None]:
    """Run the rounds of a stage, write weights and ledger, and return the mean training loss of each round.

    Where the training diverges, it stops with the weights of the last sound round, whose number is returned as well;
    None: the weights are those of the last round.

    Rounds are as the radio network has `driven` them: vehicles that it loses are lost in theirs, and the cloud's rounds
    need all edge servers. A privacy budget may end them before the schedule's end, and of asynchronous rounds each
    budget. Where rules make arrays personal, the weights have the mean of the regions' arrays, and each region's model
    is in the same folder, as are regional models.
    """
    learning, task, cloud, rules = own.learning, own.learning.task, own.cloud, driven.rules
    state, states = FederationState(), {region: FederationState() for region in own.regions if cloud is not None}
    afforded, schedule = own.afford(rules, own.schedule.rounds, driven.buffers), own.schedule
    if cloud is not None:
        schedule = replace(schedule, rounds=afforded)  # rates fall over these
        rules.check_personal(to_arrays(own.network))
    server = EDGE if cloud is None else CLOUD
    checkpoints = FederationCheckpoints(
        task,
        own.folder,
        own.book,
        own.report,
        {server: state, **{f"{EDGE}/{region}": each for region, each in states.items()}},
        describe_federation(own.strategies.edge if cloud is None else own.strategies, rules),
        schedule.rounds,
        rules.privacy,
        own.score if own.validation else None,
        own.first_loss,
    )
    start, done = checkpoints.resume(to_arrays(own.network))
    named = {EDGE if cloud is None else f"{EDGE}/{region}": each for region, each in own.regions.items()}
    checkpoints.keep_secrets({name: rules.secret_parties([*each.clients]) for name, each in named.items()})
    everybody = {name: client for region in own.regions for name, client in own.list_vehicles(region).items()}
    if where.timed and not rules.hides_draws:
        everybody = time_clients(everybody, own.folder)
    clients, within = own.conduct.enlist(everybody), own.conduct.within
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
            how: dict[str, Any] = {"strategy": own.strategies.cloud, "rules": rules.of_servers()}
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
    own: StageFederation,
    driven: DrivenStage,
    clients: Mapping[str, Trainable],
    runtime: "Runtime | PartlyDeployed | None",
    state: FederationState,
) -> RunRounds:
    """Return the rounds of a region's vehicles, to be run from some weights after some rounds."""
    ((region, at),) = own.regions.items()

    def run(weights: Weights, account: Account, done: int, on_round: OnRound) -> LocalUpdate:
        return federate(
            clients,
            weights,
            own.schedule,
            account,
            strategy=own.strategies.edge,
            rules=driven.rules,
            state=state,
            done=done,
            earlier=at.earlier,
            before_round=partial(own.prepare, clients, runtime),
            ask_after=own.conduct.follow,
            on_round=on_round,
            runtime=runtime,
            distiller=own.shared,
            buffers=driven.buffers.get(region),
        )

    return run


def _keep_round(
    own: StageFederation,
    servers: Mapping[str, EdgeServer],
    state: FederationState,
    checkpoints: FederationCheckpoints,
    number: int,
    weights: Weights,
    loss: float | None,
) -> None:
    """Keep the checkpoint after a round; in stage III also the divergence of the regions, and their statistics.

    The checkpoint has the mean of the regions' personal arrays. Raises `RoundsOver` where no other round is to begin.
    """
    regions = [*servers.values()]
    if len(regions) > 1:
        both = ([each.begun for each in regions], [each.trained for each in regions])
        divergence = RoundDivergence(*(measure_divergence(models) for models in both))
        state.records[-1] = replace(state.records[-1], divergence=divergence)
    for region, server in servers.items() if own.cloud is not None and own.cloud.keeps_statistics else ():
        keep_statistics(server.trained, own.folder, region)
    personal = [each.state.personal for each in regions if each.state.personal and each.rules.personal_arrays]
    checkpoints.save(number, {**weights, **(average(personal, [1.0] * len(personal)) if personal else {})}, loss)
    if own.conduct.over or checkpoints.kept is not None:
        raise RoundsOver


def _save_regional_models(
    learning: Learning, folder: Path, states: Mapping[str, FederationState], regions: Iterable[str]
) -> None:
    """Write each region's personal model: the common weights with the arrays that its edge server keeps, if any."""
    for region in regions:
        model = load_stage_network(learning.task, folder)
        from_arrays(model, {**to_arrays(model), **(states[region].personal if region in states else {})})
        save_network(learning.task, model, folder / regional_weights(region))
