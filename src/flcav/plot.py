"""Figures for notebooks: functions that draw a record into matplotlib axes, and how notebooks display records.

Each function takes the axes to draw into, by default those of a new figure, and returns them:

>>> import flcav
>>> axes = flcav.plot.town(flcav.load_town("suburb"))
>>> axes.figure.savefig("suburb.png")  # a notebook shows it by itself

`flcav.report` draws the pictures of the command line and of reports from the same parts.
"""

from collections.abc import Callable, Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib import colormaps, pyplot
from matplotlib.axes import Axes
from pydantic import BaseModel

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes
from flcav.optimization.allocation.allocate import Allocation
from flcav.optimization.curves.history import History
from flcav.optimization.placement.solve import Placement
from flcav.report import style
from flcav.report.charts import runs as run_charts
from flcav.report.pictures import birdseye, clouds, maps, town_map
from flcav.sensors.frame import Frame
from flcav.world.map.town import Town

if TYPE_CHECKING:
    from flcav.perception.errors import Registry
    from flcav.runs.results.run import Run

pyplot.switch_backend(matplotlib.get_backend())  # loaded outside of the style's context, which would undo its settings
SIDE_IN = 6.4  # of a new figure
MARGIN = 1.1  # around boxes that are drawn without a frame
MOST_ROWS = 20  # of a table in a notebook


def new_axes(width_in: float = SIDE_IN, height_in: float = SIDE_IN) -> Axes:
    """Return the axes of a new figure of pyplot [inch], which a notebook shows below its cell."""
    return pyplot.figure(figsize=(width_in, height_in), layout="constrained").add_subplot()


@style.styled
def town(shown: Town, axes: Axes | None = None) -> Axes:
    """Draw the map of a town in the world frame [m]: streets, markings, houses, trees, signs and numbered poles."""
    x_low, y_low, x_high, y_high = shown.bounds
    axes = axes or new_axes(SIDE_IN, SIDE_IN * (y_high - y_low) / (x_high - x_low) + 0.4)
    town_map.draw_map(axes, shown)
    axes.set_title(shown.name)
    return axes


@style.styled
def frame(shown: Frame, axes: Axes | None = None, *, dataset: Dataset | None = None, range_m: float = 50.0) -> Axes:
    """Draw a frame from above in its agent's frame: LiDAR returns by height, radar echoes, ground-truth boxes.

    dataset: which the frame is of; heights are above its ground, else above the world's z = 0.
    """
    axes = axes or new_axes()
    birdseye.draw_view(axes, birdseye.view_frame(dataset, shown, range_m=range_m))
    axes.set_title(f"{shown.key} · {shown.time_s:.1f} s")
    return axes


@style.styled
def boxes(shown: Boxes, axes: Axes | None = None, *, colour: str = style.BLUE) -> Axes:
    """Draw boxes from above in their frame, x upwards and y to the left [m]."""
    axes = axes or new_axes()
    clouds.draw_boxes(axes, shown, colour, width=1.2)
    if len(shown):
        corners = clouds.on_page(shown.corners()[:, :4, :2].reshape(-1, 2))
        half = MARGIN * max(np.ptp(corners, axis=0).max() / 2, 1.0)
        x, y = (corners.min(axis=0) + corners.max(axis=0)) / 2
        axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    axes.xaxis.set_major_formatter(lambda value, _: f"{-value:g}")  # the page's x points to the right, y to the left
    axes.set(aspect="equal", xlabel="y [m]", ylabel="x [m]", title=_count(len(shown), "box", "boxes"))
    return axes


@style.styled
def errors(
    shown: "Registry",
    axes: Axes | None = None,
    *,
    town: Town,
    placed: Placement | None = None,
    range_m: float | None = None,
) -> Axes:
    """Draw the registered errors of a network on the map of a town, with the sensors that were placed for them.

    range_m: of the placed sensors. Raises `InputError` for a placement without it.
    """
    if placed is not None and range_m is None:
        raise InputError("a placement is drawn with range_m, the range of its sensors in metres")
    sites = maps.poles_of(town)
    chosen = {} if placed is None else {[*sites][number]: float(range_m or 0.0) for number in placed.chosen}
    axes = axes or new_axes(SIDE_IN, SIDE_IN * 0.95)
    maps.draw_errors(axes, maps.ErrorMap(town, shown.positions, shown.kinds, sites, chosen))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), frameon=False, ncols=2)
    return axes


