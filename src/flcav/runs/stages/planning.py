"""The steps that plan a run, and plan the rest of it again after a stage."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from flcav.config import Config, InputError, read_config
from flcav.fusion.distillation import Distillation
from flcav.network.clock.rounds import NetworkSettings
from flcav.network.ledger import BYTES_PER_MB, LINKS, Link, LinkMegabytes
from flcav.network.plan import MessageSizes
from flcav.network.radio.links import RadioLinks
from flcav.optimization.allocation.uploads import UploadDemand, share_by_held, share_by_links
from flcav.optimization.problem import Problem
from flcav.perception.client import as_shared
from flcav.perception.objects.model import SecondConfig
from flcav.perception.task import find_configuration
from flcav.perception.tasks import task_named
from flcav.runs.allocation import PlanRequest, PlanSettings, make_plan, remake_plan
from flcav.runs.arms import PlanRule, Setting
from flcav.runs.driving import link_drive, measure_uplinks, predict_air_s
from flcav.runs.engine import Step, Work
from flcav.runs.frames import Frames
from flcav.runs.recipe import CLOUD, EDGE, MAIN, Budgets, FixedPlan, PlanLimits
from flcav.runs.registry import LABEL_SIZES, load_all
from flcav.runs.results.plans import Plan
from flcav.runs.results.saved import PROBLEM
from flcav.runs.results.training import Watched, average_last
from flcav.runs.stages.outline import Outline
from flcav.runs.stages.settings import StepSettings, make_step, read_entries
from flcav.runs.stages.testing import list_validations
from flcav.runs.tables import parse_history, read_history
from flcav.runs.training.updates import RegionDrive, Sensors, UpdateForm, measure_exchange, model_mb, update_forms
from flcav.storage.files import write_json


class LabelSettings(Config):
    """Settings of the prediction of what vehicles send to have their samples labelled by the road average."""

    distillation: Distillation
    drives: Mapping[str, str]  # recording, by federating region
    recorded: tuple[str, ...]  # regions that are recorded datasets
    poles: tuple[int, ...]  # numbers of the poles that the arms name for sensors
    count: int  # of the other sensors in a region, the most of the arms
    traffic_m: float  # radius of the traffic around a pole [m]
    near_m: float  # vehicles label frames recorded within this distance of a sensor [m]


class PlannedTask(Config):
    """A task as the planning step receives it."""

    network: str | None  # name of the configuration; None: the task's first
    weight: float  # of its error in the objective
    train_s: float  # time that a vehicle of speed 1 trains in a round [s]
    fixed: FixedPlan | None  # a plan given by hand, instead of a history
    history: str | None  # learning history, the text of a CSV table
    pools: tuple[str, ...]  # recordings of the candidates for upload
    labels: LabelSettings | None = None  # of the labels "road-average" in any arm


class AirSettings(Config):
    """Settings of the prediction of the time that a round's messages take on the air."""

    network: NetworkSettings
    range_m: float  # of the traffic that the unit's pole is chosen by [m]
    drives: Mapping[str, str]  # recording, by region
    recorded: tuple[str, ...]  # regions that are recorded datasets


class UploadSettings(Config):
    """Settings of planned uploads."""

    regions: tuple[str, ...]  # that pretrain
    network: NetworkSettings | None  # vehicles upload by what their uplinks carry; None: by the frames they have
    range_m: float  # of the traffic that the unit's pole is chosen by [m]


class FirstPlanSettings(StepSettings):
    """Settings of a run's first plan."""

    rule: PlanRule
    seed: int
    budgets_mb: Budgets
    headroom: float  # fraction of the budgets left unspent
    limits: PlanLimits
    horizon_s: float | None  # longest time that a vehicle trains, over all rounds of all tasks [s]
    edge_rounds_per_cloud_round: int
    tasks: Mapping[str, PlannedTask]
    held: Mapping[str, Mapping[str, int]]  # numbers of training frames, by federating region and vehicle
    speeds: Mapping[str, float]  # of every vehicle, "region/vehicle"; empty: all train at the same speed
    called: tuple[int, int] | None = None  # least and most vehicles of a group on request; None: it does not decide
    overlap: float = 0.0  # share of a further vehicle's data that those called before it have
    updates: tuple[UpdateForm, ...]  # forms of the arms' updates, of which the largest is planned with
    uploads: UploadSettings | None  # None: uploads are drawn
    air: AirSettings | None  # None: messages take no time

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        drives = () if self.air is None else self.air.drives.values()
        labelled = [own.labels.drives.values() for own in self.tasks.values() if own.labels is not None]
        pools = (step for task in self.tasks.values() for step in task.pools)
        return (*pools, *drives, *(step for steps in labelled for step in steps))


