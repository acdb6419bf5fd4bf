"""The multi-layer graph of MLGRA: tasks, networks, modalities, vehicles (Wang et al., IEEE Network 37(3), 2023).

It is the graph of the article's Fig. 3a, in three layers of edges:

- Layer 1 joins each task to its network. Tasks with the same network are a cluster: one resource serves them all, and
  the cluster's loss is the weighted sum of theirs. A task's learning curve overrides its network's. A task that is
  joined to several networks has alternatives, which may read other modalities: a plan takes one of them.
- Layer 2 joins a network to the modalities that it reads, with the size of one sample [MB].
- Layer 3 joins a modality to the vehicles that record it, with the number and the quality of the samples they hold.

The graph is a `networkx.Graph` with nodes (kind, name); nodes and edges have these numbers as attributes. It contains
all data of an allocation problem, and it is saved as node-link JSON.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self

import networkx as nx
from pydantic import Field, model_validator

from flcav.config import InputError, parse_config, read_yaml
from flcav.network.plan import FormName
from flcav.optimization.curves.curves import NonNegative, OwnCurve, Positive
from flcav.optimization.problem import Annotation, Budgets, Count, Form, Limits, LocalSteps, Problem, Quantities, Uplink
from flcav.storage.records import LEFT_OUT, WHERE_TRUE

CHOICES = ("local_steps", "forms")  # fields of a network that a plan chooses from
KINDS = ("task", "network", "modality", "vehicle")  # of nodes; each layer joins two neighbours of this list


class TaskNode(Quantities):
    """A perception task: its network, its weight and, where it differs from the network's, its learning curve."""

    network: str | Annotated[tuple[str, ...], Field(min_length=2)]  # several: alternatives, of which a plan takes one
    weight: Positive = 1.0
    curve: OwnCurve | None = None  # None: its network's
    boxes: Annotated[NonNegative | None, LEFT_OUT] = None  # as of `AllocationTask`; None: its default
    annotations: Annotated[Mapping[str, Annotation], WHERE_TRUE] = {}  # as of `AllocationTask`

    @property
    def networks(self) -> tuple[str, ...]:
        """Its network, or all of its alternatives."""
        return (self.network,) if isinstance(self.network, str) else self.network


class NetworkNode(Quantities):
    """A network: message sizes, modalities, limits, and the learning curve of those of its tasks that state none."""

    model_mb: Positive  # one model update
    exchange_mb: Annotated[Positive | None, LEFT_OUT] = None  # as of `AllocationTask`
    labels_mb: Annotated[NonNegative | None, LEFT_OUT] = None  # as of `AllocationTask`
    modalities: Annotated[tuple[str, ...], Field(min_length=1)]
    limits: Limits
    curve: OwnCurve | None = None
    train_s: NonNegative = 0.0  # time that a vehicle of speed 1 trains in one round [s]
    local_steps: Annotated[tuple[LocalSteps, ...], WHERE_TRUE] = ()  # as of `AllocationTask`
    forms: Annotated[Mapping[FormName, Form], WHERE_TRUE] = {}  # as of `AllocationTask`


class ModalityNode(Quantities):
    """A modality: a kind of sensor data, and the size of one sample."""

    sample_mb: Positive  # one labelled sample


class Holding(Quantities):
    """Number and quality of the samples that a vehicle holds of a modality."""

    samples: Count | None = None  # None: not limited
    quality: Positive = 1.0  # worth of one sample


class VehicleNode(Quantities):
    """A vehicle: its edge server, its uplink, and its samples by modality."""

    edge: str
    uplink_mbps: Uplink | None = None  # None: not known
    speed: Positive = 1.0  # rounds that it trains while a vehicle of speed 1 trains one
    holds: Annotated[Mapping[str, Holding], Field(min_length=1)]


