"""Stages II and III of a task: vehicles federate with edge servers, and in stage III these with the cloud.

Stage II, and further edge rounds after it, take place in one region; stage III joins all regions.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

from flcav.federation.edge_server import edge_seeds
from flcav.federation.links.in_process import update_bytes
from flcav.federation.strategies.fedmd import FedMD
from flcav.network.ledger import Ledger
from flcav.perception.client import SharedSamples, TaskClient
from flcav.perception.weights import to_arrays
from flcav.runs.arms import Setting, find_calls, find_strategies
from flcav.runs.driving import DrivenStage, join_regions
from flcav.runs.engine import Step, Work
from flcav.runs.frames import Frames
from flcav.runs.recipe import CLOUD, EDGE, MORE_EDGE, Federation
from flcav.runs.registry import CONDUCTS, COUNTS, DEALS, DRIVES, load_all
from flcav.runs.results.plans import Plan, TaskPlan
from flcav.runs.results.training import StageResult, StatisticsScore
from flcav.runs.stages.cloud import CloudServer, EnsembleDistillation
from flcav.runs.stages.outline import Outline
from flcav.runs.stages.regions import (
    LabelledSamples,
    RenewedSamples,
    choose_loss,
    drive_region,
    label_samples,
    load_uploads,
    score_labels,
)
from flcav.runs.stages.rounds import (
    Conduct,
    RegionStart,
    StageFederation,
    Whereabouts,
    federate_stage,
)
from flcav.runs.stages.settings import (
    FederationSettings,
    RegionInputs,
    make_step,
    open_region_book,
    read_entries,
    share_plan_budget,
)
from flcav.runs.training.learning import Learning, Strategies, load_stage_network, make_clients, score_statistics
from flcav.runs.training.messages import send_region_network, share_frames
from flcav.runs.training.private_rounds import PrivateRounds, find_budget_noise, plan_private_rounds, take_noise
from flcav.runs.training.records import read_rounds
from flcav.runs.training.updates import follow_plan

Recall = Callable[[Mapping[str, Sequence[Any]]], Mapping[str, Sequence[Any]]]  # adds samples to those by client


class EdgeSettings(FederationSettings):
    """Settings of stage II in a region, or of its further edge rounds if `inputs.edge` names a stage II to continue."""

    inputs: RegionInputs
    validation: Mapping[str, str] = {}  # recordings of the frames on which every round is scored, by region
    shown: str = ""  # recording of the region's validation frames for the score shown to a group; "": none
    scored: bool = False  # whether the labels are compared with ground truth
    last: bool = False  # whether the arm ends with it

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (*self.inputs.needs, *self.validation.values(), *((self.shown,) if self.shown else ()))

    @property
    def stage(self) -> str:
        """EDGE or MORE_EDGE."""
        return EDGE if self.inputs.edge is None else MORE_EDGE

    @property
    def regions(self) -> Mapping[str, RegionInputs]:
        """The inputs by region, like those of stage III."""
        return {self.inputs.region: self.inputs}

    @property
    def first(self) -> RegionInputs:
        """The inputs of its region."""
        return self.inputs


class CloudSettings(FederationSettings):
    """Settings of stage III."""

    regions: Mapping[str, RegionInputs]  # federating regions, with their stages II
    pools: Mapping[str, str] = {}  # recordings of the candidates for upload, by region, where the cloud trains on them
    validation: Mapping[str, str] = {}  # recordings on which the regional statistics are scored, by region
    stage: ClassVar[str] = CLOUD
    scored: ClassVar[bool] = False

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        more = (*self.pools.values(), *self.validation.values())
        return (*(step for inputs in self.regions.values() for step in inputs.needs), *more)

    @property
    def first(self) -> RegionInputs:
        """The inputs of the first region; all regions have its plan and pretrained network."""
        return next(iter(self.regions.values()))


StageSettings = EdgeSettings | CloudSettings


def federate_step(
    work: Work,
    settings: StageSettings,
    processes: int = 1,
    runtime: str = "embedded",
    timed: int = 0,
    fleet: str = "",
    recall: Recall | None = None,
) -> None:
    """Run a stage of a task: label the vehicles' samples, federate, save weights, ledger and result.

    Vehicles train in so many `processes` of a `runtime`, or on the fleet in the folder `fleet`; a `timed` other than 0
    records their training times. Further edge rounds are as many as the region would have in stage III.
    """
    first = settings.first
    plan = Plan.load(work.inputs[first.plan])
    book = _open_book(work, settings, plan)
    before = len(book.entries)
    under = _name_messages(settings)
    labelled = {name: label_samples(work, settings, inputs, book, under) for name, inputs in settings.regions.items()}
    where = Whereabouts(runtime, processes, fleet, settings.vehicles, bool(timed))
    held = [name for region in labelled.values() for name in region.samples if len(region.samples[name])]
    with where.reach(held) as reached:
        conduct, (samples, dealt) = Conduct(), _deal(work, settings, labelled)
        if isinstance(settings, EdgeSettings) and settings.stage == EDGE:
            about = (work, settings, labelled[first.region], book, plan, reached.deployed)
            conduct = next((found for call in load_all(CONDUCTS) if (found := call(*about)) is not None), conduct)
            samples[first.region] = conduct.choose(samples[first.region])
        if recall is not None:
            samples = {region: recall(vehicles) for region, vehicles in samples.items()}
        noise = _find_noise(work, settings, plan)
        settings = settings.model_copy(update={"federation": take_noise(settings.federation, noise)})
        federation = _open_federation(work, settings, samples, plan, book, conduct)
        driven = _drive(work, settings, federation, plan.tasks[settings.learning.task])
        if isinstance(settings, EdgeSettings):
            conduct = conduct.foresee(driven.records.get(first.region, ()), first.region)
            federation = replace(federation, conduct=conduct)
        losses, kept = federate_stage(federation, driven, reached)
        rows = conduct.report(work, settings, federation.schedule.rounds, reached.deployed)
    labels = None
    clients = [client for start in federation.regions.values() for client in start.clients.values()]
    if settings.scored and settings.stage == EDGE and clients:
        labels = score_labels(work, first, federation.network.config, labelled[first.region].samples)
    region = None if settings.stage == CLOUD else first.region
    StageResult(
        stage=settings.stage,
        task=settings.learning.task,
        region=region,
        rounds=len(losses),
        samples=sum(len(client.samples) for client in clients),
        clients=len(clients),
        poles=tuple(pole for region in labelled.values() for pole in region.poles),
        losses=losses,
        records=read_rounds(work.folder, region, before, driven.seconds),
        labels=labels,
        noise=noise,
        statistics=_score_statistics(work, settings, federation.learning) if settings.stage == CLOUD else None,
        kept=kept,
        **dealt,
        **rows,
    ).save(work.folder)


def _deal(
    work: Work, settings: StageSettings, labelled: Mapping[str, LabelledSamples]
) -> tuple[dict[str, Mapping[str, Sequence[Any]]], dict[str, Any]]:
    """Return the vehicles' samples by region, redistributed by extras, and rows of the stage's result."""
    samples = {name: region.samples for name, region in labelled.items()}
    rows = dict[str, Any]()
    for deal in load_all(DEALS):
        for region, inputs in settings.regions.items():
            samples[region], found = deal(work, settings, inputs, samples[region])
            rows |= found
    return samples, rows


def _name_messages(settings: StageSettings) -> str:
    """Return the stage under which messages are entered: further edge rounds belong to stage II."""
    return CLOUD if settings.stage == CLOUD else EDGE


def _open_book(work: Work, settings: StageSettings, plan: Plan) -> Ledger:
    """Return the ledger of the stage, with the messages of the stages before it.

    In stage II a region's share of the budget is proportional to its vehicles, or to those that the plan calls.
    """
    first = settings.first
    share = share_plan_budget(plan, settings.budgets_mb, settings.learning.task)
    if isinstance(settings, CloudSettings):
        edges = [inputs.edge for inputs in settings.regions.values() if inputs.edge is not None]
        return Ledger(share, read_entries(work, first.pretrain, *edges))
    called = plan.tasks[settings.learning.task].called
    vehicles = {name: count if called is None else min(called, count) for name, count in settings.vehicles.items()}
    book = open_region_book(work, share, first.pretrain, vehicles, first.region)
    before = first.edge or first.errors  # the ledger of stage II includes that of the errors
    return book if before is None else Ledger(book.budget, read_entries(work, before))


def _plan_private(settings: EdgeSettings, plan: Plan) -> PrivateRounds[Federation]:
    """Return the rounds of stage II and of the stage after it that the privacy budget affords."""
    planned = plan.tasks[settings.learning.task]
    k = settings.federation.edge_rounds_per_cloud_round
    further = 0 if settings.last else planned.cloud_rounds * k
    return plan_private_rounds(settings.federation, settings.vehicles.values(), planned.edge_rounds, further, k)


def _find_noise(work: Work, settings: StageSettings, plan: Plan) -> float | None:
    """Return the noise multiplier for the privacy budget and planned rounds; None where it is given, or no noise."""
    if settings.first.edge is not None:  # the budget is for both stages: noise was fixed in stage II
        return StageResult.load(work.inputs[settings.first.edge]).noise
    assert isinstance(settings, EdgeSettings)  # stage III always continues a stage II
    return find_budget_noise(settings.federation, _plan_private(settings, plan).rules)


def _count_rounds(settings: StageSettings, plan: Plan, conduct: Conduct, before: Sequence[StageResult]) -> int:
    """Return the planned rounds of the stage, of stage II as privacy affords; 0 after a stage II that diverged."""
    planned = plan.tasks[settings.learning.task]
    if any(earlier.kept is not None for earlier in before):
        return 0
    if isinstance(settings, CloudSettings):
        return planned.cloud_rounds
    if settings.stage == MORE_EDGE:
        return planned.cloud_rounds * settings.federation.edge_rounds_per_cloud_round
    return 0 if conduct.vacant else _plan_private(settings, plan).edge


def _open_federation(
    work: Work,
    settings: StageSettings,
    samples: Mapping[str, Mapping[str, Sequence[Any]]],
    plan: Plan,
    book: Ledger,
    conduct: Conduct,
) -> StageFederation:
    """Return the federation, after sending vehicles what they lack: shared frames, their network, constant labels."""
    first = settings.first
    how = settings.federation
    cloud = isinstance(settings, CloudSettings)
    learning = choose_loss(work, settings, first.pretrain)
    strategies = Strategies(*find_strategies(how))
    began = first.pretrain if cloud else first.edge or first.pretrain
    network = load_stage_network(learning.task, work.inputs[began])
    before = {
        name: StageResult.load(work.inputs[inputs.edge])
        for name, inputs in settings.regions.items()
        if inputs.edge is not None
    }
    rounds = _count_rounds(settings, plan, conduct, [*before.values()])
    starts = dict[str, RegionStart]()
    for region, inputs in settings.regions.items():
        clients = make_clients(learning, network.config, samples[region])
        weights = to_arrays(load_stage_network(learning.task, work.inputs[inputs.edge or inputs.pretrain]))
        earlier = before[region].rounds if region in before else 0
        held = samples[region]
        if inputs.edge is not None and rounds and isinstance(held, RenewedSamples):
            held.renew(1, weights)
        starts[region] = RegionStart(clients, weights, earlier, how.edge_rounds_per_cloud_round if cloud else 1)
    for count in load_all(COUNTS):
        rounds, starts = count(strategies.edge, rounds, starts, cloud)
    names = (CLOUD, "") if cloud else (settings.stage, first.region)
    earlier = max(start.earlier for start in starts.values())
    restart = how.cloud_rate if cloud else None
    start_share = 0.0 if earlier else learning.training.start_share
    relabel = samples[first.region] if settings.stage == EDGE else None
    losses = [loss for result in before.values() for loss in result.losses[:1] if loss is not None]
    return StageFederation(
        learning=learning,
        network=network,
        regions=starts,
        schedule=learning.schedule(rounds, learning.training.local_steps, *names, earlier=earlier, restart=restart),
        strategies=strategies,
        book=book,
        folder=work.folder,
        report=work.report,
        start_share=how.cloud_start_share if cloud else start_share,
        cloud=_open_cloud(work, settings, learning, network.config) if isinstance(settings, CloudSettings) else None,
        shared=_share(work, settings, learning, network, starts, book) if isinstance(strategies.edge, FedMD) else None,
        validation={}
        if cloud
        else {name: Frames.open(work.inputs[step]) for name, step in settings.validation.items()},
        relabel=relabel.renew if isinstance(relabel, RenewedSamples) else None,
        conduct=conduct,
        first_loss=max(losses, default=None),
    )


def _share(
    work: Work,
    settings: StageSettings,
    learning: Learning,
    network: Any,
    starts: Mapping[str, RegionStart],
    book: Ledger,
) -> SharedSamples:
    """Return the shared samples for class probabilities, after sending vehicles these, or their network of stage II."""
    first, (strategy, _) = settings.first, find_strategies(settings.federation)
    assert isinstance(strategy, FedMD)
    shown = share_frames(work, learning, network.config, strategy, first.pools, first.pretrain)
    for region, at in starts.items():
        if settings.regions[region].edge is not None:  # vehicles have the frames, and continue the region's network
            send_region_network(book, learning.task, at.weights, at.clients, _name_messages(settings))
        else:
            shown.send(book, network, region, [*at.clients])
    return shown.samples


def _open_cloud(work: Work, settings: CloudSettings, learning: Learning, config: Any) -> CloudServer:
    """Return the cloud's tasks besides averaging: it may train on the samples that it received in stage I."""
    how = settings.federation
    cloud = CloudServer(bool(settings.validation), topics=how.cloud_topics)
    if not how.trains_in_cloud:
        return cloud
    samples = load_uploads(work, learning, config, settings.first.pretrain, settings.pools)
    own = TaskClient(learning.task, config, samples, batch=learning.batch)
    distil = partial(EnsembleDistillation, own, how.cloud_distillation) if how.cloud_distillation else None
    return replace(cloud, replay=own if how.replay else None, replay_share=how.replay, distil=distil)


