"""Charts of the article's Fig. 3a: the three-layer graph, and learning curves with their points and bands.

The graph joins tasks, networks, modalities and vehicles in four columns (Wang et al., IEEE Network 37(3), 2023).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flcav.report import style

COLUMNS = {"task": "tasks", "network": "networks", "modality": "modalities", "vehicle": "vehicles"}
COLOURS = {"task": style.ORANGE, "network": style.BLUE, "modality": style.GREEN, "vehicle": style.MUTED}
GAP = 3.0  # between columns; rows of nodes are 1 apart
Node = tuple[str, str]  # kind, name
NAME_HEIGHT = 0.11  # of the axes: two lines of text
SERIES_COLOURS = (style.ORANGE, style.BLUE, style.GREEN, style.PURPLE, style.VERMILLION)
Route = Sequence[tuple[int, int]]  # edge rounds, cloud rounds, at each x
MOST_TICKS = 14  # number of rounds that fit below the curves


@style.styled
def three_layers(graph: nx.Graph) -> Figure:
    """Return the figure of a graph made by `flcav.optimization.graph.build_graph`."""
    tallest = max(sum(kind == column for _, kind in graph.nodes(data="kind")) for column in COLUMNS)
    figure = style.canvas(6.6, 1.0 + 0.42 * max(tallest, 4))
    draw_layers(figure.add_subplot(), graph)
    return figure


def draw_layers(axes: Axes, graph: nx.Graph) -> None:
    """Draw nodes in columns by kind, and edges, whose width grows with the quality of a vehicle's data."""
    places = layout(graph)
    for one, other, edge in graph.edges(data=True):
        (x0, y0), (x1, y1) = sorted((places[one], places[other]))
        colour = COLOURS["task" if edge["layer"] == 1 else "modality" if edge["layer"] == 3 else "network"]
        quality = edge.get("quality", 1.0)
        axes.plot([x0, x1], [y0, y1], color=colour, linewidth=0.3 + 1.3 * quality, alpha=0.75, zorder=1)
    for node, (x, y) in places.items():
        _draw_node(axes, graph, node, x, y)
    top = max(y for _, y in places.values()) + 0.9
    for number, (kind, title) in enumerate(COLUMNS.items()):
        axes.text(number * GAP, top, title, ha="center", fontweight="bold", color=COLOURS[kind])
        if number:
            axes.text(
                (number - 0.5) * GAP, top, f"layer {number}", ha="center", fontsize=style.SMALL, color=style.MUTED
            )
    axes.set(xlim=(-1.1, 3 * GAP + 1.1), ylim=(min(y for _, y in places.values()) - 0.6, top + 0.5))
    style.hide_axes(axes)


def _draw_node(axes: Axes, graph: nx.Graph, node: Node, x: float, y: float) -> None:
    kind, name = node
    box = {"boxstyle": "round,pad=0.28", "facecolor": "white", "edgecolor": COLOURS[kind], "linewidth": 1.2}
    axes.text(x, y, f"{name}{_note(graph, node)}", ha="center", va="center", fontsize=style.SMALL, bbox=box, zorder=2)


def _note(graph: nx.Graph, node: Node) -> str:
    """Return the label next to a node's name: task weight, model or sample size, uplink, or else the edge server."""
    kind, attributes = node[0], graph.nodes[node]
    if kind == "task":
        return f" · {next(iter(graph[node].values()))['weight']:.2g}"
    if kind == "network":
        return f"\n{attributes['model_mb']:g} MB"
    if kind == "modality":
        return f"\n{attributes['sample_mb']:g} MB/sample"
    uplink = attributes["uplink_mbps"]
    return f" · {uplink['wireless']:g} Mbit/s" if uplink else f" · {attributes['edge']}"


def layout(graph: nx.Graph) -> dict[Node, tuple[float, float]]:
    """Return the position (x, y) of every node: a centred column per kind, sorted by the barycentres of neighbours."""
    columns = [[node for node, kind in graph.nodes(data="kind") if kind == column] for column in COLUMNS]
    tallest = max(map(len, columns))
    heights: dict[Node, float] = {}
    for column in columns:

        def wish(node: Node) -> float:
            joined = [heights[other] for other in graph[node] if other in heights]
            return -float(np.mean(joined)) if joined else 0.0

        spread = (tallest - 1) / max(len(column), 1)  # short columns are spread out
        for row, node in enumerate(sorted(column, key=wish)):
            heights[node] = -(row - (len(column) - 1) / 2) * (spread + 1 / max(len(column), 1))
    return {node: (number * GAP, heights[node]) for number, column in enumerate(columns) for node in column}


