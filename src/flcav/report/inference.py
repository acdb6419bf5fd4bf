"""What a network found in one input, drawn on that input."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.perception.camera_view import CameraView
from flcav.perception.objects.infer import boxes_of_rows
from flcav.perception.task import Finding
from flcav.report import style
from flcav.report.on_picture import boxes_on_picture, points_on_picture, show_view
from flcav.report.predicted_paths import draw_paths
from flcav.report.sweeps import draw_boxes, on_page

WIDTH_IN = 8.0
ABOVE_IN = 6.5  # side of a cloud from above
BOX_COLOURS = {"Car": style.BLUE, "Pedestrian": style.VERMILLION, "Cyclist": style.GREEN}
SIGN_COLOURS = {"light_red": style.VERMILLION, "light_yellow": style.ORANGE, "light_green": style.GREEN}


@style.styled
def draw_weather(finding: Finding) -> Figure:
    """Return the picture beside the probability of each weather."""
    picture, result = finding.seen, finding.result
    figure = style.canvas(WIDTH_IN * 1.5, WIDTH_IN * picture.shape[0] / picture.shape[1] + 0.4)
    image, bars = figure.subplots(1, 2, width_ratios=(3, 1.2))
    _show(image, picture, f"{finding.path.name} · {result['class']}")
    names = list(result["probabilities"])
    colours = [style.BLUE if name == result["class"] else style.RULE for name in names]
    drawn = bars.barh(names, [result["probabilities"][name] for name in names], color=colours)
    bars.bar_label(drawn, fmt="%.2f", padding=3, fontsize=style.SMALL, color=style.INK)
    bars.set(xlim=(0, 1.15), xticks=[])
    bars.invert_yaxis()
    bars.spines["bottom"].set_visible(False)
    bars.set_title("probability")
    return figure


@style.styled
def draw_signs(finding: Finding) -> Figure:
    """Return the picture with its boxes; each names its class and score."""
    picture, boxes = finding.seen, finding.result["boxes"]
    figure = style.canvas(WIDTH_IN, WIDTH_IN * picture.shape[0] / picture.shape[1] + 0.3)
    axes = figure.add_subplot()
    _show(axes, picture, f"{finding.path.name} · {len(boxes)} found")
    sign_boxes(axes, boxes)
    return figure


def sign_boxes(axes: Axes, boxes: Sequence[Mapping[str, Any]]) -> None:
    """Draw boxes of signs on a picture that `axes` show; each names its class and score."""
    width = max(axes.get_xlim())
    for box in boxes:
        colour = SIGN_COLOURS.get(box["class"], style.BLUE)
        size = (box["x2"] - box["x1"], box["y2"] - box["y1"])
        axes.add_patch(Rectangle((box["x1"], box["y1"]), *size, fill=False, edgecolor=colour, linewidth=1.4))
        right = box["x1"] > 0.7 * width  # the name stays within the picture
        axes.annotate(
            f"{box['class'].replace('_', ' ')} {box['score']:.2f}",
            (box["x2"] if right else box["x1"], box["y1"]),
            (0, 2),
            textcoords="offset points",
            ha="right" if right else "left",
            fontsize=style.SMALL,
            color="white",
            bbox={"facecolor": colour, "edgecolor": "none", "pad": 0.8},
        )


@style.styled
def draw_objects(finding: Finding) -> Figure:
    """Return the point cloud from above, forward up, with its boxes; above it a camera's picture, where there is one.

    On the picture the cloud is coloured by distance, and boxes have their edges.
    """
    boxes, view = boxes_of_rows(finding.result["boxes"]), finding.view()
    title = f"{finding.path.name} · {len(boxes)} found"
    if view is None:
        figure = style.canvas(ABOVE_IN, ABOVE_IN + 0.6)
        above = figure.add_subplot()
        above.set_title(title)
    else:
        height = WIDTH_IN * view.picture.shape[0] / view.picture.shape[1]
        figure = style.canvas(WIDTH_IN, height + ABOVE_IN + 1.2)
        ahead, above = figure.subplots(2, 1, height_ratios=(height, ABOVE_IN))
        ahead.set_title(title)
        _draw_ahead(figure, ahead, finding.seen, boxes, view)
    _draw_above(above, finding.seen, boxes)
    counts = {name: int((boxes.label == name).sum()) for name in BOX_COLOURS}
    look: dict[str, Any] = {"facecolor": "none", "linewidth": 1.4}
    style.key(
        figure,
        [
            Patch(edgecolor=BOX_COLOURS[name], label=f"{count} {name}", **look)
            for name, count in counts.items()
            if count
        ],
    )
    return figure


def _draw_ahead(figure: Figure, axes: Axes, points: NDArray[np.float32], boxes: Boxes, view: CameraView) -> None:
    show_view(axes, view)
    scale = points_on_picture(axes, points, view)
    for name, colour in BOX_COLOURS.items():
        boxes_on_picture(axes, boxes[boxes.label == name], view, colour)
    bar = figure.colorbar(scale, ax=axes, location="bottom", extend="max", fraction=0.03, pad=0.01, aspect=70)
    bar.set_label("distance of a return [m]")
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]


def _draw_above(axes: Axes, points: NDArray[np.float32], boxes: Boxes) -> None:
    across, up = on_page(boxes.corners()[..., :2]).reshape(-1, 2).T
    aside, ahead = (float(np.max(ends, initial=least) + 2) for ends, least in ((np.abs(across), 28), (up, 52)))
    axes.set(xlim=(-aside, aside), ylim=(-6, ahead), aspect="equal")
    axes.scatter(*on_page(points[:, :2]).T, s=0.4, color=style.POINT, linewidths=0, rasterized=True)
    for name, colour in BOX_COLOURS.items():
        draw_boxes(axes, boxes[boxes.label == name], colour, width=1.4)
    axes.plot(0, 0, "^", color=style.INK, markersize=6)
    style.bare(axes)
    style.scale_bar(axes, 10)


DRAWINGS: dict[str, Callable[[Finding], Figure]] = {
    "weather": draw_weather,
    "signs": draw_signs,
    "objects": draw_objects,
    "trajectory": draw_paths,
}


def _show(axes: Axes, picture: NDArray[np.uint8], title: str) -> None:
    height, width = picture.shape[:2]
    axes.imshow(picture, extent=(0, width, height, 0))  # pixels by their edges
    style.bare(axes)
    axes.set_title(title)
