"""Networks and modalities, and ways of annotation, that a plan chooses from: against all plans, and the verifier."""

import dataclasses
import json
from typing import Any

import pytest
from made_problems import parsed

from flcav.config import InputError
from flcav.optimization.allocation.allocate import Allocation, allocate
from flcav.optimization.allocation.baselines import baseline
from flcav.optimization.allocation.replanning import PlanState, condition_problem
from flcav.optimization.graph import Layers, build_graph, extract_layers, to_problem
from flcav.optimization.verification.allocation import verify_allocation

WAYS = {"careful": {"box_s": 10.0}, "quick": {"box_s": 3.0, "worth": 0.6, "loss": 0.005}}


def one_task(**changes: Any) -> dict[str, Any]:
    """Return a problem of a task by LiDAR alone, of 1 MB a sample, or with a radar or a camera beside it."""
    lidar = {
        **{"name": "objects", "network": "lidar", "sample_mb": 1.0, "model_mb": 1.0, "edge_groups": [2]},
        "limits": {"samples": [1, 500], "edge_rounds": [0, 0], "cloud_rounds": [0, 0]},
        "curve": {"model": "additive", "floor": 0.1, "pretrain": {"a": 1.0, "b": 0.5}},
    }
    more = [
        {**lidar, "network": "radar", "sample_mb": 1.1, "curve": {**lidar["curve"], "floor": 0.09}},
        {**lidar, "network": "camera", "sample_mb": 2.0, "curve": {**lidar["curve"], "floor": 0.05}},
    ]
    for each in more:
        del each["name"]
    budgets = {"wireless": 100.0, "wireline": 100.0}
    return {"budgets_mb": budgets, "tasks": [lidar | {"alternatives": more} | changes]}


def faults(values: dict[str, Any], plan: Allocation, **changes: Any) -> tuple[str, ...]:
    told = dataclasses.asdict(plan)
    for name in ("used_mb", "marginal_error_per_gb"):
        told[name] = {link.removesuffix("_mb"): each for link, each in told[name].items()}
    told |= {name: changes.pop(name) for name in ("annotation_s",) if name in changes}
    told["tasks"] = [told["tasks"][0] | changes]
    return tuple(verify_allocation(parsed(values).model_dump_json(), json.dumps(told)).faults)


@pytest.mark.parametrize(("mb", "network", "samples"), [(4.0, "lidar", 4), (20.0, "radar", 18), (100.0, "camera", 50)])
def test_the_network_of_least_error_is_chosen_under_the_budget(mb: float, network: str, samples: int) -> None:
    """By hand: at 20 MB .1 + 1/sqrt(20) = .3236, .09 + 1/sqrt(18) = .3257; at 100 MB .2, .1954 and .1914."""
    values = one_task() | {"budgets_mb": {"wireless": mb, "wireline": mb}}
    floors = {"lidar": (0.1, 1.0), "radar": (0.09, 1.1), "camera": (0.05, 2.0)}
    errors = {name: floor + int(mb / size + 1e-9) ** -0.5 for name, (floor, size) in floors.items()}
    plan = allocate(parsed(values))
    assert plan.tasks[0].network == min(errors, key=errors.__getitem__)
    assert plan.objective == pytest.approx(min(errors.values()))
    assert plan.status == "optimal"
    assert faults(values, plan) == ()


def test_a_limit_of_annotation_chooses_the_way_and_the_samples() -> None:
    """By hand: 1200 s are 30 careful samples of 4 boxes, or 100 quick ones, each worth .6 of a careful one."""
    values = one_task(alternatives=[], network=None, annotations=WAYS, boxes=4.0) | {"annotation_s": 1200.0}
    plan = allocate(parsed(values))
    own = plan.tasks[0]
    assert (own.annotation, own.samples, plan.annotation_s) == ("quick", 100, pytest.approx(1200.0))
    assert own.predicted_error == pytest.approx(0.105 + (0.6 * 100) ** -0.5)
    assert faults(values, plan) == ()
    assert faults(values, plan, annotation_s=1100.0)
    assert faults(values, plan, annotation="careful")
    rich = values | {"annotation_s": 4000.0}
    assert allocate(parsed(rich)).tasks[0].annotation == "careful"
    free = {name: each for name, each in values.items() if name != "annotation_s"}
    assert allocate(parsed(free)).tasks[0].annotation == "careful"  # time costs nothing


@pytest.mark.parametrize("model", ["effective", "additive"])
def test_both_choices_together_are_the_best_of_all_plans(model: str) -> None:
    values: dict[str, Any] = one_task(annotations=WAYS, boxes=2.0) | {"annotation_s": 500.0}
    if model == "effective":
        curve = {"model": "effective", "floor": 0.1, "a": 1.0, "b": 0.5, "alpha": 0.8, "beta": 0.5, "group_samples": 9}
        values["tasks"][0] |= {"curve": curve, "alternatives": []}
    found = []
    for variant in parsed(values).tasks[0].variants:
        for way, how in (variant.annotations or {"": None}).items():
            worth, loss, seconds = (how.worth, how.loss, 2.0 * how.box_s) if how else (1.0, 0.0, 0.0)
            most = int(min(100 / variant.sample_mb, 500 / seconds if seconds else 500) + 1e-9)
            alpha = 0.8 if model == "effective" else 1.0
            error = variant.curve.floor + loss + (alpha * worth * most) ** -0.5  # pyright: ignore[reportAttributeAccessIssue]
            found.append((error, variant.network, way or None))
    plan = allocate(parsed(values))
    assert (plan.tasks[0].network, plan.tasks[0].annotation) == min(found)[1:]
    assert plan.objective == pytest.approx(min(found)[0])
    assert faults(values, plan) == ()


