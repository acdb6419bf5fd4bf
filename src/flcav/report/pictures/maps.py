"""Map of a town with registered errors, candidate poles and chosen poles."""

import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter
from shapely.geometry import LineString, Point

from flcav.geometry import Boxes
from flcav.report import style
from flcav.world.geodesy import convert_to_geodetic
from flcav.world.line_of_sight import Viewshed
from flcav.world.map.town import Town
from flcav.world.sites import list_street_names

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
OTHERS: tuple[dict[str, Any], ...] = tuple(
    {**MISS, "marker": marker, "color": style.INK} for marker in ("D", "s", "v", "P", "h")
)
KINDS = {
    "miss": ("missed", MISS),
    "false_positive": ("false positive", FALSE_POSITIVE),
    "final_error": ("final error", FINAL_ERROR),
}
CROWDED = 30  # number of poles above which only the chosen ones and those of rules are numbered
LONGEST = 3  # greatest length of an id that fits a pole's mark
LINE_EM = 0.52  # width of a character of the lines below a map, in ems
CELL_M = 2.0  # cell size of the map of error density
BLUR_M = 12.0  # standard deviation of its smoothing: half the width of a crossing
HEAT = LinearSegmentedColormap.from_list("heat", ["#fff3e0", "#f6b26b", "#c0392b"])
BARS_M = (10, 20, 50, 100, 200, 500, 1000, 2000)  # lengths of scale bars
TURNED = 1e-3  # rotation of the axes against east and north above which latitudes are left out
ROOM = 0.75  # least ratio of a street's length to that of its name, which may reach into junctions
DENSE = 120  # number of errors above which they are drawn smaller
DENSEST, MOST_VISIBLE = "densest traffic", "most visible objects"  # conventional rules of placement
HALO = [patheffects.withStroke(linewidth=2.5, foreground="white")]


@dataclass(frozen=True)
class ErrorMap:
    """Registered errors of a network in a town, and the placement of roadside sensors for them."""

    town: Town
    errors: Array  # (E, 3) world [m]
    kind: NDArray[np.str_]  # (E,) a key of KINDS, or a user-defined kind
    poles: Mapping[str, Array]  # candidate sites (3,) world [m] by id
    chosen: Mapping[str, float] = field(default_factory=dict)  # range [m] of the sensors on chosen poles, by id
    covered: NDArray[np.bool_] | None = None  # (E,) whether a sensor covers the error; None: not shown
    viewsheds: Mapping[str, Viewshed] = field(default_factory=dict)  # of chosen poles, shown in place of their range
    notes: Sequence[str] = ()  # lines on the placement below the map; by default the chosen poles
    conventional: Mapping[str, Collection[str]] = field(default_factory=dict)  # ids of poles by conventional rule
    zones: Mapping[str, float] = field(default_factory=dict)  # errors per hectare within `zone_m` of poles, by id
    zone_m: float = 0.0
    heat: bool = False  # whether to show the density of the errors
    title: str = ""  # above the map
    beyond: NDArray[np.bool_] | None = None  # (E,) whether no candidate reaches the error; None: not shown
    noun: str = "error"  # name of a place: "error", or "point" for user-defined places


def poles_of(town: Town) -> dict[str, Array]:
    """Return a town's candidate sites (3,) [m, world] by id."""
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
    style.scale_bar(axes, max(length for length in BARS_M if length <= max((x_high - x_low) / 6, BARS_M[0])))


def draw_coordinates(axes: Axes, town: Town) -> None:
    """Draw coordinates of the world frame [m] below and to the left of a map, latitude and longitude opposite.

    The latter are left out where the axes of the town's geo-reference are rotated.
    """
    for axis, side in ((axes.xaxis, "bottom"), (axes.yaxis, "left")):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(lambda value, _: f"{value:g} m".replace("-", "\N{MINUS SIGN}"))
        axis.set_tick_params(length=3, width=0.6)
        axes.spines[side].set_visible(True)
    (along, turned), (back, ahead) = town.geo.x_axis, town.geo.y_axis
    if max(abs(turned), abs(back)) > TURNED or min(along, ahead) <= 0:
        return
    x_low, y_low, x_high, y_high = town.bounds
    (south, west, _), (north, east, _) = convert_to_geodetic(
        town.geo, np.array(((x_low, y_low, 0.0), (x_high, y_high, 0.0)))
    ).tolist()
    above = axes.secondary_xaxis("top", functions=_map_linearly((x_low, x_high), (west, east)))
    right = axes.secondary_yaxis("right", functions=_map_linearly((y_low, y_high), (south, north)))
    for owner, axis, side, signs in ((above, above.xaxis, "top", "EW"), (right, right.yaxis, "right", "NS")):
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(lambda value, _, signs=signs: f"{abs(value):.7g}° {signs[int(value < 0)]}")
        axis.set_tick_params(length=3, width=0.6)
        owner.spines[side].set_visible(True)


