"""Map of a town: streets with their markings, buildings, trees, signs, lights, and numbered poles."""

from collections.abc import Iterable
from typing import Required, TypedDict

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from shapely.geometry import MultiPoint

from flcav.geometry import heading_vectors
from flcav.report import style
from flcav.world.map.lanes import map_layers
from flcav.world.map.layers import outline_paint
from flcav.world.map.town import Town

Array = NDArray[np.float64]

GRASS = "#e7ecdf"
ROAD, KERB, PAVEMENT = "#8d8f92", "#b9b6ae", "#dcd9d2"
PAINTED = "#ffffff"
HOUSES = ("#e3cfb8", "#d9b99a", "#c99f7d")  # by height, low to high
HOUSE_EDGE, SHADE = "#a5876c", "#00000022"
TREES, CROWN = "#9fb98a", "#86a371"
CLUTTER = "#b3a999"
LAMP = "#f2c94c"
WIDE_IN = 10.0
SUN = np.array([0.35, -0.5])  # offset of a shadow x, y [m] for a height of `SHADOW`
SHADOW = 5.0  # [m]


@style.styled
def town_map(town: Town) -> bytes:
    """Return the map of a town as a PNG file; equal towns give equal bytes."""
    x_low, y_low, x_high, y_high = town.bounds
    figure = style.canvas(WIDE_IN, WIDE_IN * (y_high - y_low) / (x_high - x_low) + 0.8)
    axes = figure.add_subplot()
    draw_map(axes, town)
    figure.suptitle(f"{town.name}: {town.parameters.description}", fontsize=style.TEXT + 1, color=style.INK)
    style.key(figure, _legend(town), fontsize=style.TEXT)
    return style.png(figure, dpi=160)


def draw_map(axes: Axes, town: Town) -> None:
    """Draw a town into axes; world frame [m]."""
    layers = map_layers(town)
    x_low, y_low, x_high, y_high = town.bounds
    axes.set(xlim=(x_low, x_high), ylim=(y_low, y_high), aspect="equal", facecolor=GRASS)
    style.hide_axes(axes)

    def fill(polygons: Iterable[Array], colour: str | list[str], edge: str = "none", width: float = 0.0) -> None:
        axes.add_collection(PolyCollection(list(polygons), facecolors=colour, edgecolors=edge, linewidths=width))

    fill(town.sidewalks, PAVEMENT, PAVEMENT, 0.3)
    fill(town.roads, ROAD, ROAD, 0.3)
    axes.add_collection(LineCollection(list(town.kerbs), colors=KERB, linewidths=0.6))
    fill((shape.outline for shape in outline_paint(layers)), PAINTED, PAINTED, 0.15)
    for _, rows in town.clutter:
        fill((footprint(*row[:5]) for row in rows), CLUTTER)
    houses = [footprint(*row[:5]) for row in town.buildings]
    heights = town.buildings[:, 5]
    fill((shadow(house, height) for house, height in zip(houses, heights)), SHADE)
    classes = np.digitize(heights, np.quantile(heights, (1 / 3, 2 / 3)) if len(heights) else (0, 0))
    fill(houses, [HOUSES[i] for i in classes], HOUSE_EDGE, 0.5)
    discs(axes, town.trees[:, :2] + SUN * 0.8, 2 * town.trees[:, 3], SHADE)
    discs(axes, town.trees[:, :2], 2 * town.trees[:, 3], TREES, CROWN)
    discs(axes, town.lamps[:, :2], np.full(len(town.lamps), 0.9), LAMP)
    for label, look, at in symbols(town):
        axes.plot(*at.T, linestyle="none", label=label, **look)
    for number, (x, y, _) in zip(town.poles.id, town.poles.position):
        axes.plot(x, y, "o", markersize=13, color=style.BLUE, markeredgecolor="white", zorder=8)
        axes.text(x, y, str(number), ha="center", va="center_baseline", fontsize=8, color="white", zorder=9)
    style.scale_bar(axes, 50)


class Marker(TypedDict, total=False):
    """The marker of a kind of sign or light, as arguments of `Axes.plot`."""

    marker: Required[str]
    markersize: Required[float]  # [pt]
    color: Required[str]
    markeredgecolor: str


def symbols(town: Town) -> list[tuple[str, Marker, Array]]:
    """Return label, marker and positions (N, 2) of each kind of sign and light in a town."""
    kinds = np.array(town.signs.kind)
    at = town.signs.position[:, :2]
    speed = np.char.startswith(kinds, "speed") if len(kinds) else np.zeros(0, np.bool_)
    rows: list[tuple[str, Marker, Array]] = [
        ("traffic light", {"marker": "s", "markersize": 4.5, "color": style.GREEN}, town.signals.position[:, :2]),
        ("stop sign", {"marker": "8", "markersize": 6, "color": style.VERMILLION}, at[kinds == "stop"]),
        ("give way sign", {"marker": "v", "markersize": 6, "color": style.ORANGE}, at[kinds == "yield"]),
        (
            "speed sign",
            {"marker": "o", "markersize": 5, "color": "white", "markeredgecolor": style.VERMILLION},
            at[speed],
        ),
    ]
    return [row for row in rows if len(row[2])]


def shadow(house: Array, height: float) -> Array:
    """Return the convex hull (K, 2) [m] of a house's outline (4, 2) [m] and its shadow, for a `height` [m]."""
    both = MultiPoint(np.concatenate((house, house + SUN * height / SHADOW)))
    return shapely.get_coordinates(both.convex_hull)


def footprint(x: float, y: float, yaw: float, length: float, width: float) -> Array:
    """Return the corners (4, 2) [m] of a rectangle with centre x, y [m], heading `yaw` [rad], length and width [m]."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2 * (length, width)
    cos, sin = heading_vectors(yaw)
    return corners @ np.array([[cos, sin], [-sin, cos]]) + (x, y)


def discs(axes: Axes, at: Array, diameter: Array, colour: str, edge: str = "none") -> None:
    """Draw discs at positions (N, 2) with diameters (N,) [m]."""
    axes.add_collection(
        EllipseCollection(
            diameter, diameter, np.zeros(len(at)), units="x", offsets=at, transOffset=axes.transData,
            facecolors=colour, edgecolors=edge, linewidths=0.4,
        )
    )  # fmt: skip


def _legend(town: Town) -> list[Line2D]:
    pole = {"marker": "o", "markersize": 9, "color": style.BLUE, "markeredgecolor": "white"}
    rows = [("candidate pole", pole), *((label, look) for label, look, _ in symbols(town))]
    rows.append(("street lamp", {"marker": "o", "markersize": 4, "color": LAMP}))
    rows.append(("tree", {"marker": "o", "markersize": 9, "color": TREES, "markeredgecolor": CROWN}))
    return [Line2D([], [], linestyle="none", label=label, **look) for label, look in rows]
