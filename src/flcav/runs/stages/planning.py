"""The steps that plan a run, and that plan the rest of it again after a stage."""

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
from flcav.perception.objects.config import SecondConfig
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
    """Settings for predicting the messages by which vehicles have their samples labelled by the road average."""

    distillation: Distillation
    drives: Mapping[str, str]  # recording, by federating region
    recorded: tuple[str, ...]  # regions that are recorded datasets
    poles: tuple[int, ...]  # numbers of the poles that the arms name for sensors
    count: int  # number of the other sensors in a region: the maximum over the arms
    traffic_m: float  # radius of the traffic around a pole [m]
    near_m: float  # vehicles label frames recorded within this distance of a sensor [m]


class PlannedTask(Config):
    """The planning step's input for a task."""

    network: str | None  # name of the configuration; None: the task's first
    weight: float  # of its error in the objective
    train_s: float  # time that a vehicle of speed 1 trains in a round [s]
    fixed: FixedPlan | None  # a plan given by hand, instead of a history
    history: str | None  # learning history, the text of a CSV table
    pools: tuple[str, ...]  # recordings of the candidates for upload
    labels: LabelSettings | None = None  # of the labels "road-average" in any arm


class AirSettings(Config):
    """Settings for predicting the time that a round's messages take on the air."""

    network: NetworkSettings
    range_m: float  # radius around a pole within which traffic counts for choosing the unit's pole [m]
    drives: Mapping[str, str]  # recording, by region
    recorded: tuple[str, ...]  # regions that are recorded datasets


class UploadSettings(Config):
    """Settings of planned uploads."""

    regions: tuple[str, ...]  # that pretrain
    network: NetworkSettings | None  # vehicles upload by the capacity of their uplinks; None: by the frames they have
    range_m: float  # radius around a pole within which traffic counts for choosing the unit's pole [m]


class FirstPlanSettings(StepSettings):
    """Settings of a run's first plan."""

    rule: PlanRule
    seed: int
    budgets_mb: Budgets  # of the run, both uplinks [MB]
    headroom: float  # fraction of the budgets left unspent
    limits: PlanLimits
    horizon_s: float | None  # longest time that a vehicle trains, over all rounds of all tasks [s]
    edge_rounds_per_cloud_round: int
    tasks: Mapping[str, PlannedTask]
    held: Mapping[str, Mapping[str, int]]  # numbers of training frames, by federating region and vehicle
    speeds: Mapping[str, float]  # relative computing speeds by "region/vehicle"; empty: all train at the same speed
    called: tuple[int, int] | None = None  # least and most vehicles of a group on request; None: it does not decide
    overlap: float = 0.0  # share of a further vehicle's data that the vehicles called before it already have
    updates: tuple[UpdateForm, ...]  # forms of the arms' updates; the plan is made for the largest
    uploads: UploadSettings | None  # None: uploads are drawn
    air: AirSettings | None  # None: messages take no time

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        drives = () if self.air is None else self.air.drives.values()
        labelled = [task.labels.drives.values() for task in self.tasks.values() if task.labels is not None]
        pools = (step for task in self.tasks.values() for step in task.pools)
        return (*pools, *drives, *(step for steps in labelled for step in steps))


class ReplanSettings(StepSettings):
    """Settings of the updated plan of the rest of a run, after a stage."""

    stage: Literal["pretrain", "edge"]
    first: str  # step of the first plan
    plan: str  # step of the plan by which the stage was carried out
    watched: Mapping[str, tuple[str, ...]]  # validations of the stage, by task
    books: Mapping[str, tuple[str, ...]]  # steps whose ledgers count as spent, by task

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (
            self.first,
            self.plan,
            *(step for by_task in (self.watched, self.books) for steps in by_task.values() for step in steps),
        )