def _score_statistics(work: Work, settings: StageSettings, learning: Learning) -> tuple[StatisticsScore, ...] | None:
    """Return the scores with the regions' statistics of batch normalisation; None where they are not asked for."""
    if not settings.validation:
        return None
    frames = {name: Frames.open(work.inputs[step]) for name, step in settings.validation.items()}
    return score_statistics(learning.task, load_stage_network(learning.task, work.folder), work.folder, frames)


def _drive(work: Work, settings: StageSettings, federation: StageFederation, plan: TaskPlan) -> DrivenStage:
    """Simulate the rounds of a plan on the radio network."""
    how = settings.federation
    cloud = federation.cloud is not None
    ways_s = None
    if cloud and how.network is not None:
        ways_s = 2 * how.network.wireline.seconds(update_bytes(to_arrays(federation.network)))
    for drive in load_all(DRIVES):
        if (found := drive(work, settings, federation, ways_s)) is not None:
            return found
    schedule = federation.schedule
    numbers = range(1, schedule.rounds + 1)
    driven = {}
    for region, at in federation.regions.items():
        if cloud:
            seeds = [seed for number in numbers for seed in edge_seeds(schedule, number, region, at.edge_rounds)]
        else:
            seeds = [schedule.work(number).seed for number in numbers]
        rules = follow_plan(how, plan, after_edge=cloud or bool(at.earlier))
        vehicles = {name: client for name, client in at.clients.items() if name not in federation.within}
        about = (federation.learning, settings.regions[region], replace(at, clients=vehicles))
        driven[region] = drive_region(work, settings, *about, rules, seeds)
    return join_regions(driven, how.edge_rounds_per_cloud_round, ways_s)


