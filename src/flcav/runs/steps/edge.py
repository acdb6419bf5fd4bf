"""Stage II of a task in a region, and its further edge rounds: the vehicles federate with their edge server."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from flcav.federation.runtimes.link import open_fleet, open_questions
from flcav.federation.runtimes.metered import Account
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.network.ledger import Ledger
from flcav.perception.distillation import SharedSamples
from flcav.perception.weights import to_arrays
from flcav.runs.arms import Setting, find_strategies
from flcav.runs.engine import Step, Work
from flcav.runs.frames import Frames
from flcav.runs.labels.road_average import RoadAverageLabels
from flcav.runs.plan.updates import follow_plan
from flcav.runs.radio.buffered import drive_buffers
from flcav.runs.radio.driving import DrivenRounds
from flcav.runs.recipe import EDGE, MORE_EDGE, Federation
from flcav.runs.results.plans import Plan, TaskPlan
from flcav.runs.results.training import StageResult
from flcav.runs.steps.groups import call_group
from flcav.runs.steps.memory import Memory, remember
from flcav.runs.steps.outline import Outline
from flcav.runs.steps.regions import (
    LabelledSamples,
    choose_loss,
    drive_region,
    label_samples,
    open_buffered_fleet,
    save_clock,
    score_labels,
)
from flcav.runs.steps.settings import (
    FederationSettings,
    RegionInputs,
    make_step,
    open_region_book,
    read_entries,
    share_plan_budget,
)
from flcav.runs.training.edge_rounds import EdgeFederation, federate_edge
from flcav.runs.training.leads import follow_leads
from flcav.runs.training.learning import load_stage_network, make_clients
from flcav.runs.training.messages import send_region_network, share_frames
from flcav.runs.training.private_rounds import PrivateRounds, find_budget_noise, plan_private_rounds, take_noise
from flcav.runs.training.records import read_rounds


class EdgeSettings(FederationSettings):
    """Settings of stage II in a region; with a stage II to go on from (`inputs.edge`) of its further edge rounds."""

    inputs: RegionInputs
    validation: Mapping[str, str] = {}  # recordings of the frames that each round is scored on, by region
    shown: str = ""  # recording of the region's validation frames, on which a group's score is told; "": it is not
    scored: bool = False  # whether the labels are compared with ground truth
    last: bool = False  # whether the arm ends with it
    memory: Memory | None = None  # that its vehicles replay, of conditions that they were in before

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        remembered = () if self.memory is None else self.memory.needs
        return (*self.inputs.needs, *self.validation.values(), *((self.shown,) if self.shown else ()), *remembered)

    @property
    def stage(self) -> str:
        """Return EDGE or MORE_EDGE."""
        return EDGE if self.inputs.edge is None else MORE_EDGE


def edge_step(
    work: Work,
    settings: EdgeSettings,
    processes: int = 1,
    runtime: str = "embedded",
    timed: int = 0,
    fleet: str = "",
) -> None:
    """Run stage II of a task in a region, or its further edge rounds: as many as the region has in stage III.

    Vehicles train in so many `processes` of a `runtime`; other than 0, `timed` keeps their times.
    """
    inputs, plan = settings.inputs, Plan.load(work.inputs[settings.inputs.plan])
    book = _open_book(work, settings, plan)
    before, labelled = len(book.entries), label_samples(work, settings, inputs, book, EDGE)
    clients = [name for name in labelled.samples if len(labelled.samples[name])]
    where: Any = {"processes": processes, "runtime": runtime, "timed": bool(timed)}
    if runtime != "flower":
        _federate_region(work, settings, plan, book, before, labelled, where)
    else:
        with open_fleet(clients, Path(fleet) if fleet else None, settings.vehicles) as deployed:
            _federate_region(work, settings, plan, book, before, labelled, {**where, "deployed": deployed})


def _federate_region(
    work: Work,
    settings: EdgeSettings,
    plan: Plan,
    book: Ledger,
    before: int,
    labelled: LabelledSamples,
    where: Mapping[str, Any],
) -> None:
    """Run the rounds of a region's vehicles, by arguments of `federate_edge`; save weights and result.

    before: number of entries in `book` of what was sent earlier.
    """
    inputs, stage, called, whole = settings.inputs, settings.stage, None, labelled.samples
    deployed = where.get("deployed")
    if stage == EDGE and settings.federation.requests is not None:
        most = plan.tasks[settings.learning.task].called
        called = call_group(
            work, settings, inputs, settings.federation.requests, whole, book, most, labelled.poles, deployed
        )
        labelled = replace(labelled, samples=called.samples)
    if settings.memory is not None:
        replayed = remember(work, settings, settings.memory, inputs.region, labelled.samples)
        labelled = replace(labelled, samples=replayed)
    if stage == MORE_EDGE and isinstance(labelled.samples, RoadAverageLabels):
        _label_once(work, settings, plan, labelled.samples)
    noise = _find_noise(work, settings, plan)
    settings = settings.model_copy(update={"federation": take_noise(settings.federation, noise)})
    own, k = plan.tasks[settings.learning.task], settings.federation.edge_rounds_per_cloud_round
    rounds = _plan_private(settings, plan).edge if stage == EDGE else own.cloud_rounds * k
    if called is not None and not called.samples:
        rounds = 0
    federation = _open_federation(work, settings, labelled, rounds, book)
    if called is not None:
        federation = replace(federation, watch=called.watch, roadside=frozenset(called.group.roadside))
    driven = _drive(work, settings, federation, own)
    if called is not None and called.group.lead in called.vehicles:  # ad hoc
        terms = follow_leads(called.vehicles, called.group.lead, driven.records, inputs.region)
        federation, called = replace(federation, terms=terms), replace(called, terms=terms)
    losses = federate_edge(federation, driven.rules, driven.outages, buffers=driven.buffers, **where)
    clients, labels = federation.clients, None
    group = None
    if called is not None:
        shown = Frames.open(work.inputs[settings.shown]) if settings.shown else None
        account = Account(book, EDGE, settings.learning.task, "wireless")
        with open_questions(called.watch.members, deployed, account) as ask:
            group = called.dissolve(work.folder, work.inputs[inputs.pretrain], shown, rounds, ask)
    if settings.scored and stage == EDGE and clients:
        labels = score_labels(work, inputs, federation.network.config, whole)
    StageResult(
        stage=stage,
        task=settings.learning.task,
        region=inputs.region,
        rounds=len(losses),
        samples=sum(len(client.samples) for client in clients.values()),
        clients=len(clients),
        poles=labelled.poles,
        losses=losses,
        records=read_rounds(work.folder, inputs.region, before, {inputs.region: driven.seconds}),
        labels=labels,
        noise=noise,
        group=group,
    ).save(work.folder)


def _open_book(work: Work, settings: EdgeSettings, plan: Plan) -> Ledger:
    """Return the ledger of the region, with what it sent before; its share is by the vehicles that a plan calls."""
    inputs, share = settings.inputs, share_plan_budget(plan, settings.budgets_mb, settings.learning.task)
    called = plan.tasks[settings.learning.task].called
    vehicles = {name: count if called is None else min(called, count) for name, count in settings.vehicles.items()}
    book = open_region_book(work, share, inputs.pretrain, vehicles, inputs.region)
    before = inputs.edge or inputs.errors  # the ledger of stage II includes that of the errors
    return book if before is None else Ledger(book.budget, read_entries(work, before))


def _label_once(work: Work, settings: EdgeSettings, plan: Plan, samples: RoadAverageLabels) -> None:
    """Label the samples of further edge rounds by what the network of stage II detects, where there are any rounds."""
    inputs = settings.inputs
    if inputs.edge is not None and plan.tasks[settings.learning.task].cloud_rounds:
        trained = load_stage_network(settings.learning.resolve().task, work.inputs[inputs.edge])
        samples.renew(1, to_arrays(trained))


def _plan_private(settings: EdgeSettings, plan: Plan) -> PrivateRounds[Federation]:
    """Return the rounds of stage II and of what follows that the privacy budget affords."""
    own, k = plan.tasks[settings.learning.task], settings.federation.edge_rounds_per_cloud_round
    further = 0 if settings.last else own.cloud_rounds * k
    return plan_private_rounds(settings.federation, settings.vehicles.values(), own.edge_rounds, further, k)


def _find_noise(work: Work, settings: EdgeSettings, plan: Plan) -> float | None:
    """Return the noise that the privacy budget gives for the planned rounds; None where it is given, or none is."""
    if settings.inputs.edge is not None:
        return StageResult.load(work.inputs[settings.inputs.edge]).noise
    return find_budget_noise(settings.federation, _plan_private(settings, plan).rules)


def _open_federation(
    work: Work, settings: EdgeSettings, labelled: LabelledSamples, rounds: int, book: Ledger
) -> EdgeFederation:
    """Return the federation of the region's vehicles, after sending them what they lack."""
    inputs, samples = settings.inputs, labelled.samples
    learning = choose_loss(work, settings, inputs.pretrain)
    start = load_stage_network(learning.task, work.inputs[inputs.edge or inputs.pretrain])
    clients = make_clients(learning, start.config, samples)
    earlier = 0 if inputs.edge is None else StageResult.load(work.inputs[inputs.edge]).rounds
    names, (strategy, _) = (settings.stage, inputs.region), find_strategies(settings.federation)
    if isinstance(strategy, FedBuff):
        strategy.check_buffer(len(clients))
        rounds = strategy.count_rounds(rounds, len(clients))
    schedule = learning.schedule(rounds, learning.training.local_steps, *names, earlier=earlier)
    watched = {name: Frames.open(work.inputs[step]) for name, step in settings.validation.items()}
    federation = EdgeFederation(
        learning=learning,
        network=start,
        clients=clients,
        schedule=schedule,
        strategy=strategy,
        earlier=earlier,
        book=book,
        folder=work.folder,
        report=work.report,
        validation=watched,
    )
    if isinstance(strategy, FedMD):
        return replace(federation, shared=_share_with_vehicles(work, settings, federation, strategy))
    if isinstance(samples, RoadAverageLabels) and settings.stage == EDGE:
        return replace(federation, relabel=samples.renew)
    return federation