class ReplanSettings(StepSettings):
    """Settings of the updated plan of the rest of a run, after a stage."""

    stage: Literal["pretrain", "edge"]
    first: str  # step of the first plan
    plan: str  # step of the plan that was carried out in the stage
    watched: Mapping[str, tuple[str, ...]]  # validations of the stage, by task
    books: Mapping[str, tuple[str, ...]]  # steps whose ledgers count, by task

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return (
            self.first,
            self.plan,
            *(step for by in (self.watched, self.books) for own in by.values() for step in own),
        )


def plan_step(work: Work, settings: FirstPlanSettings) -> None:
    """Allocate both budgets to all tasks."""
    scenes = {} if settings.air is None else _link_drives(work, settings.air, settings.seed)
    asked = tuple(_request(work, settings, name, scenes) for name in settings.tasks)
    plan, problem = make_plan(asked, frame_plan(settings), settings.rule)
    if problem is not None:
        write_json(work.folder / PROBLEM, problem.model_dump(mode="json"))
    if settings.uploads is not None:
        pools = {name: own.pools for name, own in settings.tasks.items()}
        plan = plan_uploads(work, plan, pools, settings.uploads, settings.seed)
    plan.save(work.folder)


def frame_plan(settings: FirstPlanSettings) -> PlanSettings:
    """Return budgets, bounds and topology of a run's first plan."""
    return PlanSettings(
        budgets_mb=LinkMegabytes(settings.budgets_mb.wireless, settings.budgets_mb.wireline),
        headroom=settings.headroom,
        limits=settings.limits,
        edge_groups=tuple(map(len, settings.held.values())),
        edge_rounds_per_cloud_round=settings.edge_rounds_per_cloud_round,
        group_samples=tuple(sum(own.values()) for own in settings.held.values()),
        horizon_s=settings.horizon_s,
        speeds=settings.speeds,
        called=settings.called,
        overlap=settings.overlap,
    )


def _request(
    work: Work, settings: FirstPlanSettings, name: str, scenes: Mapping[str, Sequence[RadioLinks]]
) -> PlanRequest:
    """Return the planner's request for a task; `scenes`: radio links of the vehicles' drives, by region."""
    own, task = settings.tasks[name], task_named(name)
    config, shared = find_configuration(task, own.network), as_shared(task)
    pools = [Frames.open(work.inputs[step]) for step in own.pools]
    sizes = [len(message) for split in pools for message in shared.pack_samples(split.data, config, split.vehicles)]
    most = len(sizes) if own.fixed is None else own.fixed.samples
    messages = MessageSizes(
        sample_mb=float(np.mean(sizes)) / 1e6,
        model_mb=model_mb(task, own.network, settings.updates),
        exchange_mb=measure_exchange(task, config, pools, settings.updates, most, settings.seed),
        labels_mb=None if own.labels is None else _measure_labels(work, own.labels, settings.held, config),
    )
    history = None if own.history is None else parse_history(name, own.history, name)
    whole_mb = model_mb(task, own.network) if scenes else 0.0
    air_s = {region: _predict(region, name, each, whole_mb, messages) for region, each in scenes.items()}
    return PlanRequest(name, own.weight, messages, len(sizes), history, own.fixed, own.train_s, air_s)


def _measure_labels(
    work: Work, how: LabelSettings, held: Mapping[str, Mapping[str, int]], config: SecondConfig
) -> float:
    """Return what a vehicle sends to have its samples labelled once [MB]; `held` as in `FirstPlanSettings`."""
    regions = [
        RegionDrive(
            Frames.open(work.inputs[step]), region in how.recorded, sum(held[region].values()), len(held[region])
        )
        for region, step in how.drives.items()
    ]
    sensors = Sensors(how.poles, how.count, how.traffic_m, how.near_m)
    return sum(measure(regions, sensors, how.distillation, config) for measure in load_all(LABEL_SIZES))


