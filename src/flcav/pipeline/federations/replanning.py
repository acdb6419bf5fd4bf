"""Plans of the rest of a stage, made anew after each of its rounds, from what it has reached and sent.

The edge server of a region plans its rest of stage II, and the cloud that of stage III for all regions together; what
others do is taken as planned. Megabytes that rounds cost less than planned go back to what is left. A plan is a
function of what a checkpoint holds, so that a federation that goes on after a kill makes the same ones.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from flcav.federation.rules import Rules
from flcav.federation.runtimes.metered import Outage
from flcav.federation.stages import Schedule
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.network.ledger import BYTES_PER_MB, LINKS, Ledger
from flcav.network.plan import MessageSizes, Price, StagePlan, price
from flcav.optimization.allocation.replanning import PlanState, TaskState, condition_problem
from flcav.optimization.problem import AllocationTask, Problem
from flcav.optimization.solvers.instance import Infeasible, price_counts
from flcav.pipeline.frames import Frames
from flcav.pipeline.planning import allocate_tasks, continue_joins, make_task_plan
from flcav.pipeline.recipe import CLOUD, EDGE, PRETRAIN
from flcav.pipeline.results import Plan, RoundPlan, TaskPlan

LEAST_MB = 1e-9  # of a budget, which is above 0


@dataclass(frozen=True)
class Terms:
    """Prices and budgets of a stage: what its rounds cost, and what may be sent in it and after it.

    Of stage II they are those of one region, whose part of the wireline is the same as that of each other region.
    """

    stage: Literal["edge", "cloud"]
    groups: tuple[int, ...]  # vehicles of each edge server
    k: int  # edge rounds per cloud round
    allowed_mb: Price  # by the plan, headroom left out, with what the stage's ledger begins with
    budget_mb: Price  # by the ledger

    def rounds(self, plan: TaskPlan) -> int:
        """Return the rounds of the stage by a plan."""
        return plan.edge_rounds if self.stage == EDGE else plan.cloud_rounds

    def counts(self, plan: TaskPlan, done: int) -> tuple[int, int, int]:
        """Return samples, edge rounds and cloud rounds after `done` rounds of the stage."""
        return (plan.samples, done, 0) if self.stage == EDGE else (plan.samples, plan.edge_rounds, done)

    def price(self, plan: TaskPlan, done: int) -> Price:
        """Return the list price of what the ledger holds after `done` rounds: of stage II without the samples."""
        _, edge, cloud = self.counts(plan, done)
        samples_mb = 0.0 if self.stage == EDGE else plan.samples * plan.sample_mb
        rounds = price_rounds(plan, self.groups, self.k, edge, cloud)
        return Price(rounds.wireless_mb + samples_mb, rounds.wireline_mb + samples_mb)

    def price_rest(self, plan: TaskPlan, done: int) -> Price:
        """Return the list price of what a plan does after `done` rounds of the stage, stages after it included."""
        edge = plan.edge_rounds - done if self.stage == EDGE else 0
        cloud = plan.cloud_rounds - (done if self.stage == CLOUD else 0)
        return price_rounds(plan, self.groups, self.k, edge, cloud)

    def cut(self, plan: TaskPlan, done: int, sent_mb: Price) -> TaskPlan:
        """Return the plan with no more rounds of the stage than the ledger pays, what comes after it included."""
        name = f"{self.stage}_rounds"
        after = self.price_rest(replace(plan, **{name: done}), done)
        one = price_rounds(plan, self.groups, self.k, int(self.stage == EDGE), int(self.stage == CLOUD))
        free = _minus(_minus(self.budget_mb, sent_mb), after)
        paid = [int(max(mb, 0.0) // cost) for mb, cost in zip(_links(free), _links(one), strict=True) if cost > 0]
        return replace(plan, **{name: min(self.rounds(plan), done + min(paid))})

    def settle(self, plan: TaskPlan, done: int, sent_mb: Price) -> TaskPlan:
        """Return the plan with its megabytes: what was sent, and the list price of the rest."""
        return settle(plan, self.price_rest(plan, done), sent_mb)


def price_rounds(plan: TaskPlan, groups: tuple[int, ...], k: int, edge_rounds: int, cloud_rounds: int) -> Price:
    """Return the list price of rounds of a task; `groups`: vehicles of each edge server, `k`: as in `StagePlan`."""
    return price(StagePlan(0, edge_rounds, cloud_rounds, groups, k), MessageSizes(plan.sample_mb, plan.model_mb))


def settle(plan: TaskPlan, rest: Price, sent_mb: Price) -> TaskPlan:
    """Return the plan with its megabytes: what was sent, and the price of the rest."""
    wireless, wireline = (a + b for a, b in zip(_links(sent_mb), _links(rest), strict=True))
    return replace(plan, wireless_mb=wireless, wireline_mb=wireline)


class Replan(Protocol):
    """Whatever plans the rest of a stage anew."""

    @property
    def terms(self) -> Terms:
        """Return what rounds cost and may cost."""
        ...

    def replan(self, before: TaskPlan, done: int, reached: float | None, sent_mb: Price) -> TaskPlan:
        """Return the plan after `done` rounds of the stage; `before` is the one made before the last of them.

        reached: score on validation frames. sent_mb: sent upwards until then.
        """
        ...


@dataclass(frozen=True)
class Planner:
    """Planner of the rest of a stage of one task by its learning curve, under what is left of both budgets."""

    problem: Problem  # of stage II that of the region, see `restrict_problem`
    plan: Plan  # of all tasks at the beginning of the stage: others are carried out as it says
    task: str
    terms: Terms

    def replan(self, before: TaskPlan, done: int, reached: float | None, sent_mb: Price) -> TaskPlan:
        """Return the plan of least predicted error that goes on from here; see `Replan`.

        The plan before is not cut as long as the ledger pays it: the headroom is for what messages differ by. Where
        what is left allows no plan within the limits, it is the plan before with the rounds that are still paid.
        """
        terms, k = self.terms, self.problem.edge_rounds_per_cloud_round
        counts = terms.counts(before, done)
        tasks = {task.name: task for task in self.problem.tasks}
        others = [_pin(task, self.plan.tasks[task.name]) for task in self.problem.tasks if task.name != self.task]
        list_price = price_counts(self.problem, tasks[self.task], counts)
        paid = [price_counts(self.problem, each, _least(each)) for each in others]
        rest = _links(terms.price_rest(before, done))
        free, most = (_links(_minus(whole, sent_mb)) for whole in (terms.allowed_mb, terms.budget_mb))
        budgets = {
            link: max(left, min(need, hard)) + getattr(list_price, f"{link}_mb") + sum(_on(each, link) for each in paid)
            for link, left, need, hard in zip(LINKS, free, rest, most, strict=True)
        }
        limited = self.problem.budgets_mb.model_copy(update={link: max(mb, LEAST_MB) for link, mb in budgets.items()})
        known = 0 < float(tasks[self.task].curve.error(*counts, k)) < float("inf")
        state = TaskState(
            samples=counts[0],
            edge_rounds=counts[1],
            cloud_rounds=counts[2],
            accuracy=reached if known else None,
            ended=PRETRAIN if terms.stage == EDGE else EDGE,
        )
        pinned = {each.name: each for each in others}
        asked = self.problem.model_copy(
            update={
                "budgets_mb": limited,
                "tasks": tuple(pinned.get(task.name, task) for task in self.problem.tasks),
            }
        )
        asked = condition_problem(asked, PlanState(tasks={self.task: state}))
        try:
            allotted, shares = allocate_tasks(asked)
        except Infeasible:
            return terms.settle(terms.cut(before, done, sent_mb), done, sent_mb)
        own = next(each for each in allotted if each.name == self.task)
        new = make_task_plan(MessageSizes(before.sample_mb, before.model_mb), own, asked, shares)
        over = done if terms.stage == EDGE else before.edge_rounds + k * done
        past = (PRETRAIN,) if terms.stage == EDGE else (PRETRAIN, EDGE)
        predicted = {**(new.predicted or {}), **{each: (before.predicted or {})[each] for each in past}}
        joins = continue_joins(before, new, over)
        new = replace(new, predicted=predicted, joins=joins, uploads=before.uploads)
        return terms.settle(new, done, sent_mb)


@dataclass(frozen=True)
class Follower:
    """Follower of the plans that another federation of the same stage made, as far as its own ledger pays them."""

    plans: Mapping[int, TaskPlan]  # after each of its rounds
    terms: Terms

    def replan(self, before: TaskPlan, done: int, reached: float | None, sent_mb: Price) -> TaskPlan:
        """Return the plan of the federation that is followed; see `Replan`."""
        found = self.plans.get(done, before)
        return self.terms.settle(self.terms.cut(found, done, sent_mb), done, sent_mb)


class Course:
    """The course of a stage: its plan, made anew after each round, and the number of rounds by the plan before each."""

    def __init__(self, plan: TaskPlan, planner: Replan, book: Ledger, most: int | None = None) -> None:
        """Begin with `plan`; `book` is the stage's ledger. most: rounds of the federation that is followed."""
        self.plan, self._planner, self._book, self._most = plan, planner, book, most
        self.made: list[RoundPlan] = []
        self._planned = [planner.terms.rounds(plan)]

    @property
    def rounds(self) -> int:
        """Return the number of rounds of the stage by the plan of now."""
        return self._planned[-1] if self._most is None else min(self._planned[-1], self._most)

    def schedule(self, schedule: Schedule, number: int) -> Schedule:
        """Return the schedule that ends with the round `number`, at the rates of the plans before each round."""
        return replace(schedule, rounds=number, planned=tuple(self._planned[:number]))

    def go_on(self, done: int, reached: float | None) -> None:
        """Plan the rest anew after the round `done`."""
        terms, sent = self._planner.terms, self._sent(done)
        self.plan = self._planner.replan(self.plan, done, reached, sent)
        self._planned.append(max(terms.rounds(self.plan), done))
        self.made.append(RoundPlan(done, reached, terms.price(self.plan, done), sent, self.plan))

    def _sent(self, done: int) -> Price:
        """Return what was sent upwards until the end of the round `done`; the ledger may hold later rounds."""
        terms = self._planner.terms
        sent = dict.fromkeys(LINKS, 0)
        for entry in self._book.entries:
            last = done if terms.stage == EDGE or entry.link == "wireline" else terms.k * done
            if entry.direction == "up" and (entry.stage != terms.stage or entry.round <= last):
                sent[entry.link] += entry.bytes
        return Price(sent["wireless"] / BYTES_PER_MB, sent["wireline"] / BYTES_PER_MB)