def _map_linearly(
    one: tuple[float, float], other: tuple[float, float]
) -> tuple[Callable[[ArrayLike], ArrayLike], Callable[[ArrayLike], ArrayLike]]:
    """Return the linear function that maps the ends of one interval to those of the other, and its inverse."""
    slope = (other[1] - other[0]) / (one[1] - one[0])
    return (
        lambda value: other[0] + (np.asarray(value) - one[0]) * slope,
        lambda value: one[0] + (np.asarray(value) - other[0]) / slope,
    )


def draw_street_names(axes: Axes, scene: ErrorMap) -> None:
    """Write the names of the town's streets along them, once per street, where there is room and no sensor."""
    figure = axes.figure.get_figure(root=True)
    metres_per_pt = (scene.town.bounds[2] - scene.town.bounds[0]) / (72 * figure.get_figwidth())
    taken = [scene.poles[number][:2] for number in scene.chosen]
    for name, lines in list_street_names(scene.town).items():
        wide_m = LINE_EM * style.SMALL * len(name) * metres_per_pt
        rooms = [line for line in map(LineString, lines) if line.length >= ROOM * wide_m]
        free = [min((line.distance(Point(at)) for at in taken), default=0.0) for line in rooms]
        if not rooms:
            continue
        line = rooms[int(np.argmax(free))]
        middle, ahead = (line.interpolate(line.length / 2 + step) for step in (0.0, 1.0))
        turn = np.degrees(np.arctan2(ahead.y - middle.y, ahead.x - middle.x))
        upright = (turn + 90) % 180 - 90
        look: dict[str, Any] = {"fontsize": style.SMALL, "fontstyle": "italic", "color": style.MUTED}
        at = {"ha": "center", "va": "center", "rotation": upright, "rotation_mode": "anchor", "zorder": 4.5}
        axes.text(middle.x, middle.y, name, path_effects=HALO, clip_on=True, **look, **at)


def draw_errors(axes: Axes, scene: ErrorMap) -> None:
    """Draw the town, errors, zones and poles, with lines below about the chosen poles and those of conventional rules.

    A chosen pole is drawn with its viewshed or range, a pole of a conventional rule as a square, a covered error in
    blue.
    """
    draw_town(axes, scene.town)
    if scene.heat and len(scene.errors):
        draw_density(axes, scene)
    for number, range_m in scene.chosen.items():
        draw_reach(axes, scene.poles[number], range_m, scene.viewsheds.get(number))
    _plot_errors(axes, scene)
    for number, per_hectare in scene.zones.items():
        x, y = scene.poles[number][:2]
        axes.add_patch(
            Circle((x, y), scene.zone_m, fill=False, edgecolor=style.INK, linewidth=0.8, linestyle=":", zorder=1.5)
        )
        look = {"fontsize": style.SMALL, "path_effects": HALO, "zorder": 6}
        axes.text(x, y - scene.zone_m, f"{per_hectare:.0f}/ha", ha="center", va="center_baseline", **look)
    _plot_poles(axes, scene)
    placed = scene.notes or ([f"placed: {name_poles(scene.chosen)}"] if scene.chosen else ())
    rules = [f"{rule}: {name_poles(ids)}" for rule, ids in scene.conventional.items() if ids]
    width_pt = axes.figure.get_figure(root=True).get_figwidth() * 72 * axes.get_position().width
    wide = max(int(width_pt / (LINE_EM * style.SMALL)), 20)
    lines = [line for note in (*placed, *rules) for line in textwrap.wrap(note, wide, subsequent_indent="    ")]
    axes.set_xlabel("\n".join(lines), loc="left", fontsize=style.SMALL, color=style.INK)


def name_poles(ids: Collection[str]) -> str:
    """Return ids of poles in words: "pole 2" or "poles 2, 3"."""
    return f"pole{'' if len(ids) == 1 else 's'} {', '.join(ids)}"


def draw_reach(axes: Axes, at: Array, range_m: float, viewshed: Viewshed | None) -> None:
    """Draw the range of a sensor `at` (3,) [m] on the ground, filled within its viewshed, or entirely without one."""
    reach = np.sqrt(max(range_m**2 - at[2] ** 2, 0.0))  # radius of the range's sphere at ground level
    look: dict[str, Any] = {"edgecolor": style.BLUE, "zorder": 1.5}
    if viewshed is None:
        axes.add_patch(Circle(tuple(at[:2]), reach, facecolor=style.BLUE, alpha=0.10, linewidth=0, zorder=1.5))
        axes.add_patch(Circle(tuple(at[:2]), reach, fill=False, linewidth=1.2, **look))
        return
    axes.add_patch(Circle(tuple(at[:2]), reach, fill=False, linewidth=0.6, linestyle=":", **look))
    smooth = gaussian_filter(viewshed.seen.astype(np.float64), 1.0)  # removes specks behind poles and lamps
    area = (viewshed.x, viewshed.y, smooth)
    axes.contourf(*area, [0.5, 1.5], colors=[style.BLUE], alpha=0.2, zorder=1.5)
    axes.contour(*area, [0.5], colors=[style.BLUE], linewidths=0.8, zorder=1.5)