def _link_drives(work: Work, air: AirSettings, seed: int) -> dict[str, list[RadioLinks]]:
    """Return the links of each region's drives."""
    opened = {region: Frames.open(work.inputs[step]) for region, step in air.drives.items()}
    return {
        region: link_drive(region, drive, air.network, air.range_m, seed, region in air.recorded)
        for region, drive in opened.items()
    }


def _predict(region: str, task: str, scenes: Sequence[RadioLinks], whole_mb: float, sizes: MessageSizes) -> float:
    sent_mb = sizes.model_mb if sizes.exchange_mb is None else sizes.exchange_mb
    found = predict_air_s(scenes, round(whole_mb * BYTES_PER_MB), round(sent_mb * BYTES_PER_MB))
    if found is None:
        raise InputError(
            f"federation.network: no vehicle of '{region}' ends the messages of a round of '{task}' in its registry "
            "drives, so that a plan within horizon_s cannot reckon with them"
        )
    return found


def replan_step(work: Work, settings: ReplanSettings) -> None:
    """Update the plan of the rest of the run after a stage, from the scores reached and the megabytes sent."""
    problem = read_config(Problem, work.inputs[settings.first] / PROBLEM)
    done = Plan.load(work.inputs[settings.plan])
    reached: dict[str, float] = {}
    used: dict[Link, int] = dict.fromkeys(LINKS, 0)
    for task in problem.tasks:
        reached[task.name] = average_last([Watched.load(work.inputs[step]) for step in settings.watched[task.name]])
        for entry in read_entries(work, *settings.books[task.name]):
            if entry.link in used:
                used[entry.link] += entry.bytes * (entry.direction == "up")
    used_mb = LinkMegabytes(*(used[link] / BYTES_PER_MB for link in LINKS))
    remake_plan(done, problem, settings.stage, reached, used_mb).save(work.folder)


def plan_uploads(work: Work, plan: Plan, pools: Mapping[str, Sequence[str]], how: UploadSettings, seed: int) -> Plan:
    """Return the plan with the number of samples that each vehicle uploads, of every task.

    pools: by task the steps that recorded the pools, of the regions in `how`. With a `network` there, vehicles upload
    by what their uplinks carry, as measured in the pools of the first task; otherwise by the frames they have.
    """
    opened = {
        task: {region: Frames.open(work.inputs[step]) for region, step in zip(how.regions, steps, strict=True)}
        for task, steps in pools.items()
    }
    asked = {}
    for task, splits in opened.items():
        held = {name: len(frames) for region, split in splits.items() for name, frames in list_frames(region, split)}
        asked[task] = UploadDemand(plan.tasks[task].samples, plan.tasks[task].sample_mb, held)
    if how.network is None:
        shares = {task: share_by_held(own) for task, own in asked.items()}
    else:
        mbps: dict[str, float] = {}
        for region, split in next(iter(opened.values())).items():
            found = measure_uplinks(region, split, how.network, how.range_m, seed)
            mbps |= {
                name: found.get(name, 0.0)
                for own in asked.values()
                for name in own.held
                if name.startswith(f"{region}/")
            }
        shares = share_by_links(asked, mbps)
    return replace(plan, tasks={task: replace(own, uploads=shares[task]) for task, own in plan.tasks.items()})


def list_frames(region: str, split: Frames) -> list[tuple[str, list[int]]]:
    """Return the frames of each vehicle of a split, "region/vehicle", in the order of their names."""
    found: dict[str, list[int]] = {}
    for frame in split.vehicles:
        found.setdefault(f"{region}/{split.data.keys[frame].agent}", []).append(frame)
    return sorted(found.items())


def make_plan_step(outline: Outline, arm: Setting) -> Step:
    """Return the step that makes an arm's first plan."""
    recipe, air, uploads = outline.recipe, _predict_air(outline), None
    if recipe.uploads == "planned":
        network, range_m = recipe.federation.network, recipe.placement.range_m
        uploads = UploadSettings(regions=recipe.with_role("pretrain"), network=network, range_m=range_m)
    held = _count_held(outline)
    settings = FirstPlanSettings(
        rule=arm.plan,
        seed=recipe.seed,
        budgets_mb=recipe.budgets_mb,
        headroom=recipe.headroom,
        limits=recipe.limits,
        horizon_s=recipe.horizon_s,
        edge_rounds_per_cloud_round=recipe.federation.edge_rounds_per_cloud_round,
        tasks={task: _plan_task(outline, task) for task in recipe.tasks},
        held=held,
        speeds=_list_speeds(outline, held, timed=air is not None),
        called=None if arm.calls is None else arm.calls[:2],
        overlap=0.0 if arm.calls is None else arm.calls.overlap,
        updates=tuple(update_forms(outline.settings.values())),
        uploads=uploads,
        air=air,
    )
    return make_step(outline.names.plan(arm.name), plan_step, settings)


