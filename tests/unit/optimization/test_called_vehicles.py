"""How many vehicles a plan calls to a group: against trying every number and every plan, and what the verifier says."""

import dataclasses
import json
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_problems import SMALL, parsed, written

from flcav.config import InputError
from flcav.network.plan import MessageSizes, StagePlan, price
from flcav.optimization.allocation.allocate import Allocation, allocate
from flcav.optimization.allocation.baselines import BASELINES, baseline
from flcav.optimization.allocation.replanning import PlanState, condition_problem
from flcav.optimization.verification.allocation import verify_allocation


def calling(seed: int, tasks: int, model: str, budget: float = 300.0, k: int = 1) -> dict[str, Any]:
    """Return a problem as a user writes it, whose plan decides how many vehicles are called."""
    values: dict[str, Any] = written(seed, tasks, model, SMALL, budget, k)
    for number, task in enumerate(values["tasks"]):
        task["called"] = [1, max(task["edge_groups"])]
        if (seed + number) % 3:  # the later ones bring less
            task["worth"] = [0.5**place for place in range(4)]
    return values


def error_of(task: dict[str, Any], called: int, x: int, y: int, z: int, k: int) -> float:
    """Return the error by the formulas of the page, where `called` vehicles of each edge server bring their data."""
    curve, sizes = task["curve"], task["edge_groups"]
    worth = task.get("worth", [1.0] * 4)
    brought, whole = ([sum(worth[: min(n, size)]) for size in sizes] for n in (called, max(sizes)))
    if curve["model"] == "federated":
        held = [own * a / b for own, a, b in zip(curve["group_samples"], brought, whole, strict=True)]
        one, all_ = (sum(each) / len(each) for each in (held, curve["group_samples"]))
        drift = curve["drift"]
        known = one * (1 - 1 / (y + k * z + 1)) + (curve["gamma"] + (k > 0) * (1 - one / all_)) * all_ * z / (z + 1)
        extra = drift * z / (z + 1) if drift > 0 else -drift / (z + 1)
    else:
        share = sum(brought) / sum(whole)
        by_cloud = (k > 0) * (1 - share) * z / (z + 1)  # stage III has all vehicles
        known, extra = curve["group_samples"] * (share * (1 - 1 / (y + k * z + 1)) + by_cloud), 0.0
    power = curve["a"] * (curve["alpha"] * x + curve["beta"] * known) ** -curve["b"]
    return float(curve["floor"] + power + extra)


def search(values: dict[str, Any]) -> tuple[float, list[int]]:
    """Return the best objective and numbers of vehicles, by trying all of them with all samples and rounds."""
    k, largest = values["edge_rounds_per_cloud_round"], values.get("objective") == "max-min"
    budgets, choices = values["budgets_mb"], []
    for task in values["tasks"]:
        own, sizes, model = [], task["edge_groups"], task["model_mb"]
        ranges = (range(low, high + 1) for low, high in task["limits"].values())
        for called, x, y, z in product(range(task["called"][0], task["called"][1] + 1), *ranges):
            if k == 0 and z > 1:
                continue
            cars = sum(min(called, size) for size in sizes)
            wireless = x * task["sample_mb"] + (y * cars + k * z * sum(sizes)) * model
            wireline = x * task["sample_mb"] + z * len(sizes) * model
            if wireless <= budgets["wireless"] and wireline <= budgets["wireline"]:
                own.append(
                    (
                        error_of(task, called, x, y, z, k) * (1 if largest else task["weight"]),
                        wireless,
                        wireline,
                        called,
                    )
                )
        choices.append(np.array(own))
    best, numbers = np.inf, []
    if len(choices) == 1:
        found = choices[0][np.argmin(choices[0][:, 0])]
        return float(found[0]), [int(found[3])]
    for one in choices[0]:
        other = choices[1]
        fits = (one[1] + other[:, 1] <= budgets["wireless"]) & (one[2] + other[:, 2] <= budgets["wireline"])
        if fits.any():
            joined = np.maximum(one[0], other[fits, 0]) if largest else one[0] + other[fits, 0]
            if joined.min() < best:
                best, numbers = float(joined.min()), [int(one[3]), int(other[fits][np.argmin(joined), 3])]
    return best, numbers


