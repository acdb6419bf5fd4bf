"""Stage III of a task: edge servers federate with the cloud, vehicles with edge servers."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flcav.federation.buffered_rounds import Buffers, afford_buffers
from flcav.federation.divergence import RoundDivergence, measure_divergence
from flcav.federation.edge_server import EdgeServer, afford_cloud_rounds, edge_seeds
from flcav.federation.rounds import federate
from flcav.federation.rules import Rules
from flcav.federation.runtimes.embedded import update_bytes
from flcav.federation.runtimes.link import Runtime, open_runtime
from flcav.federation.runtimes.metered import Account, Outage
from flcav.federation.runtimes.ros_names import join_names
from flcav.federation.state import FederationState
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedavg import average
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.trainable import Trainable, Update, Weights
from flcav.interface.progress import Report
from flcav.network.clock.rounds import NetworkSettings
from flcav.network.ledger import Ledger
from flcav.perception.client import TaskClient
from flcav.perception.distillation import SharedSamples
from flcav.perception.weights import from_arrays, save_network, to_arrays
from flcav.runs.arms import Setting, find_strategies
from flcav.runs.engine import Step, Work
from flcav.runs.frames import Frames
from flcav.runs.labels.road_average import RoadAverageLabels
from flcav.runs.plan.updates import follow_plan
from flcav.runs.radio.buffered import drive_cloud_buffers
from flcav.runs.radio.driving import DrivenCloud, join_regions
from flcav.runs.recipe import CLOUD, EDGE
from flcav.runs.results.plans import Plan, TaskPlan
from flcav.runs.results.training import StageResult, StatisticsScore
from flcav.runs.steps.outline import Outline
from flcav.runs.steps.regions import (
    choose_loss,
    drive_region,
    label_samples,
    load_uploads,
    open_buffered_fleet,
    save_clock,
)
from flcav.runs.steps.settings import FederationSettings, RegionInputs, make_step, read_entries, share_plan_budget
from flcav.runs.training.checkpoints import FederationCheckpoints
from flcav.runs.training.learning import (
    Learning,
    Strategies,
    describe_federation,
    give_outputs,
    load_stage_network,
    make_clients,
    regional_weights,
)
from flcav.runs.training.messages import send_region_network, share_frames
from flcav.runs.training.private_rounds import take_noise
from flcav.runs.training.records import read_rounds
from flcav.runs.training.statistics import keep_statistics, score_statistics

if TYPE_CHECKING:
    from flcav.federation.runtimes.topics import RosTopics

BAG = "bag-from-round"  # begins the names of the folders of ROS 2 bags
REPLAY = "cloud-replay"  # the cloud's own training among the edge servers; no region has a hyphen in its name


@dataclass(frozen=True)
class RegionStart:
    """The start of a region's edge server in stage III."""

    clients: Mapping[str, TaskClient]  # its vehicles, by name
    weights: Weights  # of stage II
    earlier: int  # rounds of stage II


@dataclass(frozen=True)
class Replay:
    """The cloud's own training on what it was sent in stage I, which counts for a given number of samples."""

    client: TaskClient
    samples: int

    def train(self, weights: Weights, **how: Any) -> Update:
        """Return the update of `TaskClient.train`, with that number."""
        return replace(self.client.train(weights, **how), samples=self.samples)