def make_replan_step(outline: Outline, stage: str) -> Step:
    """Return the step that updates the plan after stage I or II, from what the run itself reached."""
    names, main = outline.names, outline.settings[MAIN]
    tasks = [name for name, task in outline.recipe.tasks.items() if task.history is not None]
    edges = {task: tuple(names.edge(MAIN, region, task) for region in main.regions) for task in tasks}
    settings = ReplanSettings(
        stage="edge" if stage == EDGE else "pretrain",
        first=names.plan(MAIN),
        plan=names.plan(MAIN, stage),
        watched={task: tuple(step.name for step in list_validations(outline, stage, task)) for task in tasks},
        books={task: (names.pretrain(MAIN, task), *(edges[task] if stage == EDGE else ())) for task in tasks},
    )
    return make_step(names.plan(MAIN, CLOUD if stage == EDGE else EDGE), replan_step, settings)


def _plan_task(outline: Outline, task: str) -> PlannedTask:
    own = outline.recipe.tasks[task]
    return PlannedTask(
        network=own.network,
        weight=own.weight,
        train_s=own.train_s,
        fixed=own.plan,
        history=None if own.history is None else read_history(task, own.history, outline.beside),
        pools=tuple(outline.pools(task).values()),
        labels=_label_task(outline, task),
    )


def _label_task(outline: Outline, task: str) -> LabelSettings | None:
    """Return the inputs for predicting label messages; None if no arm labels by the road average."""
    arms = [arm for arm in outline.settings.values() if arm.central is None]
    averaging = outline.averaging(task)
    if not averaging:
        return None
    most = {"window_s": outline.window_s(task), "pose_graph": any(each.pose_graph for each in averaging)}
    placements, own = [arm.placement for arm in arms], outline.recipe.placement
    split = "registry" if task in (*own.tasks, outline.placing_task) else "validation"
    return LabelSettings(
        distillation=averaging[0].model_copy(update=most),  # the largest messages of any arm
        drives={region: outline.names.recording(region, split, task) for region in outline.federating},
        recorded=tuple(outline.recorded),
        poles=tuple(sorted({pole for each in placements for pole in each.poles})),
        count=max((each.count for each in placements if each.rule not in ("fixed", "none")), default=0),
        traffic_m=own.range_m,
        near_m=own.group_range_m,
    )


def _predict_air(outline: Outline) -> AirSettings | None:
    """Return the inputs for predicting transmission times of a plan with a horizon; None without a network."""
    recipe, network = outline.recipe, outline.recipe.federation.network
    if network is None or recipe.horizon_s is None:
        return None
    names, task = outline.names, outline.placing_task
    drives = {region: names.recording(region, "registry", task) for region in outline.federating}
    recorded = tuple(outline.recorded)
    return AirSettings(network=network, range_m=recipe.placement.range_m, drives=drives, recorded=recorded)


def _count_held(outline: Outline) -> dict[str, dict[str, int]]:
    """Return the vehicles of each federating region with their numbers of training frames."""
    recipe, each = outline.recipe, outline.recipe.sized_splits.edge
    return {
        region: outline.recorded.get(region)
        or {f"cav{number}": each.scenes * each.spins for number in range(recipe.vehicles(region))}
        for region in outline.federating
    }


def _list_speeds(outline: Outline, held: dict[str, dict[str, int]], timed: bool) -> dict[str, float]:
    """Return the speed of every vehicle, "region/vehicle"; empty where no region gives any, and no message is timed."""
    speeds = {region: outline.recipe.speeds(region) for region in held}
    if not timed and not any(speeds.values()):
        return {}
    return {f"{region}/{cav}": speeds[region].get(cav, 1.0) for region, own in held.items() for cav in own}
