"""The step functions of a run: each loads the results of earlier steps, calls its stage's function, saves the result.

Arguments are JSON values, of which a step's fingerprint is made. Other steps are given by name; `Work.inputs` has their
folders.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flcav.config import InputError, read_config
from flcav.federation.runtimes.embedded import update_bytes
from flcav.federation.stages import edge_seeds
from flcav.files import write_json
from flcav.intervals import Estimate
from flcav.network.ledger import BYTES_PER_MB, LINKS, Budget, Ledger, LedgerEntry, Link
from flcav.network.plan import MessageSizes, Price
from flcav.optimization.problem import Problem
from flcav.perception.client import as_shared
from flcav.perception.errors import THRESHOLD, RegistersErrors, load_errors, save_errors
from flcav.perception.outcomes import as_measurable, compute_interval, compute_measure, score_network
from flcav.perception.task import find_configuration
from flcav.perception.tasks import task_named
from flcav.perception.weights import save_network, to_arrays
from flcav.pipeline.arms import PlanRule, find_strategies
from flcav.pipeline.before_after import detect_before_after
from flcav.pipeline.federations.messages import release_network, report_errors
from flcav.pipeline.federations.network import drive_region, join_regions
from flcav.pipeline.federations.records import read_rounds
from flcav.pipeline.federations.rounds import load_round_network
from flcav.pipeline.frames import Frames, deal_frames, hash_manifest, hash_town, record_frames
from flcav.pipeline.labels import (
    LABEL_SOURCES,
    annotated_samples,
    fit_label_threshold,
    pseudo_label_samples,
    select_frames_near,
)
from flcav.pipeline.placing import find_sites, place_sensors, read_traces
from flcav.pipeline.planning import (
    PlanRequest,
    PlanSettings,
    UpdateForm,
    follow_plan,
    make_plan,
    model_mb,
    parse_history,
    remake_plan,
)
from flcav.pipeline.recipe import (
    CENTRAL,
    CLOUD,
    EDGE,
    MORE_EDGE,
    PRETRAIN,
    Federation,
    Placement,
    Role,
    RunRecipe,
    SplitName,
    Training,
)
from flcav.pipeline.results import (
    ERRORS,
    LEDGER,
    OUTCOMES,
    WEIGHTS,
    ErrorRegistry,
    Placed,
    Plan,
    Pretrained,
    Round,
    StageResult,
    Tested,
    Watched,
    average_regions,
)
from flcav.pipeline.stages import (
    Learning,
    RegionStart,
    Strategies,
    choose_uploads,
    federate_cloud,
    federate_edge,
    load_stage_network,
    make_clients,
    pretrain,
    region_budget,
    share_budget,
    train_centrally,
    upload_samples,
)
from flcav.pipeline.steps import Work

PROBLEM = "problem.json"

Fields = Mapping[str, Any]


def record_step(work: Work, fields: Fields, beside: str, places: Sequence[str], version: Mapping[str, str]) -> None:
    """Record one split, also from the poles that the steps `places` chose; `version`: SHA-256 of the town's files.

    Raises `InputError` where the files have changed.
    """
    if hash_town(fields["town"], Path(beside)) != version:
        raise InputError(f"{fields['town']}: the town was changed while the run was under way")
    poles = [pole for step in places for pole in Placed.load(work.inputs[step]).chosen]
    record_frames(fields, poles, Path(beside), work.folder, work.report).save(work.folder)


def deal_step(work: Work, path: str, split: SplitName, role: Role, seed: int, whole: bool, version: str) -> None:
    """Take one split from the dataset at `path`; `version`: SHA-256 of its manifest.

    Raises `InputError` where the manifest has changed.
    """
    if hash_manifest(Path(path)) != version:
        raise InputError(f"{path}: the dataset was changed while the run was under way")
    deal_frames(Path(path), split, role, seed, whole).save(work.folder)


def plan_step(
    work: Work,
    recipe: Fields,
    rule: PlanRule,
    pools: Mapping[str, Sequence[str]],
    histories: Mapping[str, str],
    updates: Sequence[Fields] = (),
    recorded: Mapping[str, Mapping[str, int]] | None = None,
) -> None:
    """Allocate both budgets to all tasks; by task, `pools`: steps that recorded pools, `histories`: CSV tables.

    `updates` are the forms of the arms' updates, of which the largest is planned with; default: whole updates.
    `recorded`: of federating regions of recorded data, the vehicles with their numbers of training frames.
    """
    asked_for = RunRecipe.model_validate(recipe)
    asked, held = [], _held_frames(asked_for, recorded or {})
    forms = tuple(UpdateForm.model_validate(update) for update in updates) or (UpdateForm(),)
    for name in asked_for.tasks:
        task, network = task_named(name), asked_for.tasks[name].network
        config = find_configuration(task, network)
        sizes = [
            len(message)
            for step in pools[name]
            for split in (Frames.open(work.inputs[step]),)
            for message in as_shared(task).pack_samples(split.data, config, split.vehicles)
        ]
        messages = MessageSizes(float(np.mean(sizes)) / 1e6, model_mb(task, network, forms))
        own = asked_for.tasks[name]
        history = parse_history(name, histories[name], name) if name in histories else None
        asked.append(PlanRequest(name, own.weight, messages, len(sizes), history, own.plan, own.train_s))
    budgets = Price(asked_for.budgets_mb.wireless, asked_for.budgets_mb.wireline)
    k = asked_for.federation.edge_rounds_per_cloud_round
    speeds = list_speeds(asked_for, held)
    groups, samples = tuple(map(len, held.values())), tuple(sum(own.values()) for own in held.values())
    frame = PlanSettings(budgets, asked_for.headroom, asked_for.limits, groups, k, samples, asked_for.horizon_s, speeds)
    plan, problem = make_plan(tuple(asked), frame, rule)
    if problem is not None:
        write_json(work.folder / PROBLEM, problem.model_dump(mode="json"))
    plan.save(work.folder)


def replan_step(
    work: Work,
    first: str,
    plan: str,
    stage: Literal["pretrain", "edge"],
    watched: Mapping[str, Sequence[str]],
    books: Mapping[str, Sequence[str]],
) -> None:
    """Plan the rest of the run anew after `stage`: by task, `watched` are its validations, `books` its ledgers.

    `first` is the step of the first plan, `plan` that of the one carried out in `stage`.
    """
    problem = read_config(Problem, work.inputs[first] / PROBLEM)
    done = Plan.load(work.inputs[plan])
    reached: dict[str, float] = {}
    used: dict[Link, int] = dict.fromkeys(LINKS, 0)
    for task in problem.tasks:
        last = average_regions([Watched.load(work.inputs[step]) for step in watched[task.name]])[-1]
        reached[task.name] = last.score
        for entry in _entries(work, *books[task.name]):
            used[entry.link] += entry.bytes * (entry.direction == "up")
    used_mb = Price(used["wireless"] / BYTES_PER_MB, used["wireline"] / BYTES_PER_MB)
    remake_plan(done, problem, stage, reached, used_mb).save(work.folder)


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
    chosen = choose_uploads(
        {region: split.vehicles for region, split in opened.items()}, own.tasks[task].samples, upload_seed
    )
    book = Ledger(_share_budget(own, budget_mb, task))
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


def errors_step(
    work: Work,
    task: str,
    region: str,
    pretrained: str,
    registry: str,
    plan: str,
    vehicles: Mapping[str, int],
    budget_mb: tuple[float, float],
) -> None:
    """Register the errors of the pretrained network in a region, as its vehicles report them to the edge server.

    Raises `InputError` for a task whose errors have no position.
    """
    learned = task_named(task)
    if not isinstance(learned, RegistersErrors):
        raise InputError(f"placement.tasks: the errors of '{task}' have no place in a town")
    drive = Frames.open(work.inputs[registry])
    book = _region_book(work, task, region, plan, pretrained, vehicles, budget_mb)
    network = release_network(book, learned, load_stage_network(learned, work.inputs[pretrained]), region, drive)
    threshold = Pretrained.load(work.inputs[pretrained]).threshold
    lowest = THRESHOLD if threshold is None else threshold
    found = learned.register_errors(network, drive.data, drive.vehicles, lowest, work.report)
    found = report_errors(book, learned, found, region, drive)
    book.save(work.folder / LEDGER)
    save_errors(found.errors, work.folder / ERRORS)
    kinds = sorted({error.kind for error in found.errors})
    counts = {kind: sum(error.kind == kind for error in found.errors) for kind in kinds}
    ErrorRegistry(region, task, counts, found.dropped).save(work.folder)


def place_step(
    work: Work,
    region: str,
    how: Fields,
    errors: Mapping[str, str],
    weights: Mapping[str, float],
    registry: str,
    edge: str | None,
) -> None:
    """Place a region's roadside sensors by the errors and weights of each task.

    `edge`: step of the recorded training data, if any, whose poles are the only candidates.
    """
    drive = Frames.open(work.inputs[registry])
    sites = find_sites(drive, None if edge is None else Frames.open(work.inputs[edge]))
    found = {task: load_errors(work.inputs[step] / ERRORS) for task, step in errors.items()}
    traces = read_traces(drive.data, drive.vehicles)
    place_sensors(region, Placement.model_validate(how), sites, found, weights, traces).save(work.folder)


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
) -> None:
    """Run stage II of a task in a region; `steps`: what its samples depend on, see `_label_samples`.

    With a step "edge" it goes on from that stage II, for as many rounds as the region has in stage III. On a network,
    a vehicle trains `train_s` / speed in a round [s]. Each round is scored on the frames of the steps `validation`, by
    region. Vehicles train in so many `processes` of a `runtime`.
    """
    learning = Learning(task_named(task), network, Training.model_validate(training), seed)
    plan, how = Plan.load(work.inputs[steps["plan"]]), Federation.model_validate(federation)
    own = plan.tasks[task]
    book = _region_book(work, task, region, steps["plan"], steps["pretrain"], vehicles, budget_mb)
    if "errors" in steps:
        book = Ledger(book.budget, _entries(work, steps["errors"]))
    if "edge" in steps:
        stage, rounds = MORE_EDGE, own.cloud_rounds * how.edge_rounds_per_cloud_round
        book = Ledger(book.budget, _entries(work, steps["edge"]))
        samples, poles = _label_samples(work, learning, region, labels, steps)
    else:
        stage, rounds = EDGE, own.edge_rounds
        samples, poles = _label_samples(work, learning, region, labels, steps, book)
    start = load_stage_network(learning.task, work.inputs[steps.get("edge", steps["pretrain"])])
    clients = make_clients(learning, start.config, samples)
    earlier = StageResult.load(work.inputs[steps["edge"]]).rounds if "edge" in steps else 0
    schedule = learning.schedule(rounds, learning.training.local_steps, stage, region, earlier=earlier)
    strategy, _ = find_strategies(how)
    rules = follow_plan(how, own, earlier)
    before, asked = len(book.entries), (learning, start, clients, schedule, strategy)
    seeds = [schedule.work(number).seed for number in range(1, rounds + 1)]
    driven = drive_region(work, learning, how, rules, region, [*clients], steps, seeds, earlier, train_s, speeds)
    watched = {name: Frames.open(work.inputs[step]) for name, step in validation.items()}
    where: Any = (book, work.folder, work.report, driven.outages, watched, processes, runtime)
    losses = federate_edge(*asked, driven.rules, earlier, *where)
    held = sum(len(client.samples) for client in clients.values())
    records = read_rounds(work.folder, region, before, {region: driven.seconds})
    StageResult(stage, task, region, len(losses), held, len(clients), poles, losses, records).save(work.folder)


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
) -> None:
    """Run stage III of a task: the edge servers of `regions` federate with the cloud, vehicles with edge servers."""
    learning = Learning(task_named(task), network, Training.model_validate(training), seed)
    first = next(iter(regions.values()))
    own, how = Plan.load(work.inputs[first["plan"]]), Federation.model_validate(federation)
    start = load_stage_network(learning.task, work.inputs[first["pretrain"]])
    book = Ledger(
        _share_budget(own, budget_mb, task), _entries(work, first["pretrain"], *(s["edge"] for s in regions.values()))
    )
    servers, held, count, helped = {}, 0, 0, []
    for region, steps in regions.items():
        samples, poles = _label_samples(work, learning, region, labels, steps)
        clients = make_clients(learning, start.config, samples)
        weights = to_arrays(load_stage_network(learning.task, work.inputs[steps["edge"]]))
        servers[region] = RegionStart(clients, weights, StageResult.load(work.inputs[steps["edge"]]).rounds)
        held += sum(len(client.samples) for client in clients.values())
        count, helped = count + len(clients), [*helped, *poles]
    rounds, k = own.tasks[task].cloud_rounds, how.edge_rounds_per_cloud_round
    federating = Strategies(*find_strategies(how))
    rules = follow_plan(how, own.tasks[task], own.tasks[task].edge_rounds)
    before, schedule = len(book.entries), learning.schedule(rounds, learning.training.local_steps, CLOUD, "")
    seeds = {
        name: [seed for n in range(1, rounds + 1) for seed in edge_seeds(schedule, n, name, k)] for name in servers
    }
    driven = {
        name: drive_region(
            work, learning, how, rules, name, [*at.clients], regions[name], seeds[name], at.earlier, train_s, speeds
        )
        for name, at in servers.items()
    }
    rules, lost, seconds = join_regions(driven, k, how.network, update_bytes(to_arrays(start)))
    asked = (learning, start, servers, rounds, k, federating, rules)
    losses = federate_cloud(*asked, book, work.folder, work.report, lost)
    records = read_rounds(work.folder, None, before, seconds)
    StageResult(CLOUD, task, None, len(losses), held, count, tuple(helped), losses, records).save(work.folder)


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
) -> None:
    """Continue training centrally on ground truth, for as many optimiser steps as stage II takes in the region.

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
    rounds = Plan.load(work.inputs[steps["plan"]]).tasks[task].edge_rounds
    losses = train_centrally(learning, trained, samples, rounds, vehicles, source)
    save_network(learning.task, trained, work.folder / WEIGHTS)
    StageResult(CENTRAL, task, region, rounds, len(samples), 1, (), losses).save(work.folder)


