"""Statistics of LiDAR clouds: returns by range, intensities, the street ahead, and cars.

Only points in the view of a forward camera count, since KITTI labels no others.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from flcav.geometry import Boxes, points_in_boxes
from flcav.perception.objects.augment import in_view
from flcav.report import style

RANGES_M = (0, 5, 10, 15, 20, 25, 30, 40, 50, 60, 80)
GROUND_M = (5, 8, 12, 16, 20, 25)  # limits of the sections of street ahead
ASIDE_M = 4.0  # half the width of the street
LOW_M = -1.2  # points below are ground, sensor frame
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
NO_INTENSITY = 0.005  # below this a return counts as without intensity

Labelled = tuple[NDArray[np.float32], Boxes]  # points (N, 4) and cars of a frame, LiDAR frame


@dataclass(frozen=True)
class Street:
    """Medians of the points of the street in one section ahead."""

    ahead_m: str  # limits of the section, "near-far"
    height_m: float  # median, sensor frame
    spread_m: float  # interquartile range of height
    intensity: float


@dataclass(frozen=True)
class SeenCar:
    """A labelled car with returns."""

    distance_m: float
    returns: int
    length_m: float
    width_m: float
    height_m: float
    without_intensity: float  # share of its returns


@dataclass(frozen=True)
class CloudNumbers:
    """Statistics of the clouds of several frames; numbers of returns are means per frame."""

    frames: int
    returns: float
    returns_per_range: Mapping[str, float]  # "near-far m" -> returns
    intensity_quantiles: tuple[float, ...]  # 5, 25, 50, 75 and 95 %
    without_intensity: float  # share of returns
    ground: tuple[Street, ...]
    cars: tuple[SeenCar, ...]


def summarise_clouds(frames: Iterable[Labelled]) -> CloudNumbers:
    """Return the statistics of the clouds of several frames."""
    frames = [(points[in_view(points)], cars) for points, cars in frames]
    points = np.concatenate([points for points, _ in frames])
    distance = np.linalg.norm(points[:, :3], axis=1)
    per_range = np.histogram(distance, RANGES_M)[0] / len(frames)
    return CloudNumbers(
        frames=len(frames),
        returns=len(points) / len(frames),
        returns_per_range=dict(zip(_names(RANGES_M), per_range.round(1).tolist(), strict=True)),
        intensity_quantiles=tuple(np.quantile(points[:, 3], QUANTILES).round(3).tolist()),
        without_intensity=float((points[:, 3] < NO_INTENSITY).mean()),
        ground=_ground(points),
        cars=tuple(car for cloud, cars in frames for car in _cars(cloud, cars)),
    )


def _ground(points: NDArray[np.float32]) -> tuple[Street, ...]:
    """Return the median height and intensity of the street, and the spread of its height, by distance ahead."""
    low = points[(np.abs(points[:, 1]) < ASIDE_M) & (points[:, 2] < LOW_M)]
    rows = []
    for near, far in itertools.pairwise(GROUND_M):
        section = low[(low[:, 0] >= near) & (low[:, 0] < far)]
        if len(section):
            height, intensity = float(np.median(section[:, 2])), float(np.median(section[:, 3]))
            spread = float(np.subtract(*np.quantile(section[:, 2], (0.75, 0.25))))
            rows.append(Street(f"{near}-{far}", height, spread, intensity))
    return tuple(rows)


def _cars(points: NDArray[np.float32], cars: Boxes) -> list[SeenCar]:
    """Return distance, returns, size and share of returns without intensity of each car with returns."""
    inside = points_in_boxes(points, cars)
    rows = []
    for box, is_inside in zip(cars.array(), inside, strict=True):
        if is_inside.any():
            without_intensity = float((points[is_inside, 3] < NO_INTENSITY).mean())
            length, width, height = box[3:6].round(2).tolist()
            rows.append(
                SeenCar(float(np.hypot(*box[:2])), int(is_inside.sum()), length, width, height, without_intensity)
            )
    return rows


def _names(limits: tuple[int, ...]) -> list[str]:
    return [f"{low}-{high} m" for low, high in itertools.pairwise(limits)]


COLOURS = (style.INK, style.BLUE, style.ORANGE)


@dataclass(frozen=True)
class CloudSeries:
    """The series of the clouds of one origin, as drawn."""

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
