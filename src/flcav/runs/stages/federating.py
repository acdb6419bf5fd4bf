"""Stages II and III of a task: vehicles federate with edge servers, and in stage III these with the cloud.

Stage II is that of a region, and so are further edge rounds after it; stage III is one of all regions.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
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
    CloudServer,
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

Recall = Callable[[Mapping[str, Sequence[Any]]], Mapping[str, Sequence[Any]]]  # adds to the samples of each client


class EdgeSettings(FederationSettings):
    """Settings of stage II in a region; with a stage II to go on from (`inputs.edge`) of its further edge rounds."""

    inputs: RegionInputs
    validation: Mapping[str, str] = {}  # recordings of the frames that each round is scored on, by region
    shown: str = ""  # recording of the region's validation frames, on which a group's score is told; "": it is not
    scored: bool = False  # whether the labels are compared with ground truth
    last: bool = False  # whether the arm ends with it

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return (*self.inputs.needs, *self.validation.values(), *((self.shown,) if self.shown else ()))

    @property
    def stage(self) -> str:
        """Return EDGE or MORE_EDGE."""
        return EDGE if self.inputs.edge is None else MORE_EDGE

    @property
    def regions(self) -> Mapping[str, RegionInputs]:
        """Return the inputs of its region by name, as those of stage III."""
        return {self.inputs.region: self.inputs}

    @property
    def first(self) -> RegionInputs:
        """Return the inputs of its region."""
        return self.inputs


class CloudSettings(FederationSettings):
    """Settings of stage III."""

    regions: Mapping[str, RegionInputs]  # that federate, each with its stage II
    pools: Mapping[str, str] = {}  # recordings of the candidates for upload, by region, where the cloud trains on them
    validation: Mapping[str, str] = {}  # recordings that the regions' own statistics are scored on, by region
    stage: ClassVar[str] = CLOUD
    scored: ClassVar[bool] = False

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        more = (*self.pools.values(), *self.validation.values())
        return (*(step for inputs in self.regions.values() for step in inputs.needs), *more)

    @property
    def first(self) -> RegionInputs:
        """Return the inputs of the first region, whose plan and pretrained network are those of all."""
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

    Vehicles train in so many `processes` of a `runtime`, or in the `fleet` of this folder; other than 0, `timed` keeps
    their times. Further edge rounds are as many as the region has in stage III.
    """
    first = settings.first
    plan = Plan.load(work.inputs[first.plan])
    book = _open_book(work, settings, plan)
    before, under = len(book.entries), _name_messages(settings)
    labelled = {name: label_samples(work, settings, own, book, under) for name, own in settings.regions.items()}
    where = Whereabouts(runtime, processes, fleet, settings.vehicles, bool(timed))
    held = [name for own in labelled.values() for name in own.samples if len(own.samples[name])]
    with where.reach(held) as reached:
        conduct, (samples, dealt) = Conduct(), _deal(work, settings, labelled)
        if isinstance(settings, EdgeSettings) and settings.stage == EDGE:
            about = (work, settings, labelled[first.region], book, plan, reached.deployed)
            conduct = next((found for call in load_all(CONDUCTS) if (found := call(*about)) is not None), conduct)
            samples[first.region] = conduct.choose(samples[first.region])
        if recall is not None:
            samples = {region: recall(own) for region, own in samples.items()}
        noise = _find_noise(work, settings, plan)
        settings = settings.model_copy(update={"federation": take_noise(settings.federation, noise)})
        federation = _open_federation(work, settings, samples, plan, book, conduct)
        driven = _drive(work, settings, federation, plan.tasks[settings.learning.task])
        if isinstance(settings, EdgeSettings):
            conduct = conduct.foresee(driven.records.get(first.region, ()), first.region)
            federation = replace(federation, conduct=conduct)
        losses, kept = federate_stage(federation, driven, reached)
        rows = conduct.report(work, settings, federation.schedule.rounds, reached.deployed)
    labels, clients = None, [client for own in federation.regions.values() for client in own.clients.values()]
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
        poles=tuple(pole for own in labelled.values() for pole in own.poles),
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
    """Return the samples of each region's vehicles, by region, as extras deal them, and rows of the stage's result."""
    samples, rows = {region: own.samples for region, own in labelled.items()}, dict[str, Any]()
    for deal in load_all(DEALS):
        for region, inputs in settings.regions.items():
            samples[region], found = deal(work, settings, inputs, samples[region])
            rows |= found
    return samples, rows


