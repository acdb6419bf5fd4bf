"""Plans by the importance of tasks in two domains, and what they gain in closed loop.

Two domains have the same towns and events, in clear weather and in fog. In each, the importance of a task is the
driving score lost without it, at the caution that it spares (`flcav.driving.studies.importance`); importances are the
weights by which objects, signs and weather share both uplink budgets. A plan drives by the package's model of errors,
in which the rates of what is found, or read, are multiplied by the accuracy that the curves predict for the plan, as a
share of the most that they predict for any plan within their counts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flcav.driving.errors import ErrorModel, load_error_model
from flcav.driving.jobs import DriveJob, Sensed, run_jobs
from flcav.driving.loop import Loop
from flcav.driving.measures import DriveResult
from flcav.driving.scenarios import DrivingScenario, spread_scenarios
from flcav.driving.studies.importance import TaskImportance, compare_drives, mean_measure, weigh
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.interface.progress import Report
from flcav.network.plan import MessageSizes
from flcav.optimization.curves.curves import OwnCurve
from flcav.optimization.curves.fitting import fit
from flcav.optimization.problem import Budgets
from flcav.reproductions.fig6b.run import TASKS, Plan
from flcav.reproductions.plan_search.run import FLEETS, PROBLEMS, SIZES_MB, pose
from flcav.runs.allocation import allocate_tasks
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.tables import load_known_history
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import describe_means, judge_means
from flcav.storage.markdown import format_table
from flcav.storage.records import Record
from flcav.world.weather import WEATHER_CLASSES

DOMAINS = ("clear", "fog")  # also the weather of its scenarios
EQUAL = "equal importances"
PLANS = (*DOMAINS, EQUAL)
BUDGET_MB = 160.0  # of either link
LEAST_WEIGHT = 0.01  # of a task that driving does not miss
LASTS_S = 12.0
SEEDS, FIRST_SEED = 1, 801  # by which importance is measured
DRIVEN_FIRST = 851  # first seed of the drives by the plans
MEASURES = ("score", "progress", "faults", "red_lights")


@dataclass(frozen=True)
class Planned:
    """A plan, and the accuracies that the curves predict."""

    weights: Mapping[str, float]  # by task
    plan: Plan
    accuracy: Mapping[str, float]
    share: Mapping[str, float]  # of the most that the curve predicts within its counts


@dataclass(frozen=True)
class Driven:
    """Measures of the drives in a domain by a plan, with intervals over scenarios."""

    score: Estimate
    progress: Estimate
    faults: Estimate  # collisions at fault of a drive
    red_lights: Estimate  # passed in a drive


@dataclass(frozen=True)
class DomainPlans(Record):
    """Importances and plans by domain, and the drives by each plan in each domain."""

    scenarios: int
    seeds: int  # of each scenario, in the drives by plans
    budget_mb: float  # of either link
    lost: Mapping[str, Mapping[str, Estimate]]  # driving score lost without a task, by domain and task
    plans: Mapping[str, Planned]
    driven: Mapping[str, Mapping[str, Driven]]  # by domain and plan
    claims: Mapping[str, MeanOverSeeds]  # differences in the driving score, over scenarios in place of seeds
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return plans and differences in words."""
        told = [f"plan for {name}: {describe_plan(planned.plan)}" for name, planned in self.plans.items()]
        return [*told, *describe_means(self.claims)]


def describe_plan(plan: Plan) -> str:
    """Return samples, edge and cloud rounds of each task as text."""
    return ", ".join(f"{task} {'/'.join(map(str, plan[task]))}" for task in TASKS)


def list_scenarios(domain: str, count: int) -> list[DrivingScenario]:
    """Return towns and events of the package's scenarios, at most `count`, in the weather of a domain."""
    distinct = {(scenario.town, scenario.event): scenario for scenario in spread_scenarios(32)}
    chosen = [*distinct.values()][:count]
    return [replace(scenario, name=f"{scenario.town}-{scenario.event}-{domain}", weather=domain) for scenario in chosen]


