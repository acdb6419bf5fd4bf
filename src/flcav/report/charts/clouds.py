"""Chart of the statistics of point clouds, of several origins beside each other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flcav.report import style

COLOURS = (style.INK, style.BLUE, style.ORANGE)


@dataclass(frozen=True)
class CloudSeries:
    """The series that are drawn of the clouds of one origin."""

    returns_per_range: Mapping[str, float]  # "near-far m" -> returns of a frame
    intensity_quantiles: Sequence[float]  # 5, 25, 50, 75 and 95 %
    street: Sequence[tuple[float, float]]  # distance ahead [m], median intensity
    cars: Sequence[tuple[float, int]]  # distance [m], returns


@style.styled
def cloud_statistics(clouds: Mapping[str, CloudSeries]) -> Figure:
    """Return four panels: returns by range, distribution of intensity, intensity of the street, returns by car."""
    figure = style.canvas(9.0, 6.4)
    ranges, intensity, ground, cars = figure.subplots(2, 2).ravel()
    for numbers, colour in zip(clouds.values(), COLOURS, strict=False):
        width = 1.8 if colour == style.INK else 1.4
        per_range = numbers.returns_per_range
        ranges.plot(range(len(per_range)), list(per_range.values()), "o-", color=colour, linewidth=width, markersize=3)
        ranges.set_xticks(range(len(per_range)), [key.removesuffix(" m") for key in per_range], rotation=45)
        intensity.plot(numbers.intensity_quantiles, (5, 25, 50, 75, 95), "o-", color=colour, linewidth=width)
        ground.plot(*np.reshape(numbers.street, (-1, 2)).T, "o-", color=colour, linewidth=width)
        size, order = (34, 3) if colour == style.INK else (9, 2)
        cars.scatter(*np.reshape(numbers.cars, (-1, 2)).T, s=size, color=colour, linewidths=0, zorder=order)
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


def _name(axes: Axes, y: str, x: str) -> None:
    axes.set_ylabel(y)
    axes.set_xlabel(x)
    axes.grid(axis="y")
