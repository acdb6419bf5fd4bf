import json
from pathlib import Path
from typing import Any

import networkx as nx
import pytest
import yaml

from flcav.config import InputError, parse_config
from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.allocation.vehicles import split_plan
from flcav.optimization.graph import (
    Layers,
    build_graph,
    extract_layers,
    group_tasks,
    load_graph,
    load_problem,
    to_problem,
)

RECIPE = Path(__file__).parents[3] / "recipes" / "graphs" / "three_layers.yaml"


def values() -> dict[str, Any]:
    return yaml.safe_load(RECIPE.read_text())


def layers(**changes: Any) -> Layers:
    return parse_config(Layers, values() | changes, "test")


def test_each_layer_joins_neighbouring_kinds() -> None:
    graph = build_graph(layers())
    order = {"task": 0, "network": 1, "modality": 2, "vehicle": 3}
    for (one, _), (other, _), layer in graph.edges(data="layer"):
        assert sorted((order[one], order[other])) == [layer - 1, layer]
    assert nx.is_connected(graph)
    assert graph.edges[("network", "lidar detector"), ("modality", "lidar")]["sample_mb"] == 1.6
    assert graph.edges[("modality", "camera"), ("vehicle", "car 4")]["quality"] == 0.6


def test_a_graph_comes_back_from_its_file(tmp_path: Path) -> None:
    graph = build_graph(layers())
    (tmp_path / "graph.json").write_text(json.dumps(nx.node_link_data(graph, edges="links")))
    again = load_graph(tmp_path / "graph.json")
    assert nx.utils.graphs_equal(again, graph)
    assert extract_layers(again) == layers()
    assert load_problem(tmp_path / "graph.json") == load_problem(RECIPE) == to_problem(graph)


def test_a_cluster_shares_one_resource_and_weighs_what_its_tasks_weigh() -> None:
    graph = build_graph(layers())
    assert group_tasks(graph)["classifier"] == {"weather": 0.2, "lights": 0.133}
    problem = to_problem(graph)
    shared = problem.tasks[0]
    assert (shared.name, shared.weight) == ("weather + lights", pytest.approx(0.333))
    plan = allocate(problem)
    errors = {"weather": plan.tasks[0], "lights": plan.tasks[0], "signs": plan.tasks[1], "objects": plan.tasks[2]}
    weights = {name: task["weight"] for name, task in values()["tasks"].items()}
    assert plan.objective == pytest.approx(sum(weights[name] * errors[name].predicted_error for name in weights))


def test_tasks_of_a_cluster_may_have_curves_of_their_own() -> None:
    changed = values()
    floors = {"weather": 0.02, "lights": 0.1}
    for task, floor in floors.items():
        curve = {"model": "additive", "floor": floor, "pretrain": {"a": 2.0, "b": 0.5}, "edge": {"a": 0.1, "x0": 1}}
        changed["tasks"][task]["curve"] = curve
    del changed["networks"]["classifier"]["curve"]
    graph = build_graph(parse_config(Layers, changed, "test"))
    plan = allocate(to_problem(graph)).tasks[0]
    errors = {member.name: member.predicted_error for member in plan.members}
    assert errors["lights"] - errors["weather"] == pytest.approx(0.08)
    mean = (0.2 * errors["weather"] + 0.133 * errors["lights"]) / 0.333
    assert plan.predicted_error == pytest.approx(mean)
    assert extract_layers(graph).tasks["lights"].curve is not None


def test_groups_are_the_vehicles_that_hold_every_modality_of_the_network() -> None:
    changed = values()
    changed["networks"]["lidar detector"]["modalities"] = ["camera", "lidar"]
    del changed["vehicles"]["car 5"]["holds"]["lidar"]
    changed["vehicles"]["car 1"]["holds"]["camera"] = {"samples": 300, "quality": 0.5}
    (fused,) = (
        task for task in to_problem(build_graph(parse_config(Layers, changed, "test"))).tasks if task.name == "objects"
    )
    assert fused.edge_groups == (4, 2)
    assert fused.sample_mb == pytest.approx(0.7 + 1.6)
    assert list(fused.uplink_mbps or {}) == ["car 1", "car 2", "car 3", "car 4", "car 6", "car 7"]
    assert (fused.samples_held["car 1"], fused.samples_held["car 2"]) == (300, 500)
    assert (fused.data_quality["car 1"], fused.data_quality["car 4"]) == (0.5, 0.6)


