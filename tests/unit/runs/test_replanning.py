"""Plans of the rest of a run: counts by hand, megabytes that return, and vehicles with the time for a round."""

from dataclasses import replace
from typing import Any

import numpy as np

from flcav.network.ledger import LinkMegabytes
from flcav.optimization.problem import Problem
from flcav.optimization.solvers.instance import Infeasible
from flcav.runs.allocation import continue_joins, remake_plan
from flcav.runs.recipe import Federation
from flcav.runs.results.plans import Plan, TaskPlan
from flcav.runs.training.updates import follow_plan

PREDICTED = {"pretrain": 0.4, "edge": 0.6, "cloud": 0.7}


def plan_of(edge: int, cloud: int, samples: int = 10, model_mb: float = 1.0) -> TaskPlan:
    return TaskPlan(samples, edge, cloud, 0.0, 0.0, 0.5, model_mb, PREDICTED)


def problem(cloud: tuple[int, int] = (1, 1), model_mb: float = 1.0, **changes: Any) -> Problem:
    """Return a problem of two regions with two vehicles and one."""
    curve = {
        "model": "additive",
        "pretrain": {"a": 0.4, "b": 0.5},
        "edge": {"a": 0.4, "x0": 1.0},
        "cloud": {"a": 0.3, "x0": 1.0},
    }
    limits = {"samples": (10, 10), "edge_rounds": (1, 12), "cloud_rounds": cloud}
    task = {"name": "t", "sample_mb": 0.5, "model_mb": model_mb, "edge_groups": (2, 1), "limits": limits}
    return Problem.model_validate(
        {"budgets_mb": {"wireless": 99, "wireline": 99}, "tasks": [{**task, "curve": curve}], **changes}
    )


def test_no_vehicle_joins_more_rounds_than_it_has_time_for_after_a_plan_is_made_anew() -> None:
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(200):
        most = {f"{region}/cav{number}": int(rng.integers(1, 7)) for region in "ab" for number in range(3)}
        plans = [replace(plan_of(rounds, 0), joins=joins_of(most, rounds)) for rounds in (4, 4 + int(rng.integers(4)))]
        before, new = plans
        over = int(rng.integers(5))
        assert before.joins is not None
        assert new.joins is not None
        past = {name: [each for each in joined if each <= over] for name, joined in before.joins.items()}
        time = {name: max(most[name], len(joined)) for name, joined in new.joins.items()}  # of so many rounds of 2 s
        spare_s = {name: 2.0 * (time[name] - len(joined)) for name, joined in new.joins.items()}
        task = problem(tasks=[{**problem().tasks[0].model_dump(), "train_s": 2.0}]).tasks[0]
        try:
            joins = continue_joins(before, new, over, task, spare_s)
        except Infeasible:
            left = {name: max(time[name] - len(past[name]), 0) for name in past}
            fewest = min(sum(many for name, many in left.items() if name[0] == region) for region in "ab")
            assert fewest < new.edge_rounds - over
            refused += 1
            continue
        assert joins is not None
        for name, joined in joins.items():
            assert [each for each in joined if each <= over] == past[name]
            assert len({*joined}) == len(joined) <= max(time[name], len(past[name]))
        for region in "ab":
            later = {each for name, joined in joins.items() if name[0] == region for each in joined if each > over}
            assert later == {*range(over + 1, new.edge_rounds + 1)}
    assert 0 < refused < 100


def test_megabytes_that_a_stage_did_not_send_are_further_rounds_of_the_next() -> None:
    plan, asked = Plan("joint", {"t": plan_of(6, 1)}), problem(cloud=(1, 6))
    limited = asked.model_copy(update={"budgets_mb": asked.budgets_mb.model_copy(update={"wireless": 40.0})})
    price = 10 * 0.5 + 6 * 3.0  # of the samples and of six edge rounds of three vehicles
    for sent, rounds in ((price, 5), (price - 3.0, 6), (price - 0.9, 5), (price + 0.1, 5), (price + 3.0, 4)):
        made = remake_plan(plan, limited, "edge", {"t": 0.6}, LinkMegabytes(sent, 5.0))
        assert (made.tasks["t"].edge_rounds, made.tasks["t"].cloud_rounds) == (6, rounds), sent
    none = remake_plan(plan, limited, "edge", {"t": 0.6}, LinkMegabytes(39.9, 5.0))
    assert none.tasks == plan.tasks  # nothing is left for a cloud round


def test_vehicles_join_the_cloud_rounds_that_they_have_time_for() -> None:
    first = replace(plan_of(6, 1), joins=dict.fromkeys(VEHICLES, tuple(range(1, 8))))
    plan = Plan("joint", {"t": first})
    for horizon_s, expected in ((None, {*VEHICLES}), (99.0, {*VEHICLES}), (14.0, {*VEHICLES})):
        made = remake_plan(plan, timed(problem(), horizon_s, "t"), "edge", {"t": 0.6}, LinkMegabytes(0.0, 0.0))
        after = follow_plan(Federation(), made.tasks["t"], after_edge=True).selection.joins
        assert {name for name, own in after.items() if own == (1,)} == expected


def test_all_tasks_go_on_as_planned_where_one_of_them_has_too_little_time_left() -> None:
    first = replace(plan_of(6, 1), joins=dict.fromkeys(VEHICLES, tuple(range(1, 8))))
    late = replace(first, edge_rounds=7, joins=dict.fromkeys(VEHICLES, tuple(range(1, 9))))
    plan, sent = Plan("joint", {"t": first, "u": late}), LinkMegabytes(0.0, 0.0)
    for horizon_s, again in ((28.0, False), (30.0, True)):  # 14 rounds of 2 s, 13 of which are over; 15
        made = remake_plan(plan, timed(problem(), horizon_s, "t", "u"), "edge", dict.fromkeys("tu", 0.6), sent)
        assert (made.tasks != plan.tasks) == again


VEHICLES = ("a/cav0", "a/cav1", "b/cav0")


def timed(asked: Problem, horizon_s: float | None, *names: str) -> Problem:
    """Return the problem of tasks with these names, whose vehicles train for 2 s in a round, within a horizon [s]."""
    own = asked.tasks[0].model_dump() | {"vehicle_train_s": dict.fromkeys(VEHICLES, 2.0)}
    tasks = [own | {"name": name} for name in names]
    return Problem.model_validate(asked.model_dump() | {"horizon_s": horizon_s, "tasks": tasks})


def joins_of(most: dict[str, int], rounds: int) -> dict[str, tuple[int, ...]]:
    """Return the rounds of vehicles, each of so many at most, one vehicle after another."""
    joins = {}
    for region in "ab":
        start = 0
        for name in (each for each in most if each[0] == region):
            count = min(max(most[name], -(-rounds // 3)), rounds)
            joins[name] = tuple(sorted((start + number) % rounds + 1 for number in range(count)))
            start += count
    return joins