def verified(values: dict[str, Any], plan: Allocation) -> tuple[str, ...]:
    told = dataclasses.asdict(plan)
    for name in ("used_mb", "marginal_error_per_gb"):
        told[name] = {link.removesuffix("_mb"): each for link, each in told[name].items()}
    return tuple(verify_allocation(parsed(values).model_dump_json(), json.dumps(told)).faults)


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    tasks=st.integers(1, 2),
    model=st.sampled_from(("effective", "federated")),
    objective=st.sampled_from(("weighted", "max-min")),
    budget=st.floats(60, 600),
    k=st.integers(0, 2),
)
def test_the_number_of_vehicles_is_the_best_of_all_and_the_bound_is_never_above(
    seed: int, tasks: int, model: str, objective: str, budget: float, k: int
) -> None:
    values = calling(seed, tasks, model, budget, k) | {"objective": objective}
    best, _ = search(values)
    plan = allocate(parsed(values))
    assert plan.lower_bound is not None
    assert plan.lower_bound <= best * (1 + 1e-9)
    assert plan.objective == pytest.approx(best, rel=1e-8)
    assert plan.status == "optimal"
    assert verified(values, plan) == ()


def one_task(**changes: Any) -> dict[str, Any]:
    curve = {"model": "effective", "a": 1.0, "b": 0.5, "alpha": 0.1, "beta": 0.5, "group_samples": 400}
    task = {"name": "objects", "sample_mb": 1.0, "model_mb": 2.0, "edge_groups": [8], "called": [1, 8], "curve": curve}
    limits = {"samples": [10, 10], "edge_rounds": [0, 20], "cloud_rounds": [0, 0]}
    budgets = {"wireless": 60.0, "wireline": 60.0}
    return {"budgets_mb": budgets, "edge_rounds_per_cloud_round": 1, "tasks": [task | {"limits": limits} | changes]}


