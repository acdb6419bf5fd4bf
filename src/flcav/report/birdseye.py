"""One frame from above: its points by height, its boxes, its agent. Ahead of the agent is up."""

from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.report import style

GROUND_M = 0.25  # points below are drawn as ground
HEIGHTS_M = Normalize(0.0, 4.0, clip=True)
HEIGHT_COLOURS = ListedColormap(colormaps["turbo"](np.linspace(0.08, 0.92, 64)))


@dataclass(frozen=True)
class View:
    """What is to be seen; everything in the agent's frame, heights above ground."""

    points: NDArray  # (N, 3) x, y, height [m]
    truth: Boxes
    returns: NDArray[np.int64]  # (M,) LiDAR returns from each of `truth`
    title: str
    range_m: float = 50.0  # shown ahead, behind and to both sides
    predictions: Boxes | None = None
    agent_size: tuple[float, float] | None = None  # length, width of a vehicle [m]; None is a pole


@style.styled
def birdseye(view: View) -> Figure:
    """Return the view as a figure with its legend and height scale."""
    figure = style.canvas(7.2, 8.25)
    axes = figure.add_subplot()
    draw_view(axes, view)
    axes.set_title(view.title)
    bar = figure.colorbar(
        ScalarMappable(HEIGHTS_M, HEIGHT_COLOURS), ax=axes, location="bottom", fraction=0.03, pad=0.01, aspect=70
    )
    bar.set_label("height of a return above ground [m]; ground in grey")
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    figure.legend(handles=_legend(view), loc="outside lower center", ncols=4, frameon=False, handlelength=1.6)
    return figure


def draw_view(axes: Axes, view: View) -> None:
    """Draw the view on axes of its own."""
    axes.set(xlim=(-view.range_m, view.range_m), ylim=(-view.range_m, view.range_m), aspect="equal")
    style.bare(axes)
    _draw_rings(axes, view.range_m)
    _draw_points(axes, view.points)
    seen = view.returns > 0
    _draw_boxes(axes, view.truth[~seen], style.MUTED, dash=(0, (3, 2)))
    _draw_boxes(axes, view.truth[seen], style.INK)
    if view.predictions is not None:
        _draw_boxes(axes, view.predictions, style.PURPLE, width=1.6)
    _draw_agent(axes, view.agent_size)
    style.scale_bar(axes, 10)


def _up(xy: NDArray) -> NDArray:
    """Return (..., 2) agent coordinates x ahead, y left as picture coordinates."""
    return np.stack((-xy[..., 1], xy[..., 0]), axis=-1)


def _draw_rings(axes: Axes, range_m: float) -> None:
    step = 10 if range_m <= 60 else 20 if range_m <= 120 else 50
    turn = np.linspace(0, 2 * np.pi, 181)
    for radius in np.arange(step, range_m * np.sqrt(2), step):
        axes.plot(radius * np.cos(turn), radius * np.sin(turn), color=style.RULE, linewidth=0.6, zorder=0)
        if radius <= range_m:
            axes.annotate(
                f"{radius:g} m",
                (0, -radius),
                ha="center",
                va="center",
                color=style.MUTED,
                fontsize=style.SMALL,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
                zorder=0.5,
            )


def _draw_points(axes: Axes, points: NDArray) -> None:
    ground = points[:, 2] < GROUND_M
    axes.scatter(*_up(points[ground, :2]).T, s=0.35, color=style.POINT, linewidths=0, zorder=1)
    raised = points[~ground]
    raised = raised[np.argsort(raised[:, 2], kind="stable")]
    colours = HEIGHT_COLOURS(HEIGHTS_M(raised[:, 2]))
    axes.scatter(*_up(raised[:, :2]).T, s=2.2, c=colours, linewidths=0, zorder=4)


def _draw_boxes(axes: Axes, boxes: Boxes, colour: str, width: float = 0.8, dash: str | tuple = "solid") -> None:
    """Draw footprints, each with a tick from its centre through the middle of its front."""
    corners = boxes.corners()[:, :4, :2]
    outlines = list(_up(corners[:, [0, 1, 2, 3, 0]]))
    axes.add_collection(LineCollection(outlines, colors=colour, linewidths=width, linestyles=[dash], zorder=3))
    ahead = np.stack((np.cos(boxes.yaw), np.sin(boxes.yaw)), axis=1)
    tip = boxes.center[:, :2] + ahead * (boxes.size[:, :1] / 2 + 0.6)
    ticks = np.stack((boxes.center[:, :2], tip), axis=1)
    axes.add_collection(LineCollection(list(_up(ticks)), colors=colour, linewidths=width, zorder=3))


def _draw_agent(axes: Axes, size: tuple[float, float] | None) -> None:
    if size is None:
        axes.plot(0, 0, "o", markersize=7, color=style.INK, markeredgecolor="white", zorder=5)
        return
    length, width = size[0] / 2, size[1] / 2
    outline = np.array([[length, 0], [length - 1, width], [-length, width], [-length, -width], [length - 1, -width]])
    axes.add_patch(Polygon(_up(outline), facecolor=style.INK, edgecolor="white", linewidth=0.6, zorder=5))


def _legend(view: View) -> list[Line2D]:
    entries = [
        Line2D([], [], color=style.INK, linewidth=0.8, label="annotated, with returns"),
        Line2D([], [], color=style.MUTED, linewidth=0.8, linestyle=(0, (3, 2)), label="annotated, no return"),
    ]
    if view.predictions is not None:
        entries.append(Line2D([], [], color=style.PURPLE, linewidth=1.6, label="predicted"))
    marker, agent = ("^", "vehicle with the sensor") if view.agent_size else ("o", "pole with the sensor")
    entries.append(Line2D([], [], linestyle="none", marker=marker, color=style.INK, label=agent))
    return entries
