"""Forecast of a run before anything is spent: rounds, megabytes, epsilon, time, and effects that its tests can detect.

One scene per task is recorded in a temporary folder, and a few steps are trained on it, to measure sizes of samples and
times. Plans are made as the run makes its first ones; what only a run can measure (times on the air, sizes of the road
average's labels, new plans after a stage) is left out.
"""

import resource
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from flcav.federation.privacy import RoundNoise, expected_clients, measure_round_noise
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.trainable import learned_names
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.network.ledger import Link
from flcav.network.plan import MessageSizes, StagePlan, price
from flcav.perception.client import Compresses, as_shared
from flcav.perception.outcomes import score_network
from flcav.perception.tasks import task_named
from flcav.perception.weights import to_arrays
from flcav.runs.allocation import PlanRequest, make_plan
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import Setting, find_strategies
from flcav.runs.frames import Frames, deal_frames, make_recording_recipe, record_frames
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN, SPLITS_OF, Federation, RunRecipe
from flcav.runs.registry import FORECASTS, load_all
from flcav.runs.results.training import PrivacySpent
from flcav.runs.stages.graph import Graph
from flcav.runs.stages.planning import FirstPlanSettings, frame_plan
from flcav.runs.stages.recording import record_step
from flcav.runs.tables import parse_history
from flcav.runs.training.learning import make_clients
from flcav.runs.training.private_rounds import (
    PrivateTraining,
    compose_trainings,
    find_budget_noise,
    plan_private_rounds,
)
from flcav.runs.training.updates import measure_exchange, model_mb
from flcav.storage.records import LEFT_OUT, Record

STEPS = 3  # training steps that are timed
SCENE_SD = 0.1  # of a paired difference of AP50 or accuracy in one test scene: .08 to .14 in reproductions/runs
# Smallest effect that a two-sided test at the level .05 detects with a power of .8, in standard errors of the mean:
# the quantiles of the normal distribution at .975 and .8.
DETECTABLE = 1.96 + 0.84


@dataclass(frozen=True)
class PlannedRounds(Record):
    """The planned samples and rounds of a task, within its budgets of traffic, time and privacy."""

    samples: int
    edge_rounds: int
    cloud_rounds: int
    noise: Annotated[float | None, LEFT_OUT] = None  # multiplier found for the privacy budget; None: given, or no noise
    round_noise: Annotated[RoundNoise | None, LEFT_OUT] = None  # largest relative to the updates; None: no noise


@dataclass(frozen=True)
class ArmForecast(Record):
    """Forecast of an arm: rounds, uplink and privacy."""

    tasks: Mapping[str, PlannedRounds]
    uplink_mb: Mapping[Link, float]  # traffic of all tasks [MB], by link
    privacy: PrivacySpent | None  # None: no noise


@dataclass(frozen=True)
class Forecast(Record):
    """Forecast of a run."""

    minutes: float  # computing time of one core [min]
    memory_mb: float  # most memory of a process, with one sample of each task in a step [MB]
    disk_mb: float  # recordings of vehicles at most [MB]
    arms: Mapping[str, ArmForecast]
    scenes: int  # test scenes of a region
    effect: float  # smallest difference of AP50 or accuracy, in [0, 1], that these tests detect in one training

    def lines(self) -> list[str]:
        """Return the forecast as lines of text."""
        took = f"{self.minutes:.1f} minutes" if self.minutes < 100 else f"{self.minutes / 60:.1f} hours"
        lines = [
            f"about {took} of one core, by one scene and {STEPS} steps of each task just timed",
            f"at most {self.disk_mb / 1e3:.1f} GB of recordings, and {self.memory_mb / 1e3:.1f} GB of memory a process",
        ]
        for name, arm in self.arms.items():
            for task, planned in arm.tasks.items():
                counts = {
                    "sample": planned.samples,
                    "edge round": planned.edge_rounds,
                    "cloud round": planned.cloud_rounds,
                }
                rounds = ", ".join(plural(count, what) for what, count in counts.items())
                lines.append(f"{name}, {task}: {rounds}")
                if planned.round_noise is not None:
                    lines.append(f"{name}, {task}: {planned.round_noise.describe()}")
            sent = " and ".join(f"{megabytes:.1f} MB {link}" for link, megabytes in arm.uplink_mb.items())
            lines.append(f"{name}: about {sent} of uplink")
            if arm.privacy is not None:
                lines.append(f"{name}: {arm.privacy.describe()}")
        power = f"tell a difference of {self.effect:.2f} with a power of 0.8"
        by = f"by a standard deviation of {SCENE_SD:g} between scenes, of AP50 and accuracy in earlier runs"
        power += f" ({by}); retraining varies besides"
        lines.append(f"tests: of one training, {plural(self.scenes, 'scene')} of a region {power}")
        return lines


