"""Importance of perception tasks for driving: ablation in closed loop, paired over scenarios and seeds.

The importance of a task is the driving score that is lost without it, at least 0; weights are importances scaled to
sum to 1, as in `optimization.allocation.allocate.resolve_problem`. For comparison, the article's rule (Wang et al.,
IEEE Network 37(3), 2023) is the loss of the joint objective without the task. With the mean score of the tasks as joint
objective, a task's loss is its score.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from flcav.driving.jobs import DriveJob, Sensed, run_jobs
from flcav.driving.loop import Loop
from flcav.driving.measures import DriveResult
from flcav.driving.scenarios import DrivingScenario
from flcav.driving.seen import FEEDS, TASKS, Coupling
from flcav.geometry import Array
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.tasks import task_named
from flcav.perception.weights import find_shipped, read_card
from flcav.statistics.bootstrap import bootstrap_over_scenes
from flcav.statistics.estimates import Estimate
from flcav.statistics.streams import stream
from flcav.storage.records import Record

COUPLINGS: tuple[Coupling, ...] = get_args(Coupling)
WHOLE = "all tasks"
MEASURES: Mapping[str, str] = {  # field of a drive -> words
    "score": "driving score",
    "progress": "progress",
    "faults": "collisions at fault",
    "least_ttc_s": "least time to collision [s]",
    "near_share": "share of time below 1.5 s to collision",
    "hard_brakes": "hard brakes",
    "red_lights": "red lights passed",
}


@dataclass(frozen=True)
class TaskImportance(Record):
    """Importance of one perception task: changes of the driving measures without it."""

    task: str
    feeds: str  # what the driver uses its output for, in words
    differences: Mapping[str, Estimate]  # by field of `MEASURES`: without the task minus with all tasks
    weight: float


@dataclass(frozen=True)
class Importance(Record):
    """Importances of the perception tasks by coupling, and their weights by the article's rule."""

    perception: str
    scenarios: int
    seeds: int
    whole: Mapping[str, float]  # means of `MEASURES` with all tasks
    tasks: Mapping[str, tuple[TaskImportance, ...]]  # by coupling
    article: Mapping[str, float]  # weights by the article's rule
    agreement: float  # Kendall's tau between the couplings' rankings

    def lines(self) -> list[str]:
        """Return the importances in words."""
        means = ", ".join(f"{MEASURES[name]} {value:.2f}" for name, value in self.whole.items())
        lines = [f"{self.scenarios} scenarios x {self.seeds} seeds, perception: {self.perception}", f"{WHOLE}: {means}"]
        for coupling, tasks in self.tasks.items():
            lines.append(f"without a task, {coupling}:")
            for task in sorted(tasks, key=lambda one: -one.weight):
                changes = "; ".join(f"{MEASURES[n]} {d.describe(sign=True)}" for n, d in task.differences.items())
                lines.append(f"    {task.task}: weight {task.weight:.2f}; {changes}")
        article = ", ".join(f"{name} {weight:.2f}" for name, weight in self.article.items())
        lines.append(f"weights by the article's rule: {article}")
        lines.append(f"agreement of the couplings' rankings (Kendall's tau): {self.agreement:.2f}")
        return lines


def read_reached() -> dict[str, float]:
    """Return the best validation score of the package's network of each task, as on its model card."""
    return {name: max(read_card(find_shipped(task_named(name))).learning.scores or (0.0,)) for name in TASKS}