@style.styled
def history(shown: History, axes: Axes | None = None) -> Axes:
    """Draw the points of a learning curve: accuracy by rounds, with the mean for each number of samples.

    Of a history without rounds: accuracy by samples.
    """
    axes = axes or new_axes(SIDE_IN, SIDE_IN * 0.65)
    samples, rounds = shown.resources[:, 0], shown.resources[:, 1:].sum(axis=1)
    trained = bool(rounds.any())
    groups = {f"{count:g} samples": samples == count for count in np.unique(samples)} if trained else {"": samples > 0}
    spent, colours = (rounds if trained else samples), colormaps["viridis"](np.linspace(0.1, 0.9, len(groups)))
    for (label, chosen), colour in zip(groups.items(), colours):
        at = np.unique(spent[chosen])
        mean = [shown.accuracy[chosen & (spent == value)].mean() for value in at]
        axes.plot(spent[chosen], shown.accuracy[chosen], "o", color=colour, markersize=3, alpha=0.5)
        axes.plot(at, mean, color=colour, linewidth=1.5, label=label)
    axes.set(xlabel="rounds, edge and cloud" if trained else "samples", ylabel="accuracy")
    axes.set_title(f"{_count(len(shown.accuracy), 'point')}; lines: means")
    axes.grid(axis="y")
    if trained:
        axes.legend(frameon=False)
    return axes


@style.styled
def plan(shown: Allocation, axes: Axes | None = None) -> Axes:
    """Draw the uplink traffic of a plan [MB]: of each task on the wireless and on the wireline link."""
    axes = axes or new_axes(SIDE_IN, 1.2 + 0.5 * len(shown.tasks))
    left = np.zeros(2)
    for number, task in enumerate(shown.tasks):
        mb = np.array([task.wireless_mb, task.wireline_mb])
        colour = (style.BLUE, style.ORANGE, *style.OTHER_COLOURS)[number % 6]
        axes.barh(["wireless", "wireline"], mb, left=left, color=colour, label=task.name)
        left += mb
    axes.set(xlabel="uplink traffic [MB]", title=f"{shown.status}; predicted error {shown.objective:.3f}")
    axes.legend(frameon=False)
    return axes


@style.styled
def differences(shown: "Run", axes: Axes | None = None) -> Axes:
    """Draw the paired differences of a run's networks on the same test frames, with their 95 % intervals."""
    rows = {each.name: each.estimate for each in shown.differences}
    axes = axes or new_axes(SIDE_IN * 1.4, 0.8 + 0.35 * len(rows))
    measures = dict.fromkeys(test.result.measure for test in shown.tested)
    run_charts.draw_arms(axes, f"difference in {', '.join(measures)} (95 % interval)", rows)
    return axes


PICTURES: Mapping[str, Callable[[Any], Axes]] = {"Town": town, "Frame": frame, "History": history}


def picture(record: object) -> bytes | None:
    """Return a record's picture in a notebook as a PNG file; None for one that is displayed as a table."""
    for name in _names(record):
        if name in PICTURES:
            figure = PICTURES[name](record).figure
            try:
                return style.png(figure.get_figure(root=True), dpi=100)
            finally:
                pyplot.close(figure.get_figure(root=True))  # else the notebook would show it again
    return None


def as_table(record: object) -> str | None:
    """Return a record as an HTML table for a notebook; None for one that is displayed as a picture."""
    for name in _names(record):
        if name in TABLES:
            return TABLES[name](record)
    return None


def _names(record: object) -> Iterable[str]:
    return (each.__name__ for each in type(record).__mro__)