@dataclass(frozen=True)
class _Measured:
    """Measured message sizes and computing times of a task."""

    sample_mb: float  # size of an uploaded sample [MB]
    compressed_mb: float  # likewise, compressed where the task can [MB]
    exchange_mb: float | None  # what a vehicle sends to be combined in a round [MB]; None: a model update
    pool: int  # candidates for upload
    frame_s: float  # time to record a frame [s]
    frame_mb: float  # a recorded frame on disk [MB]
    step_s: float  # time of a training step [s]
    test_s: float  # time to test a frame [s]


def forecast_run(
    recipe: RunRecipe, *, beside: Path | str | None = None, progress: Report = ignore_progress
) -> Forecast:
    """Return the forecast of a run; raises `InputError` where the recipe cannot be run, as the run does."""
    graph = Graph(recipe, Path(beside or "."))
    check_federations(recipe, graph.settings.values())
    measured = {}
    for done, task in enumerate(recipe.tasks, start=1):
        measured[task] = _measure(graph, task)
        progress(done, len(recipe.tasks), task)
    plans = {name: _plan_arm(graph, arm, measured) for name, arm in graph.settings.items()}
    arms = {name: _forecast_arm(graph, arm, plans, measured) for name, arm in graph.settings.items() if not arm.repeat}
    scenes = recipe.sized_splits.test.scenes
    minutes = sum(_list_seconds(graph, plans, measured)) / 60
    disk_mb = sum(frames * measured[task].frame_mb for (_, task), frames in _count_frames(graph).items())
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    return Forecast(minutes, memory_mb, disk_mb, arms, scenes, DETECTABLE * SCENE_SD / float(np.sqrt(scenes)))


def _measure(graph: Graph, task: str) -> _Measured:
    settings = _plan_settings(graph, MAIN)
    learning = graph.learning(graph.settings[MAIN], task).resolve()
    with tempfile.TemporaryDirectory() as folder:
        split, pool, frame_s = _record_scene(graph, task, Path(folder))
        frame_mb = (
            sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file()) / 1e6 / len(split.data)
        )
        packed = [*as_shared(learning.task).pack_samples(split.data, learning.config, split.vehicles)]
        compressed = learning.task.compress_samples(packed) if isinstance(learning.task, Compresses) else packed
        sample_mb, compressed_mb = (
            float(np.mean([len(message) for message in form])) / 1e6 for form in (packed, compressed)
        )
        about = (learning.task, learning.config, [split], settings.updates, len(split.vehicles), settings.seed)
        exchange_mb = measure_exchange(*about)
        network = learning.build_network()
        samples = learning.task.samples(split.data, learning.config, split.vehicles)
        (client,) = make_clients(learning, learning.config, {task: samples}).values()
        weights = to_arrays(network)
        client.train(weights, steps=1, learning_rate=1e-4, seed=0)  # compiles, which must not be timed
        score_network(learning.task, network, split.data, split.vehicles)  # as above
        began = time.process_time()
        client.train(weights, steps=STEPS, learning_rate=1e-4, seed=0)
        trained = time.process_time()
        frames = split.vehicles
        score_network(learning.task, network, split.data, frames)
        test_s = (time.process_time() - trained) / len(frames)
    return _Measured(sample_mb, compressed_mb, exchange_mb, pool, frame_s, frame_mb, (trained - began) / STEPS, test_s)