def _name_messages(settings: StageSettings) -> str:
    """Return the stage that messages are entered under: further edge rounds are of stage II."""
    return CLOUD if settings.stage == CLOUD else EDGE


def _open_book(work: Work, settings: StageSettings, plan: Plan) -> Ledger:
    """Return the ledger of the stage, with what was sent before.

    In stage II the region has a share of the budget by the vehicles that a plan calls.
    """
    first, share = settings.first, share_plan_budget(plan, settings.budgets_mb, settings.learning.task)
    if isinstance(settings, CloudSettings):
        edges = [inputs.edge for inputs in settings.regions.values() if inputs.edge is not None]
        return Ledger(share, read_entries(work, first.pretrain, *edges))
    called = plan.tasks[settings.learning.task].called
    vehicles = {name: count if called is None else min(called, count) for name, count in settings.vehicles.items()}
    book = open_region_book(work, share, first.pretrain, vehicles, first.region)
    before = first.edge or first.errors  # the ledger of stage II includes that of the errors
    return book if before is None else Ledger(book.budget, read_entries(work, before))


def _plan_private(settings: EdgeSettings, plan: Plan) -> PrivateRounds[Federation]:
    """Return the rounds of stage II and of what follows that the privacy budget affords."""
    own, k = plan.tasks[settings.learning.task], settings.federation.edge_rounds_per_cloud_round
    further = 0 if settings.last else own.cloud_rounds * k
    return plan_private_rounds(settings.federation, settings.vehicles.values(), own.edge_rounds, further, k)


def _find_noise(work: Work, settings: StageSettings, plan: Plan) -> float | None:
    """Return the noise that the privacy budget gives for the planned rounds; None where it is given, or none is."""
    if settings.first.edge is not None:
        return StageResult.load(work.inputs[settings.first.edge]).noise
    assert isinstance(settings, EdgeSettings)  # stage III goes on from stage II
    return find_budget_noise(settings.federation, _plan_private(settings, plan).rules)


def _count_rounds(settings: StageSettings, plan: Plan, conduct: Conduct, before: Sequence[StageResult]) -> int:
    """Return the planned rounds of the stage, as many as privacy affords; none after a stage II that diverged."""
    own = plan.tasks[settings.learning.task]
    if any(each.kept is not None for each in before):
        return 0
    if isinstance(settings, CloudSettings):
        return own.cloud_rounds
    if settings.stage == MORE_EDGE:
        return own.cloud_rounds * settings.federation.edge_rounds_per_cloud_round
    return 0 if conduct.vacant else _plan_private(settings, plan).edge


def _open_federation(
    work: Work,
    settings: StageSettings,
    samples: Mapping[str, Mapping[str, Sequence[Any]]],
    plan: Plan,
    book: Ledger,
    conduct: Conduct,
) -> StageFederation:
    """Return the federation, after sending vehicles what they lack: frames, the network, labels that are made once."""
    first, how, cloud = settings.first, settings.federation, isinstance(settings, CloudSettings)
    learning, strategies = choose_loss(work, settings, first.pretrain), Strategies(*find_strategies(how))
    began = first.pretrain if cloud else first.edge or first.pretrain
    network = load_stage_network(learning.task, work.inputs[began])
    before = {
        name: StageResult.load(work.inputs[own.edge]) for name, own in settings.regions.items() if own.edge is not None
    }
    rounds, starts = _count_rounds(settings, plan, conduct, [*before.values()]), dict[str, RegionStart]()
    for region, inputs in settings.regions.items():
        clients = make_clients(learning, network.config, samples[region])
        weights = to_arrays(load_stage_network(learning.task, work.inputs[inputs.edge or inputs.pretrain]))
        earlier, own = before[region].rounds if region in before else 0, samples[region]
        if inputs.edge is not None and rounds and isinstance(own, RenewedSamples):
            own.renew(1, weights)
        starts[region] = RegionStart(clients, weights, earlier, how.edge_rounds_per_cloud_round if cloud else 1)
    for count in load_all(COUNTS):
        rounds, starts = count(strategies.edge, rounds, starts, cloud)
    names = (CLOUD, "") if cloud else (settings.stage, first.region)
    earlier = max(each.earlier for each in starts.values())
    restart = how.cloud_rate if cloud else None
    start_share = 0.0 if earlier else learning.training.start_share
    relabel = samples[first.region] if settings.stage == EDGE else None
    losses = [loss for each in before.values() for loss in each.losses[:1] if loss is not None]
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
    """Return the samples that vehicles answer on, after sending them these, or their region's network of stage II."""
    first, (strategy, _) = settings.first, find_strategies(settings.federation)
    assert isinstance(strategy, FedMD)
    shown = share_frames(work, learning, network.config, strategy, first.pools, first.pretrain)
    for region, at in starts.items():
        if settings.regions[region].edge is not None:  # they have the frames, and go on from the region's network
            send_region_network(book, learning.task, at.weights, at.clients, _name_messages(settings))
        else:
            shown.send(book, network, region, [*at.clients])
    return shown.samples


