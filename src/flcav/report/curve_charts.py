"""Learning curves with the points they were fitted to and their bands."""

from collections.abc import Mapping, Sequence
from typing import Any

import networkx as nx
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flcav.report import style
from flcav.report.layers_chart import draw_layers

NAME_HEIGHT = 0.11  # of the axes: two lines of text
COLOURS = (style.ORANGE, style.BLUE, style.GREEN, style.PURPLE, style.VERMILLION)


@style.styled
def fig3a(results: Mapping[str, Any], graph: nx.Graph) -> Figure:
    """Return the graph, the curves of the article's points by task, and those of our own history by sample size."""
    figure = style.canvas(14.4, 4.4)
    left, middle, right = figure.subplots(1, 3, width_ratios=(5.6, 3, 3))
    draw_layers(left, graph)
    left.set_title("Tasks, networks, modalities, vehicles", fontweight="bold")
    draw_power_curves(middle, results["article"])
    middle.set_title("The article's points", fontweight="bold")
    draw_own_curves(right, results["own"])
    right.set_title("Our own runs", fontweight="bold")
    return figure


def draw_power_curves(axes: Axes, curves: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw accuracy against samples, a curve per task, with its points and 95 % band."""
    ends = []
    for (task, curve), colour in zip(curves.items(), COLOURS, strict=False):
        axes.fill_between(curve["resource"], curve["low"], curve["high"], color=colour, alpha=0.18, linewidth=0)
        axes.plot(curve["resource"], curve["accuracy"], color=colour)
        axes.plot(*zip(*curve["points"], strict=True), "o", color=colour, markersize=5, markeredgecolor="white")
        decay = curve["fitted"]["pretrain"]
        fitted = f"{task}\n1 − {decay['a']:.3g}·x$^{{-{decay['b']:.2g}}}$"
        ends.append((curve["resource"][-1], curve["accuracy"][-1], fitted, colour))
    axes.set_xscale("log")
    axes.set(xlabel="samples", ylabel="accuracy", ylim=(None, 1.03))
    _name_ends(axes, ends)
    axes.grid(axis="y")


def draw_own_curves(axes: Axes, own: Mapping[str, Any]) -> None:
    """Draw accuracy along a run, pretrained, edge rounds, cloud rounds: a curve per sample size."""
    route = own["route"]
    places, ends = range(len(route)), []
    for line, colour in zip(own["lines"], COLOURS[1:], strict=False):
        axes.fill_between(places, line["low"], line["high"], color=colour, alpha=0.18, linewidth=0)
        axes.plot(places, line["accuracy"], color=colour)
        axes.plot(*zip(*line["points"], strict=True), "o", color=colour, markersize=5, markeredgecolor="white")
        ends.append((places[-1], line["accuracy"][-1], f"{line['samples']}\nsamples", colour))
    _name_ends(axes, ends)
    edges = [place for place, (edge, cloud) in enumerate(route) if edge and not cloud]
    clouds = [place for place, (_, cloud) in enumerate(route) if cloud]
    for stage, places_of in (("edge rounds", edges), ("cloud rounds", clouds)):
        if places_of:
            axes.axvline(places_of[0] - 0.5, color=style.MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
            middle = (places_of[0] + places_of[-1]) / 2
            axes.text(middle, 0.02, stage, transform=axes.get_xaxis_transform(), ha="center", fontsize=style.SMALL)
    axes.set_xticks(list(places), [str(cloud or edge) for edge, cloud in route])
    axes.set(xlabel="rounds of the stage; 0: pretrained", ylabel="AP50")
    axes.grid(axis="y")


def _name_ends(axes: Axes, ends: Sequence[tuple[float, float, str, str]]) -> None:
    """Name lines (x, y of the end, name, colour) at their ends; names keep a distance from each other."""
    low, high = axes.get_ylim()
    above = high
    for x, y, name, colour in sorted(ends, key=lambda end: -end[1]):
        above = min(y, above - NAME_HEIGHT * (high - low))
        axes.annotate(
            name,
            (x, y),
            xytext=(1.02, above),
            textcoords=axes.get_yaxis_transform(),
            color=colour,
            va="center",
            fontsize=style.SMALL,
        )
