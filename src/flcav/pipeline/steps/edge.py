"""The step of stage II of a task in a region, and of its further edge rounds."""

from collections.abc import Mapping
from dataclasses import replace
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
from flcav.pipeline.planning.updates import follow_plan
from flcav.pipeline.recipe import EDGE, MORE_EDGE, Federation
from flcav.pipeline.results.plans import Plan, TaskPlan
from flcav.pipeline.results.training import StageResult
from flcav.pipeline.stages.clients import make_clients
from flcav.pipeline.stages.edge import EdgeFederation, federate_edge
from flcav.pipeline.steps.budgets import open_region_book, read_entries, share_plan_budget
from flcav.pipeline.steps.driving import drive_region
from flcav.pipeline.steps.labelling import LabelledSamples, label_samples, learn_by_distillation, score_labels
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
        return (*self.inputs.needs, *self.validation.values())

    @property
    def stage(self) -> str:
        """Return EDGE or MORE_EDGE."""
        return EDGE if self.inputs.edge is None else MORE_EDGE


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
    own, k = plan.tasks[settings.learning.task], settings.federation.edge_rounds_per_cloud_round
    rounds = _plan_private(settings, plan).edge if stage == EDGE else own.cloud_rounds * k
    federation = _open_federation(work, settings, labelled, rounds, book)
    driven = _drive(work, settings, federation, own, rounds)
    where: Any = {"processes": processes, "runtime": runtime, "timed": bool(timed)}
    losses = federate_edge(federation, driven.rules, driven.outages, **where)
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
    names = (settings.stage, inputs.region)
    schedule = learning.schedule(rounds, learning.training.local_steps, *names, earlier=earlier)
    strategy, _ = find_strategies(settings.federation)
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


def _drive(work: Work, settings: EdgeSettings, federation: EdgeFederation, plan: TaskPlan, rounds: int) -> DrivenRounds:
    """Return what the radio network makes of the rounds of a plan."""
    own, inputs = federation, settings.inputs
    seeds = [own.schedule.work(number).seed for number in range(1, rounds + 1)]
    rules = follow_plan(settings.federation, plan, after_edge=bool(own.earlier))
    return drive_region(work, settings, own.learning, inputs, [*own.clients], own.earlier, rules, seeds)