class Layers(Quantities):
    """The graph as a configuration, in YAML or code: nodes by name, edges as references.

    Construction raises pydantic's ValidationError where a reference names no node, a task has no learning curve, or a
    network has no task or no vehicle with all its modalities.
    """

    budgets_mb: Budgets
    edge_rounds_per_cloud_round: Count = 1
    horizon_s: Positive | None = None
    annotation_s: Annotated[Positive | None, LEFT_OUT] = None  # as of `Problem`
    tasks: Annotated[Mapping[str, TaskNode], Field(min_length=1)]
    networks: Annotated[Mapping[str, NetworkNode], Field(min_length=1)]
    modalities: Annotated[Mapping[str, ModalityNode], Field(min_length=1)]
    vehicles: Annotated[Mapping[str, VehicleNode], Field(min_length=1)]

    @model_validator(mode="after")
    def _joined(self) -> Self:
        serves = Counter(network for task in self.tasks.values() for network in task.networks)
        for name, task in self.tasks.items():
            for network in task.networks:
                _known(f"tasks.{name}.network", network, self.networks)
                if task.curve is None and self.networks[network].curve is None:
                    raise ValueError(f"tasks.{name}.curve is missing, and networks.{network} has none either")
            shared = next((network for network in task.networks if serves[network] > 1), None)
            if shared and (len(task.networks) > 1 or task.annotations):
                field = "annotations" if task.annotations else "network"
                raise ValueError(f"tasks.{name}.{field}: networks.{shared} serves another task too, or this one twice")
            if task.curve is not None and len(task.networks) > 1:
                raise ValueError(f"tasks.{name}.curve is of one network, and it has {len(task.networks)}")
        for name, network in self.networks.items():
            for modality in network.modalities:
                _known(f"networks.{name}.modalities", modality, self.modalities)
            if not serves[name]:
                raise ValueError(f"networks.{name} serves no task")
            if not any(set(network.modalities) <= set(each.holds) for each in self.vehicles.values()):
                raise ValueError(f"networks.{name} reads {', '.join(network.modalities)}, which no vehicle holds")
        for name, vehicle in self.vehicles.items():
            for modality in vehicle.holds:
                _known(f"vehicles.{name}.holds", modality, self.modalities)
        return self


def _known(field: str, name: str, among: Mapping[str, Any]) -> None:
    if name not in among:
        raise ValueError(f"{field} = {name!r} is none of {', '.join(among)}")


def build_graph(layers: Layers) -> nx.Graph:
    """Return the graph of `layers`: nodes (kind, name), edges with attribute `layer` 1, 2 or 3.

    Node attributes are `kind` and the node's fields; edge attributes `weight` (layer 1), `sample_mb` (layer 2),
    `samples` and `quality` (layer 3). Budgets, k and the horizon are attributes of the graph.
    """
    graph = nx.Graph(
        budgets_mb=layers.budgets_mb.model_dump(),
        edge_rounds_per_cloud_round=layers.edge_rounds_per_cloud_round,
        horizon_s=layers.horizon_s,
        **layers.model_dump(mode="json", include={"annotation_s"}),
    )
    for name, task in layers.tasks.items():
        graph.add_node(("task", name), kind="task", **task.model_dump(mode="json", exclude={"network", "weight"}))
        for network in task.networks:
            graph.add_edge(("task", name), ("network", network), layer=1, weight=task.weight)
    for name, network in layers.networks.items():
        attributes = network.model_dump(mode="json", exclude={"modalities"})
        graph.add_node(("network", name), kind="network", **attributes)
        for modality in network.modalities:
            sample_mb = layers.modalities[modality].sample_mb
            graph.add_edge(("network", name), ("modality", modality), layer=2, sample_mb=sample_mb)
    for name, modality in layers.modalities.items():
        graph.add_node(("modality", name), kind="modality", sample_mb=modality.sample_mb)
    for name, vehicle in layers.vehicles.items():
        graph.add_node(("vehicle", name), kind="vehicle", **vehicle.model_dump(mode="json", exclude={"holds"}))
        for modality, held in vehicle.holds.items():
            graph.add_edge(("modality", modality), ("vehicle", name), layer=3, **held.model_dump(mode="json"))
    return graph


