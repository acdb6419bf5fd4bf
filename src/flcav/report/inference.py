"""What a network found in one input, drawn on that input."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.report import style
from flcav.report.predicted_paths import draw_paths
from flcav.report.sweeps import draw_boxes

WIDTH_IN = 8.0
BOX_FIELDS = ("x", "y", "z", "length", "width", "height", "yaw")
SIGN_COLOURS = {"light_red": style.VERMILLION, "light_yellow": style.ORANGE, "light_green": style.GREEN}


@style.styled
def draw_weather(picture: NDArray[np.uint8], result: Mapping[str, Any], title: str) -> Figure:
    """Return the picture beside the probability of each weather."""
    figure = style.canvas(WIDTH_IN * 1.5, WIDTH_IN * picture.shape[0] / picture.shape[1] + 0.4)
    image, bars = figure.subplots(1, 2, width_ratios=(3, 1.2))
    _show(image, picture, f"{title} · {result['class']}")
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
def draw_signs(picture: NDArray[np.uint8], result: Mapping[str, Any], title: str) -> Figure:
    """Return the picture with its boxes; each names its class and score."""
    figure = style.canvas(WIDTH_IN, WIDTH_IN * picture.shape[0] / picture.shape[1] + 0.3)
    axes = figure.add_subplot()
    _show(axes, picture, f"{title} · {len(result['boxes'])} found")
    sign_boxes(axes, result["boxes"])
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


def boxes_of(result: Mapping[str, Any]) -> Boxes:
    """Return the boxes of objects that a finding's JSON holds, LiDAR frame."""
    rows = np.array([[box[name] for name in BOX_FIELDS] for box in result["boxes"]]).reshape(-1, 7)
    return Boxes.from_array(rows, [box["class"] for box in result["boxes"]])


@style.styled
def draw_objects(points: NDArray[np.float32], result: Mapping[str, Any], title: str) -> Figure:
    """Return the point cloud from above, forward up, with its boxes."""
    boxes = boxes_of(result)
    figure = style.canvas(6.5, 6.9)
    axes = figure.add_subplot()
    axes.set(xlim=(-30, 30), ylim=(-6, 54), aspect="equal")
    axes.scatter(-points[:, 1], points[:, 0], s=0.4, color=style.POINT, linewidths=0)
    draw_boxes(axes, boxes, style.BLUE, width=1.4)
    style.bare(axes)
    style.scale_bar(axes, 10)
    axes.set_title(f"{title} · {len(boxes)} found")
    return figure


DRAWINGS: dict[str, Callable[[NDArray[Any], Mapping[str, Any], str], Figure]] = {
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