def _record_scene(graph: Graph, task: str, folder: Path) -> tuple[Frames, int, float]:
    """Return a scene of the candidates for upload, the number of all candidates, and the time to record a frame [s]."""
    recipe = graph.recipe
    pools = graph.pools(task)
    region, name = next(iter(pools.items()))
    place = recipe.regions[region]
    if place.data is not None:
        path, whole = graph.find_data(place, "pool"), isinstance(place.data, Mapping)
        dealt = deal_frames(path, "pool", place.role, recipe.seed, whole)
        dealt.save(folder)
        split = Frames.open(folder)
        return split, len(split.vehicles) * len(pools), 0.0
    recording = make_recording_recipe(recipe, region, "pool", task, name)
    first = recording.model_copy(update={"scenes": 1, "spins_per_scene": 1, "cavs": 1, "frames": None})
    with tempfile.TemporaryDirectory() as unused:  # compiles what the recording calls
        record_frames(first, graph.beside, Path(unused) / "first", ignore_progress)
    began = time.perf_counter()
    record_frames(recording.model_copy(update={"scenes": 1}), graph.beside, folder, ignore_progress).save(folder)
    split = Frames.open(folder)
    took_s = time.perf_counter() - began
    return split, len(split.vehicles) * recording.scenes * len(pools), took_s / len(split.data)


def _plan_settings(graph: Graph, arm: str) -> FirstPlanSettings:
    name = graph.names.plan(arm)
    return next(step.arguments["settings"] for step in graph.steps if step.name == name)