def extract_layers(graph: nx.Graph) -> Layers:
    """Return the configuration of a graph: the inverse of `build_graph`; raises `InputError` for any other graph."""
    nodes = {kind: [key for key, found in graph.nodes(data="kind") if found == kind] for kind in KINDS}
    for key in nodes["task"]:
        if not graph.degree[key]:
            raise InputError(f"graph: task {key[1]!r} is joined to no network")
    try:
        tasks = {
            key[1]: {
                "network": joined[0] if len(joined := [network[1] for network in graph[key]]) == 1 else joined,
                "weight": max(graph.edges[key, network]["weight"] for network in graph[key]),
                "curve": graph.nodes[key]["curve"],
                **{name: graph.nodes[key][name] for name in ("boxes", "annotations") if name in graph.nodes[key]},
            }
            for key in nodes["task"]
        }
        networks = {
            key[1]: {
                **{name: graph.nodes[key][name] for name in ("model_mb", "limits", "curve")},
                **{name: graph.nodes[key].get(name) for name in ("exchange_mb", "labels_mb")},
                **{name: graph.nodes[key][name] for name in CHOICES if name in graph.nodes[key]},
                "train_s": graph.nodes[key].get("train_s", 0.0),
                "modalities": [other[1] for other in graph[key] if other[0] == "modality"],
            }
            for key in nodes["network"]
        }
        modalities = {key[1]: {"sample_mb": graph.nodes[key]["sample_mb"]} for key in nodes["modality"]}
        vehicles = {
            key[1]: {
                **{name: graph.nodes[key][name] for name in ("edge", "uplink_mbps")},
                "speed": graph.nodes[key].get("speed", 1.0),
                "holds": {m[1]: {name: graph.edges[m, key][name] for name in Holding.model_fields} for m in graph[key]},
            }
            for key in nodes["vehicle"]
        }
    except KeyError as error:
        raise InputError(f"graph: a node or an edge has no {error.args[0]!r}") from None
    values = {"tasks": tasks, "networks": networks, "modalities": modalities, "vehicles": vehicles}
    return parse_config(Layers, {**graph.graph, **values}, "graph")


def load_graph(path: Path) -> nx.Graph:
    """Return the graph in the file at `path`: node-link JSON or `Layers` in YAML; raises `InputError` for another."""
    values = read_yaml(path)
    if not (isinstance(values, dict) and "nodes" in values):
        return build_graph(parse_config(Layers, values, str(path)))
    try:
        return build_graph(extract_layers(nx.node_link_graph(values, edges="links")))
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, nx.NetworkXError) as error:
        raise InputError(f"{path}: not a graph in node-link JSON ({error})") from None


def load_problem(path: Path | str) -> Problem:
    """Return the allocation problem in the YAML or JSON file at `path`: a list of tasks, or a graph in either form.

    Raises `InputError` naming file, field, value and rule where it is none. See docs/allocation.md.

    >>> from flcav import load_problem
    >>> len(load_problem("recipes/allocation/three_tasks.yaml").tasks)
    3
    """
    path = Path(path)
    graph = read_graph(path)
    return parse_config(Problem, read_yaml(path), str(path)) if graph is None else to_problem(graph)


def read_graph(path: Path) -> nx.Graph | None:
    """Return the graph in the file at `path`, None where it holds a list of tasks; raises `InputError`."""
    values = read_yaml(path)
    return load_graph(path) if isinstance(values, dict) and ("networks" in values or "nodes" in values) else None


def group_tasks(graph: nx.Graph) -> dict[str, dict[str, float]]:
    """Return the clusters: for each network the weights of its tasks, by name."""
    found: dict[str, dict[str, float]] = {}
    for task, network, weight in (
        (a, b, weight) if a[0] == "task" else (b, a, weight)
        for a, b, weight in graph.edges(data="weight")
        if weight is not None
    ):
        found.setdefault(network[1], {})[task[1]] = weight
    return found