def test_a_plan_trades_vehicles_for_rounds() -> None:
    """By hand: 50 MB after the samples are 25 updates: n vehicles, floor(25 / n) rounds of them; n (1 - 1/(t + 1))."""
    brought = {n: n * (1 - 1 / (25 // n + 1)) for n in range(1, 9)}
    plan = allocate(parsed(one_task())).tasks[0]
    assert plan.called == max(brought, key=lambda n: brought[n]) == 8
    brought = {n: n * (1 - 1 / (7 // n + 1)) for n in range(1, 9)}  # of 7 updates
    values = one_task() | {"budgets_mb": {"wireless": 24.0, "wireline": 60.0}}
    plan = allocate(parsed(values)).tasks[0]
    assert (plan.called, plan.edge_rounds, plan.wireless_mb) == (max(brought, key=lambda n: brought[n]), 1, 24.0)
    dear = one_task(
        edge_groups=[4, 4], called=[1, 4], limits={**one_task()["tasks"][0]["limits"], "edge_rounds": [3, 3]}
    )
    plan = allocate(parsed(dear)).tasks[0]  # three rounds of all cost 48 MB, of three at each server 36 MB
    assert (plan.called, plan.wireless_mb) == (4, 58.0)
    plan = allocate(parsed(dear | {"budgets_mb": {"wireless": 50.0, "wireline": 60.0}})).tasks[0]
    assert (plan.called, plan.wireless_mb) == (3, 46.0)


def test_where_further_vehicles_bring_little_fewer_are_called() -> None:
    """By hand: 25 updates; n vehicles bring (2 - 2^(1 - n)) (1 - 1/(t + 1)) in t = floor(25 / n) rounds."""
    brought = {n: (2 - 2.0 ** (1 - n)) * (1 - 1 / (min(25 // n, 20) + 1)) for n in range(1, 9)}
    plan = allocate(parsed(one_task(worth=[0.5**place for place in range(8)]))).tasks[0]
    assert plan.called == max(brought, key=lambda n: brought[n]) == 5


def test_a_changed_number_of_vehicles_is_found_by_the_verifier() -> None:
    values = one_task() | {"budgets_mb": {"wireless": 40.0, "wireline": 60.0}}
    plan = allocate(parsed(values))
    assert verified(values, plan) == ()
    for called in (1, 9, None):
        other = dataclasses.replace(plan, tasks=(dataclasses.replace(plan.tasks[0], called=called),))
        assert verified(values, other)


def test_stage_three_has_all_vehicles_in_the_price() -> None:
    sizes = MessageSizes(sample_mb=0.5, model_mb=1.0, labels_mb=0.1)
    found = price(StagePlan(0, 4, 2, (5, 3), called=3), sizes)
    assert found.wireless_mb == pytest.approx(4 * 6 * 1.1 + 2 * 8 + 8 * 0.1)
    assert price(StagePlan(0, 4, 2, (5, 3), called=5), sizes) == price(StagePlan(0, 4, 2, (5, 3)), sizes)


def test_after_stage_two_the_number_called_stays_and_what_was_not_sent_is_left() -> None:
    limits = {"samples": [10, 10], "edge_rounds": [0, 4], "cloud_rounds": [0, 9]}
    asked = parsed(one_task(limits=limits) | {"budgets_mb": {"wireless": 100.0, "wireline": 60.0}})
    state = {"samples": 10, "edge_rounds": 4, "called": 3, "ended": "edge"}
    spent = PlanState.model_validate({"tasks": {"objects": state}})
    less = PlanState.model_validate({"tasks": {"objects": state}, "used_mb": {"wireless": 18.0, "wireline": 10.0}})
    rest, unspent = condition_problem(asked, spent), condition_problem(asked, less)
    assert rest.tasks[0].called == (3, 3)
    assert allocate(rest).tasks[0].called == 3
    assert unspent.budgets_mb.wireless == pytest.approx(100 + (10 + 4 * 3 * 2) - 18)  # as after two of the four rounds
    assert [allocate(each).tasks[0].cloud_rounds for each in (rest, unspent)] == [4, 5]  # of 66 and 82 MB at 16 MB
    with pytest.raises(InputError, match="does not call so many"):
        condition_problem(asked, PlanState.model_validate({"tasks": {"objects": {**state, "called": 9}}}))


@pytest.mark.slow
@pytest.mark.parametrize("name", BASELINES)
def test_baselines_call_the_most_and_are_no_better(name: str) -> None:
    values = calling(5, 2, "effective")
    found, plan = baseline(parsed(values), name), allocate(parsed(values))
    assert found.objective >= plan.objective * (1 - 1e-9)
    assert [own.called for own in found.tasks] == [own["called"][1] for own in values["tasks"]]
    assert found.used_mb.wireless_mb <= values["budgets_mb"]["wireless"]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"called": [3, 2]}, "from 3 to 2"),
        ({"called": [1, 9]}, "of 8 at an edge server"),
        ({"worth": [1.0]}, "is of 1 vehicles"),
        ({"worth": [1.0] * 8, "called": None}, "'called' is missing"),
        ({"curve": {"model": "additive"}}, "does not know what data"),
        ({"vehicle_train_s": {f"c{n}": 1.0 for n in range(8)}}, "vehicles with names"),
    ],
)
def test_what_cannot_be_called_is_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        parsed(one_task(**changes))
    many = one_task()
    many["tasks"] = [many["tasks"][0] | {"name": f"t{n}"} for n in range(3)]
    with pytest.raises(InputError, match="512 combinations"):
        allocate(parsed(many))