def _plan_arm(graph: Graph, arm: Setting, measured: Mapping[str, _Measured]) -> dict[str, PlannedRounds]:
    """Return the plan of an arm's tasks, with the rounds that its privacy budget affords."""
    settings = _plan_settings(graph, arm.name)
    requests = []
    for name, task in settings.tasks.items():
        sizes = _size_messages(settings, name, measured[name])
        history = None if task.history is None else parse_history(name, task.history, name)
        requests.append(PlanRequest(name, task.weight, sizes, measured[name].pool, history, task.fixed, task.train_s))
    plan, _ = make_plan(tuple(requests), frame_plan(settings), settings.rule)
    planned = {}
    for name, entry in plan.tasks.items():
        further = entry.cloud_rounds * (k := arm.federation.edge_rounds_per_cloud_round)
        vehicles = [graph.vehicles[region] for region in arm.regions]
        private = plan_private_rounds(
            arm.federation, vehicles, entry.edge_rounds, further if arm.stages[-1] in (CLOUD, MORE_EDGE) else 0, k
        )
        found = find_budget_noise(arm.federation, private.rules)
        counts = (entry.samples, private.edge, private.further // k)
        planned[name] = PlannedRounds(*counts, found, measure_noise(graph, arm, name, private.rules))
    return planned


def measure_noise(graph: Graph, arm: Setting, task: str, rules: Federation) -> RoundNoise | None:
    """Return the noise of a round of an arm in the region with the fewest vehicles in a round; None without noise.

    Noise hides one vehicle, whatever the number of them: it is largest relative to the mean update of the fewest.
    """
    if rules.privacy is None or arm.central:
        return None
    weights = to_arrays(graph.learning(arm, task).resolve().build_network())
    sent = {*rules.upload.exchanged(weights)}
    values = sum(weights[name].size for name in learned_names(weights) if name in sent)
    strategy, _ = find_strategies(rules)
    if isinstance(strategy, FedBuff):
        return measure_round_noise(rules.privacy, strategy.buffer, values)
    names = ([str(number) for number in range(graph.vehicles[region])] for region in arm.regions)
    fewest = min(expected_clients(rules.selection, vehicles) for vehicles in names)
    return measure_round_noise(rules.privacy, fewest, values)


def _size_messages(settings: FirstPlanSettings, task: str, measured: _Measured) -> MessageSizes:
    network = settings.tasks[task].network
    return MessageSizes(measured.sample_mb, model_mb(task_named(task), network, settings.updates), measured.exchange_mb)


def _forecast_arm(
    graph: Graph,
    arm: Setting,
    plans: Mapping[str, Mapping[str, PlannedRounds]],
    measured: Mapping[str, _Measured],
) -> ArmForecast:
    settings = _plan_settings(graph, arm.name)
    k = arm.federation.edge_rounds_per_cloud_round
    groups = tuple(graph.vehicles[region] for region in arm.regions)
    uplink_mb = np.zeros(2)  # wireless, wireline
    for task, planned in plans[arm.name].items():
        cloud = planned.cloud_rounds if CLOUD in arm.stages else 0
        edge = 0 if arm.central else planned.edge_rounds + (planned.cloud_rounds * k if MORE_EDGE in arm.stages else 0)
        sizes = measured[task]
        sent = price(StagePlan(planned.samples, edge, cloud, groups, k), _size_messages(settings, task, sizes))
        uplink_mb += (sent.wireless_mb, sent.wireline_mb)
        uplink_mb += (arm.uploads or 0) * len(groups) * (sizes.compressed_mb if arm.compressed else sizes.sample_mb)
    trainings = [
        PrivateTraining(region, graph.vehicles[region], planned.edge_rounds + planned.cloud_rounds * k, planned.noise)
        for repeat in range(1 + graph.recipe.retrainings)
        for planned in plans[arm.name].values()
        for region in arm.regions
    ]
    spent = None if arm.central else compose_trainings(arm.federation, trainings)
    return ArmForecast(plans[arm.name], dict(zip(("wireless", "wireline"), uplink_mb.tolist())), spent)


def _count_frames(graph: Graph) -> dict[tuple[str, str], int]:
    """Return the most frames that vehicles record, by step and task, windows for labels included."""
    recorded = {step.name: step.arguments["settings"].recipe for step in graph.steps if step.run is record_step}
    named = {
        (graph.names.recording(region, split, task), task)
        for region, place in graph.recipe.regions.items()
        for split in SPLITS_OF[place.role]
        for task in graph.recipe.tasks
    }
    count = {name: recipe.scenes * recipe.spins * recipe.cavs for name, recipe in recorded.items()}
    return {(name, task): count[name] for name, task in sorted(named) if name in recorded}


def _list_seconds(
    graph: Graph, plans: Mapping[str, Mapping[str, PlannedRounds]], measured: Mapping[str, _Measured]
) -> Iterator[float]:
    """Yield the times of all recordings, trainings and tests [s]; steps that arms share count once."""
    recipe, names, steps = graph.recipe, graph.names, {step.name for step in graph.steps}
    size = recipe.sized_splits
    counted = set[str]()

    def once(step: str, seconds: float) -> float:
        new = step in steps and step not in counted
        counted.add(step)
        return seconds if new else 0.0

    for (recording, task), frames in _count_frames(graph).items():
        yield once(recording, frames * measured[task].frame_s)
    for task, times in measured.items():
        for arm in graph.settings.values():
            plan, training = plans[arm.name][task], arm.training[task]
            yield once(names.pretrain(arm.name, task), training.steps * times.step_s)
            per_round = {region: graph.vehicles[region] * training.local_steps * times.step_s for region in arm.regions}
            k = arm.federation.edge_rounds_per_cloud_round
            rounds = {EDGE: plan.edge_rounds, CENTRAL: plan.edge_rounds, MORE_EDGE: plan.cloud_rounds * k}
            for stage in arm.stages:
                if stage == CLOUD:
                    yield once(names.cloud(arm.name, task), plan.cloud_rounds * k * sum(per_round.values()))
                    continue
                for region in arm.regions:
                    yield once(names.stage(arm.name, stage, region, task), rounds[stage] * per_round[region])
            frames = size.test.scenes * size.test.spins * size.test.cavs
            for stage, region, tested in graph.tested(arm):
                if tested == task:
                    trained = names.stage(arm.name, stage, region, task)
                    yield once(names.test(trained, region, None), frames * times.test_s)
        watched = size.validation.scenes * size.validation.spins * size.validation.cavs
        main = plans[MAIN][task]
        for stage, region, tested in graph.watched():
            if tested == task:
                rounds_done = {PRETRAIN: 0, EDGE: main.edge_rounds, CLOUD: main.cloud_rounds}.get(stage, 0)
                trained = names.stage(MAIN, stage, region, task)
                yield once(names.rounds(trained, region), (1 + rounds_done) * watched * times.test_s)
        for further in load_all(FORECASTS):
            yield further(graph, task, plans[MAIN][task].edge_rounds, times.step_s, times.test_s)
