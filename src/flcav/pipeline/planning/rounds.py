"""Plans of the rest of a stage, made anew after each of its rounds, from what it has reached and sent.

The edge server of a region plans its rest of stage II, and the cloud that of stage III for all regions together; what
others do is taken as planned. Megabytes that rounds cost less than planned go back to what is left. A plan is a
function of what a checkpoint holds, so that a federation that goes on after a kill makes the same ones.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

from flcav.network.ledger import LINKS
from flcav.network.plan import Price
from flcav.optimization.allocation.replanning import PlanState, TaskState, condition_problem
from flcav.optimization.problem import AllocationTask, Problem
from flcav.optimization.solvers.instance import Infeasible, price_counts
from flcav.pipeline.planning.allocation import allocate_tasks, make_task_plan
from flcav.pipeline.planning.stages import continue_joins, find_spare
from flcav.pipeline.planning.terms import Terms, links_mb, subtract
from flcav.pipeline.recipe import EDGE, PRETRAIN
from flcav.pipeline.results.plans import Plan, TaskPlan

LEAST_MB = 1e-9  # of a budget, which is above 0


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
        rest = links_mb(terms.price_rest(before, done))
        free, most = (links_mb(subtract(whole, sent_mb)) for whole in (terms.allowed_mb, terms.budget_mb))
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
        over = done if terms.stage == EDGE else before.edge_rounds + k * done
        try:
            allotted, shares = allocate_tasks(asked)
            own = next(each for each in allotted if each.name == self.task)
            new = make_task_plan(before.sizes, own, asked, shares)
            joins = continue_joins(before, new, over, tasks[self.task], find_spare(asked, shares))
        except Infeasible:
            return terms.settle(terms.cut(before, done, sent_mb), done, sent_mb)
        past = (PRETRAIN,) if terms.stage == EDGE else (PRETRAIN, EDGE)
        predicted = {**(new.predicted or {}), **{each: (before.predicted or {})[each] for each in past}}
        new = replace(new, predicted=predicted, joins=joins, uploads=before.uploads, ran=before.ran)
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


def _on(mb: Price, link: str) -> float:
    return getattr(mb, f"{link}_mb")