class Driven(Protocol):
    """Rounds of a stage: by which rules, and whom the network loses, by round and client."""

    @property
    def rules(self) -> Rules:
        """Return the rules of the rounds."""
        ...

    @property
    def outages(self) -> Mapping[tuple[int, str], Outage]:
        """Return who is lost and why, by round, from 1, and client."""
        ...


@dataclass(frozen=True)
class Replanning:
    """A stage whose rest is planned anew after each round: its course, and how a plan is carried out."""

    course: Course
    drive: Callable[[TaskPlan, int], Driven]  # of the first rounds by a plan, so many
    score: Callable[[Mapping[str, float]], float | None]  # of a round, from the scores by region

    def run(
        self,
        weights: Weights,
        done: int,
        scores: Sequence[Mapping[str, float]],
        run_round: Callable[[Weights, int, Driven], LocalUpdate | None],
    ) -> None:
        """Run the rounds after the first `done` one by one, each followed by a plan of the rest.

        scores: of each round by region, to which `run_round` adds. It returns None for a round that a privacy budget
        does not afford, which is the end.
        """
        for number in range(1, done + 1):
            self.course.go_on(number, self._reached(scores, number))
        while done < self.course.rounds:
            update = run_round(weights, done + 1, self.drive(self.course.plan, done + 1))
            if update is None:
                return
            weights, done = update.weights, done + 1
            self.course.go_on(done, self._reached(scores, done))

    def _reached(self, scores: Sequence[Mapping[str, float]], number: int) -> float | None:
        return self.score(scores[number - 1]) if scores else None


