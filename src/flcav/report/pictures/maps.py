"""The map of a town with registered errors, candidate poles and the chosen ones."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from flcav.geometry import Boxes
from flcav.report import style
from flcav.world.map.town import Town

Array = NDArray[np.float64]

MISS: dict[str, Any] = {
    "marker": "o",
    "markersize": 5,
    "color": style.MISSED,
    "markeredgecolor": "white",
    "markeredgewidth": 0.5,
}
FALSE_POSITIVE: dict[str, Any] = {"marker": "x", "markersize": 5, "color": style.FALSE, "markeredgewidth": 1.3}
FINAL_ERROR: dict[str, Any] = {**MISS, "marker": "^", "color": style.ORANGE}
OTHER: dict[str, Any] = {**MISS, "marker": "D", "markersize": 4, "color": style.INK}
KINDS = {
    "miss": ("missed", MISS),
    "false_positive": ("false positive", FALSE_POSITIVE),
    "final_error": ("final error", FINAL_ERROR),
}
NOTE_M = 15.0  # approximate distance of a note from its pole
WIDE = 3.0  # width of a note, divided by its height
CELL_M = 2.0  # of the map of the errors' density
BLUR_M = 12.0  # standard deviation of its smoothing: half of a crossing
HEAT = LinearSegmentedColormap.from_list("heat", ["#fff3e0", "#f6b26b", "#c0392b"])
DENSEST, MOST_VISIBLE = "densest traffic", "most visible objects"  # what the poles of conventional rules have
HALO = [patheffects.withStroke(linewidth=2.5, foreground="white")]


@dataclass(frozen=True)
class ErrorMap:
    """Registered errors of a network in a town, and the placement of roadside sensors for them."""

    town: Town
    errors: Array  # (E, 3) world [m]
    kind: NDArray[np.str_]  # (E,) a key of KINDS, or a kind of a user's own
    poles: Mapping[str, Array]  # candidate sites by id: (3,) world [m]
    chosen: Mapping[str, float] = field(default_factory=dict)  # poles with a sensor: its range [m] by the pole's id
    conventional: Mapping[str, Collection[str]] = field(default_factory=dict)  # ids of a rule's poles by what they have
    zones: Mapping[str, float] = field(default_factory=dict)  # errors per hectare within `zone_m` of a pole, by its id
    zone_m: float = 0.0
    heat: bool = False  # whether to show the density of the errors


def poles_of(town: Town) -> dict[str, Array]:
    """Return a town's candidate sites by id."""
    return {str(number): xyz for number, xyz in zip(town.poles.id, town.poles.position, strict=True)}


def draw_town(axes: Axes, town: Town) -> None:
    """Draw roads, buildings and trees of `town`, and a scale bar."""
    x_low, y_low, x_high, y_high = town.bounds
    axes.set(xlim=(x_low, x_high), ylim=(y_low, y_high), aspect="equal")
    style.hide_axes(axes)
    axes.add_collection(PolyCollection(list(town.sidewalks), facecolor=style.SIDEWALK, linewidth=0))
    axes.add_collection(PolyCollection(list(town.roads), facecolor=style.ROAD, edgecolor=style.ROAD, linewidth=0.5))
    trees = [Circle((x, y), radius) for x, y, _, radius in town.trees]
    axes.add_collection(PatchCollection(trees, facecolor=style.TREE, linewidth=0))
    x, y, yaw, length, width, height = town.buildings.T
    houses = Boxes.from_array(np.c_[x, y, height / 2, length, width, height, yaw], "building")
    outlines = houses.corners()[:, :4, :2]
    axes.add_collection(PolyCollection(list(outlines), facecolor=style.BUILDING, linewidth=0))
    style.scale_bar(axes, 50)


