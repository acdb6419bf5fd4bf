"""The step of stage II of a task in a region, and of its further edge rounds."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from flcav.federation.strategies.fedmd import FedMD
from flcav.network.ledger import Ledger
from flcav.perception.distillation import SharedSamples
from flcav.perception.weights import to_arrays
from flcav.pipeline.arms import find_strategies
from flcav.pipeline.engine import Work
from flcav.pipeline.federations.network import DrivenRounds
from flcav.pipeline.federations.outputs import send_region_network, share_frames
from flcav.pipeline.federations.records import read_rounds
from flcav.pipeline.federations.spent import PrivateRounds, find_budget_noise, plan_private_rounds, take_noise
from flcav.pipeline.frames import Frames
from flcav.pipeline.labels.road_average import RoadAverageLabels
from flcav.pipeline.learning import load_stage_network
from flcav.pipeline.planning.course import Course, Replanning
from flcav.pipeline.planning.updates import follow_plan
from flcav.pipeline.recipe import EDGE, MORE_EDGE, Federation
from flcav.pipeline.results.plans import Plan, TaskPlan
from flcav.pipeline.results.training import StageResult
from flcav.pipeline.stages.clients import make_clients
from flcav.pipeline.stages.edge import EdgeFederation, federate_edge
from flcav.pipeline.steps.budgets import open_region_book, read_entries, share_plan_budget
from flcav.pipeline.steps.driving import open_network
from flcav.pipeline.steps.labelling import LabelledSamples, label_samples, learn_by_distillation, score_labels
from flcav.pipeline.steps.replanning import Rest
from flcav.pipeline.steps.settings import FederationSettings, RegionInputs


class EdgeSettings(FederationSettings):
    """Settings of stage II in a region; with a stage II to go on from (`inputs.edge`) of its further edge rounds."""

    inputs: RegionInputs
    validation: Mapping[str, str] = {}  # recordings of the frames that each round is scored on, by region
    scored: bool = False  # whether the labels are compared with ground truth
    last: bool = False  # whether the arm ends with it

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        replan = () if self.replan is None else self.replan.needs
        return (*self.inputs.needs, *replan, *self.validation.values())

    @property
    def stage(self) -> str:
        """Return which of both it is."""
        return EDGE if self.inputs.edge is None else MORE_EDGE


@dataclass(frozen=True)
class _Rounds:
    """The rounds that a plan gives a region, and their course where that is planned anew after each."""

    planned: int
    course: Course | None


def edge_step(
    work: Work, settings: EdgeSettings, processes: int = 1, runtime: str = "embedded", timed: int = 0
) -> None:
    """Run stage II of a task in a region, or its further edge rounds: as many as the region has in stage III.

    Vehicles train in so many `processes` of a `runtime`; other than 0, `timed` keeps their times.
    """
    inputs, stage, plan = settings.inputs, settings.stage, Plan.load(work.inputs[settings.inputs.plan])
    book = _open_book(work, settings, plan)
    before, labelled = len(book.entries), label_samples(work, settings, inputs, book, EDGE)
    if stage == MORE_EDGE and isinstance(labelled.samples, RoadAverageLabels):
        _label_once(work, settings, plan, labelled.samples)
    noise = _find_noise(work, settings, plan)
    settings = settings.model_copy(update={"federation": take_noise(settings.federation, noise)})
    rounds = _count_rounds(work, settings, plan, book)
    federation = _open_federation(work, settings, labelled, rounds, book)
    drive = _open_drive(work, settings, federation)
    where: Any = {"processes": processes, "runtime": runtime, "timed": bool(timed)}
    if rounds.course is None:
        driven = drive(plan.tasks[settings.learning.task], rounds.planned)
        losses = federate_edge(federation, driven.rules, driven.outages, **where)
    else:
        replanning = Replanning(rounds.course, drive, lambda scores: scores[inputs.region])
        losses = federate_edge(federation, settings.federation, replanning=replanning, **where)
        driven = drive(rounds.course.plan, len(losses))
    clients, labels = federation.clients, None
    if settings.scored and stage == EDGE:
        labels = score_labels(work, inputs, federation.network.config, labelled.samples)
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
        plans=None if rounds.course is None else tuple(rounds.course.made),
        labels=labels,
        noise=noise,
    ).save(work.folder)


def _open_book(work: Work, settings: EdgeSettings, plan: Plan) -> Ledger:
    """Return the ledger of the region, with what it sent before."""
    inputs, share = settings.inputs, share_plan_budget(plan, settings.budgets_mb, settings.learning.task)
    book = open_region_book(work, share, inputs.pretrain, settings.vehicles, inputs.region)
    before = inputs.edge or inputs.errors  # the ledger of stage II includes that of the errors
    return book if before is None else Ledger(book.budget, read_entries(work, before))


def _label_once(work: Work, settings: EdgeSettings, plan: Plan, samples: RoadAverageLabels) -> None:
    """Label the samples of further edge rounds by what the network of stage II detects, where there are any rounds."""
    inputs = settings.inputs
    if inputs.edge is not None and plan.tasks[settings.learning.task].cloud_rounds:
        trained = load_stage_network(settings.learning.resolve().task, work.inputs[inputs.edge])
        samples.renew(1, to_arrays(trained))


def _count_rounds(work: Work, settings: EdgeSettings, plan: Plan, book: Ledger) -> _Rounds:
    """Return the rounds by the plan; under re-planning their course, or as many as the rounds followed."""
    inputs, own = settings.inputs, plan.tasks[settings.learning.task]
    rest = None if settings.replan is None else Rest(work, settings, settings.replan, plan, book)
    if settings.stage == EDGE:
        course = None if rest is None else rest.open_edge(inputs.region, inputs.pretrain)
        return _Rounds(_plan_private(settings, plan).edge if course is None else own.edge_rounds, course)
    if rest is not None:
        return _Rounds(rest.count_further(inputs.region, inputs.pretrain), None)
    return _Rounds(own.cloud_rounds * settings.federation.edge_rounds_per_cloud_round, None)


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
    work: Work, settings: EdgeSettings, labelled: LabelledSamples, rounds: _Rounds, book: Ledger
) -> EdgeFederation:
    """Return the federation of the region's vehicles, after sending them what they lack."""
    inputs, learning, samples = settings.inputs, settings.learning.resolve(), labelled.samples
    if settings.distillation is not None:
        learning = learn_by_distillation(learning, settings.distillation)
    start = load_stage_network(learning.task, work.inputs[inputs.edge or inputs.pretrain])
    clients = make_clients(learning, start.config, samples)
    earlier = 0 if inputs.edge is None else StageResult.load(work.inputs[inputs.edge]).rounds
    names = (settings.stage, inputs.region)
    schedule = learning.schedule(rounds.planned, learning.training.local_steps, *names, earlier=earlier)
    strategy, _ = find_strategies(settings.federation)
    frames = settings.validation
    if rounds.course is not None and settings.replan is not None:
        frames = {**settings.replan.frames, **frames}
    watched = {name: Frames.open(work.inputs[step]) for name, step in frames.items()}
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
        return replace(federation, before_round=samples.renew)
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


def _open_drive(
    work: Work, settings: EdgeSettings, federation: EdgeFederation
) -> Callable[[TaskPlan, int], DrivenRounds]:
    """Return what simulates so many rounds by a plan over the radio network."""
    own, inputs = federation, settings.inputs
    simulate = open_network(work, settings, own.learning, inputs, [*own.clients], own.earlier)

    def drive(by: TaskPlan, rounds: int) -> DrivenRounds:
        seeds = [own.schedule.work(number).seed for number in range(1, rounds + 1)]
        return simulate(follow_plan(settings.federation, by, after_edge=bool(own.earlier)), seeds)

    return drive