def test_another_network_than_the_plans_is_found_by_the_verifier() -> None:
    values = one_task()
    plan = allocate(parsed(values))
    assert plan.tasks[0].network == "camera"
    for network in ("lidar", "radar", "sonar", None):
        assert faults(values, plan, network=network)
    assert "alternatives" not in parsed(one_task(alternatives=[])).model_dump_json()


def test_what_is_done_keeps_its_network_and_its_annotation() -> None:
    values = one_task(annotations=WAYS) | {"annotation_s": 600.0}
    state = {"samples": 20, "network": "lidar", "annotation": "quick"}
    rest = condition_problem(parsed(values), PlanState.model_validate({"tasks": {"objects": state}}))
    plan = allocate(rest).tasks[0]
    assert (plan.network, plan.annotation, plan.samples) == ("lidar", "quick", 100)
    for changes, told in (({"network": None}, "network is not told"), ({"annotation": "hasty"}, "'?hasty'? is no")):
        with pytest.raises(InputError, match=told):
            condition_problem(parsed(values), PlanState.model_validate({"tasks": {"objects": {**state, **changes}}}))


def test_baselines_keep_to_the_annotators_time() -> None:
    values = one_task(annotations=WAYS) | {"annotation_s": 300.0}
    found = baseline(parsed(values), "equal-stages").tasks[0]
    assert (found.network, found.annotation, found.samples) == ("lidar", "careful", 30)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"network": None}, "need a 'network' each, all different"),
        ({"alternatives": [{**one_task()["tasks"][0]["alternatives"][0], "network": "lidar"}]}, "all different"),
        ({"train_s": 1.0}, "take train_s, or none"),
        ({"annotations": {"careful": {"box_s": -1}}}, "box_s"),
    ],
)
def test_alternatives_that_do_not_fit_are_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        parsed(one_task(**changes))


def test_a_limit_without_annotations_is_refused_and_too_little_time_is_one_sentence() -> None:
    with pytest.raises(InputError, match="annotation_s = 5 limits nothing"):
        parsed(one_task() | {"annotation_s": 5.0})
    with pytest.raises(InputError, match="takes 3 s of annotators, 1 s more than annotation_s = 2"):
        allocate(
            parsed(one_task(alternatives=[], network=None, annotations={"q": {"box_s": 3}}) | {"annotation_s": 2.0})
        )


def layers(**changes: Any) -> Layers:
    """Return a graph of a task with two networks, and a vehicle without a radar."""
    network = {
        **{"model_mb": 1.0, "limits": {"samples": [1, 50], "edge_rounds": [0, 5], "cloud_rounds": [0, 0]}},
        "curve": {"model": "additive", "floor": 0.1, "pretrain": {"a": 1.0, "b": 0.5}},
    }
    values = {
        "budgets_mb": {"wireless": 100.0, "wireline": 100.0},
        "annotation_s": 900.0,
        "tasks": {"objects": {"network": ["alone", "fused"], "annotations": WAYS, "boxes": 3.0}},
        "networks": {
            "alone": {**network, "modalities": ["lidar"]},
            "fused": {**network, "modalities": ["lidar", "radar"]},
        },
        "modalities": {"lidar": {"sample_mb": 1.0}, "radar": {"sample_mb": 0.1}},
        "vehicles": {
            "a": {"edge": "E", "holds": {"lidar": {}, "radar": {}}},
            "b": {"edge": "E", "holds": {"lidar": {}}},
        },
    }
    return Layers.model_validate({**values, **changes})


def test_a_graph_with_several_networks_of_a_task_is_a_problem_with_alternatives() -> None:
    made = build_graph(layers())
    assert extract_layers(made) == layers()
    (task,) = to_problem(made).tasks
    assert [each.network for each in task.variants] == ["alone", "fused"]
    assert [each.edge_groups for each in task.variants] == [(2,), (1,)]  # one vehicle has no radar
    assert [each.sample_mb for each in task.variants] == [1.0, pytest.approx(1.1)]
    assert [each.boxes for each in task.variants] == [3.0, 3.0]
    assert to_problem(made).annotation_s == 900.0


def test_a_network_of_alternatives_serves_one_task() -> None:
    tasks = {"objects": {"network": ["alone", "fused"]}, "others": {"network": "alone"}}
    with pytest.raises(ValueError, match=r"tasks.objects.network: networks.alone serves another task too"):
        layers(tasks=tasks, annotation_s=None)
