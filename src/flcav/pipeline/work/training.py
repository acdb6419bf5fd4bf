"""Steps of the three stages of training, and of centralised training in place of stage II."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flcav.config import InputError
from flcav.federation.runtimes.embedded import update_bytes
from flcav.federation.stages import edge_seeds
from flcav.federation.strategies.fedmd import FedMD
from flcav.network.ledger import Ledger
from flcav.perception.distillation import SharedSamples
from flcav.perception.tasks import task_named
from flcav.perception.weights import save_network, to_arrays
from flcav.pipeline.arms import find_strategies
from flcav.pipeline.federations.distillation import RoadAverageLabels
from flcav.pipeline.federations.network import DrivenCloud, DrivenRounds, join_regions, open_network
from flcav.pipeline.federations.outputs import send_region_network, share_frames
from flcav.pipeline.federations.records import read_rounds
from flcav.pipeline.federations.replanning import Replanning, mean_by_frames
from flcav.pipeline.frames import Frames
from flcav.pipeline.labels import (
    LABEL_SOURCES,
    annotated_samples,
    fit_label_threshold,
    pseudo_label_samples,
    select_frames_near,
)
from flcav.pipeline.placing import find_sites
from flcav.pipeline.planning import follow_plan
from flcav.pipeline.recipe import CENTRAL, CLOUD, EDGE, MORE_EDGE, Federation, Role, Training
from flcav.pipeline.results import LEDGER, WEIGHTS, Placed, Plan, Pretrained, StageResult, TaskPlan
from flcav.pipeline.stages import (
    Learning,
    RegionStart,
    Strategies,
    choose_planned_uploads,
    choose_uploads,
    federate_cloud,
    federate_edge,
    load_stage_network,
    make_clients,
    pretrain,
    train_centrally,
    upload_samples,
)
from flcav.pipeline.steps import Work
from flcav.pipeline.work import Fields
from flcav.pipeline.work.budgets import open_region_book, read_entries, share_plan_budget
from flcav.pipeline.work.distilling import label_by_average, learn_by_distillation, score_labels
from flcav.pipeline.work.replanning import Rest, RoundPlans
from flcav.pipeline.work.uploads import list_frames


def pretrain_step(
    work: Work,
    task: str,
    network: str | None,
    training: Fields,
    seed: int,
    upload_seed: int,
    budget_mb: tuple[float, float],
    plan: str,
    pools: Mapping[str, str],
    validation: Sequence[str],
    thresholded: bool,
) -> None:
    """Run stage I of a task: upload the planned samples, train on them, fix the score threshold of pseudo-labels."""
    learning = Learning(task_named(task), network, Training.model_validate(training), seed)
    own = Plan.load(work.inputs[plan])
    opened = {region: Frames.open(work.inputs[step]) for region, step in pools.items()}
    watched = [Frames.open(work.inputs[step]) for step in validation]
    config = learning.config
    uploads = own.tasks[task].uploads
    if uploads is None:
        pools_of = {region: split.vehicles for region, split in opened.items()}
        chosen = choose_uploads(pools_of, own.tasks[task].samples, upload_seed)
    else:
        held = {region: dict(list_frames(region, split)) for region, split in opened.items()}
        chosen = choose_planned_uploads(held, uploads, upload_seed)
    book = Ledger(share_plan_budget(own, budget_mb, task))
    samples: list[Any] = []
    for region, frames in chosen.items():
        if frames:
            samples += _each(upload_samples(book, learning.task, config, region, opened[region], frames))
    book.save(work.folder / LEDGER)
    validated = pretrain(learning, samples, watched, work.folder, work.report)
    trained = load_stage_network(learning.task, work.folder)
    Pretrained(
        task=task,
        network=network or next(iter(learning.task.configurations)),
        uploaded=chosen,
        validated=validated,
        steps=learning.training.steps,
        threshold=fit_label_threshold(trained, watched) if thresholded else None,
    ).save(work.folder)


def edge_step(
    work: Work,
    task: str,
    network: str | None,
    training: Fields,
    seed: int,
    budget_mb: tuple[float, float],
    region: str,
    vehicles: Mapping[str, int],
    labels: str,
    federation: Fields,
    steps: Mapping[str, Any],
    train_s: float = 0.0,
    speeds: Mapping[str, float] = {},
    validation: Mapping[str, str] = {},
    processes: int = 1,
    runtime: str = "embedded",
    replan: Fields | None = None,
    distillation: Fields | None = None,
    scored: bool = False,
) -> None:
    """Run stage II of a task in a region; `steps`: what its samples depend on, see `_label_samples`.

    With a step "edge" it goes on from that stage II, for as many rounds as the region has in stage III. On a network,
    a vehicle trains `train_s` / speed in a round [s]. Each round is scored on the frames of the steps `validation`, by
    region. Vehicles train in so many `processes` of a `runtime`. `replan`: `RoundPlans`; None: the plan is not made
    anew after each round. `distillation`: settings of the labels "road-average". `scored`: the labels are compared with
    ground truth.
    """
    if distillation is not None and (processes > 1 or runtime != "embedded"):
        raise InputError("labels 'road-average' are renewed between rounds: vehicles train in one process, --jobs 1")
    learning = Learning(task_named(task), network, Training.model_validate(training), seed)
    plan, how = Plan.load(work.inputs[steps["plan"]]), Federation.model_validate(federation)
    own, k = plan.tasks[task], how.edge_rounds_per_cloud_round
    book = open_region_book(work, task, region, steps["plan"], steps["pretrain"], vehicles, budget_mb)
    if "errors" in steps:
        book = Ledger(book.budget, read_entries(work, steps["errors"]))
    if "edge" in steps:
        stage, rounds = MORE_EDGE, own.cloud_rounds * k
        book = Ledger(book.budget, read_entries(work, steps["edge"]))
    else:
        stage, rounds = EDGE, own.edge_rounds
    before = len(book.entries)
    samples, poles = _label_samples(work, learning, region, labels, steps, book, EDGE, distillation)
    start = load_stage_network(learning.task, work.inputs[steps.get("edge", steps["pretrain"])])
    if stage == MORE_EDGE and rounds and isinstance(samples, RoadAverageLabels):
        samples.renew(1, to_arrays(start))
    if distillation is not None:
        learning = learn_by_distillation(learning, distillation)
    rest = None if replan is None else Rest(work, plan, task, k, budget_mb, RoundPlans.model_validate(replan), book)
    course = rest.open_edge(region, steps["pretrain"]) if rest is not None and stage == EDGE else None
    if rest is not None and stage == MORE_EDGE:
        rounds = rest.count_further(region, steps["pretrain"])
    clients = make_clients(learning, start.config, samples)
    earlier = StageResult.load(work.inputs[steps["edge"]]).rounds if "edge" in steps else 0
    schedule = learning.schedule(rounds, learning.training.local_steps, stage, region, earlier=earlier)
    strategy, _ = find_strategies(how)
    shared = None
    if isinstance(strategy, FedMD):
        shared = _share_with_vehicles(work, learning, start, strategy, steps, book, region, [*clients])
    simulate = open_network(work, learning, how, region, [*clients], steps, earlier, train_s, speeds)

    def drive(by: TaskPlan, rounds: int) -> DrivenRounds:
        seeds = [schedule.work(number).seed for number in range(1, rounds + 1)]
        return simulate(follow_plan(how, by, earlier), seeds)

    asked = (learning, start, clients, schedule, strategy)
    frames = validation if rest is None or course is None else {**rest.how.frames, **validation}
    watched = {name: Frames.open(work.inputs[step]) for name, step in frames.items()}
    about: Any = {"shared": shared}
    if isinstance(samples, RoadAverageLabels) and stage == EDGE:
        about["before_round"] = samples.renew
    if course is None:
        driven = drive(own, rounds)
        where: Any = (book, work.folder, work.report, driven.outages, watched, processes, runtime)
        losses = federate_edge(*asked, driven.rules, earlier, *where, **about)
    else:
        replanning = Replanning(course, drive, lambda scores: scores[region])
        where = (book, work.folder, work.report, {}, watched, processes, runtime, replanning)
        losses = federate_edge(*asked, how, earlier, *where, **about)
        driven = drive(course.plan, len(losses))
    held = sum(len(client.samples) for client in clients.values())
    records = read_rounds(work.folder, region, before, {region: driven.seconds})
    made, quality = None if course is None else tuple(course.made), None
    if scored and stage == EDGE:
        group = _select_group(work, Frames.open(work.inputs[steps["frames"]]), steps)
        quality = score_labels(work, region, steps, group, start.config, samples)
    StageResult(
        stage, task, region, len(losses), held, len(clients), poles, losses, records, plans=made, labels=quality
    ).save(work.folder)


def cloud_step(
    work: Work,
    task: str,
    network: str | None,
    training: Fields,
    seed: int,
    budget_mb: tuple[float, float],
    labels: str,
    federation: Fields,
    regions: Mapping[str, Mapping[str, Any]],
    train_s: float = 0.0,
    speeds: Mapping[str, float] = {},
    replan: Fields | None = None,
    distillation: Fields | None = None,
) -> None:
    """Run stage III of a task: the edge servers of `regions` federate with the cloud, vehicles with edge servers.

    `replan` is as in `edge_step`, with the validation `frames` of every region.
    """
    learning = Learning(task_named(task), network, Training.model_validate(training), seed)
    first = next(iter(regions.values()))
    own, how = Plan.load(work.inputs[first["plan"]]), Federation.model_validate(federation)
    start = load_stage_network(learning.task, work.inputs[first["pretrain"]])
    book = Ledger(
        share_plan_budget(own, budget_mb, task),
        read_entries(work, first["pretrain"], *(s["edge"] for s in regions.values())),
    )
    if distillation is not None:
        learning = learn_by_distillation(learning, distillation)
    rounds, k = own.tasks[task].cloud_rounds, how.edge_rounds_per_cloud_round
    servers, held, count, helped, before = {}, 0, 0, [], len(book.entries)
    for region, steps in regions.items():
        samples, poles = _label_samples(work, learning, region, labels, steps, book, CLOUD, distillation)
        clients = make_clients(learning, start.config, samples)
        weights = to_arrays(load_stage_network(learning.task, work.inputs[steps["edge"]]))
        if rounds and isinstance(samples, RoadAverageLabels):
            samples.renew(1, weights)
        servers[region] = RegionStart(clients, weights, StageResult.load(work.inputs[steps["edge"]]).rounds)
        held += sum(len(client.samples) for client in clients.values())
        count, helped = count + len(clients), [*helped, *poles]
    federating = Strategies(*find_strategies(how))
    shared = None
    if isinstance(federating.edge, FedMD):
        shown = share_frames(work, learning, start.config, federating.edge, first["pools"], first["pretrain"])
        shared = shown.samples
        for at in servers.values():
            send_region_network(book, learning.task, at.weights, at.clients, CLOUD)
    schedule = learning.schedule(rounds, learning.training.local_steps, CLOUD, "")
    networks = {
        name: open_network(work, learning, how, name, [*at.clients], regions[name], at.earlier, train_s, speeds)
        for name, at in servers.items()
    }

    def drive(by: TaskPlan, rounds: int) -> DrivenCloud:
        rules, numbers = follow_plan(how, by, by.edge_rounds), range(1, rounds + 1)
        seeds = {name: [seed for n in numbers for seed in edge_seeds(schedule, n, name, k)] for name in servers}
        driven = {name: network(rules, seeds[name]) for name, network in networks.items()}
        return join_regions(driven, k, how.network, update_bytes(to_arrays(start)))

    if replan is not None:
        rest = Rest(work, own, task, k, budget_mb, RoundPlans.model_validate(replan), book)
        course = rest.open_cloud(regions)
        watched = {name: Frames.open(work.inputs[step]) for name, step in rest.how.frames.items()}
        replanning = Replanning(course, drive, lambda scores: mean_by_frames(scores, watched))
        asked = (learning, start, servers, rounds, k, federating, how)
        losses = federate_cloud(*asked, book, work.folder, work.report, {}, watched, replanning, shared)
        driven, made = drive(course.plan, len(losses)), tuple(course.made)
    else:
        driven, made = drive(own.tasks[task], rounds), None
        asked = (learning, start, servers, rounds, k, federating, driven.rules)
        losses = federate_cloud(*asked, book, work.folder, work.report, driven.outages, shared=shared)
    records = read_rounds(work.folder, None, before, driven.seconds)
    StageResult(CLOUD, task, None, len(losses), held, count, tuple(helped), losses, records, plans=made).save(
        work.folder
    )


def central_step(
    work: Work,
    task: str,
    network: str | None,
    training: Fields,
    seed: int,
    region: str,
    vehicles: int,
    source: Role,
    steps: Mapping[str, Any],
    follows: str | None = None,
) -> None:
    """Continue training centrally on ground truth, for as many optimiser steps as stage II takes in the region.

    `follows` is the step of that stage II where its number of rounds was planned anew.
    `source` "pretrain": on the uploaded samples. "federate": on the training frames of the region's vehicles.
    """
    learning = Learning(task_named(task), network, Training.model_validate(training), seed)
    trained = load_stage_network(learning.task, work.inputs[steps["pretrain"]])
    if source == "pretrain":
        uploaded = Pretrained.load(work.inputs[steps["pretrain"]]).uploaded
        parts = [(Frames.open(work.inputs[steps["pools"][name]]), frames) for name, frames in uploaded.items()]
    else:
        split = Frames.open(work.inputs[steps["frames"]])
        parts = [(split, _select_group(work, split, steps))]
    samples = [
        sample for split, frames in parts for sample in _each(learning.task.samples(split.data, trained.config, frames))
    ]
    if follows is None:
        rounds = Plan.load(work.inputs[steps["plan"]]).tasks[task].edge_rounds
    else:
        rounds = StageResult.load(work.inputs[follows]).rounds
    losses = train_centrally(learning, trained, samples, rounds, vehicles, source)
    save_network(learning.task, trained, work.folder / WEIGHTS)
    StageResult(CENTRAL, task, region, rounds, len(samples), 1, (), losses).save(work.folder)


def _share_with_vehicles(
    work: Work,
    learning: Learning,
    start: Any,
    strategy: FedMD,
    steps: Mapping[str, Any],
    book: Ledger,
    region: str,
    vehicles: Sequence[str],
) -> SharedSamples:
    """Return the samples that a region's vehicles answer on, after sending what they lack: frames, and the network."""
    shown = share_frames(work, learning, start.config, strategy, steps["pools"], steps["pretrain"])
    if "edge" in steps:  # they have the frames, and go on from the region's network
        send_region_network(book, learning.task, to_arrays(start), vehicles, EDGE)
    else:
        shown.send(book, start, region, vehicles)
    return shown.samples


