"""Real and simulated clouds beside each other, and detections in a real one."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.perception.camera_view import CameraView
from flcav.report import style
from flcav.report.on_picture import boxes_on_picture, show_view
from flcav.report.sweeps import draw_boxes, draw_points

COLOURS = (style.INK, style.BLUE, style.ORANGE)
EXTENT = (0.0, 60.0, 22.0)


@dataclass(frozen=True)
class Street:
    """The street at some distance ahead; medians."""

    ahead_m: str  # "near-far"
    height_m: float  # sensor frame
    spread_m: float  # of height: between quartiles
    intensity: float


@dataclass(frozen=True)
class SeenCar:
    """A car that has returns."""

    distance_m: float
    returns: int
    length_m: float
    width_m: float
    height_m: float
    without_intensity: float  # share of its returns


@dataclass(frozen=True)
class CloudNumbers:
    """What the clouds of some frames are like; means per frame."""

    frames: int
    returns: float
    returns_per_range: Mapping[str, float]  # "near-far m" -> returns
    intensity_quantiles: tuple[float, ...]  # 5, 25, 50, 75 and 95 %
    without_intensity: float  # share of returns
    ground: tuple[Street, ...]
    cars: tuple[SeenCar, ...]


@style.styled
def compare(clouds: Mapping[str, CloudNumbers]) -> Figure:
    """Return four panels: returns per range, intensities, the street ahead, returns per car."""
    figure = style.canvas(9.0, 6.4)
    ranges, intensity, ground, cars = figure.subplots(2, 2).ravel()
    for numbers, colour in zip(clouds.values(), COLOURS, strict=False):
        width = 1.8 if colour == style.INK else 1.4
        per_range = numbers.returns_per_range
        ranges.plot(range(len(per_range)), list(per_range.values()), "o-", color=colour, linewidth=width, markersize=3)
        ranges.set_xticks(range(len(per_range)), [key.removesuffix(" m") for key in per_range], rotation=45)
        intensity.plot(numbers.intensity_quantiles, (5, 25, 50, 75, 95), "o-", color=colour, linewidth=width)
        street = numbers.ground
        middle = [np.mean([float(limit) for limit in row.ahead_m.split("-")]) for row in street]
        ground.plot(middle, [row.intensity for row in street], "o-", color=colour, linewidth=width)
        dots = np.array([(car.distance_m, car.returns) for car in numbers.cars]).reshape(-1, 2)
        size = 34 if colour == style.INK else 9
        cars.scatter(*dots.T, s=size, color=colour, linewidths=0, zorder=3 if colour == style.INK else 2)
    _name(ranges, "returns of a frame", "distance [m]")
    _name(intensity, "share of returns below [%]", "intensity")
    _name(ground, "median intensity of the street", "distance ahead [m]")
    _name(cars, "returns of a car", "distance [m]")
    cars.set_yscale("log")
    ground.set_ylim(bottom=0)
    handles = [
        Line2D([], [], color=colour, marker="o", label=name) for name, colour in zip(clouds, COLOURS, strict=False)
    ]
    style.key(figure, handles)
    return figure


@style.styled
def real_frame(
    name: str, points: NDArray[np.float32], view: CameraView, cars: Boxes, hit: NDArray[np.bool_], found: Boxes
) -> Figure:
    """Return a real frame's cloud from above beside its image, with the labelled cars and the boxes found.

    `hit` (cars,): which were found at IoU 0.5.
    """
    figure = style.canvas(11.0, 4.9)
    above, ahead = figure.subplots(1, 2, width_ratios=(1, 1.55))
    draw_points(above, points, -1.7, EXTENT)
    draw_boxes(above, cars[hit], style.GREEN, fill=0.25, width=1.0)
    draw_boxes(above, cars[~hit], style.MISSED, fill=0.35, width=1.0)
    draw_boxes(above, found, style.BLUE, width=1.4)
    style.bare(above)
    style.scale_bar(above, 10)
    above.set_title(f"{name}: {hit.sum()} of {len(cars)} cars found at IoU 0.5")
    show_view(ahead, view)
    for boxes, colour in ((cars[hit], style.GREEN), (cars[~hit], style.MISSED), (found, style.BLUE)):
        boxes_on_picture(ahead, boxes, view, colour, width=1.0)
    colours = {"labelled, found": style.GREEN, "labelled, missed": style.MISSED, "detection": style.BLUE}
    style.key(figure, [Line2D([], [], color=colour, label=name) for name, colour in colours.items()])
    return figure


def _name(axes: Axes, y: str, x: str) -> None:
    axes.set_ylabel(y)
    axes.set_xlabel(x)
    axes.grid(axis="y")