@dataclass(frozen=True)
class Curve:
    """A learning curve to draw."""

    name: str  # written at its end
    x: Sequence[float]
    accuracy: Sequence[float]  # at each x
    low: Sequence[float]  # lower end of the band
    high: Sequence[float]
    points: Sequence[tuple[float, float]]  # x and accuracy of the fitted points


@style.styled
def fig3a(article: Sequence[Curve], own: Sequence[Curve], route: Route, graph: nx.Graph) -> Figure:
    """Return three panels: graph, curves of the article's points by task, curves of our history by sample size."""
    figure = style.canvas(14.4, 4.4)
    left, middle, right = figure.subplots(1, 3, width_ratios=(5.6, 3, 3))
    draw_layers(left, graph)
    left.set_title("Tasks, networks, modalities, vehicles", fontweight="bold")
    draw_power_curves(middle, article)
    middle.set_title("The article's points", fontweight="bold")
    draw_own_curves(right, own, route)
    right.set_title("Our own runs", fontweight="bold")
    return figure


def draw_power_curves(axes: Axes, curves: Sequence[Curve]) -> None:
    """Draw accuracy against samples, a curve per task, with its points and 95 % band."""
    _draw(axes, curves, SERIES_COLOURS)
    axes.set_xscale("log")
    axes.set(xlabel="samples", ylabel="accuracy", ylim=(None, 1.03))
    _name_ends(axes, curves, SERIES_COLOURS)
    axes.grid(axis="y")


def draw_own_curves(axes: Axes, curves: Sequence[Curve], route: Route) -> None:
    """Draw accuracy along `route` (pretrained, edge rounds, cloud rounds).

    `curves` are by ascending number of samples; of more than three, the first, middle and last are drawn.
    """
    if len(curves) > 3:
        curves = [curves[0], curves[len(curves) // 2], curves[-1]]
    _draw(axes, curves, SERIES_COLOURS[1:])
    _name_ends(axes, curves, SERIES_COLOURS[1:])
    edges = [place for place, (edge, cloud) in enumerate(route) if edge and not cloud]
    clouds = [place for place, (_, cloud) in enumerate(route) if cloud]
    for stage, places_of in (("edge rounds", edges), ("cloud rounds", clouds)):
        if places_of:
            axes.axvline(places_of[0] - 0.5, color=style.MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
            middle = (places_of[0] + places_of[-1]) / 2
            axes.text(middle, 0.02, stage, transform=axes.get_xaxis_transform(), ha="center", fontsize=style.SMALL)
    step = 1 if len(route) <= MOST_TICKS else 2  # every second number of rounds, where labels would touch
    named = [place for place, (edge, cloud) in enumerate(route) if (cloud or edge) % step == 0]
    axes.set_xticks(named, [str(route[place][1] or route[place][0]) for place in named])
    axes.set(xlabel="rounds of the stage; 0: pretrained", ylabel="AP50")
    axes.grid(axis="y")


def _draw(axes: Axes, curves: Sequence[Curve], colours: Sequence[str]) -> None:
    for curve, colour in zip(curves, colours, strict=False):
        axes.fill_between(curve.x, curve.low, curve.high, color=colour, alpha=0.18, linewidth=0)
        axes.plot(curve.x, curve.accuracy, color=colour)
        axes.plot(*zip(*curve.points, strict=True), "o", color=colour, markersize=5, markeredgecolor="white")


def _name_ends(axes: Axes, curves: Sequence[Curve], colours: Sequence[str]) -> None:
    """Write the curves' names at their ends, without overlaps."""
    low, high = axes.get_ylim()
    places = style.keep_apart([curve.accuracy[-1] for curve in curves], NAME_HEIGHT * (high - low), high)
    for curve, place, colour in zip(curves, places, colours, strict=False):
        axes.annotate(
            curve.name,
            (curve.x[-1], curve.accuracy[-1]),
            xytext=(1.02, place),
            textcoords=axes.get_yaxis_transform(),
            color=colour,
            va="center",
            fontsize=style.SMALL,
        )