def _open_cloud(work: Work, settings: CloudSettings, learning: Learning, config: Any) -> CloudServer:
    """Return what the cloud does besides averaging: it may train on the samples that it was sent in stage I."""
    how, replay = settings.federation, None
    if how.replay:
        samples = load_uploads(work, learning, config, settings.first.pretrain, settings.pools)
        replay = TaskClient(learning.task, config, samples, batch=learning.batch)
    return CloudServer(bool(settings.validation), replay, how.replay, how.cloud_topics)


def _score_statistics(work: Work, settings: StageSettings, learning: Learning) -> tuple[StatisticsScore, ...] | None:
    """Return the scores by each region's statistics of batch normalisation; None where they are not asked for."""
    if not settings.validation:
        return None
    frames = {name: Frames.open(work.inputs[step]) for name, step in settings.validation.items()}
    return score_statistics(learning.task, load_stage_network(learning.task, work.folder), work.folder, frames)


def _drive(work: Work, settings: StageSettings, federation: StageFederation, plan: TaskPlan) -> DrivenStage:
    """Return what the radio network makes of the rounds of a plan."""
    own, how, cloud = federation, settings.federation, federation.cloud is not None
    ways_s = None
    if cloud and how.network is not None:
        ways_s = 2 * how.network.wireline.seconds(update_bytes(to_arrays(own.network)))
    for drive in load_all(DRIVES):
        if (found := drive(work, settings, own, ways_s)) is not None:
            return found
    numbers, driven = range(1, own.schedule.rounds + 1), {}
    for region, at in own.regions.items():
        if cloud:
            seeds = [seed for each in numbers for seed in edge_seeds(own.schedule, each, region, at.edge_rounds)]
        else:
            seeds = [own.schedule.work(number).seed for number in numbers]
        rules = follow_plan(how, plan, after_edge=cloud or bool(at.earlier))
        vehicles = {name: client for name, client in at.clients.items() if name not in own.conduct.within}
        about = (own.learning, settings.regions[region], replace(at, clients=vehicles))
        driven[region] = drive_region(work, settings, *about, rules, seeds)
    return join_regions(driven, how.edge_rounds_per_cloud_round, ways_s)


def list_edge_steps(outline: Outline, arm: Setting, task: str) -> Iterator[Step]:
    """Yield stage II of an arm for a task, in each of its regions."""
    scored = outline.tracks(task) or bool(outline.averaging(task))
    asks = find_calls(outline.recipe, arm.federation) is not None
    for region in arm.regions:
        name, inputs = outline.names.edge(arm.name, region, task), outline.inputs(arm, region, task, EDGE)
        shown = outline.names.recording(region, "validation", task) if asks else ""
        about = dict(outline.federation(arm, task, EDGE))
        settings = EdgeSettings(**about, inputs=inputs, shown=shown, scored=scored, last=arm.stages[-1] == EDGE)
        yield make_step(name, federate_step, settings, outline.vehicles[region])


def list_more_edge_steps(outline: Outline, arm: Setting, task: str) -> Iterator[Step]:
    """Yield the further edge rounds of an arm for a task, in each of its regions."""
    for region in arm.regions:
        name, inputs = outline.names.more_edge(arm.name, region, task), outline.inputs(arm, region, task, MORE_EDGE)
        settings = EdgeSettings(**dict(outline.federation(arm, task, MORE_EDGE)), inputs=inputs)
        yield make_step(name, federate_step, settings, outline.vehicles[region])


def make_cloud_step(outline: Outline, arm: Setting, task: str) -> Step:
    """Return stage III of an arm for a task."""
    names = outline.names
    scored = arm.regions if arm.federation.score_statistics else ()
    settings = CloudSettings(
        **dict(outline.federation(arm, task, CLOUD)),
        regions={region: outline.inputs(arm, region, task, CLOUD) for region in arm.regions},
        pools=outline.pools(task) if arm.federation.replay else {},
        validation={region: names.recording(region, "validation", task) for region in scored},
    )
    at_once = max(outline.vehicles[region] for region in arm.regions)  # of one edge server
    return make_step(names.cloud(arm.name, task), federate_step, settings, at_once)
