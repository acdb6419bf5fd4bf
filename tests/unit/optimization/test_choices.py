"""Local steps and forms of updates that a plan chooses: against trying every choice and plan, and the verifier."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_problems import SMALL, parsed, searched, written

from flcav.config import InputError
from flcav.optimization.allocation.allocate import Allocation, allocate, settle_plan
from flcav.optimization.allocation.baselines import baseline
from flcav.optimization.allocation.fleet import allocate_fleet
from flcav.optimization.allocation.replanning import PlanState, condition_problem
from flcav.optimization.graph import load_problem
from flcav.optimization.verification.allocation import verify_allocation

STEPS = [{"factor": 1}, {"factor": 2, "worth": 1.6}, {"factor": 4, "worth": 2.3}]
FORMS = {"float32": {}, "int8": {"bits": 8.4, "loss": 0.001}, "int4": {"loss": 0.02}}


def choosing(seed: int, tasks: int, model: str, budget: float = 60.0, k: int = 1) -> dict[str, Any]:
    """Return a problem as a user writes it, whose plan decides on local steps and forms."""
    rng = np.random.default_rng(seed)
    values: dict[str, Any] = written(seed, tasks, model, SMALL, budget, k)
    for task in values["tasks"]:
        task["train_s"] = float(rng.uniform(0.5, 3))
        task["local_steps"] = [
            {"factor": 1}, {"factor": float(rng.uniform(0.3, 4)), "worth": float(rng.uniform(0.5, 4))}
        ]  # fmt: skip
        lossy = {"int8": {"loss": 0.01}, "top-k": {"fraction": float(rng.uniform(0.05, 0.3)), "loss": 0.02}}
        task["forms"] = {"float32": {}} | dict([[*lossy.items()][seed % 2]])
    return values | {"horizon_s": float(rng.uniform(15, 40))}


def verified(values: dict[str, Any], plan: Allocation, **changes: Any) -> tuple[str, ...]:
    told = dataclasses.asdict(plan)
    for name in ("used_mb", "marginal_error_per_gb"):
        told[name] = {link.removesuffix("_mb"): each for link, each in told[name].items()}
    told["tasks"] = [told["tasks"][0] | changes, *told["tasks"][1:]]
    return tuple(verify_allocation(parsed(values).model_dump_json(), json.dumps(told)).faults)


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    tasks=st.integers(1, 2),
    model=st.sampled_from(("additive", "shared", "effective", "federated")),
    objective=st.sampled_from(("weighted", "max-min")),
    budget=st.floats(20, 300),
    k=st.integers(0, 2),
)
def test_the_choice_is_the_best_of_all_and_the_bound_is_never_above(
    seed: int, tasks: int, model: str, objective: str, budget: float, k: int
) -> None:
    values = choosing(seed, tasks, model, budget, k) | {"objective": objective}
    best = searched(values)
    plan = allocate(parsed(values))
    assert plan.lower_bound is not None
    assert plan.lower_bound <= best * (1 + 1e-9)
    assert plan.objective == pytest.approx(best, rel=1e-8)
    assert plan.status == "optimal"
    assert verified(values, plan) == ()


def one_task(**changes: Any) -> dict[str, Any]:
    """Return a problem with 10 s to train in: its edge rounds bring 1 / (y + 1) of .4."""
    curve = {"model": "additive", "floor": 0.05, "edge": {"a": 0.4, "b": 1.0, "x0": 1}}
    task = {"name": "objects", "sample_mb": 1.0, "model_mb": 8.0, "edge_groups": [2], "train_s": 1.0, "curve": curve}
    limits = {"samples": [0, 0], "edge_rounds": [0, 20], "cloud_rounds": [0, 0]}
    budgets = {"wireless": 64.0, "wireline": 64.0}
    return {"budgets_mb": budgets, "horizon_s": 10.0, "tasks": [task | {"limits": limits} | changes]}


def chosen(values: dict[str, Any]) -> tuple[float | None, str | None, int, float]:
    plan = allocate(parsed(values))
    own = plan.tasks[0]
    assert verified(values, plan) == ()
    return own.local_steps, own.form, own.edge_rounds, own.predicted_error


def test_few_megabytes_make_steps_worth_their_time_and_few_seconds_make_rounds_small() -> None:
    """By hand: 64 MB are 4 rounds of 16 MB, 15 of 4.2 MB or 32 of 2 MB; 10 s are 10, 5 or 2 rounds."""
    assert chosen(one_task()) == (None, None, 4, pytest.approx(0.05 + 0.4 / 5))
    assert chosen(one_task(local_steps=STEPS)) == (2, None, 4, pytest.approx(0.05 + 0.4 / (1.6 * 4 + 1)))
    assert chosen(one_task(forms=FORMS)) == (None, "int8", 10, pytest.approx(0.05 + 0.001 + 0.4 / 11))
    assert chosen(one_task(local_steps=STEPS, forms=FORMS)) == (1, "int8", 10, pytest.approx(0.051 + 0.4 / 11))
    rich = one_task(local_steps=STEPS, forms=FORMS) | {"budgets_mb": {"wireless": 160.0, "wireline": 1.0}}
    assert chosen(rich) == (1, "float32", 10, pytest.approx(0.05 + 0.4 / 11))
    endless = {**one_task(local_steps=STEPS), "horizon_s": None}  # time costs nothing: the steps of most worth
    assert chosen(endless) == (4, None, 4, pytest.approx(0.05 + 0.4 / (2.3 * 4 + 1)))


def test_one_choice_is_no_choice_and_defaults_change_nothing() -> None:
    plain, told = (
        allocate(parsed(one_task(**each))) for each in ({}, {"local_steps": STEPS[:1], "forms": {"float32": {}}})
    )
    assert (told.tasks[0].local_steps, told.tasks[0].form) == (1, "float32")
    untold = dataclasses.replace(told.tasks[0], local_steps=None, form=None)
    assert dataclasses.replace(told, tasks=(untold,)) == plain
    assert "local_steps" not in parsed(one_task()).model_dump_json()


def test_another_choice_than_the_plans_is_found_by_the_verifier() -> None:
    values = one_task(local_steps=STEPS, forms=FORMS)
    plan = allocate(parsed(values))
    assert verified(values, plan) == ()
    for changes in ({"form": "float32"}, {"form": "int4"}, {"form": None}, {"local_steps": 2.0}, {"local_steps": 3.0}):
        assert verified(values, plan, **changes)


def test_vehicles_with_names_have_their_own_time_for_the_steps() -> None:
    """By hand: c0 has time for 10 rounds of a step, 5 of two; c1 is ten times as slow, and joins one of each ten."""
    values = one_task(vehicle_train_s={"c0": 1.0, "c1": 10.0}, local_steps=STEPS, forms={"int4": {}})
    plan, shares = allocate_fleet(parsed(values))
    own = plan.tasks[0]
    assert (own.local_steps, own.form) == (1, "int4")
    assert [len(share.rounds) for share in shares["objects"]] == [own.edge_rounds - 1, 1] or own.edge_rounds == 11
    assert all(share.busy_s <= 10 for share in shares["objects"])
    assert shares["objects"][0].wireless_mb == pytest.approx(len(shares["objects"][0].rounds) * 1.0)
    assert verified(values, plan) == ()


def test_rounds_that_are_done_keep_their_steps_and_form() -> None:
    values = one_task(local_steps=STEPS, forms=FORMS)
    state = {"samples": 0, "edge_rounds": 3, "local_steps": 2.0, "form": "int4", "accuracy": 0.8}
    rest = condition_problem(parsed(values), PlanState.model_validate({"tasks": {"objects": state}}))
    plan = allocate(rest).tasks[0]
    assert (plan.local_steps, plan.form, plan.edge_rounds) == (2, "int4", 5)  # 10 s
    then = condition_problem(rest, PlanState.model_validate({"tasks": {"objects": {**state, "accuracy": None}}}))
    assert float(settle_plan(then, [plan]).tasks[0].curve.error(0, 3, 0)) == pytest.approx(0.2)
    used = {"wireless": 10.0, "wireline": 0.0}  # three rounds of two updates of 1 MB were to take 6 MB
    less = condition_problem(parsed(values), PlanState.model_validate({"tasks": {"objects": state}, "used_mb": used}))
    assert less.budgets_mb.wireless == pytest.approx(64 - 4)
    for changes, told in (
        ({"form": None}, "form is not told"),
        ({"local_steps": 3.0}, "local_steps = 3.0 is no choice"),
    ):
        with pytest.raises(InputError, match=told):
            condition_problem(parsed(values), PlanState.model_validate({"tasks": {"objects": {**state, **changes}}}))
    with pytest.raises(InputError, match="form = int8 is no choice of the problem's: none"):
        condition_problem(
            parsed(one_task()), PlanState.model_validate({"tasks": {"objects": {"samples": 0, "form": "int8"}}})
        )


def test_baselines_have_the_first_choice() -> None:
    values = choosing(3, 2, "additive", 200.0)
    found, plan = baseline(parsed(values), "equal-stages"), allocate(parsed(values))
    assert [(own.local_steps, own.form) for own in found.tasks] == [(1, "float32")] * 2
    assert found.objective >= plan.objective * (1 - 1e-9)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"forms": {"int2": {}}}, "forms.int2"),
        ({"forms": {"int8": {"bits": 33}}}, "33 bits per parameter are more than the 32 that are stored"),
        ({"forms": {"top-k": {"fraction": 0.6}}}, "38.4 bits per parameter are more"),
        ({"forms": {"top-k": {}}}, "it takes 'fraction' or 'bits'"),
        ({"forms": {"int8": {"fraction": 0.1}}}, "no 'fraction', which is of top-k"),
        ({"forms": {"int8": {}}, "exchange_mb": 1.0}, "vehicles send 'exchange_mb' instead"),
        (
            {"local_steps": [{"factor": 11}]},
            "no round can hold 11 times the steps, which take 11 s and horizon_s is 10",
        ),
        ({"local_steps": [{"factor": 2}, {"factor": 2}]}, "2 of them have the factor 2"),
        ({"local_steps": [{"factor": 0}]}, "greater than 0"),
    ],
)
def test_what_cannot_be_chosen_is_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        parsed(one_task(**changes))


def test_more_combinations_than_can_be_planned_are_one_sentence() -> None:
    many = one_task(local_steps=STEPS, forms=FORMS)
    many["tasks"] = [many["tasks"][0] | {"name": f"t{number}"} for number in range(3)]
    with pytest.raises(InputError, match="729 combinations over all tasks, and 256 at most"):
        allocate(parsed(many))


def test_an_example_problem_tells_what_it_chose() -> None:
    plan = allocate(load_problem(Path(__file__).parents[3] / "recipes" / "allocation" / "steps_and_forms.yaml"))
    assert plan.tasks[0].describe_choices() == "4 times the local steps of the history, updates in int8"
    few = allocate(parsed(one_task(local_steps=STEPS, forms=FORMS))).tasks[0]
    assert few.describe_choices() == "the local steps of the history, updates in int8"
    assert allocate(parsed(one_task())).tasks[0].describe_choices() == ""