def _plot_errors(axes: Axes, scene: ErrorMap) -> None:
    """Plot the errors by kind, the covered ones in blue."""
    covered = np.zeros(len(scene.errors), np.bool_) if scene.covered is None else scene.covered
    other_kinds = [kind for kind in dict.fromkeys(scene.kind.tolist()) if kind not in KINDS]
    looks = KINDS | {kind: (kind, OTHERS[i % len(OTHERS)]) for i, kind in enumerate(other_kinds)}
    rest = "" if scene.covered is None else ", uncovered"
    crowd = {"markersize": 3.5} if len(scene.errors) > DENSE else {}
    far = np.zeros(len(scene.errors), np.bool_) if scene.beyond is None else scene.beyond & ~covered
    ring = {"color": style.MUTED, "markerfacecolor": "none", "markeredgecolor": style.MUTED, "markeredgewidth": 1.0}
    states = (
        (rest, ~covered & ~far, {}),
        (", beyond every pole", far, ring),
        (", covered", covered, {"color": style.BLUE}),
    )
    for state, chosen, colour in states:
        for kind, (label, look) in looks.items():
            if (of_kind := (scene.kind == kind) & chosen).any():
                name = f"{label}{state} ({of_kind.sum()})"
                axes.plot(
                    *scene.errors[of_kind, :2].T,
                    linestyle="none",
                    label=name,
                    zorder=5.5,
                    **{**look, **colour, **crowd},
                )


def _plot_poles(axes: Axes, scene: ErrorMap) -> None:
    """Plot the poles with their ids; of more than `CROWDED`, only the chosen ones and those of rules have ids."""
    ruled = {number for ids in scene.conventional.values() for number in ids}
    crowded = len(scene.poles) > CROWDED
    known = {*axes.get_legend_handles_labels()[1]}
    for number, (x, y, _) in scene.poles.items():
        chosen = number in scene.chosen
        small = crowded and not chosen and number not in ruled
        face, ink, label = (style.BLUE, "white", "sensor") if chosen else ("white", style.INK, "candidate pole")
        look: dict[str, Any] = {
            "color": face,
            "markeredgecolor": "white" if chosen else style.INK,
            "zorder": 4 if small else 8 if chosen else 5,
            "linestyle": "none",
        }
        shape, size = "s" if number in ruled else "o", 4 if small else 14 if chosen else 13
        axes.plot(x, y, shape, markersize=size, **look)
        if not small:
            axes.text(
                x,
                y,
                number,
                ha="center",
                va="center_baseline",
                fontsize=style.SMALL,
                color=ink,
                zorder=9 if chosen else 6,
            )
        for name, sign in ((label, "o"), *((("of a conventional rule", "s"),) if shape == "s" else ())):
            if name not in known:
                axes.plot([], [], sign, markersize=7, label=name, **look)
                known.add(name)


def draw_density(axes: Axes, scene: ErrorMap) -> None:
    """Draw the density of errors per hectare, smoothed by a Gaussian of `BLUR_M`, with a colour bar."""
    x_low, y_low, x_high, y_high = scene.town.bounds
    columns, rows = (max(round(size / CELL_M), 1) for size in (x_high - x_low, y_high - y_low))
    counts = np.histogram2d(
        scene.errors[:, 1], scene.errors[:, 0], (rows, columns), ((y_low, y_high), (x_low, x_high))
    )[0]
    per_hectare = gaussian_filter(counts, BLUR_M / CELL_M, mode="constant") * 1e4 / CELL_M**2
    x, y = (low + CELL_M / 2 + CELL_M * np.arange(n) for low, n in ((x_low, columns), (y_low, rows)))
    levels = MaxNLocator(6).tick_values(0.0, float(per_hectare.max()))[1:]  # the least dense zone is left blank
    zones = axes.contourf(x, y, per_hectare, levels, cmap=HEAT, alpha=0.5, zorder=1.2, extend="neither")
    bar = axes.figure.colorbar(zones, ax=axes, shrink=0.6, pad=0.02, aspect=25)
    bar.set_label(f"{scene.noun}s per hectare", color=style.MUTED)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