def test_a_vehicle_of_twice_the_speed_trains_half_as_long() -> None:
    changed = values()
    changed["networks"]["lidar detector"]["train_s"] = 30.0
    changed["vehicles"]["car 2"]["speed"] = 2.0
    changed["vehicles"]["car 4"]["speed"] = 0.5
    graph = build_graph(parse_config(Layers, changed, "test"))
    weather, _, objects = to_problem(graph).tasks
    assert (weather.train_s, weather.vehicle_train_s) == (0.0, {})
    assert [objects.vehicle_train_s[f"car {i}"] for i in (1, 2, 4)] == [30.0, 15.0, 60.0]
    sending_s = 8 * 60 / 9
    assert objects.round_s("car 2") == pytest.approx(15.0 + sending_s)
    del changed["vehicles"]["car 1"]["uplink_mbps"]
    unknown = to_problem(build_graph(parse_config(Layers, changed, "test"))).tasks[2]
    assert (unknown.vehicles, unknown.train_s) == ((), 60.0)


def test_a_round_takes_as_long_as_what_its_network_exchanges() -> None:
    changed = values()
    changed["networks"]["lidar detector"] |= {"exchange_mb": 6.0, "labels_mb": 3.0}
    objects = to_problem(build_graph(parse_config(Layers, changed, "test"))).tasks[2]
    assert objects.round_s("car 2") == pytest.approx(8 * (6 + 3) / 9)


def test_the_vehicles_of_a_graph_carry_its_plan() -> None:
    problem = load_problem(RECIPE)
    plan = allocate(problem)
    shares = split_plan(problem, plan.tasks)
    for task in plan.tasks:
        assert sum(share.samples for share in shares[task.name]) == task.samples
    assert all(share.samples == 0 for share in shares["signs"] if share.vehicle in ("car 3", "car 4"))  # poorer data


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        (("tasks", "signs", "network"), "none", "tasks.signs.network = 'none' is none of classifier"),
        (("networks", "classifier", "modalities"), ["radar"], "networks.classifier.modalities = 'radar'"),
        (("vehicles", "car 1", "holds"), {"radar": {}}, "vehicles.car 1.holds = 'radar'"),
        (("modalities", "camera", "sample_mb"), float("nan"), "finite"),
        (("modalities", "camera", "sample_mb"), -1, "greater than 0"),
        (("networks", "classifier", "exchange_mb"), -0.1, "classifier.exchange_mb' = -0.1: .* greater than 0"),
        (("networks", "classifier", "labels_mb"), -0.1, "classifier.labels_mb' = -0.1: .* greater than or equal"),
        (("networks", "idle"), {**values()["networks"]["classifier"]}, "networks.idle serves no task"),
        (("vehicles",), {"car 1": values()["vehicles"]["car 1"] | {"holds": {"camera": {}}}}, "no vehicle holds"),
        (("networks", "classifier", "curve"), None, "tasks.weather.curve is missing"),
        (("colour",), "red", "unknown field 'colour'"),
    ],
)
def test_what_does_not_join_is_one_sentence(path: tuple[str, ...], value: Any, sentence: str) -> None:
    changed = values()
    at = changed
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    with pytest.raises(InputError, match=sentence):
        parse_config(Layers, changed, "test")


def test_other_graphs_are_refused(tmp_path: Path) -> None:
    graph = build_graph(layers())
    graph.add_edge(("task", "signs"), ("network", "classifier"), layer=1, weight=1.0)
    with pytest.raises(InputError, match=r"networks.classifier serves another task too"):
        extract_layers(graph)
    graph = build_graph(layers())
    del graph.nodes[("network", "classifier")]["model_mb"]
    with pytest.raises(InputError, match="no 'model_mb'"):
        extract_layers(graph)
    (tmp_path / "graph.json").write_text('{"nodes": [], "links": [{"layer": 1}]}')
    with pytest.raises(InputError, match="node-link"):
        load_graph(tmp_path / "graph.json")
    with pytest.raises(InputError, match="no such file"):
        load_graph(tmp_path / "none.json")
