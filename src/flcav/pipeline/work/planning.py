"""Steps that plan a run, and plan the rest of it anew."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from flcav.config import InputError, read_config
from flcav.files import write_json
from flcav.network.clock.rounds import NetworkSettings
from flcav.network.ledger import BYTES_PER_MB, LINKS, Link
from flcav.network.plan import MessageSizes, Price
from flcav.network.radio.links import RadioLinks
from flcav.optimization.problem import Problem
from flcav.perception.client import as_shared
from flcav.perception.task import find_configuration
from flcav.perception.tasks import task_named
from flcav.pipeline.arms import PlanRule
from flcav.pipeline.federations.prediction import link_drive, predict_air_s
from flcav.pipeline.federations.replanning import price_rounds, settle
from flcav.pipeline.frames import Frames
from flcav.pipeline.planning import (
    PlanRequest,
    PlanSettings,
    UpdateForm,
    count_carried_out,
    make_plan,
    model_mb,
    parse_history,
    remake_plan,
)
from flcav.pipeline.recipe import RunRecipe
from flcav.pipeline.results import PROBLEM, Plan, StageResult, Watched, average_last
from flcav.pipeline.steps import Work
from flcav.pipeline.work import Fields
from flcav.pipeline.work.budgets import read_entries
from flcav.pipeline.work.uploads import plan_uploads


def plan_step(
    work: Work,
    recipe: Fields,
    rule: PlanRule,
    pools: Mapping[str, Sequence[str]],
    histories: Mapping[str, str],
    updates: Sequence[Fields] = (),
    recorded: Mapping[str, Mapping[str, int]] | None = None,
    uploads: Fields | None = None,
    air: Fields | None = None,
) -> None:
    """Allocate both budgets to all tasks; by task, `pools`: steps that recorded pools, `histories`: CSV tables.

    `updates` are the forms of the arms' updates, of which the largest is planned with; default: whole updates.
    `recorded`: of federating regions of recorded data, the vehicles with their numbers of training frames. `uploads`:
    how the vehicles' uploads are planned, see `plan_uploads`; None: they are drawn. `air`: the network that counts in
    the time of a round, its "range_m" of traffic, and by region the "drives" that it is predicted from; None: vehicles
    train alone.
    """
    asked_for = RunRecipe.model_validate(recipe)
    asked, held = [], _held_frames(asked_for, recorded or {})
    forms = tuple(UpdateForm.model_validate(update) for update in updates) or (UpdateForm(),)
    linked = {} if air is None else _link_drives(work, asked_for, recorded or {}, air)
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
        whole_mb = model_mb(task, network) if linked else 0.0
        air_s = {region: _predict(region, name, scenes, whole_mb, messages) for region, scenes in linked.items()}
        asked.append(PlanRequest(name, own.weight, messages, len(sizes), history, own.plan, own.train_s, air_s))
    budgets = Price(asked_for.budgets_mb.wireless, asked_for.budgets_mb.wireline)
    k = asked_for.federation.edge_rounds_per_cloud_round
    speeds = _list_speeds(asked_for, held, linked)
    groups, samples = tuple(map(len, held.values())), tuple(sum(own.values()) for own in held.values())
    frame = PlanSettings(budgets, asked_for.headroom, asked_for.limits, groups, k, samples, asked_for.horizon_s, speeds)
    plan, problem = make_plan(tuple(asked), frame, rule)
    if problem is not None:
        write_json(work.folder / PROBLEM, problem.model_dump(mode="json"))
    if uploads is not None:
        plan = plan_uploads(work, plan, pools, uploads, asked_for.seed)
    plan.save(work.folder)


def replan_step(
    work: Work,
    first: str,
    plan: str,
    stage: Literal["pretrain", "edge"],
    watched: Mapping[str, Sequence[str]],
    books: Mapping[str, Sequence[str]],
    edges: Mapping[str, Sequence[str]] = {},
) -> None:
    """Plan the rest of the run anew after `stage`: by task, `watched` are its validations, `books` its ledgers.

    `first` is the step of the first plan, `plan` that of the one carried out in `stage`. `edges` are the steps of stage
    II whose numbers of rounds were planned anew after each round.
    """
    problem = read_config(Problem, work.inputs[first] / PROBLEM)
    done = Plan.load(work.inputs[plan])
    reached: dict[str, float] = {}
    used: dict[str, dict[Link, int]] = {task.name: dict.fromkeys(LINKS, 0) for task in problem.tasks}
    for task in problem.tasks:
        reached[task.name] = average_last([Watched.load(work.inputs[step]) for step in watched[task.name]])
        for entry in read_entries(work, *books[task.name]):
            used[task.name][entry.link] += entry.bytes * (entry.direction == "up")
    sent = {task: Price(own["wireless"] / BYTES_PER_MB, own["wireline"] / BYTES_PER_MB) for task, own in used.items()}
    used_mb = Price(*(sum(own[link] for own in used.values()) / BYTES_PER_MB for link in LINKS))
    ran = {
        task: count_carried_out(done.tasks[task], [StageResult.load(work.inputs[step]) for step in steps])
        for task, steps in edges.items()
    }
    made = remake_plan(done, problem, stage, reached, used_mb, ran)
    k = problem.edge_rounds_per_cloud_round
    groups = problem.tasks[0].edge_groups
    booked = {}
    for task in edges:
        own = made.tasks[task]
        booked[task] = settle(own, price_rounds(own, groups, k, 0, own.cloud_rounds), sent[task])
    replace(made, tasks={**made.tasks, **booked}).save(work.folder)


def _link_drives(
    work: Work, recipe: RunRecipe, recorded: Mapping[str, Mapping[str, int]], air: Fields
) -> dict[str, list[RadioLinks]]:
    """Return the links of each region's drives, see `plan_step`."""
    settings = NetworkSettings.model_validate(air["network"])
    return {
        region: link_drive(
            region, Frames.open(work.inputs[step]), settings, air["range_m"], recipe.seed, region in recorded
        )
        for region, step in air["drives"].items()
    }


def _predict(region: str, task: str, scenes: Sequence[RadioLinks], whole_mb: float, sizes: MessageSizes) -> float:
    found = predict_air_s(scenes, round(whole_mb * BYTES_PER_MB), round(sizes.model_mb * BYTES_PER_MB))
    if found is None:
        raise InputError(
            f"federation.network: no vehicle of '{region}' ends the messages of a round of '{task}' in its registry "
            "drives, so that a plan within horizon_s cannot reckon with them"
        )
    return found


def _list_speeds(
    recipe: RunRecipe, held: Mapping[str, Mapping[str, int]], linked: Mapping[str, Sequence[RadioLinks]]
) -> dict[str, float]:
    """Return the speed of every vehicle by its name in a federation; empty where no region gives any, nor links.

    held: the vehicles of each federating region with their numbers of training frames.
    """
    if not linked and not any(recipe.regions[region].speed for region in held):
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
