"""The step of stage III of a task: edge servers federate with the cloud."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flcav.federation.edge_server import edge_seeds
from flcav.federation.runtimes.embedded import update_bytes
from flcav.federation.strategies.fedmd import FedMD
from flcav.network.ledger import Ledger
from flcav.perception.weights import to_arrays
from flcav.pipeline.arms import find_strategies
from flcav.pipeline.engine import Work
from flcav.pipeline.federations.network import DrivenCloud, join_regions
from flcav.pipeline.federations.outputs import send_region_network, share_frames
from flcav.pipeline.federations.records import read_rounds
from flcav.pipeline.federations.spent import take_noise
from flcav.pipeline.frames import Frames
from flcav.pipeline.labels.road_average import RoadAverageLabels
from flcav.pipeline.learning import Learning, load_stage_network
from flcav.pipeline.planning.updates import follow_plan
from flcav.pipeline.recipe import CLOUD
from flcav.pipeline.results.plans import Plan, TaskPlan
from flcav.pipeline.results.training import StageResult, StatisticsScore
from flcav.pipeline.stages.clients import Strategies, make_clients
from flcav.pipeline.stages.cloud import CloudFederation, RegionStart, federate_cloud
from flcav.pipeline.stages.statistics import score_statistics
from flcav.pipeline.steps.budgets import read_entries, share_plan_budget
from flcav.pipeline.steps.driving import drive_region
from flcav.pipeline.steps.labelling import label_samples, learn_by_distillation
from flcav.pipeline.steps.settings import FederationSettings, RegionInputs


class CloudSettings(FederationSettings):
    """Settings of stage III."""

    regions: Mapping[str, RegionInputs]  # that federate, each with its stage II
    validation: Mapping[str, str] = {}  # recordings that the regions' own statistics are scored on, by region

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return (*(step for inputs in self.regions.values() for step in inputs.needs), *self.validation.values())

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


def cloud_step(work: Work, settings: CloudSettings, processes: int = 1) -> None:
    """Run stage III of a task: the edge servers of all regions federate with the cloud, vehicles with edge servers.

    Vehicles train in so many `processes`.
    """
    first, task, learning = settings.first, settings.learning.task, settings.learning.resolve()
    noise = StageResult.load(work.inputs[next(iter(settings.edges.values()))]).noise
    settings = settings.model_copy(update={"federation": take_noise(settings.federation, noise)})
    plan, start = Plan.load(work.inputs[first.plan]), load_stage_network(learning.task, work.inputs[first.pretrain])
    share = share_plan_budget(plan, settings.budgets_mb, task)
    book = Ledger(share, read_entries(work, first.pretrain, *settings.edges.values()))
    if settings.distillation is not None:
        learning = learn_by_distillation(learning, settings.distillation)
    before, rounds = len(book.entries), plan.tasks[task].cloud_rounds
    servers = _open_servers(work, settings, learning, start.config, rounds, book)
    federation = _open_federation(work, settings, learning, start, servers, book)
    driven = _drive(work, settings, federation, plan.tasks[task])
    losses = federate_cloud(federation, rounds, driven.rules, driven.outages, processes=processes)
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
        edge_rounds=settings.federation.edge_rounds_per_cloud_round,
        strategies=strategies,
        book=book,
        folder=work.folder,
        report=work.report,
        shared=shared,
        keeps_statistics=bool(settings.validation),
        rate=settings.federation.cloud_rate,
    )


def _score_statistics(work: Work, settings: CloudSettings, federation: CloudFederation) -> tuple[StatisticsScore, ...]:
    task, frames = (
        federation.learning.task,
        {name: Frames.open(work.inputs[step]) for name, step in settings.validation.items()},
    )
    return score_statistics(task, load_stage_network(task, work.folder), work.folder, frames)


def _drive(work: Work, settings: CloudSettings, federation: CloudFederation, plan: TaskPlan) -> DrivenCloud:
    """Return what the radio network makes of the cloud rounds of a plan."""
    own, k, how, numbers = federation, federation.edge_rounds, settings.federation, range(1, plan.cloud_rounds + 1)
    schedule = own.learning.schedule(plan.cloud_rounds, own.learning.training.local_steps, CLOUD, "")
    rules, driven = follow_plan(how, plan, after_edge=True), {}
    for name, at in own.regions.items():
        seeds = [seed for number in numbers for seed in edge_seeds(schedule, number, name, k)]
        about = (own.learning, settings.regions[name], [*at.clients], at.earlier)
        driven[name] = drive_region(work, settings, *about, rules, seeds)
    return join_regions(driven, k, how.network, update_bytes(to_arrays(own.network)))