def _count(number: int, noun: str, plural: str = "") -> str:
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def _table(title: str, head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a table as HTML, its longest part first; every text is escaped."""
    listed = [[*row] for row in rows]
    left = len(listed) - MOST_ROWS

    def line(cells: Iterable[object], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(str(cell))}</{tag}>" for cell in cells) + "</tr>"

    body = "".join(line(row, "td") for row in listed[:MOST_ROWS])
    more = f"<p>and {left} more</p>" if left > 0 else ""
    return f"<b>{escape(title)}</b><table><thead>{line(head, 'th')}</thead><tbody>{body}</tbody></table>{more}"


def _boxes(shown: Boxes) -> str:
    scores = [""] * len(shown) if shown.score is None else [f"{score:.2f}" for score in shown.score]
    rows = (
        (label, *(f"{value:.2f}" for value in (*center, *size)), f"{np.degrees(yaw):.0f}°", score)
        for label, center, size, yaw, score in zip(shown.label, shown.center, shown.size, shown.yaw, scores)
    )
    head = ("class", "x [m]", "y [m]", "z [m]", "length [m]", "width [m]", "height [m]", "yaw", "score")
    return _table(_count(len(shown), "box", "boxes"), head, rows)


def _dataset(shown: Dataset) -> str:
    agents: dict[str, list[int]] = {}
    for number, key in enumerate(shown.keys):
        agents.setdefault(key.agent, []).append(number)
    rows = []
    for agent, numbers in agents.items():
        first = shown.frame(numbers[0])
        sensors = (*first.lidar, *first.images, *first.infrared, *first.radar, *first.gnss, *first.imu)
        scenes = len({shown.keys[number].scene for number in numbers})
        rows.append((agent, len(numbers), scenes, ", ".join(sensors)))
    title = f"{shown.folder.name}: {_count(len(shown), 'frame')}, {_count(len(shown.manifest.scenes), 'scene')}"
    return _table(title, ("agent", "frames", "scenes", "sensors"), rows)


def _config(shown: BaseModel) -> str:
    fields = shown.model_fields_set
    title = f"{type(shown).__name__}, fields that were set"
    return _table(title, ("field", "value"), ((name, getattr(shown, name)) for name in sorted(fields)))


def _errors(shown: "Registry") -> str:
    counts: dict[tuple[str, str], list[float]] = {}
    for each in shown:
        counts.setdefault((each.kind, each.label), []).append(each.weight)
    rows = ((*key, len(weights), f"{sum(weights):g}") for key, weights in counts.items())
    return _table(_count(len(shown), "error"), ("kind", "class", "number", "weight"), rows)


def _placement(shown: Placement) -> str:
    proof = "optimal, proven" if shown.optimal else f"at most {shown.upper_bound:g} can be covered"
    gains = shown.marginal_gain or ("",) * len(shown.chosen)
    title = f"{_count(shown.covered, 'error')} covered, weight {shown.covered_weight:g}: {proof}"
    return _table(title, ("pole (index)", "weight that it alone covers"), zip(shown.chosen, gains))


def _plan(shown: Allocation) -> str:
    rows = (
        (
            *(task.name, task.samples, task.edge_rounds, task.cloud_rounds),
            *(f"{1 - task.predicted_error:.3f}", f"{task.wireless_mb:.1f}", f"{task.wireline_mb:.1f}"),
        )
        for task in shown.tasks
    )
    bound = "" if shown.lower_bound is None else f", no plan is below {shown.lower_bound:.4f}"
    head = ("task", "samples", "edge rounds", "cloud rounds", "predicted accuracy", "wireless MB", "wireline MB")
    return _table(f"{shown.status}: objective {shown.objective:.4f}{bound}", head, rows)


def _run(shown: "Run") -> str:
    tests = (
        (each.arm, each.stage, each.region, each.task, each.result.measure, each.estimate.describe())
        for each in shown.tested
    )
    found = ((each.place, each.question, each.decision) for each in shown.findings)
    return _table("Tests", ("arm", "stage", "region", "task", "measure", "95 % interval"), tests) + _table(
        "Findings", ("region, task", "claim", "verdict"), found
    )


TABLES: Mapping[str, Callable[[Any], str]] = {
    "Boxes": _boxes,
    "Dataset": _dataset,
    "Recipe": _config,
    "RunRecipe": _config,
    "Problem": _config,
    "Registry": _errors,
    "Placement": _placement,
    "Allocation": _plan,
    "Run": _run,
}