def list_edge_steps(outline: Outline, arm: Setting, task: str) -> Iterator[Step]:
    """Yield the steps of stage II of an arm for a task, by region."""
    scored = outline.tracks(task) or bool(outline.averaging(task))
    asks = find_calls(outline.recipe, arm.federation) is not None
    for region in arm.regions:
        name, inputs = outline.names.edge(arm.name, region, task), outline.inputs(arm, region, task, EDGE)
        shown = outline.names.recording(region, "validation", task) if asks else ""
        about = dict(outline.federation(arm, task, EDGE))
        settings = EdgeSettings(**about, inputs=inputs, shown=shown, scored=scored, last=arm.stages[-1] == EDGE)
        yield make_step(name, federate_step, settings, outline.vehicles[region])


def list_more_edge_steps(outline: Outline, arm: Setting, task: str) -> Iterator[Step]:
    """Yield the steps with further edge rounds of an arm for a task, by region."""
    for region in arm.regions:
        name, inputs = outline.names.more_edge(arm.name, region, task), outline.inputs(arm, region, task, MORE_EDGE)
        settings = EdgeSettings(**dict(outline.federation(arm, task, MORE_EDGE)), inputs=inputs)
        yield make_step(name, federate_step, settings, outline.vehicles[region])


def make_cloud_step(outline: Outline, arm: Setting, task: str) -> Step:
    """Return the step of stage III of an arm for a task."""
    names = outline.names
    scored = arm.regions if arm.federation.score_statistics else ()
    settings = CloudSettings(
        **dict(outline.federation(arm, task, CLOUD)),
        regions={region: outline.inputs(arm, region, task, CLOUD) for region in arm.regions},
        pools=outline.pools(task) if arm.federation.trains_in_cloud else {},
        validation={region: names.recording(region, "validation", task) for region in scored},
    )
    at_once = max(outline.vehicles[region] for region in arm.regions)  # edge servers train one after another
    return make_step(names.cloud(arm.name, task), federate_step, settings, at_once)