def measure_lost(
    scenarios: Sequence[DrivingScenario], model: ErrorModel, jobs: int, progress: Report, kept: Path
) -> tuple[TaskImportance, ...]:
    """Return the importance of each allocated task, with the caution that a driver needs without it."""
    seeds = range(FIRST_SEED, FIRST_SEED + SEEDS)
    names = [scenario.name for _ in seeds for scenario in scenarios]

    def drive(task: str | None) -> list[DriveResult]:
        loop = Loop(lasts_s=LASTS_S)
        driven = [DriveJob(scenario, seed, task, "cautious", loop) for seed in seeds for scenario in scenarios]
        return run_jobs(driven, Sensed("model", model), jobs, progress, kept)

    whole = drive(None)
    return weigh([compare_drives(task, whole, drive(task), names) for task in TASKS])


def weigh_tasks(importances: Sequence[TaskImportance]) -> dict[str, float]:
    """Return the weights of the tasks, which sum to 1: scores lost without them, at least `LEAST_WEIGHT`."""
    least = {each.task: max(each.weight, LEAST_WEIGHT) for each in importances}
    return {task: weight / sum(least.values()) for task, weight in least.items()}


def plan_tasks(weights: Mapping[str, float], curves: Mapping[str, OwnCurve], budget_mb: float = BUDGET_MB) -> Planned:
    """Return the joint plan by weights, as `flcav allocate` makes it, within the counts of the histories."""
    problem = next(each for each in PROBLEMS if set(each.tasks) == set(TASKS))
    sizes = {task: MessageSizes(*SIZES_MB[history], None) for task, history in problem.tasks.items()}
    posed = pose(problem, sizes, FLEETS[0], [weights[task] for task in problem.tasks])
    budgets = Budgets(wireless=budget_mb, wireline=budget_mb)
    tasks = allocate_tasks(posed.model_copy(update={"budgets_mb": budgets}))[0]
    plan = {task.name: (task.samples, task.edge_rounds, task.cloud_rounds) for task in tasks}
    most = {task: load_known_history(task).resources.max(axis=0).tolist() for task in TASKS}  # counts
    accuracy = {task: 1 - float(curves[task].error(*plan[task], 1)) for task in TASKS}
    best = {task: 1 - float(curves[task].error(*most[task], k=1)) for task in TASKS}
    return Planned(weights, plan, accuracy, {task: accuracy[task] / best[task] for task in TASKS})


def spoil(model: ErrorModel, share: Mapping[str, float]) -> ErrorModel:
    """Return a model of errors whose rates of what is found, or read, are multiplied by a share for each task.

    Weather that is no longer read correctly is read as any other class.
    """
    objects, signs, weather = (share[task] for task in ("objects", "signs", "weather"))

    def misread(true: str, found: Mapping[str, float]) -> dict[str, float]:
        lost = (1 - weather) * found[true]
        others = [name for name in WEATHER_CLASSES if name != true]
        read = {name: found.get(name, 0.0) + lost / len(others) for name in others}
        return {true: weather * found[true], **read}

    return replace(
        model,
        detected={label: tuple(objects * rate for rate in rates) for label, rates in model.detected.items()},
        lights=(signs * model.lights[0], model.lights[1]),
        weather={true: misread(true, found) for true, found in model.weather.items()},
    )


def compare_domains(out: Path, scenarios: int, seeds: int, jobs: int, progress: Report) -> DomainPlans:
    """Measure importances, make the plans, and drive by them; drives are kept in `out`."""
    model, kept = load_error_model(), out / "drives.jsonl"
    curves = {task: fit(load_known_history(task), model="best").curve for task in TASKS}
    lost: dict[str, dict[str, Estimate]] = {}
    weights: dict[str, Mapping[str, float]] = {EQUAL: {task: 1 / len(TASKS) for task in TASKS}}
    for domain in DOMAINS:
        importances = measure_lost(list_scenarios(domain, scenarios), model, jobs, progress, kept)
        lost[domain] = {each.task: negate(each.differences["score"]) for each in importances}
        weights[domain] = weigh_tasks(importances)
    plans = {name: plan_tasks(weights[name], curves) for name in PLANS}
    drives: dict[str, dict[str, list[DriveResult]]] = {}
    for domain in DOMAINS:
        driven = [
            DriveJob(scenario, seed, loop=Loop(lasts_s=LASTS_S))
            for seed in range(DRIVEN_FIRST, DRIVEN_FIRST + seeds)
            for scenario in list_scenarios(domain, scenarios)
        ]
        drives[domain] = {
            name: run_jobs(driven, Sensed("model", spoil(model, planned.share)), jobs, progress, kept)
            for name, planned in plans.items()
        }
    return summarise(scenarios, seeds, lost, plans, drives)


