"""Stage II of a task in a region, and its further edge rounds: the vehicles federate with their edge server."""

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from safetensors.numpy import load_file

from flcav.federation.buffered_rounds import Buffers, afford_buffers
from flcav.federation.leads import Term, federate_led, follow_leads
from flcav.federation.privacy import count_affordable
from flcav.federation.rounds import BeforeRound, OnRound, Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.runtimes.link import Runtime, open_runtime
from flcav.federation.runtimes.metered import Account, Outage
from flcav.federation.runtimes.processes import ClientProcesses
from flcav.federation.state import FederationState
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.interface.progress import Report
from flcav.network.ledger import Ledger
from flcav.perception.client import TaskClient
from flcav.perception.distillation import SharedSamples
from flcav.perception.outcomes import score_network
from flcav.perception.weights import to_arrays
from flcav.pipeline.arms import Setting, find_strategies
from flcav.pipeline.engine import Step, Work
from flcav.pipeline.frames import Frames
from flcav.pipeline.labels.road_average import RoadAverageLabels
from flcav.pipeline.plan.updates import follow_plan
from flcav.pipeline.radio.buffered import drive_buffers
from flcav.pipeline.radio.driving import DrivenRounds
from flcav.pipeline.recipe import EDGE, MORE_EDGE, Federation
from flcav.pipeline.results.plans import Plan, TaskPlan
from flcav.pipeline.results.training import StageResult
from flcav.pipeline.steps.groups import call_group
from flcav.pipeline.steps.memory import Memory, remember
from flcav.pipeline.steps.outline import Outline
from flcav.pipeline.steps.regions import (
    LabelledSamples,
    drive_region,
    label_samples,
    learn_by_distillation,
    open_buffered_fleet,
    save_clock,
    score_labels,
)
from flcav.pipeline.steps.settings import (
    FederationSettings,
    RegionInputs,
    make_step,
    open_region_book,
    read_entries,
    share_plan_budget,
)
from flcav.pipeline.training.checkpoints import FederationCheckpoints, load_round_network, round_path
from flcav.pipeline.training.groups import GroupWatch, Levelled
from flcav.pipeline.training.learning import (
    Learning,
    describe_federation,
    give_outputs,
    load_stage_network,
    make_clients,
)
from flcav.pipeline.training.messages import send_region_network, share_frames
from flcav.pipeline.training.private_rounds import PrivateRounds, find_budget_noise, plan_private_rounds, take_noise
from flcav.pipeline.training.records import read_rounds
from flcav.pipeline.training.timing import time_clients


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
    fleet: Path | None = None,
) -> tuple[float | None, ...]:
    """Run the rounds of stage II of a region; write weights and ledger, return each round's loss.

    A privacy budget may end it before the schedule's end, and of asynchronous rounds, `buffers`, each budget. Vehicles
    train in so many `processes` of a `runtime` of `RUNTIMES`, to the same weights; where that is `timed`, their times
    are kept, see `read_times`, unless nobody is to know who was drawn. The vehicles that `outages` name by round are
    lost in it.
    """
    own, learning, state = federation, federation.learning, FederationState()
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
    if own.watch is not None:
        for number in range(1, done + 1):
            own.watch.note(load_file(round_path(own.folder, number)))
    with (
        checkpoints.refusals(),
        open_runtime(runtime, clients, processes, fleet) as where,
        contextlib.suppress(Levelled),
    ):
        if own.watch is not None and own.watch.over:
            raise Levelled
        if done < own.afford(rules, own.schedule.rounds, buffers):
            account = Account(own.book, EDGE, learning.task.name, "wireless", outages, own.roadside)
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
    if watch is not None:
        watch.note(weights)
        watch.tell(checkpoints.book, number)
    checkpoints.save(number, weights, loss)
    if watch is not None and watch.over:
        raise Levelled


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
    inputs, stage, plan = settings.inputs, settings.stage, Plan.load(work.inputs[settings.inputs.plan])
    book = _open_book(work, settings, plan)
    before, labelled = len(book.entries), label_samples(work, settings, inputs, book, EDGE)
    called, whole = None, labelled.samples
    if stage == EDGE and settings.federation.requests is not None:
        most = plan.tasks[settings.learning.task].called
        called = call_group(
            work, settings, inputs, settings.federation.requests, labelled.samples, book, most, labelled.poles
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
    where: Any = {"processes": processes, "runtime": runtime, "timed": bool(timed)}
    where["fleet"] = Path(fleet) if fleet else None
    losses = federate_edge(federation, driven.rules, driven.outages, buffers=driven.buffers, **where)
    clients, labels = federation.clients, None
    shown = Frames.open(work.inputs[settings.shown]) if settings.shown else None
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
        group=None if called is None else called.dissolve(work.folder, work.inputs[inputs.pretrain], shown, rounds),
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
    inputs, learning, samples = settings.inputs, settings.learning.resolve(), labelled.samples
    if settings.distillation is not None:
        learning = learn_by_distillation(learning, settings.distillation)
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
