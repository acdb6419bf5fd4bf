"""Learning curves with the points they were fitted to and their bands."""

from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flcav.report import style
from flcav.report.layers_chart import draw_layers

NAME_HEIGHT = 0.11  # of the axes: two lines of text
COLOURS = (style.ORANGE, style.BLUE, style.GREEN, style.PURPLE, style.VERMILLION)

Route = Sequence[tuple[int, int]]  # edge rounds, cloud rounds, place by place


@dataclass(frozen=True)
class Curve:
    """A learning curve as it is drawn."""

    name: str  # at its end
    x: Sequence[float]
    accuracy: Sequence[float]  # at each x
    low: Sequence[float]  # band
    high: Sequence[float]
    points: Sequence[tuple[float, float]]  # x, accuracy: what it was fitted to


@style.styled
def fig3a(article: Sequence[Curve], own: Sequence[Curve], route: Route, graph: nx.Graph) -> Figure:
    """Return the graph, the curves of the article's points by task, and those of our own history by sample size."""
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
    _draw(axes, curves, COLOURS)
    axes.set_xscale("log")
    axes.set(xlabel="samples", ylabel="accuracy", ylim=(None, 1.03))
    _name_ends(axes, curves, COLOURS)
    axes.grid(axis="y")


def draw_own_curves(axes: Axes, curves: Sequence[Curve], route: Route) -> None:
    """Draw accuracy along a run, pretrained, edge rounds, cloud rounds: a curve per sample size."""
    places = range(len(route))
    _draw(axes, curves, COLOURS[1:])
    _name_ends(axes, curves, COLOURS[1:])
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


def _draw(axes: Axes, curves: Sequence[Curve], colours: Sequence[str]) -> None:
    for curve, colour in zip(curves, colours, strict=False):
        axes.fill_between(curve.x, curve.low, curve.high, color=colour, alpha=0.18, linewidth=0)
        axes.plot(curve.x, curve.accuracy, color=colour)
        axes.plot(*zip(*curve.points, strict=True), "o", color=colour, markersize=5, markeredgecolor="white")


def _name_ends(axes: Axes, curves: Sequence[Curve], colours: Sequence[str]) -> None:
    """Name curves at their ends; names keep a distance from each other."""
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
