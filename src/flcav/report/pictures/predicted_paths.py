"""Predicted paths on the map: modes with their probability as opacity, ground truth, and constant velocity.

The first mode is the single prediction, with the thickest line.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from flcav.geometry import heading_vectors, left_vectors
from flcav.perception.marks import Paths, RoadUser
from flcav.report import style

Array = NDArray[np.float64]

MAP_COLOURS = ((0.93, 0.93, 0.92), (0.85, 0.85, 0.84), (0.96, 0.93, 0.84))  # road, lane, crossing
FAINTEST = 0.15  # least opacity of a mode
PREDICTED, TRUTH, PLAIN = style.BLUE, style.INK, style.ORANGE


def paths_on_map(axes: Axes, layers: NDArray[np.bool_], paths: Paths) -> None:
    """Draw the map (layers, H, W) around the observer with the predicted paths, the observer's heading up."""
    reach, observer = paths.reach_m, np.array(paths.observer)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.imshow(_ground(layers), extent=(-reach, reach, -reach, reach), interpolation="antialiased")
    for light in paths.lights:
        at = _on_page(np.array([[light.x, light.y]]), observer)[0]
        colour = style.GREEN if light.open else style.VERMILLION
        axes.plot(*at, "s", markersize=3.5, color=colour, markeredgewidth=0, zorder=3)
    for user in paths.users:
        _draw_user(axes, user, observer)
    axes.plot(0, 0, "^", markersize=6, color=style.INK, markeredgecolor="white", zorder=8)
    style.hide_axes(axes)


def _ground(layers: NDArray[np.bool_]) -> Array:
    out = np.ones((*layers.shape[1:], 3))
    for layer, colour in zip(layers, MAP_COLOURS, strict=True):
        out[layer] = colour
    return out


def _draw_user(axes: Axes, user: RoadUser, observer: Array) -> None:
    length, width = user.length / 2, user.width / 2
    corners = np.array([(length, width), (length, -width), (-length, -width), (-length, width)])
    turn = np.stack((heading_vectors(user.yaw), left_vectors(user.yaw)))
    here = np.array([user.x, user.y])
    outline = _on_page(corners @ turn + here, observer)
    axes.add_patch(Polygon(outline, facecolor="white", edgecolor=style.INK, linewidth=0.8, zorder=4))

    def line(path: Array, **look: Any) -> Array:
        points = _on_page(np.concatenate((here[None], path)), observer)
        axes.plot(*points.T, solid_capstyle="round", **look)
        return points[-1]

    if user.constant_velocity is not None:
        line(user.constant_velocity, color=PLAIN, linewidth=1.2, linestyle=(0, (2, 1.5)), zorder=5)
    for number, mode in reversed(list(enumerate(user.modes))):
        look = {"color": PREDICTED, "alpha": max(FAINTEST, mode.probability), "zorder": 6}
        end = line(mode.path, linewidth=2.4 if number == 0 else 1.6, **look)
        axes.plot(*end, "o", markersize=4, markeredgewidth=0, **look)
    if user.truth is not None:
        line(user.truth, color=TRUTH, linewidth=1.0, zorder=7)


def _on_page(points: Array, observer: Array) -> Array:
    """Return world points (N, 2) in page coordinates: distances to the right of the observer and ahead of it [m]."""
    x, y = (points - observer[:2]).T
    cos, sin = np.cos(observer[2]), np.sin(observer[2])
    return np.stack((sin * x - cos * y, cos * x + sin * y), axis=1)


def paths_key(paths: Paths) -> list[Line2D]:
    """Return the legend of `paths_on_map`."""
    horizon_s = paths.times_s[-1]
    handles = [
        Line2D([], [], linestyle="none", marker="^", markersize=6, color=style.INK, label="observer"),
        Line2D([], [], color=PREDICTED, linewidth=2.4, marker="o", markersize=4, label=f"predicted, {horizon_s:g} s"),
        Line2D([], [], color=TRUTH, linewidth=1.0, label="truth"),
        Line2D([], [], color=PLAIN, linewidth=1.2, linestyle=(0, (2, 1.5)), label="constant velocity"),
    ]
    if paths.lights:
        square: dict[str, Any] = {"linestyle": "none", "marker": "s", "markersize": 4}
        handles.append(Line2D([], [], color=style.GREEN, label="green", **square))
        handles.append(Line2D([], [], color=style.VERMILLION, label="red or amber", **square))
    return handles