def measure_importance(
    scenarios: Sequence[DrivingScenario],
    seeds: Sequence[int],
    sensed: Sensed,
    reached: Mapping[str, float],
    *,
    lasts_s: float = 20.0,
    processes: int = 1,
    progress: Report = ignore_progress,
    kept: Path | None = None,
) -> Importance:
    """Return the importance of each task in both couplings.

    `reached` is the score of each task's network, 0 to 1, for the article's rule; drives last at most `lasts_s` [s];
    `kept` as in `jobs.run_jobs`. Raises `ValueError` without scenarios or seeds.
    """
    if not scenarios or not seeds:
        raise ValueError("importance needs a scenario and a seed")
    loop = Loop(lasts_s=lasts_s)
    arms: list[tuple[str | None, Coupling]] = [(None, "bare"), *((t, c) for c in COUPLINGS for t in TASKS)]
    keys = [(seed, arm, scenario) for seed in seeds for arm in arms for scenario in scenarios]
    jobs = [DriveJob(scenario, seed, task, coupling, loop) for seed, (task, coupling), scenario in keys]
    drives = run_jobs(jobs, sensed, processes, progress, kept)
    by_arm = {arm: [drive for drive, (_, driven, _) in zip(drives, keys) if driven == arm] for arm in arms}
    names = [scenario.name for _ in seeds for scenario in scenarios]
    whole = by_arm[None, "bare"]
    tasks = {c: weigh([compare_drives(t, whole, by_arm[t, c], names) for t in TASKS]) for c in COUPLINGS}
    ranks = [[task.differences["score"].mean for task in tasks[c]] for c in COUPLINGS]
    total = sum(reached.values())
    return Importance(
        perception=sensed.kind,
        scenarios=len(scenarios),
        seeds=len(seeds),
        whole={name: float(np.mean([getattr(drive, name) for drive in whole])) for name in MEASURES},
        tasks=tasks,
        article={task: reached[task] / total for task in TASKS},
        agreement=kendall(*ranks),
    )


def compare_drives(
    task: str, whole: Sequence[DriveResult], without: Sequence[DriveResult], names: Sequence[str]
) -> TaskImportance:
    """Return the paired differences of drives without a task minus drives with all tasks; `weigh` sets the weight."""
    differences = {name: paired_difference(whole, without, names, name) for name in MEASURES}
    return TaskImportance(task, FEEDS[task], differences, 0.0)


def paired_difference(
    first: Sequence[DriveResult], second: Sequence[DriveResult], names: Sequence[str], field: str
) -> Estimate:
    """Return the mean paired difference of a measure, second minus first, with its bootstrap interval over scenarios.

    The seeds of a scenario are resampled together.
    """
    off = np.array([float(getattr(b, field)) - float(getattr(a, field)) for a, b in zip(first, second, strict=True)])
    return _mean_over(off, names, field)


def mean_measure(drives: Sequence[DriveResult], field: str) -> Estimate:
    """Return the mean of a measure, with its bootstrap interval over scenarios, or over seeds for a single scenario."""
    names = [drive.scenario for drive in drives]
    groups = names if len(set(names)) > 1 else [str(drive.seed) for drive in drives]
    return _mean_over(np.array([float(getattr(drive, field)) for drive in drives]), groups, field)


def _mean_over(values: Array, groups: Sequence[str], field: str) -> Estimate:
    def mean(counts: np.ndarray) -> np.ndarray:
        return (counts @ values) / np.maximum(counts.sum(axis=1), 1)

    if len(set(groups)) < 2:
        return Estimate(float(values.mean()), None, None)
    low, high = bootstrap_over_scenes(mean, groups, rng=stream(0, "importance", field))
    return Estimate(float(values.mean()), low, high)


def weigh(tasks: Sequence[TaskImportance]) -> tuple[TaskImportance, ...]:
    """Return the tasks with their weights: lost driving scores, at least 0, scaled to sum to 1; equal if all are 0."""
    lost = np.array([max(-task.differences["score"].mean, 0.0) for task in tasks])
    weight = lost / lost.sum() if lost.sum() > 0 else np.full(len(tasks), 1 / len(tasks))
    return tuple(replace(task, weight=float(w)) for task, w in zip(tasks, weight))


def kendall(first: Sequence[float], second: Sequence[float]) -> float:
    """Return Kendall's rank correlation tau-a of two sequences of the same items."""
    a, b = np.array(first), np.array(second)
    sign = np.sign(a[:, None] - a) * np.sign(b[:, None] - b)
    return float(sign.sum() / (len(a) * (len(a) - 1)))