def _share_with_vehicles(
    work: Work, settings: EdgeSettings, federation: EdgeFederation, strategy: FedMD
) -> SharedSamples:
    """Return the samples that a region's vehicles answer on, after sending what they lack: frames, and the network."""
    inputs, learning, start = settings.inputs, federation.learning, federation.network
    shown = share_frames(work, learning, start.config, strategy, inputs.pools, inputs.pretrain)
    if inputs.edge is not None:  # they have the frames, and go on from the region's network
        send_region_network(federation.book, learning.task, to_arrays(start), federation.clients, EDGE)
    else:
        shown.send(federation.book, start, inputs.region, [*federation.clients])
    return shown.samples


def _drive(work: Work, settings: EdgeSettings, federation: EdgeFederation, plan: TaskPlan) -> DrivenRounds:
    """Return what the radio network makes of the rounds of a plan."""
    own, inputs, network, rounds = federation, settings.inputs, settings.federation.network, federation.schedule.rounds
    if isinstance(own.strategy, FedBuff) and network is not None:
        fleet = open_buffered_fleet(work, settings, own.learning, inputs, [*own.clients])
        driven = drive_buffers(fleet, own.strategy, network, settings.federation, rounds)
        save_clock(driven, work, inputs.region)
        return driven
    seeds = [own.schedule.work(number).seed for number in range(1, rounds + 1)]
    rules = follow_plan(settings.federation, plan, after_edge=bool(own.earlier))
    vehicles = [name for name in own.clients if name not in own.roadside]
    return drive_region(work, settings, own.learning, inputs, vehicles, own.earlier, rules, seeds)


def list_edge_steps(outline: Outline, arm: Setting, task: str) -> Iterator[Step]:
    """Yield stage II of an arm for a task, in each of its regions."""
    scored = outline.tracks(task) or bool(outline.averaging(task))
    for region in arm.regions:
        name, inputs = outline.names.edge(arm.name, region, task), outline.inputs(arm, region, task, EDGE)
        about = outline.federation(arm, task, EDGE)
        asks = arm.federation.requests is not None
        shown = outline.names.recording(region, "validation", task) if asks else ""
        settings = EdgeSettings(**about, inputs=inputs, shown=shown, scored=scored, last=arm.stages[-1] == EDGE)
        yield make_step(name, edge_step, settings, outline.vehicles[region])


def list_more_edge_steps(outline: Outline, arm: Setting, task: str) -> Iterator[Step]:
    """Yield the further edge rounds of an arm for a task, in each of its regions."""
    for region in arm.regions:
        name, inputs = outline.names.more_edge(arm.name, region, task), outline.inputs(arm, region, task, MORE_EDGE)
        settings = EdgeSettings(**outline.federation(arm, task, MORE_EDGE), inputs=inputs)
        yield make_step(name, edge_step, settings, outline.vehicles[region])
