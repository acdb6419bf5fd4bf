"""Drawing of a network's predictions on its input, for all tasks, by kind of mark."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.perception.images import CameraView
from flcav.perception.marks import (
    Bars,
    CloudBoxes,
    GroundLines,
    Mark,
    Paths,
    PictureBoxes,
    PictureClasses,
    PictureLines,
)
from flcav.perception.task import Finding
from flcav.report import style
from flcav.report.pictures.camera import boxes_on_picture, points_on_picture, show_view
from flcav.report.pictures.clouds import draw_boxes, on_page
from flcav.report.pictures.predicted_paths import paths_key, paths_on_map

WIDTH_IN = 8.0
ABOVE_IN = 6.5  # side of a cloud in bird's-eye view
MAP_IN = 7.2  # side of a map
BARS_IN = 3.6  # width of what is drawn next to the input
GROUND_AHEAD_M, GROUND_ASIDE_M = 42.0, 14.0  # shown of the ground
HALF_PX = 0.5  # from pixels by their centres to pixels by their edges
COLOURS = {  # of classes with a customary colour
    "Car": style.BLUE,
    "Pedestrian": style.VERMILLION,
    "Cyclist": style.GREEN,
    "light_red": style.VERMILLION,
    "light_yellow": style.ORANGE,
    "light_green": style.GREEN,
    "solid": style.VERMILLION,
    "broken": style.SKY,
    "road_edge": style.GREEN,
    "stop_line": style.ORANGE,
    "crossing": style.PURPLE,
    "arrow": style.BLUE,
}
TINT = 0.55  # opacity of a class over the picture
BOX: dict[str, Any] = {"facecolor": "none", "linewidth": 1.4}


@dataclass(frozen=True)
class Panels:
    """The axes for marks."""

    seen: Axes  # the picture, the cloud from above, or the map
    ahead: tuple[Axes, CameraView] | None  # above a cloud: a camera's picture of the same scene


@style.styled
def draw(finding: Finding) -> Figure:
    """Return the network's input with all marks, bars and the ground next to it, and a camera's picture above a cloud.

    Clouds and maps are in bird's-eye view, with the observer's heading up. In a camera's picture the cloud is coloured
    by distance, and boxes are drawn by their edges.
    """
    beside = [mark for mark in finding.marks if isinstance(mark, tuple(SIDE))]
    view = finding.view() if finding.seen.ndim == 2 else None
    width, height = _size(finding.seen, view)
    figure = style.canvas(width + BARS_IN * len(beside), height)
    body: FigureBase = figure
    if beside:
        ratios = (width, *(BARS_IN for _ in beside))
        body, *side = figure.subfigures(1, 1 + len(beside), width_ratios=ratios, squeeze=False)[0]
        for page, mark in zip(side, beside, strict=True):
            SIDE[type(mark)](page.add_subplot(), mark)
    captions = " · ".join(mark.caption for mark in finding.marks)
    panels = _show(body, finding.seen, view, f"{finding.path.name} · {captions}" if captions else finding.path.name)
    handles: list[Artist] = []
    for mark in finding.marks:
        if type(mark) in DRAWERS:
            handles += DRAWERS[type(mark)](panels, finding.seen, mark)
    if finding.seen.ndim == 2:
        _frame_from_above(panels.seen, finding.marks)
    if handles:
        style.key(body, handles)
    return figure


def _size(seen: NDArray[Any], view: CameraView | None) -> tuple[float, float]:
    """Return width and height [inch] of the drawn input, with its title."""
    if seen.ndim == 2:
        if view is None:
            return ABOVE_IN, ABOVE_IN + 0.6
        return WIDTH_IN, WIDTH_IN * view.picture.shape[0] / view.picture.shape[1] + ABOVE_IN + 1.2
    if seen.dtype == np.bool_:
        return MAP_IN, MAP_IN + 0.7
    return WIDTH_IN, WIDTH_IN * seen.shape[0] / seen.shape[1] + 0.4


def _show(page: FigureBase, seen: NDArray[Any], view: CameraView | None, title: str) -> Panels:
    """Show the input; a map is drawn by its mark, and only gets axes."""
    if view is None:
        axes = page.subplots()
        axes.set_title(title)
        if seen.ndim == 2:
            _cloud_from_above(axes, seen)
        elif seen.dtype != np.bool_:
            _picture(axes, seen)
        return Panels(axes, None)
    height = WIDTH_IN * view.picture.shape[0] / view.picture.shape[1]
    ahead, above = page.subplots(2, 1, height_ratios=(height, ABOVE_IN))
    ahead.set_title(title)
    show_view(ahead, view)
    bar = page.colorbar(
        points_on_picture(ahead, seen, view),
        ax=ahead,
        location="bottom",
        extend="max",
        fraction=0.03,
        pad=0.01,
        aspect=70,
    )
    bar.set_label("distance of a return [m]")
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    _cloud_from_above(above, seen)
    return Panels(above, (ahead, view))


def _picture(axes: Axes, picture: NDArray[np.uint8]) -> None:
    height, width = picture.shape[:2]
    axes.imshow(picture, extent=(0, width, height, 0))  # pixels by their edges
    style.hide_axes(axes)


def _cloud_from_above(axes: Axes, points: NDArray[np.float32]) -> None:
    axes.scatter(*on_page(points[:, :2]).T, s=0.4, color=style.POINT, linewidths=0, rasterized=True)
    axes.plot(0, 0, "^", color=style.INK, markersize=6)
    style.hide_axes(axes)


def _frame_from_above(axes: Axes, marks: Iterable[Mark]) -> None:
    """Set the limits of a cloud's axes so that all boxes are inside, and add a scale bar."""
    boxes = [mark.boxes for mark in marks if isinstance(mark, CloudBoxes)]
    corners = [on_page(group.corners()[..., :2]).reshape(-1, 2) for group in boxes]
    across, up = np.concatenate([np.zeros((0, 2)), *corners]).T
    aside, ahead = (float(np.max(ends, initial=least) + 2) for ends, least in ((np.abs(across), 28), (up, 52)))
    behind = float(np.min(up - 2, initial=-6))
    axes.set(xlim=(-aside, aside), ylim=(behind, ahead), aspect="equal")
    style.scale_bar(axes, 10)