def _label_samples(
    work: Work,
    learning: Learning,
    region: str,
    labels: str,
    steps: Mapping[str, Any],
    book: Ledger,
    stage: str,
    distillation: Fields | None,
) -> tuple[Mapping[str, Sequence[Any]], tuple[int, ...]]:
    """Return each vehicle's labelled samples, and the poles that contributed labels.

    `steps`: "pretrain", the recorded "frames", the arm's "place", and "sites", the placements of all arms; after stage
    II "edge". Messages enter `book`, under `stage`. `distillation`: settings of the labels "road-average".
    """
    split, kind = Frames.open(work.inputs[steps["frames"]]), LABEL_SOURCES[labels]
    frames = _select_group(work, split, steps)
    if not kind.from_detections:
        config = load_stage_network(learning.task, work.inputs[steps["pretrain"]]).config
        return annotated_samples(learning.task, config, split, frames, region), ()
    poles = Placed.load(work.inputs[steps["place"]]).chosen if kind.from_poles else ()
    if distillation is not None:
        return label_by_average(work, learning, region, steps, frames, poles, distillation, book, stage), poles
    frozen = load_stage_network(learning.task, work.inputs[steps["pretrain"]])
    threshold = Pretrained.load(work.inputs[steps["pretrain"]]).threshold
    assert threshold is not None  # fixed wherever labels come from detections
    first = None if "edge" in steps else book  # later labels are those of stage II
    samples = pseudo_label_samples(frozen, threshold, split, frames, poles, region, work.report, first, kind.trained)
    return samples, poles


def _select_group(work: Work, split: Frames, steps: Mapping[str, Any]) -> tuple[int, ...]:
    """Return the vehicles' frames near a roadside sensor of any arm, so that all arms have the same frames.

    Raises `InputError` where there are none.
    """
    placed = [Placed.load(work.inputs[step]) for step in steps["sites"]]
    numbers = {pole for each in placed for pole in each.chosen}
    if not numbers:
        return split.vehicles
    sites = find_sites(split, split if steps["recorded"] else None)
    near = select_frames_near(split, sites.position[np.isin(sites.number, list(numbers)), :2], steps["group_range_m"])
    if not near:
        raise InputError(
            f"{split.data.folder.parent.name}: no vehicle comes within {steps['group_range_m']:g} m "
            f"(placement.group_range_m) of a sensor, so that none can take part"
        )
    return near


def _each(samples: Sequence[Any]) -> list[Any]:
    """Load all samples into memory: each is drawn many times."""
    return [samples[number] for number in range(len(samples))]