def test_step(work: Work, task: str, region: str, trained: str, frames: str, seed: int, model: str | None) -> None:
    """Test the network of the step `trained`, or the own model of a region, `model`, on a region's test frames.

    Raises `InputError` where the frames hold no target, so that the measure is undefined.
    """
    learned, split = task_named(task), Frames.open(work.inputs[frames])
    network, how = load_stage_network(learned, work.inputs[trained], model), as_measurable(learned)
    outcomes = how.outcomes(network, split.data, split.vehicles, work.report)
    outcomes.save(work.folder / OUTCOMES)
    mean = compute_measure(learned, outcomes)
    if np.isnan(mean):
        raise InputError(f"{region}: its {len(split.vehicles)} test frames hold nothing to find; take more scenes")
    scenes = len({split.data.keys[i].scene for i in split.vehicles})
    Tested(
        region=region,
        task=task,
        measure=how.measure_name,
        estimate=Estimate(mean, *compute_interval(learned, outcomes, seed)),
        numbers=how.numbers(outcomes),
        frames=len(split.vehicles),
        scenes=scenes,
    ).save(work.folder)


def rounds_step(
    work: Work, task: str, region: str, stage: str, start: str, trained: str, frames: str, averaged: int, share: float
) -> None:
    """Validate a federation's network after each round on a region's validation frames, used for nothing else.

    The network is that of a federation which ends with this round: the mean of the last `averaged` rounds' weights,
    with `share` of those of the step `start`. A pretrained network is validated as round 0.
    """
    learned, split = task_named(task), Frames.open(work.inputs[frames])
    first = load_stage_network(learned, work.inputs[start])
    networks = {0: first}
    if stage != PRETRAIN:
        numbers = range(1, StageResult.load(work.inputs[trained]).rounds + 1)
        folder = work.inputs[trained]
        networks = {each: load_round_network(learned, first, folder, each, averaged, share) for each in numbers}
    rounds = []
    for number, network in networks.items():
        rounds.append(Round(number, score_network(learned, network, split.data, split.vehicles)))
        work.report(number, len(networks), "")
    Watched(stage, task, region, len(split.vehicles), tuple(rounds)).save(work.folder)