def mean_by_frames(scores: Mapping[str, float], watched: Mapping[str, Frames]) -> float:
    """Return the mean of the regions' scores, weighted by the numbers of frames `watched` in them."""
    return float(
        np.average([scores[name] for name in watched], weights=[len(own.vehicles) for own in watched.values()])
    )


def restrict_problem(problem: Problem, vehicles: Mapping[str, int], region: str) -> Problem:
    """Return the allocation problem of one region's vehicles; `vehicles`: their numbers, in the problem's order.

    Vehicles with names are called "region/vehicle".
    """
    number = [*vehicles].index(region)

    def own(task: AllocationTask) -> AllocationTask:
        named = {
            field: {name: value for name, value in getattr(task, field).items() if name.startswith(f"{region}/")}
            for field in ("uplink_mbps", "data_quality", "vehicle_train_s")
            if getattr(task, field) is not None
        }
        return task.model_copy(update={**named, "edge_groups": (task.edge_groups[number],), "samples_held": {}})

    return problem.model_copy(update={"tasks": tuple(map(own, problem.tasks))})


def _pin(task: AllocationTask, plan: TaskPlan) -> AllocationTask:
    """Return the task with the counts of its plan as its limits."""
    counts = {name: (getattr(plan, name),) * 2 for name in ("samples", "edge_rounds", "cloud_rounds")}
    return task.model_copy(update={"limits": task.limits.model_copy(update=counts)})


def _least(task: AllocationTask) -> tuple[int, int, int]:
    return task.limits.samples[0], task.limits.edge_rounds[0], task.limits.cloud_rounds[0]


def _links(mb: Price) -> tuple[float, float]:
    return mb.wireless_mb, mb.wireline_mb


def _on(mb: Price, link: str) -> float:
    return getattr(mb, f"{link}_mb")


def _minus(mb: Price, less: Price) -> Price:
    return Price(mb.wireless_mb - less.wireless_mb, mb.wireline_mb - less.wireline_mb)
