"""Steps that plan a run, and plan the rest of it anew."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from flcav.config import Config, InputError, read_config
from flcav.fusion.distillation import Distillation
from flcav.network.clock.rounds import NetworkSettings
from flcav.network.ledger import BYTES_PER_MB, LINKS, Link
from flcav.network.plan import MessageSizes, Price
from flcav.network.radio.links import RadioLinks
from flcav.optimization.problem import Problem
from flcav.perception.client import as_shared
from flcav.perception.objects.config import SecondConfig
from flcav.perception.task import find_configuration
from flcav.perception.tasks import task_named
from flcav.pipeline.arms import PlanRule
from flcav.pipeline.engine import Work
from flcav.pipeline.federations.prediction import link_drive, predict_air_s
from flcav.pipeline.frames import Frames
from flcav.pipeline.planning.allocation import PlanRequest, PlanSettings, make_plan
from flcav.pipeline.planning.exchanges import Held, Sensors, measure_exchange, measure_labels
from flcav.pipeline.planning.histories import parse_history
from flcav.pipeline.planning.stages import remake_plan
from flcav.pipeline.planning.updates import UpdateForm, model_mb
from flcav.pipeline.recipe import Budgets, FixedPlan, Limits
from flcav.pipeline.results.plans import Plan
from flcav.pipeline.results.saved import PROBLEM
from flcav.pipeline.results.training import Watched, average_last
from flcav.pipeline.steps.budgets import read_entries
from flcav.pipeline.steps.settings import StepSettings
from flcav.pipeline.steps.uploads import UploadSettings, plan_uploads
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
    """A task as the step that plans it is given it."""

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


class FirstPlanSettings(StepSettings):
    """Settings of a run's first plan."""

    rule: PlanRule
    seed: int
    budgets_mb: Budgets
    headroom: float  # fraction of the budgets left unspent
    limits: Limits
    horizon_s: float | None  # longest time that a vehicle trains, over all rounds of all tasks [s]
    edge_rounds_per_cloud_round: int
    tasks: Mapping[str, PlannedTask]
    held: Mapping[str, Mapping[str, int]]  # numbers of training frames, by federating region and vehicle
    speeds: Mapping[str, float]  # of every vehicle, "region/vehicle"; empty: all train at the same speed
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
    """Settings of the plan of the rest of a run, made anew after a stage."""

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
        budgets_mb=Price(settings.budgets_mb.wireless, settings.budgets_mb.wireline),
        headroom=settings.headroom,
        limits=settings.limits,
        edge_groups=tuple(map(len, settings.held.values())),
        edge_rounds_per_cloud_round=settings.edge_rounds_per_cloud_round,
        group_samples=tuple(sum(own.values()) for own in settings.held.values()),
        horizon_s=settings.horizon_s,
        speeds=settings.speeds,
    )


def _request(
    work: Work, settings: FirstPlanSettings, name: str, scenes: Mapping[str, Sequence[RadioLinks]]
) -> PlanRequest:
    """Return a task as the planner sees it; `scenes`: links of the vehicles' drives, by region."""
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
        Held(Frames.open(work.inputs[step]), region in how.recorded, sum(held[region].values()), len(held[region]))
        for region, step in how.drives.items()
    ]
    sensors = Sensors(how.poles, how.count, how.traffic_m, how.near_m)
    return measure_labels(regions, sensors, how.distillation, config)


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
    """Plan the rest of the run anew after a stage, from what was reached and sent."""
    problem = read_config(Problem, work.inputs[settings.first] / PROBLEM)
    done = Plan.load(work.inputs[settings.plan])
    reached: dict[str, float] = {}
    used: dict[Link, int] = dict.fromkeys(LINKS, 0)
    for task in problem.tasks:
        reached[task.name] = average_last([Watched.load(work.inputs[step]) for step in settings.watched[task.name]])
        for entry in read_entries(work, *settings.books[task.name]):
            used[entry.link] += entry.bytes * (entry.direction == "up")
    used_mb = Price(*(used[link] / BYTES_PER_MB for link in LINKS))
    remake_plan(done, problem, settings.stage, reached, used_mb).save(work.folder)
