"""Bird's-eye view of a frame: points coloured by height, boxes, and the agent; ahead of the agent is up."""

from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.report import style
from flcav.report.pictures.clouds import GROUND_M, draw_boxes, on_page

HEIGHTS_M = Normalize(0.0, 4.0, clip=True)
HEIGHT_COLOURS = ListedColormap(colormaps["turbo"](np.linspace(0.08, 0.92, 64)))


@dataclass(frozen=True)
class View:
    """Content of the view: everything in the agent's frame, heights above ground."""

    points: NDArray  # (N, 3) x, y, height [m]
    truth: Boxes
    returns: NDArray[np.int64]  # (M,) LiDAR returns from each of `truth`
    title: str
    range_m: float = 50.0  # half the side of the square shown
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
    """Draw the view into axes."""
    axes.set(xlim=(-view.range_m, view.range_m), ylim=(-view.range_m, view.range_m), aspect="equal")
    style.hide_axes(axes)
    _draw_rings(axes, view.range_m)
    _draw_points(axes, view.points)
    seen = view.returns > 0
    draw_boxes(axes, view.truth[~seen], style.MUTED, width=0.8, dashed=True)
    draw_boxes(axes, view.truth[seen], style.INK, width=0.8)
    if view.predictions is not None:
        draw_boxes(axes, view.predictions, style.PURPLE, width=1.6)
    _draw_agent(axes, view.agent_size)
    style.scale_bar(axes, 10)


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
    axes.scatter(*on_page(points[ground, :2]).T, s=0.35, color=style.POINT, linewidths=0, zorder=1)
    raised = points[~ground]
    raised = raised[np.argsort(raised[:, 2], kind="stable")]
    colours = HEIGHT_COLOURS(HEIGHTS_M(raised[:, 2]))
    axes.scatter(*on_page(raised[:, :2]).T, s=2.2, c=colours, linewidths=0, zorder=4)


def _draw_agent(axes: Axes, size: tuple[float, float] | None) -> None:
    if size is None:
        axes.plot(0, 0, "o", markersize=7, color=style.INK, markeredgecolor="white", zorder=5)
        return
    length, width = size[0] / 2, size[1] / 2
    outline = np.array([[length, 0], [length - 1, width], [-length, width], [-length, -width], [length - 1, -width]])
    axes.add_patch(Polygon(on_page(outline), facecolor=style.INK, edgecolor="white", linewidth=0.6, zorder=5))


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
