"""Predicted paths on the map: each mode as faint as it is unlikely, the truth, and where nobody would turn or brake.

The mode for who wants a single one is the thickest.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from flcav.perception.task import Finding
from flcav.perception.trajectory.infer import AROUND_M
from flcav.report import style

Array = NDArray[np.float64]

MAP_COLOURS = ((0.93, 0.93, 0.92), (0.85, 0.85, 0.84), (0.96, 0.93, 0.84))  # road, lane, crossing
FAINTEST = 0.15
PREDICTED, TRUTH, PLAIN = style.BLUE, style.INK, style.ORANGE


@style.styled
def draw_paths(finding: Finding) -> Figure:
    """Return the map around the observer with the predicted paths of a finding of the trajectory task.

    Ahead of the observer is up.
    """
    figure = style.canvas(7.2, 7.9)
    axes = figure.add_subplot()
    result = finding.result
    paths_on_map(axes, finding.seen, result)
    style.scale_bar(axes, 10)
    axes.set_title(f"{finding.path.name} · {len(result['agents'])} predicted")
    style.key(figure, _legend(result["time_s"][-1], bool(result["lights"])))
    return figure


def paths_on_map(axes: Axes, layers: NDArray[np.bool_], result: Mapping[str, Any]) -> None:
    """Draw the map (layers, H, W) with the paths of a finding on `axes`, see `draw_paths`; agents may have no modes."""
    axes.set(xlim=(-AROUND_M, AROUND_M), ylim=(-AROUND_M, AROUND_M), aspect="equal")
    axes.imshow(_ground(layers), extent=(-AROUND_M, AROUND_M, -AROUND_M, AROUND_M), interpolation="antialiased")
    observer = np.array([result["observer"][name] for name in ("x", "y", "yaw")])
    for light in result["lights"]:
        at = _on_page(np.array([[light["x"], light["y"]]]), observer)[0]
        colour = style.GREEN if light["open"] else style.VERMILLION
        axes.plot(*at, "s", markersize=3.5, color=colour, markeredgewidth=0, zorder=3)
    for agent in result["agents"]:
        _draw_agent(axes, agent, observer)
    axes.plot(0, 0, "^", markersize=6, color=style.INK, markeredgecolor="white", zorder=8)
    style.bare(axes)


def _ground(layers: NDArray[np.bool_]) -> Array:
    out = np.ones((*layers.shape[1:], 3))
    for layer, colour in zip(layers, MAP_COLOURS, strict=True):
        out[layer] = colour
    return out


def _draw_agent(axes: Axes, agent: Mapping[str, Any], observer: Array) -> None:
    length, width, yaw = agent["length"] / 2, agent["width"] / 2, agent["yaw"]
    corners = np.array([(length, width), (length, -width), (-length, -width), (-length, width)])
    turn = np.array([(np.cos(yaw), np.sin(yaw)), (-np.sin(yaw), np.cos(yaw))])
    here = np.array([agent["x"], agent["y"]])
    outline = _on_page(corners @ turn + here, observer)
    axes.add_patch(Polygon(outline, facecolor="white", edgecolor=style.INK, linewidth=0.8, zorder=4))

    def line(path: Sequence[Sequence[float]], **look: Any) -> Array:
        points = _on_page(np.array([here, *path]), observer)
        axes.plot(*points.T, solid_capstyle="round", **look)
        return points[-1]

    line(agent["constant_velocity"], color=PLAIN, linewidth=1.2, linestyle=(0, (2, 1.5)), zorder=5)
    for number, mode in reversed(list(enumerate(agent["modes"]))):
        look = {"color": PREDICTED, "alpha": max(FAINTEST, mode["probability"]), "zorder": 6}
        end = line(mode["path"], linewidth=2.4 if number == 0 else 1.6, **look)
        axes.plot(*end, "o", markersize=4, markeredgewidth=0, **look)
    if agent["truth"] is not None:
        line(agent["truth"], color=TRUTH, linewidth=1.0, zorder=7)


def _on_page(points: Array, observer: Array) -> Array:
    """Return the points (N, 2) of the world to the right of the observer and ahead of it."""
    x, y = (points - observer[:2]).T
    cos, sin = np.cos(observer[2]), np.sin(observer[2])
    return np.stack((sin * x - cos * y, cos * x + sin * y), axis=1)


def _legend(horizon_s: float, lights: bool) -> list[Line2D]:
    handles = [
        Line2D([], [], linestyle="none", marker="^", markersize=6, color=style.INK, label="observer"),
        Line2D([], [], color=PREDICTED, linewidth=2.4, marker="o", markersize=4, label=f"predicted, {horizon_s:g} s"),
        Line2D([], [], color=TRUTH, linewidth=1.0, label="truth"),
        Line2D([], [], color=PLAIN, linewidth=1.2, linestyle=(0, (2, 1.5)), label="constant velocity"),
    ]
    if lights:
        square: dict[str, Any] = {"linestyle": "none", "marker": "s", "markersize": 4}
        handles.append(Line2D([], [], color=style.GREEN, label="green", **square))
        handles.append(Line2D([], [], color=style.VERMILLION, label="red or amber", **square))
    return handles