def to_problem(graph: nx.Graph) -> Problem:
    """Return the allocation problem of a graph, with one entry in `tasks` per cluster.

    A cluster's name joins those of its tasks, and its weight is the sum of theirs. A task with several networks is one
    entry, that of its first network, and the others are its `alternatives`. A sample is one of each modality of
    its network. Its edge groups are the vehicles, by edge server, that hold all these modalities; a vehicle's number of
    samples, and their quality, is the least over them. Vehicles are named only where all their links are known; else
    all train as long as the slowest. Raises `InputError` where `graph` is none that `build_graph` returns.
    """
    layers, clusters = extract_layers(graph), group_tasks(graph)
    tasks, planned = [], set[str]()
    for name, tasks_of in clusters.items():
        if name in planned:
            continue
        networks = layers.tasks[next(iter(tasks_of))].networks
        planned.update(networks)
        if len(networks) == 1:
            tasks.append(_unit(layers, name, tasks_of))
            continue
        own, *others = (_unit(layers, each, tasks_of) | {"network": each} for each in networks)
        tasks.append(own | {"alternatives": others})
    shared = ("budgets_mb", "edge_rounds_per_cloud_round", "horizon_s", "annotation_s")
    values = {name: graph.graph[name] for name in shared if name in graph.graph}
    return parse_config(Problem, {**values, "tasks": tasks}, "graph")


def _unit(layers: Layers, name: str, tasks_of: Mapping[str, float]) -> dict[str, Any]:
    """Return the entry in `tasks` of a cluster, by a network."""
    network = layers.networks[name]
    fleet = {key: each for key, each in layers.vehicles.items() if set(network.modalities) <= set(each.holds)}
    edges = list(dict.fromkeys(each.edge for each in fleet.values()))
    ordered = {key: each for edge in edges for key, each in fleet.items() if each.edge == edge}
    held = {key: [each.holds[modality] for modality in network.modalities] for key, each in ordered.items()}
    first = layers.tasks[next(iter(tasks_of))]
    return {
        "name": " + ".join(tasks_of),
        "weight": sum(tasks_of.values()),
        "sample_mb": sum(layers.modalities[modality].sample_mb for modality in network.modalities),
        "model_mb": network.model_mb,
        "exchange_mb": network.exchange_mb,
        "labels_mb": network.labels_mb,
        "edge_groups": [sum(each.edge == edge for each in ordered.values()) for edge in edges],
        **_named(ordered, held, network.train_s),
        **network.model_dump(mode="json", include={*CHOICES}),
        **first.model_dump(mode="json", include={"boxes", "annotations"}),
        "limits": network.limits.model_dump(),
        "curve": _cluster_curve(layers, name, tasks_of),
    }


def _cluster_curve(layers: Layers, network: str, tasks: Mapping[str, float]) -> dict[str, Any]:
    """Return the learning curve of a cluster's weighted mean error; a plain curve where all its tasks have the same."""
    shared = layers.networks[network].curve
    curves = {name: layers.tasks[name].curve or shared for name in tasks}
    members = [
        {"name": name, "weight": tasks[name], "curve": curve.model_dump()}
        for name, curve in curves.items()
        if curve is not None
    ]
    if all(curve == curves[members[0]["name"]] for curve in curves.values()):
        return members[0]["curve"]
    return {"model": "shared", "members": members}


def _named(fleet: Mapping[str, VehicleNode], held: Mapping[str, Sequence[Holding]], train_s: float) -> dict[str, Any]:
    """Return the fields of a cluster that name its vehicles; only the training time where a link is not known."""
    links = {key: each.uplink_mbps.model_dump() for key, each in fleet.items() if each.uplink_mbps is not None}
    times = {key: train_s / each.speed for key, each in fleet.items()}
    if len(links) < len(fleet):
        return {"train_s": max(times.values())}
    counted = {key: [each.samples for each in holdings if each.samples is not None] for key, holdings in held.items()}
    return {
        "uplink_mbps": links,
        "vehicle_train_s": times if train_s > 0 else {},
        "samples_held": {key: min(samples) for key, samples in counted.items() if samples},
        "data_quality": {key: min(each.quality for each in holdings) for key, holdings in held.items()},
    }