def plan_step(work: Work, settings: FirstPlanSettings) -> None:
    """Allocate both budgets to all tasks."""
    scenes = {} if settings.air is None else _link_drives(work, settings.air, settings.seed)
    requests = tuple(_request(work, settings, name, scenes) for name in settings.tasks)
    plan, problem = make_plan(requests, frame_plan(settings), settings.rule)
    if problem is not None:
        write_json(work.folder / PROBLEM, problem.model_dump(mode="json"))
    if settings.uploads is not None:
        pools = {name: task.pools for name, task in settings.tasks.items()}
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
        group_samples=tuple(sum(frames.values()) for frames in settings.held.values()),
        horizon_s=settings.horizon_s,
        speeds=settings.speeds,
        called=settings.called,
        overlap=settings.overlap,
    )


def _request(
    work: Work, settings: FirstPlanSettings, name: str, scenes: Mapping[str, Sequence[RadioLinks]]
) -> PlanRequest:
    """Return the planner's request for a task; `scenes`: radio links of the vehicles' drives, by region."""
    entry, task = settings.tasks[name], task_named(name)
    config, shared = find_configuration(task, entry.network), as_shared(task)
    pools = [Frames.open(work.inputs[step]) for step in entry.pools]
    sizes = [len(message) for split in pools for message in shared.pack_samples(split.data, config, split.vehicles)]
    most = len(sizes) if entry.fixed is None else entry.fixed.samples
    messages = MessageSizes(
        sample_mb=float(np.mean(sizes)) / 1e6,
        model_mb=model_mb(task, entry.network, settings.updates),
        exchange_mb=measure_exchange(task, config, pools, settings.updates, most, settings.seed),
        labels_mb=None if entry.labels is None else _measure_labels(work, entry.labels, settings.held, config),
    )
    history = None if entry.history is None else parse_history(name, entry.history, name)
    whole_mb = model_mb(task, entry.network) if scenes else 0.0
    air_s = {region: _predict(region, name, links, whole_mb, messages) for region, links in scenes.items()}
    return PlanRequest(name, entry.weight, messages, len(sizes), history, entry.fixed, entry.train_s, air_s)


def _measure_labels(
    work: Work, how: LabelSettings, held: Mapping[str, Mapping[str, int]], config: SecondConfig
) -> float:
    """Return the size of a vehicle's messages for one labelling of its samples [MB]; `held`: as in the settings."""
    regions = [
        RegionDrive(
            Frames.open(work.inputs[step]), region in how.recorded, sum(held[region].values()), len(held[region])
        )
        for region, step in how.drives.items()
    ]
    sensors = Sensors(how.poles, how.count, how.traffic_m, how.near_m)
    return sum(measure(regions, sensors, how.distillation, config) for measure in load_all(LABEL_SIZES))


def _link_drives(work: Work, air: AirSettings, seed: int) -> dict[str, list[RadioLinks]]:
    """Return the radio links of the regions' drives, by region and scene."""
    opened = {region: Frames.open(work.inputs[step]) for region, step in air.drives.items()}
    return {
        region: link_drive(region, drive, air.network, air.range_m, seed, region in air.recorded)
        for region, drive in opened.items()
    }


def _predict(region: str, task: str, scenes: Sequence[RadioLinks], whole_mb: float, sizes: MessageSizes) -> float:
    """Return the mean time of a round's messages on the air [s]; `whole_mb`: size of the whole model [MB]."""
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
            if entry.link in used:  # budgets limit uplinks alone, and none of the sidelink
                used[entry.link] += entry.bytes * (entry.direction == "up")
    used_mb = LinkMegabytes(*(used[link] / BYTES_PER_MB for link in LINKS))
    remake_plan(done, problem, settings.stage, reached, used_mb).save(work.folder)


def plan_uploads(work: Work, plan: Plan, pools: Mapping[str, Sequence[str]], how: UploadSettings, seed: int) -> Plan:
    """Return the plan with the numbers of samples that the vehicles upload, by task and vehicle.

    `pools`: the steps that recorded the candidates, by task, in the order of the regions in `how`. With a `network`,
    vehicles upload in proportion to the capacity of their uplinks, as measured in the pools of the first task; without
    one, in proportion to the frames that they have.
    """
    opened = {
        task: {region: Frames.open(work.inputs[step]) for region, step in zip(how.regions, steps, strict=True)}
        for task, steps in pools.items()
    }
    demands = {}
    for task, splits in opened.items():
        held = {name: len(frames) for region, split in splits.items() for name, frames in list_frames(region, split)}
        demands[task] = UploadDemand(plan.tasks[task].samples, plan.tasks[task].sample_mb, held)
    if how.network is None:
        shares = {task: share_by_held(demand) for task, demand in demands.items()}
    else:
        mbps: dict[str, float] = {}
        for region, split in next(iter(opened.values())).items():
            found = measure_uplinks(region, split, how.network, how.range_m, seed)
            mbps |= {
                name: found.get(name, 0.0)
                for demand in demands.values()
                for name in demand.held
                if name.startswith(f"{region}/")
            }
        shares = share_by_links(demands, mbps)
    return replace(plan, tasks={task: replace(entry, uploads=shares[task]) for task, entry in plan.tasks.items()})