def show_bars(axes: Axes, bars: Bars) -> None:
    """Draw a bar per class, with the predicted class in colour."""
    names, best = list(bars.share), bars.caption
    colours = [style.BLUE if name == best else style.RULE for name in names]
    drawn = axes.barh(names, list(bars.share.values()), color=colours)
    axes.bar_label(drawn, fmt="%.2f", padding=3, fontsize=style.SMALL, color=style.INK)
    axes.set(xlim=(0, 1.15), xticks=[])
    axes.invert_yaxis()
    axes.spines["bottom"].set_visible(False)
    axes.set_title(bars.title)


def boxes_in_picture(axes: Axes, mark: PictureBoxes) -> None:
    """Draw rectangles with class and score on the picture shown by `axes`."""
    width = max(axes.get_xlim())
    for (x1, y1, x2, y2), name, score in zip(mark.box.tolist(), mark.label, mark.score, strict=True):
        colour = COLOURS.get(str(name), style.BLUE)
        axes.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, fill=False, edgecolor=colour, linewidth=1.4))
        right = x1 > 0.7 * width  # keeps the name within the picture
        axes.annotate(
            f"{name.replace('_', ' ')} {score:.2f}",
            (x2 if right else x1, y1),
            (0, 2),
            textcoords="offset points",
            ha="right" if right else "left",
            fontsize=style.SMALL,
            color="white",
            bbox={"facecolor": colour, "edgecolor": "none", "pad": 0.8},
        )


def show_ground(axes: Axes, mark: GroundLines) -> None:
    """Draw lines on the ground in bird's-eye view, the agent's heading up."""
    for line, kind in zip(mark.lines, mark.kind, strict=True):
        axes.plot(*on_page(line).T, color=COLOURS.get(kind, style.BLUE), linestyle=_dashes(kind), linewidth=1.6)
    axes.plot(0, 0, "^", color=style.INK, markersize=6)
    style.hide_axes(axes)
    axes.set(xlim=(-GROUND_ASIDE_M, GROUND_ASIDE_M), ylim=(-2, GROUND_AHEAD_M), aspect="equal")
    axes.set_title("on the ground")
    style.scale_bar(axes, 10)


def _dashes(kind: str) -> str:
    return "--" if kind == "broken" else "-"


def _draw_classes(panels: Panels, seen: NDArray[Any], mark: PictureClasses) -> list[Artist]:
    """Tint the picture by class, and return a key of the classes that occur."""
    colours = [to_rgb(COLOURS.get(name, style.BLUE)) for name in mark.names]
    tint = np.zeros((*mark.classes.shape, 4), np.float32)
    present = [number for number in range(1, len(mark.names)) if (mark.classes == number).any()]
    for number in present:
        tint[mark.classes == number] = (*colours[number], TINT)
    height, width = mark.classes.shape
    panels.seen.imshow(tint, extent=(0, width, height, 0))
    return [Patch(color=colours[number], label=mark.names[number].replace("_", " ")) for number in present]


def _draw_lines(panels: Panels, seen: NDArray[Any], mark: PictureLines) -> list[Artist]:
    for line, kind in zip(mark.lines, mark.kind, strict=True):
        panels.seen.plot(*(line + HALF_PX).T, color="white", linestyle=_dashes(kind), linewidth=1.4)
    if not mark.lines:
        return []
    return [Line2D([], [], color=style.RULE, linewidth=1.4, label=f"{len(mark.lines)} lane lines")]


def _draw_picture_boxes(panels: Panels, seen: NDArray[Any], mark: PictureBoxes) -> list[Artist]:
    boxes_in_picture(panels.seen, mark)
    return []


def _draw_cloud_boxes(panels: Panels, seen: NDArray[Any], mark: CloudBoxes) -> list[Artist]:
    handles: list[Artist] = []
    for name, of_class in _by_class(mark.boxes).items():
        colour = COLOURS.get(name, style.PURPLE)
        draw_boxes(panels.seen, of_class, colour, width=1.4)
        if panels.ahead is not None:
            boxes_on_picture(panels.ahead[0], of_class, panels.ahead[1], colour)
        handles.append(Patch(edgecolor=colour, label=f"{len(of_class)} {name}", **BOX))
    return handles


def _by_class(boxes: Boxes) -> dict[str, Boxes]:
    """Return the boxes by class, classes with a colour in `COLOURS` first."""
    present = set(boxes.label.tolist())
    names = [name for name in COLOURS if name in present] + sorted(present - COLOURS.keys())
    return {name: boxes[boxes.label == name] for name in names}


def _draw_paths(panels: Panels, seen: NDArray[Any], mark: Paths) -> list[Artist]:
    paths_on_map(panels.seen, seen, mark)
    style.scale_bar(panels.seen, 10)
    return [*paths_key(mark)]


DRAWERS: Mapping[type, Callable[[Panels, NDArray[Any], Any], list[Artist]]] = {
    PictureBoxes: _draw_picture_boxes,
    PictureClasses: _draw_classes,
    PictureLines: _draw_lines,
    CloudBoxes: _draw_cloud_boxes,
    Paths: _draw_paths,
}
SIDE: Mapping[type, Callable[[Axes, Any], None]] = {
    Bars: show_bars,
    GroundLines: show_ground,
}  # drawn next to the input