def negate(difference: Estimate) -> Estimate:
    """Return the estimate of what is lost, from that of a difference."""
    assert difference.low is not None
    assert difference.high is not None
    return Estimate(-difference.mean, -difference.high, -difference.low)


def summarise(
    scenarios: int,
    seeds: int,
    lost: Mapping[str, Mapping[str, Estimate]],
    plans: Mapping[str, Planned],
    drives: Mapping[str, Mapping[str, Sequence[DriveResult]]],
) -> DomainPlans:
    """Return the comparison of the drives, by domain and plan, which are of the same scenarios and seeds."""
    claims = {
        f"in {domain}: plan for {domain} - {other if other == EQUAL else f'plan for {other}'}": lead_over_scenarios(
            of_plan[domain], of_plan[other]
        )
        for domain, of_plan in drives.items()
        for other in PLANS
        if other != domain
    }
    driven = {
        domain: {
            name: Driven(**{measure: mean_measure(own, measure) for measure in MEASURES})
            for name, own in of_plan.items()
        }
        for domain, of_plan in drives.items()
    }
    return DomainPlans(scenarios, seeds, BUDGET_MB, lost, plans, driven, claims, provenance())


def lead_over_scenarios(own: Sequence[DriveResult], other: Sequence[DriveResult]) -> MeanOverSeeds:
    """Return the mean difference in the driving score over scenarios, each in the mean over its seeds."""
    by_scenario: dict[str, list[float]] = {}
    for one, two in zip(own, other, strict=True):
        by_scenario.setdefault(one.scenario, []).append(one.score - two.score)
    return mean_over_seeds([float(np.mean(each)) for each in by_scenario.values()])


def tabulate_domains(results: DomainPlans) -> dict[str, str]:
    """Return Markdown by name: importance, plans, drives, claims."""
    heads = ("task", *(f"{domain}: driving score lost without it" for domain in DOMAINS))
    tasks = next(iter(results.lost.values()))
    importance = [[task, *(results.lost[domain][task].describe(sign=True) for domain in DOMAINS)] for task in tasks]
    plans = [
        [
            name,
            *(
                f"{planned.weights[task]:.2f}: {'/'.join(map(str, planned.plan[task]))}, {planned.accuracy[task]:.3f}"
                for task in TASKS
            ),
        ]
        for name, planned in results.plans.items()
    ]
    drives = [
        [domain, name, *(getattr(own, measure).describe() for measure in MEASURES)]
        for domain, of_plan in results.driven.items()
        for name, own in of_plan.items()
    ]
    judged = judge_means(results.claims)
    claims = [
        [name, mean.describe(sign=True), judged[name].p_cell, judged[name].verdict, judged[name].takes_cell]
        for name, mean in results.claims.items()
    ]
    return {
        "importance": format_table(heads, importance),
        "plans": format_table(("plan for", *(f"{task}: weight: counts, accuracy" for task in TASKS)), plans),
        "drives": format_table(
            ("domain", "plan for", "score", "progress", "collisions at fault a drive", "red lights passed a drive"),
            drives,
        ),
        "claims": format_table(
            (
                "difference in the driving score",
                "mean over scenarios",
                "p, corrected",
                "claim that it is positive",
                "if undecided: scenarios that tell",
            ),
            claims,
        ),
    }


def _run(out: Path, options: Options) -> Outcome[DomainPlans]:
    with options.show_progress(options.title) as report:
        results = compare_domains(out, 4 if options.quick else 16, options.seeds, options.jobs, report)
    return Outcome(results, {}, results.sentences())


EXPERIMENT = Experiment(DomainPlans, _run, tabulate_domains, seeds=1, takes=("seeds", "scale", "jobs"))