@dataclass(frozen=True)
class CloudFederation:
    """The federation of edge servers with the cloud: what its rounds begin with, and where they are kept."""

    learning: Learning
    network: Any  # that the cloud begins with
    regions: Mapping[str, RegionStart]
    edge_rounds: Mapping[str, int]  # of each edge server in a cloud round, by region
    strategies: Strategies
    book: Ledger
    folder: Path  # of checkpoints, weights and ledger
    report: Report
    shared: SharedSamples | None = None  # that vehicles send outputs on, instead of weights
    keeps_statistics: bool = False  # whether each region's statistics of batch normalisation are written, too
    rate: float | None = None  # of the first round, where it is restarted
    start_share: float = 0.0  # of the network that the cloud begins with in the result
    replay: TaskClient | None = None  # the cloud's own training on the samples of stage I
    replay_share: float = 0.0  # of it in each of the cloud's averages
    topics: str | None = None  # ROS namespace by which edge servers and cloud exchange messages; None: in memory

    def afford(self, rules: Rules, rounds: int, buffers: Mapping[str, Buffers]) -> int:
        """Return as many of `rounds` as the privacy budget affords in every region; without one all."""
        for region, own in self.regions.items() if rules.privacy is not None else ():
            k = self.edge_rounds[region]
            if region in buffers:
                rounds = min(rounds, afford_buffers(buffers[region], rules.privacy) // k)
            else:
                rounds = min(rounds, afford_cloud_rounds(rules, [*own.clients], rounds, k, own.earlier))
        return rounds

    def open_replay(self) -> dict[str, Trainable]:
        """Return the cloud's own training by its name, if there is any.

        It counts for so many samples, one at least, that its share is right where all vehicles take part in a round.
        """
        if self.replay is None:
            return {}
        steps = self.learning.training.local_steps
        samples = sum(each.count_samples(steps) for own in self.regions.values() for each in own.clients.values())
        return {REPLAY: Replay(self.replay, max(round(samples * self.replay_share / (1 - self.replay_share)), 1))}

    def open_topics(self, done: int) -> "RosTopics | None":
        """Return the topics of the rounds after `done`, and their bag; None where messages stay in memory."""
        if self.topics is None:
            return None
        from flcav.federation.runtimes.topics import RosTopics

        bag = self.folder / f"{BAG}{done + 1}"
        shutil.rmtree(bag, ignore_errors=True)  # of rounds that a kill undid
        return RosTopics(join_names(self.topics, f"seed{self.learning.seed}", self.folder.name), bag=bag)

    def vehicles(self, region: str) -> Mapping[str, Trainable]:
        """Return the clients of a region's edge server, by name."""
        own = self.regions[region]
        return own.clients if self.shared is None else give_outputs(own.clients, self.shared, own.weights)

    def open_servers(
        self,
        rules: Rules,
        account: Account,
        done: int,
        states: Mapping[str, FederationState],
        runtime: Runtime | None,
        buffers: Mapping[str, Buffers] = {},
    ) -> dict[str, EdgeServer]:
        """Return the edge servers by region, after `done` cloud rounds; `states` are their own.

        The vehicles of one after another train, where `runtime` says.
        """
        return {
            region: EdgeServer(
                self.vehicles(region),
                self.edge_rounds[region],
                account,
                own.weights,
                cloud_rounds_done=done,
                strategy=self.strategies.edge,
                rules=rules,
                state=states[region],
                earlier=own.earlier,
                runtime=runtime,
                distiller=self.shared,
                buffers=buffers.get(region),
            )
            for region, own in self.regions.items()
        }


def federate_cloud(
    federation: CloudFederation,
    rounds: int,
    rules: Rules,
    outages: Mapping[tuple[int, str], Outage] = {},
    *,
    buffers: Mapping[str, Buffers] = {},
    processes: int = 1,
    runtime: str = "embedded",
    fleet: Path | None = None,
    vehicles: Mapping[str, int] = {},
) -> tuple[float | None, ...]:
    """Run stage III; write weights and ledger, return each round's loss.

    Edge rounds are run by `rules`, and lose the vehicles that `outages` names; the cloud's rounds need all edge
    servers. Where rules make arrays personal, the weights have the mean of the regions' own, and each region's model is
    beside them, as are regional models. A privacy budget may end it before `rounds`. The vehicles of one region after
    another train, in so many `processes` of a `runtime` of `RUNTIMES`: `fleet` and `vehicles` as in `open_runtime`.
    """
    own, learning, task = federation, federation.learning, federation.learning.task
    state, states = FederationState(), {region: FederationState() for region in federation.regions}
    rounds = own.afford(rules, rounds, buffers)
    checkpoints = FederationCheckpoints(
        task,
        own.folder,
        own.book,
        own.report,
        {CLOUD: state, **{f"{EDGE}/{region}": each for region, each in states.items()}},
        describe_federation(own.strategies, rules),
        rounds,
        rules.privacy,
    )
    rules.check_personal(to_arrays(own.network))
    start, done = checkpoints.resume(to_arrays(own.network))
    parties = {f"{EDGE}/{region}": rules.secret_parties([*each.clients]) for region, each in own.regions.items()}
    checkpoints.keep_secrets(parties)
    earlier = max(each.earlier for each in own.regions.values())
    schedule = learning.schedule(rounds, learning.training.local_steps, CLOUD, "", earlier=earlier, restart=own.rate)
    wireless = Account(own.book, CLOUD, task.name, "wireless", outages)
    everybody = {name: client for region in own.regions for name, client in own.vehicles(region).items()}
    with checkpoints.refusals(), open_runtime(runtime, everybody, processes, fleet, vehicles) as where:
        servers = own.open_servers(rules, wireless, done, states, where, buffers)
        federate(
            {**servers, **own.open_replay()},
            start,
            schedule,
            Account(own.book, CLOUD, task.name, "wireline", within=frozenset({REPLAY})),
            strategy=own.strategies.cloud,
            rules=rules.of_servers(),
            state=state,
            done=done,
            on_round=partial(_keep_round, own, servers, state, checkpoints),
            runtime=own.open_topics(done),
        )
    losses = checkpoints.finish(own.network, learning.training.average_rounds, own.start_share)
    if rules.personal:
        _save_regional_models(learning, own.folder, states)
    return losses


def _keep_round(
    own: CloudFederation,
    servers: Mapping[str, EdgeServer],
    state: FederationState,
    checkpoints: FederationCheckpoints,
    number: int,
    weights: Weights,
    loss: float | None,
) -> None:
    """Keep the divergence of the regions in a cloud round, their statistics, and the checkpoint.

    The checkpoint has the mean of the regions' personal arrays.
    """
    regions = [*servers.values()]
    if len(regions) > 1:
        both = ([each.begun for each in regions], [each.trained for each in regions])
        divergence = RoundDivergence(*(measure_divergence(models) for models in both))
        state.records[-1] = replace(state.records[-1], divergence=divergence)
    for region, server in servers.items() if own.keeps_statistics else ():
        keep_statistics(server.trained, own.folder, region)
    personal = [each.state.personal for each in regions if each.state.personal and each.rules.personal_arrays]
    checkpoints.save(number, {**weights, **(average(personal, [1.0] * len(personal)) if personal else {})}, loss)


def _save_regional_models(learning: Learning, folder: Path, states: Mapping[str, FederationState]) -> None:
    """Write each region's own model: the common weights with what its edge server keeps."""
    for region, own in states.items():
        model = load_stage_network(learning.task, folder)
        from_arrays(model, {**to_arrays(model), **own.personal})
        save_network(learning.task, model, folder / regional_weights(region))


class CloudSettings(FederationSettings):
    """Settings of stage III."""

    regions: Mapping[str, RegionInputs]  # that federate, each with its stage II
    pools: Mapping[str, str] = {}  # recordings of the candidates for upload, by region, where the cloud trains on them
    validation: Mapping[str, str] = {}  # recordings that the regions' own statistics are scored on, by region

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        more = (*self.pools.values(), *self.validation.values())
        return (*(step for inputs in self.regions.values() for step in inputs.needs), *more)

    @property
    def first(self) -> RegionInputs:
        """Return the inputs of the first region, whose plan and pretrained network are those of all."""
        return next(iter(self.regions.values()))

    @property
    def edges(self) -> dict[str, str]:
        """Return the step of stage II of each region."""
        return {region: inputs.edge for region, inputs in self.regions.items() if inputs.edge is not None}


@dataclass(frozen=True)
class _Servers:
    """The edge servers of stage III, by region."""

    starts: Mapping[str, RegionStart]
    poles: tuple[int, ...]  # whose sensors contributed labels

    @property
    def samples(self) -> int:
        return sum(len(client.samples) for start in self.starts.values() for client in start.clients.values())

    @property
    def clients(self) -> int:
        return sum(len(start.clients) for start in self.starts.values())


def cloud_step(
    work: Work, settings: CloudSettings, processes: int = 1, runtime: str = "embedded", fleet: str = ""
) -> None:
    """Run stage III of a task: the edge servers of all regions federate with the cloud, vehicles with edge servers.

    Vehicles train in so many `processes` of a `runtime`, or in the `fleet` of this folder.
    """
    first, task = settings.first, settings.learning.task
    learning = choose_loss(work, settings, first.pretrain)
    noise = StageResult.load(work.inputs[next(iter(settings.edges.values()))]).noise
    settings = settings.model_copy(update={"federation": take_noise(settings.federation, noise)})
    plan, start = Plan.load(work.inputs[first.plan]), load_stage_network(learning.task, work.inputs[first.pretrain])
    share = share_plan_budget(plan, settings.budgets_mb, task)
    book = Ledger(share, read_entries(work, first.pretrain, *settings.edges.values()))
    before, rounds = len(book.entries), plan.tasks[task].cloud_rounds
    servers = _open_servers(work, settings, learning, start.config, rounds, book)
    federation = _open_federation(work, settings, learning, start, servers, book)
    driven = _drive(work, settings, federation, plan.tasks[task])
    where: Any = {"processes": processes, "runtime": runtime, "vehicles": settings.vehicles}
    where["fleet"] = Path(fleet) if fleet else None
    losses = federate_cloud(federation, rounds, driven.rules, driven.outages, buffers=driven.buffers, **where)
    StageResult(
        stage=CLOUD,
        task=task,
        region=None,
        rounds=len(losses),
        samples=servers.samples,
        clients=servers.clients,
        poles=servers.poles,
        losses=losses,
        records=read_rounds(work.folder, None, before, driven.seconds),
        noise=noise,
        statistics=_score_statistics(work, settings, federation) if settings.validation else None,
    ).save(work.folder)


def _open_servers(
    work: Work, settings: CloudSettings, learning: Learning, config: Any, rounds: int, book: Ledger
) -> _Servers:
    """Return the edge servers with their vehicles' samples, as stage II left them.

    Where there are `rounds`, labels by the road average are made once more; their messages enter `book`.
    """
    starts, poles = {}, []
    for region, inputs in settings.regions.items():
        labelled = label_samples(work, settings, inputs, book, CLOUD)
        clients, stage_two = make_clients(learning, config, labelled.samples), work.inputs[settings.edges[region]]
        weights = to_arrays(load_stage_network(learning.task, stage_two))
        if rounds and isinstance(labelled.samples, RoadAverageLabels):
            labelled.samples.renew(1, weights)
        starts[region] = RegionStart(clients, weights, StageResult.load(stage_two).rounds)
        poles += labelled.poles
    return _Servers(starts, tuple(poles))


def _open_federation(
    work: Work, settings: CloudSettings, learning: Learning, start: Any, servers: _Servers, book: Ledger
) -> CloudFederation:
    """Return the federation, after sending vehicles their region's network where they send outputs."""
    strategies, shared = Strategies(*find_strategies(settings.federation)), None
    if isinstance(strategies.edge, FedMD):
        first = settings.first
        shown = share_frames(work, learning, start.config, strategies.edge, first.pools, first.pretrain)
        shared = shown.samples
        for at in servers.starts.values():
            send_region_network(book, learning.task, at.weights, at.clients, CLOUD)
    return CloudFederation(
        learning=learning,
        network=start,
        regions=servers.starts,
        edge_rounds=_count_edge_rounds(settings, strategies.edge, servers),
        strategies=strategies,
        book=book,
        folder=work.folder,
        report=work.report,
        shared=shared,
        keeps_statistics=bool(settings.validation),
        rate=settings.federation.cloud_rate,
        start_share=settings.federation.cloud_start_share,
        replay=_open_replay(work, settings, learning, start.config) if settings.federation.replay else None,
        replay_share=settings.federation.replay,
        topics=settings.federation.cloud_topics,
    )


def _count_edge_rounds(settings: CloudSettings, strategy: Strategy, servers: _Servers) -> dict[str, int]:
    """Return the rounds of each region in a cloud round; of buffers as many as have the updates of these, one at least.

    Raises `InputError` where a region has fewer vehicles than a buffer has updates.
    """
    k, found = settings.federation.edge_rounds_per_cloud_round, dict[str, int]()
    for region, own in servers.starts.items():
        found[region] = k
        if isinstance(strategy, FedBuff):
            strategy.check_buffer(len(own.clients))
            found[region] = max(strategy.count_rounds(k, len(own.clients)), 1)
    return found


def _open_replay(work: Work, settings: CloudSettings, learning: Learning, config: Any) -> TaskClient:
    """Return the cloud's own training on the samples that it was sent in stage I."""
    samples = load_uploads(work, learning, config, settings.first.pretrain, settings.pools)
    return TaskClient(learning.task, config, samples, batch=learning.batch)


def _score_statistics(work: Work, settings: CloudSettings, federation: CloudFederation) -> tuple[StatisticsScore, ...]:
    task, frames = (
        federation.learning.task,
        {name: Frames.open(work.inputs[step]) for name, step in settings.validation.items()},
    )
    return score_statistics(task, load_stage_network(task, work.folder), work.folder, frames)


def _drive(work: Work, settings: CloudSettings, federation: CloudFederation, plan: TaskPlan) -> DrivenCloud:
    """Return what the radio network makes of the cloud rounds of a plan."""
    own, how, numbers = federation, settings.federation, range(1, plan.cloud_rounds + 1)
    if isinstance(own.strategies.edge, FedBuff) and how.network is not None:
        return _drive_buffers(work, settings, own, own.strategies.edge, how.network, plan.cloud_rounds)
    k = how.edge_rounds_per_cloud_round
    schedule = own.learning.schedule(plan.cloud_rounds, own.learning.training.local_steps, CLOUD, "")
    rules, driven = follow_plan(how, plan, after_edge=True), {}
    for name, at in own.regions.items():
        seeds = [seed for number in numbers for seed in edge_seeds(schedule, number, name, k)]
        about = (own.learning, settings.regions[name], [*at.clients], at.earlier)
        driven[name] = drive_region(work, settings, *about, rules, seeds)
    return join_regions(driven, k, how.network, update_bytes(to_arrays(own.network)))


def _drive_buffers(
    work: Work,
    settings: CloudSettings,
    federation: CloudFederation,
    strategy: FedBuff,
    network: NetworkSettings,
    rounds: int,
) -> DrivenCloud:
    own, size = federation, update_bytes(to_arrays(federation.network))
    fleets = {
        name: open_buffered_fleet(work, settings, own.learning, settings.regions[name], [*at.clients])
        for name, at in own.regions.items()
    }
    driven, cloud = drive_cloud_buffers(fleets, strategy, network, settings.federation, own.edge_rounds, rounds, size)
    for region, each in driven.items():
        save_clock(each, work, region)
    return cloud


def make_cloud_step(outline: Outline, arm: Setting, task: str) -> Step:
    """Return stage III of an arm for a task."""
    names = outline.names
    scored = arm.regions if arm.federation.score_statistics else ()
    settings = CloudSettings(
        **outline.federation(arm, task, CLOUD),
        regions={region: outline.inputs(arm, region, task, CLOUD) for region in arm.regions},
        pools=outline.pools(task) if arm.federation.replay else {},
        validation={region: names.recording(region, "validation", task) for region in scored},
    )
    at_once = max(outline.vehicles[region] for region in arm.regions)  # of one edge server
    return make_step(names.cloud(arm.name, task), cloud_step, settings, at_once)