def list_frames(region: str, split: Frames) -> list[tuple[str, list[int]]]:
    """Return the vehicles of a split, "region/vehicle", with their frame numbers, in the order of their names."""
    found: dict[str, list[int]] = {}
    for frame in split.vehicles:
        found.setdefault(f"{region}/{split.data.keys[frame].agent}", []).append(frame)
    return sorted(found.items())


def make_plan_step(outline: Outline, arm: Setting) -> Step:
    """Return the step that makes an arm's first plan."""
    recipe = outline.recipe
    air = _predict_air(outline)
    uploads = None
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
    """Return the step that updates the plan after stage I or II, from the scores that the run itself reached."""
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
    entry = outline.recipe.tasks[task]
    return PlannedTask(
        network=entry.network,
        weight=entry.weight,
        train_s=entry.train_s,
        fixed=entry.plan,
        history=None if entry.history is None else read_history(task, entry.history, outline.beside),
        pools=tuple(outline.pools(task).values()),
        labels=_label_task(outline, task),
    )


def _label_task(outline: Outline, task: str) -> LabelSettings | None:
    """Return the settings for predicting label messages; None if no arm labels by the road average."""
    arms = [arm for arm in outline.settings.values() if arm.central is None]
    averaging = outline.averaging(task)
    if not averaging:
        return None
    most = {"window_s": outline.window_s(task), "pose_graph": any(average.pose_graph for average in averaging)}
    placements = [arm.placement for arm in arms]
    common = outline.recipe.placement
    split = "registry" if task in (*common.tasks, outline.placing_task) else "validation"
    return LabelSettings(
        distillation=averaging[0].model_copy(update=most),  # the largest messages of any arm
        drives={region: outline.names.recording(region, split, task) for region in outline.federating},
        recorded=tuple(outline.recorded),
        poles=tuple(sorted({pole for placement in placements for pole in placement.poles})),
        count=max((how.count for how in placements if how.rule not in ("fixed", "none")), default=0),
        traffic_m=common.range_m,
        near_m=common.group_range_m,
    )


def _predict_air(outline: Outline) -> AirSettings | None:
    """Return the settings for predicting times on the air for a plan with a horizon; None without a network."""
    recipe = outline.recipe
    network = recipe.federation.network
    if network is None or recipe.horizon_s is None:
        return None
    names, task = outline.names, outline.placing_task
    drives = {region: names.recording(region, "registry", task) for region in outline.federating}
    recorded = tuple(outline.recorded)
    return AirSettings(network=network, range_m=recipe.placement.range_m, drives=drives, recorded=recorded)


def _count_held(outline: Outline) -> dict[str, dict[str, int]]:
    """Return the numbers of training frames by federating region and vehicle."""
    recipe = outline.recipe
    size = recipe.sized_splits.edge
    return {
        region: outline.recorded.get(region)
        or {f"cav{number}": size.scenes * size.spins for number in range(recipe.vehicles(region))}
        for region in outline.federating
    }


def _list_speeds(outline: Outline, held: dict[str, dict[str, int]], timed: bool) -> dict[str, float]:
    """Return the speeds by "region/vehicle"; empty where no region gives any, and no message is timed."""
    speeds = {region: outline.recipe.speeds(region) for region in held}
    if not timed and not any(speeds.values()):
        return {}
    return {f"{region}/{cav}": speeds[region].get(cav, 1.0) for region, vehicles in held.items() for cav in vehicles}
