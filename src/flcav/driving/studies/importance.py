"""Importance of perception tasks for driving: leave a task out of the closed loop, paired over scenarios and seeds.

The importance of a task is the driving score that is lost without it, at least 0; weights are importances scaled to
sum to 1, as in `optimization.allocation.allocate.resolve_problem`. Beside it stands the article's own rule (Wang et
al., IEEE Network 37(3), 2023): the loss of the joint objective without the task, where the joint objective of
perception is the mean of what its tasks reach, so that each loses its own.
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
    """Loss of driving without a perception task; differences are without the task less with all of them."""

    task: str
    feeds: str
    differences: Mapping[str, Estimate]  # by field of `MEASURES`, with intervals over scenarios and seeds
    weight: float


@dataclass(frozen=True)
class Importance(Record):
    """Importances of the tasks by coupling, and the weights by the article's rule."""

    perception: str
    scenarios: int
    seeds: int
    whole: Mapping[str, float]  # mean of each of `MEASURES` with all tasks
    tasks: Mapping[str, tuple[TaskImportance, ...]]  # by coupling
    article: Mapping[str, float]  # weights by the article's rule
    agreement: float  # Kendall's tau between the couplings' rankings

    def lines(self) -> list[str]:
        """Return the importances in words."""
        said = ", ".join(f"{MEASURES[name]} {value:.2f}" for name, value in self.whole.items())
        lines = [f"{self.scenarios} scenarios x {self.seeds} seeds, perception: {self.perception}", f"{WHOLE}: {said}"]
        for coupling, tasks in self.tasks.items():
            lines.append(f"without a task, {coupling}:")
            for each in sorted(tasks, key=lambda one: -one.weight):
                told = "; ".join(f"{MEASURES[n]} {d.describe(sign=True)}" for n, d in each.differences.items())
                lines.append(f"    {each.task}: weight {each.weight:.2f}; {told}")
        article = ", ".join(f"{task} {weight:.2f}" for task, weight in self.article.items())
        lines.append(f"weights by the article's rule: {article}")
        lines.append(f"agreement of the couplings' rankings (Kendall's tau): {self.agreement:.2f}")
        return lines


def read_reached() -> dict[str, float]:
    """Return the best validation score of each task's network of the package, by its card."""
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

    `reached` is what each task's network reaches by its own measure, 0 to 1, for the article's rule; `kept` as in
    `jobs.run_jobs`. Raises `ValueError` without scenarios or seeds.
    """
    if not scenarios or not seeds:
        raise ValueError("importance needs a scenario and a seed")
    loop = Loop(lasts_s=lasts_s)
    arms: list[tuple[str | None, Coupling]] = [(None, "bare"), *((t, c) for c in COUPLINGS for t in TASKS)]
    keys = [(seed, arm, scenario) for seed in seeds for arm in arms for scenario in scenarios]
    jobs = [DriveJob(scenario, seed, task, coupling, loop) for seed, (task, coupling), scenario in keys]
    drives = run_jobs(jobs, sensed, processes, progress, kept)
    by_arm = {arm: [own for own, (_, each, _) in zip(drives, keys) if each == arm] for arm in arms}
    names = [scenario.name for _ in seeds for scenario in scenarios]
    whole = by_arm[None, "bare"]
    tasks = {c: weigh([compare_drives(t, whole, by_arm[t, c], names) for t in TASKS]) for c in COUPLINGS}
    ranks = [[each.differences["score"].mean for each in tasks[c]] for c in COUPLINGS]
    total = sum(reached.values())
    return Importance(
        perception=sensed.kind,
        scenarios=len(scenarios),
        seeds=len(seeds),
        whole={name: float(np.mean([getattr(own, name) for own in whole])) for name in MEASURES},
        tasks=tasks,
        article={task: reached[task] / total for task in TASKS},
        agreement=kendall(*ranks),
    )


def compare_drives(
    task: str, whole: Sequence[DriveResult], without: Sequence[DriveResult], names: Sequence[str]
) -> TaskImportance:
    """Return the paired differences of drives without a task less with it; its weight is not known yet."""
    differences = {name: paired_difference(whole, without, names, name) for name in MEASURES}
    return TaskImportance(task, FEEDS[task], differences, 0.0)


def paired_difference(
    first: Sequence[DriveResult], second: Sequence[DriveResult], names: Sequence[str], field: str
) -> Estimate:
    """Return the mean difference of a measure, second less first, with its interval over scenarios (bootstrap).

    Drives are paired; those of one scenario, the seeds, are drawn together.
    """
    off = np.array([float(getattr(b, field)) - float(getattr(a, field)) for a, b in zip(first, second, strict=True)])
    return _mean_over(off, names, field)


def mean_measure(drives: Sequence[DriveResult], field: str) -> Estimate:
    """Return the mean of a measure, with its interval over scenarios (bootstrap); over seeds where there is one."""
    names = [own.scenario for own in drives]
    groups = names if len(set(names)) > 1 else [str(own.seed) for own in drives]
    return _mean_over(np.array([float(getattr(own, field)) for own in drives]), groups, field)


def _mean_over(values: Array, groups: Sequence[str], field: str) -> Estimate:
    def mean(counts: np.ndarray) -> np.ndarray:
        return (counts @ values) / np.maximum(counts.sum(axis=1), 1)

    if len(set(groups)) < 2:
        return Estimate(float(values.mean()), None, None)
    low, high = bootstrap_over_scenes(mean, groups, rng=stream(0, "importance", field))
    return Estimate(float(values.mean()), low, high)


def weigh(tasks: Sequence[TaskImportance]) -> tuple[TaskImportance, ...]:
    """Return the tasks with their weights: the driving score lost, at least 0, scaled to sum to 1 (all 0: even)."""
    lost = np.array([max(-each.differences["score"].mean, 0.0) for each in tasks])
    weight = lost / lost.sum() if lost.sum() > 0 else np.full(len(tasks), 1 / len(tasks))
    return tuple(replace(each, weight=float(w)) for each, w in zip(tasks, weight))


def kendall(first: Sequence[float], second: Sequence[float]) -> float:
    """Return Kendall's rank correlation tau-a of two sequences of the same items."""
    a, b = np.array(first), np.array(second)
    sign = np.sign(a[:, None] - a) * np.sign(b[:, None] - b)
    return float(sign.sum() / (len(a) * (len(a) - 1)))
