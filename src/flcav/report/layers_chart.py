"""The three-layer graph as a picture: tasks, networks, modalities, vehicles in columns (the article's Fig. 3a left)."""

import networkx as nx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flcav.report import style

COLUMNS = {"task": "tasks", "network": "networks", "modality": "modalities", "vehicle": "vehicles"}
COLOURS = {"task": style.ORANGE, "network": style.BLUE, "modality": style.GREEN, "vehicle": style.MUTED}
GAP = 3.0  # between columns, where a node's row is 1 high
Node = tuple[str, str]  # kind, name


@style.styled
def three_layers(graph: nx.Graph) -> Figure:
    """Return the picture of a graph that `flcav.optimization.graph.build` made."""
    tallest = max(sum(kind == column for _, kind in graph.nodes(data="kind")) for column in COLUMNS)
    figure = style.canvas(6.6, 1.0 + 0.42 * max(tallest, 4))
    draw_layers(figure.add_subplot(), graph)
    return figure


def draw_layers(axes: Axes, graph: nx.Graph) -> None:
    """Draw the columns and what joins them: weights, megabytes of a sample, and the quality of what vehicles hold."""
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
    style.bare(axes)


def _draw_node(axes: Axes, graph: nx.Graph, node: Node, x: float, y: float) -> None:
    kind, name = node
    box = {"boxstyle": "round,pad=0.28", "facecolor": "white", "edgecolor": COLOURS[kind], "linewidth": 1.2}
    axes.text(x, y, f"{name}{_note(graph, node)}", ha="center", va="center", fontsize=style.SMALL, bbox=box, zorder=2)


def _note(graph: nx.Graph, node: Node) -> str:
    """Return what the picture says of a node besides its name."""
    kind, own = node[0], graph.nodes[node]
    if kind == "task":
        return f" · {next(iter(graph[node].values()))['weight']:.2g}"
    if kind == "network":
        return f"\n{own['model_mb']:g} MB"
    if kind == "modality":
        return f"\n{own['sample_mb']:g} MB/sample"
    return f" · {own['uplink_mbps']['wireless']:g} Mbit/s" if own["uplink_mbps"] else f" · {own['edge']}"


def layout(graph: nx.Graph) -> dict[Node, tuple[float, float]]:
    """Return the place of every node: a column per kind, within it next to what it is joined to, centred."""
    columns = [[node for node, kind in graph.nodes(data="kind") if kind == column] for column in COLUMNS]
    tallest = max(map(len, columns))
    heights: dict[Node, float] = {}
    for column in columns:

        def wish(node: Node) -> float:
            joined = [heights[other] for other in graph[node] if other in heights]
            return -float(np.mean(joined)) if joined else 0.0

        spread = (tallest - 1) / max(len(column), 1)  # short columns are drawn apart
        for row, node in enumerate(sorted(column, key=wish)):
            heights[node] = -(row - (len(column) - 1) / 2) * (spread + 1 / max(len(column), 1))
    return {node: (number * GAP, heights[node]) for number, column in enumerate(columns) for node in column}