def draw_errors(axes: Axes, scene: ErrorMap) -> None:
    """Draw the town, errors, zones and poles: the chosen ones with their range, those of conventional rules square."""
    draw_town(axes, scene.town)
    if scene.heat and len(scene.errors):
        draw_density(axes, scene)
    for number, range_m in scene.chosen.items():
        at = scene.poles[number]
        reach = np.sqrt(max(range_m**2 - at[2] ** 2, 0.0))  # of the sphere, at ground level
        axes.add_patch(Circle(tuple(at[:2]), reach, facecolor=style.BLUE, alpha=0.10, linewidth=0, zorder=1.5))
        axes.add_patch(Circle(tuple(at[:2]), reach, fill=False, edgecolor=style.BLUE, linewidth=1.2, zorder=1.5))
    for kind in dict.fromkeys([*KINDS, *scene.kind.tolist()]):
        label, look = KINDS.get(kind, (kind, OTHER))
        xyz = scene.errors[scene.kind == kind]
        if not len(xyz):
            continue
        axes.plot(*xyz[:, :2].T, linestyle="none", label=f"{label} ({len(xyz)})", **look)
    for number, per_hectare in scene.zones.items():
        x, y = scene.poles[number][:2]
        axes.add_patch(
            Circle((x, y), scene.zone_m, fill=False, edgecolor=style.INK, linewidth=0.8, linestyle=":", zorder=1.5)
        )
        look = {"fontsize": style.SMALL, "path_effects": HALO, "zorder": 6}
        axes.text(x, y - scene.zone_m, f"{per_hectare:.0f}/ha", ha="center", va="center_baseline", **look)
    notes: list[Array] = []  # their positions (2,)
    for number, (x, y, _) in scene.poles.items():
        chosen, rules = number in scene.chosen, [name for name, own in scene.conventional.items() if number in own]
        face, ink = (style.BLUE, "white") if chosen else ("white", style.INK)
        axes.plot(x, y, "s" if rules else "o", markersize=13, color=face, markeredgecolor=style.INK, zorder=5)
        axes.text(x, y, number, ha="center", va="center_baseline", fontsize=style.SMALL, color=ink, zorder=6)
        if note := _join([*(["placed"] if chosen else []), *rules]):
            others = [xyz[:2] for other, xyz in scene.poles.items() if other != number]
            notes.append(_write_beside(axes, note, np.array([x, y]), np.array([*others, *notes]).reshape(-1, 2)))


def draw_density(axes: Axes, scene: ErrorMap) -> None:
    """Draw the errors per hectare, smoothed by a Gaussian of BLUR_M, with a colour bar."""
    x_low, y_low, x_high, y_high = scene.town.bounds
    columns, rows = (max(round(size / CELL_M), 1) for size in (x_high - x_low, y_high - y_low))
    counts = np.histogram2d(
        scene.errors[:, 1], scene.errors[:, 0], (rows, columns), ((y_low, y_high), (x_low, x_high))
    )[0]
    per_hectare = gaussian_filter(counts, BLUR_M / CELL_M, mode="constant") * 1e4 / CELL_M**2
    x, y = (low + CELL_M / 2 + CELL_M * np.arange(n) for low, n in ((x_low, columns), (y_low, rows)))
    levels = MaxNLocator(6).tick_values(0.0, float(per_hectare.max()))[1:]  # the least dense zone is left blank
    zones = axes.contourf(x, y, per_hectare, levels, cmap=HEAT, alpha=0.8, zorder=1.2, extend="neither")
    bar = axes.figure.colorbar(zones, ax=axes, shrink=0.6, pad=0.02, aspect=25)
    bar.set_label("errors per hectare", color=style.MUTED)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]


def _join(words: Sequence[str]) -> str:
    """Return "a", "a and b", or on two lines "a, b and c"; "" of none."""
    if len(words) < 3:
        return " and ".join(words)
    return f"{', '.join(words[:-1])}\nand {words[-1]}"


def _write_beside(axes: Axes, note: str, at: Array, others: Array) -> Array:
    """Write `note` above or below the pole `at`, whichever is farther from the `others` (N, 2); return where (2,)."""
    places = [at + np.array((0.0, side * NOTE_M)) for side in (1, -1)]
    above, below = (np.hypot(*((others - place) / (WIDE, 1.0)).T).min(initial=np.inf) for place in places)
    look = {"fontsize": style.SMALL, "fontweight": "bold", "path_effects": HALO, "zorder": 6}
    offset, align = (10, "bottom") if above >= below else (-10, "top")
    axes.annotate(note, (at[0], at[1]), (0, offset), textcoords="offset points", ha="center", va=align, **look)
    return places[0] if above >= below else places[1]