def look_step(work: Work, before: str, after: str, frames: str) -> None:
    """Detect objects in one test sweep with the networks of two steps."""
    detect_before_after(work.inputs[before], work.inputs[after], Frames.open(work.inputs[frames])).save(work.folder)


def _label_samples(
    work: Work, learning: Learning, region: str, labels: str, steps: Mapping[str, Any], book: Ledger | None = None
) -> tuple[Mapping[str, Sequence[Any]], tuple[int, ...]]:
    """Return each vehicle's labelled samples, and the poles that contributed labels.

    `steps`: "pretrain", the recorded "frames", the arm's "place", and "sites", the placements of all arms.
    """
    split, kind = Frames.open(work.inputs[steps["frames"]]), LABEL_SOURCES[labels]
    frames = _select_group(work, split, steps)
    if not kind.from_detections:
        config = load_stage_network(learning.task, work.inputs[steps["pretrain"]]).config
        return annotated_samples(learning.task, config, split, frames, region), ()
    poles = Placed.load(work.inputs[steps["place"]]).chosen if kind.from_poles else ()
    frozen = load_stage_network(learning.task, work.inputs[steps["pretrain"]])
    threshold = Pretrained.load(work.inputs[steps["pretrain"]]).threshold
    assert threshold is not None  # fixed wherever labels come from detections
    samples = pseudo_label_samples(frozen, threshold, split, frames, poles, region, work.report, book, kind.trained)
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


