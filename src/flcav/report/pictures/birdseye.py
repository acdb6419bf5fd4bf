"""Bird's-eye view of a frame: points coloured by height, radar echoes, boxes, tracks and the agent, heading up."""

from collections.abc import Sequence
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

from flcav.dataset.ground import DatasetGround
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, inverse, transform_points
from flcav.perception.agents import POLE, kind_of
from flcav.report import style
from flcav.report.pictures.clouds import GROUND_M, draw_boxes, on_page
from flcav.sensors.frame import Frame
from flcav.sensors.radar import compute_echo_directions
from flcav.world.shapes import SHAPES

HEIGHTS_M = Normalize(0.0, 4.0, clip=True)
SEDAN = next(shape for shape in SHAPES["car"] if shape.name == "sedan")
MOVED_M = 1.0  # paths of actors that move less are not drawn
STANDING_M_S = 0.5  # smaller range rates count as zero
HEIGHT_COLOURS = ListedColormap(colormaps["turbo"](np.linspace(0.08, 0.92, 64)))


@dataclass(frozen=True)
class BirdseyeView:
    """Content of the view, in the agent's frame, with heights above ground."""

    points: NDArray  # (N, 3) x, y, height [m]
    truth: Boxes
    returns: NDArray[np.int64]  # (M,) LiDAR returns from each of `truth`
    title: str
    range_m: float = 50.0  # half the side of the square shown
    predictions: Boxes | None = None
    agent_size: tuple[float, float] | None = None  # length, width of a vehicle [m]; None is a pole
    echoes: NDArray | None = None  # (E, 3) x, y [m] and range rate [m/s, positive: receding] of radar echoes
    tracks: Sequence[NDArray] = ()  # paths (T, 2) x, y [m] of the moving actors over the scene


def view_frame(dataset: Dataset | None, frame: Frame, *, range_m: float, tracks: bool = False) -> BirdseyeView:
    """Return the view of a frame, `range_m` [m] to each side; with `tracks`, it has the actors' paths over the scene.

    Without a dataset the ground is at z = 0 of the world, and there are no paths.
    """
    agent_from_world = inverse(frame.world_from_agent)
    clouds = [transform_points(frame.agent_from_sensor[name], cloud[:, :3]) for name, cloud in frame.lidar.items()]
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    relief = None if dataset is None else DatasetGround(dataset).relief
    if relief is not None:
        points[:, 2] = relief.above(transform_points(frame.world_from_agent, points))
    elif dataset is not None:
        points[:, 2] += DatasetGround(dataset).height_of(dataset.number(frame.key))
    else:
        points[:, 2] = transform_points(frame.world_from_agent, points)[:, 2]
    return BirdseyeView(
        points=points,
        truth=frame.annotations.boxes.transform(agent_from_world),
        returns=frame.annotations.returns,
        title=f"{frame.key} · {frame.time_s:.1f} s",
        range_m=range_m,
        agent_size=None if kind_of(frame.agent) == POLE else (SEDAN.length, SEDAN.width),
        echoes=_locate_echoes(frame),
        tracks=_collect_paths(dataset, frame, agent_from_world) if tracks and dataset is not None else (),
    )


def _locate_echoes(frame: Frame) -> NDArray | None:
    """Return x, y [m, agent frame] and range rate [m/s] of all radar echoes (E, 3); None without radar."""
    located = []
    for name, echoes in frame.radar.items():
        positions = echoes[:, :1] * compute_echo_directions(echoes)
        places = transform_points(frame.agent_from_sensor[name], positions)[:, :2]
        located.append(np.column_stack((places, echoes[:, 3])))
    return np.concatenate(located) if located else None


def _collect_paths(dataset: Dataset, frame: Frame, agent_from_world: NDArray) -> list[NDArray]:
    """Return the paths (T, 2) [m, present agent frame] of the actors that move in the agent's frames of the scene."""
    path: dict[str, list[NDArray]] = {}
    for number, key in enumerate(dataset.keys):
        if (key.scene, key.agent) == (frame.scene, frame.agent):
            truth = dataset.frame(number).annotations
            for track, center in zip(truth.track.tolist(), truth.boxes.center):
                path.setdefault(track, []).append(center)
    paths = (np.array(centers) for centers in path.values())
    moving = (centers for centers in paths if np.ptp(centers, axis=0).max() > MOVED_M)
    return [transform_points(agent_from_world, centers)[:, :2] for centers in moving]


@style.styled
def birdseye(view: BirdseyeView) -> Figure:
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
    figure.legend(handles=_legend(view), loc="outside lower center", ncols=3, frameon=False, handlelength=1.6)
    return figure


def draw_view(axes: Axes, view: BirdseyeView) -> None:
    """Draw the view into axes."""
    axes.set(xlim=(-view.range_m, view.range_m), ylim=(-view.range_m, view.range_m), aspect="equal")
    style.hide_axes(axes)
    _draw_rings(axes, view.range_m)
    _draw_points(axes, view.points)
    for track in view.tracks:
        axes.plot(*on_page(track).T, color=style.GREEN, linewidth=1.2, zorder=2)
    for colour, chosen in _by_range_rate(view.echoes):
        axes.scatter(*on_page(chosen).T, s=9, marker="D", color=colour, edgecolor="white", linewidths=0.4, zorder=4.5)
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


def _by_range_rate(echoes: NDArray | None) -> list[tuple[str, NDArray]]:
    """Return the positions (N, 2) of approaching, receding and other radar echoes with their colours."""
    if echoes is None:
        return []
    rate = echoes[:, 2]
    kinds = {style.BLUE: rate < -STANDING_M_S, style.VERMILLION: rate > STANDING_M_S}
    kinds[style.MUTED] = ~(kinds[style.BLUE] | kinds[style.VERMILLION])
    return [(colour, echoes[chosen, :2]) for colour, chosen in kinds.items() if chosen.any()]


def _draw_agent(axes: Axes, size: tuple[float, float] | None) -> None:
    if size is None:
        axes.plot(0, 0, "o", markersize=7, color=style.INK, markeredgecolor="white", zorder=5)
        return
    length, width = size[0] / 2, size[1] / 2
    outline = np.array([[length, 0], [length - 1, width], [-length, width], [-length, -width], [length - 1, -width]])
    axes.add_patch(Polygon(on_page(outline), facecolor=style.INK, edgecolor="white", linewidth=0.6, zorder=5))


def _legend(view: BirdseyeView) -> list[Line2D]:
    entries = [
        Line2D([], [], color=style.INK, linewidth=0.8, label="annotated, with returns"),
        Line2D([], [], color=style.MUTED, linewidth=0.8, linestyle=(0, (3, 2)), label="annotated, no return"),
    ]
    if view.predictions is not None:
        entries.append(Line2D([], [], color=style.PURPLE, linewidth=1.6, label="predicted"))
    if view.tracks:
        entries.append(Line2D([], [], color=style.GREEN, linewidth=1.2, label="path over the scene"))
    names = {style.BLUE: "radar, approaching", style.VERMILLION: "radar, receding", style.MUTED: "radar, no range rate"}
    for colour, _ in _by_range_rate(view.echoes):
        entries.append(Line2D([], [], linestyle="none", marker="D", markersize=4, color=colour, label=names[colour]))
    marker, agent = ("^", "vehicle with the sensor") if view.agent_size else ("o", "pole with the sensor")
    entries.append(Line2D([], [], linestyle="none", marker=marker, color=style.INK, label=agent))
    return entries