def list_speeds(recipe: RunRecipe, held: Mapping[str, Mapping[str, int]]) -> dict[str, float]:
    """Return the speed of every vehicle by its name in a federation; empty where no region gives any.

    held: the vehicles of each federating region with their numbers of training frames.
    """
    if not any(recipe.regions[region].speed for region in held):
        return {}
    names = [(region, vehicle) for region, vehicles in held.items() for vehicle in vehicles]
    return {f"{region}/{vehicle}": recipe.regions[region].speed.get(vehicle, 1.0) for region, vehicle in names}


def _held_frames(recipe: RunRecipe, recorded: Mapping[str, Mapping[str, int]]) -> dict[str, Mapping[str, int]]:
    """Return the vehicles of each federating region with their numbers of training frames."""
    each = recipe.sized_splits.edge
    return {
        region: recorded.get(region)
        or {f"cav{number}": each.scenes * each.spins for number in range(recipe.vehicles(region))}
        for region in recipe.with_role("federate")
    }


def _region_book(
    work: Work,
    task: str,
    region: str,
    plan: str,
    pretrained: str,
    vehicles: Mapping[str, int],
    budget_mb: tuple[float, float],
) -> Ledger:
    """Return an empty ledger of a region's stage II, with its share of what stage I left."""
    whole = _share_budget(Plan.load(work.inputs[plan]), budget_mb, task)
    return Ledger(region_budget(Ledger(whole, _entries(work, pretrained)), vehicles, region))


def _share_budget(plan: Plan, budget_mb: tuple[float, float], task: str) -> Budget:
    planned = {name: (own.wireless_mb, own.wireline_mb) for name, own in plan.tasks.items()}
    return share_budget(Budget(*budget_mb), planned, task)


def _entries(work: Work, *steps: str) -> list[LedgerEntry]:
    return [entry for step in steps for entry in Ledger.load(work.inputs[step] / LEDGER).entries]


def _each(samples: Sequence[Any]) -> list[Any]:
    """Load all samples into memory: each is drawn many times."""
    return [samples[number] for number in range(len(samples))]
