"""A plan in pictures: megabytes per link, and error against budget."""

from collections.abc import Mapping, Sequence
from typing import TypedDict

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from flcav.report import style
from flcav.report.figures import WIDTH

TASKS = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.SKY, style.VERMILLION, style.RULE)
SHADES = {"samples": 1.0, "edge rounds": 0.62, "cloud rounds": 0.32}  # opacity by stage
LINKS = {"both links": style.RULE, "wireless alone": style.BLUE, "wireline alone": style.VERMILLION}


class Part(TypedDict):
    """What a task sends over a link in one stage."""

    link: str
    task: str
    stage: str
    mb: float


@style.styled
def megabytes(parts: Sequence[Part], links: Mapping[str, Mapping[str, float]]) -> Figure:
    """Return a bar per link: a part per task (colour) and stage (shade), against the budget [MB]."""
    tasks = list(dict.fromkeys(row["task"] for row in parts))
    colours = dict(zip(tasks, TASKS, strict=False))
    figure = style.canvas(WIDTH, 0.72 * WIDTH + 0.1 * len(tasks))
    axes = figure.add_subplot()
    widest = max(link["budget_mb"] for link in links.values())
    for y, (name, link) in enumerate(links.items()):
        left = 0.0
        for row in sorted(parts, key=lambda part: tasks.index(part["task"])):
            if row["link"] != name or not row["mb"]:
                continue
            shade = {"color": colours[row["task"]], "alpha": SHADES[row["stage"]]}
            axes.barh(y, row["mb"], left=left, height=0.44, edgecolor="white", linewidth=1.0, **shade)
            if row["mb"] > 0.09 * widest:
                ink = "white" if row["stage"] == "samples" and row["task"] == tasks[0] else style.INK
                place = {"ha": "center", "va": "center_baseline", "fontsize": style.SMALL}
                axes.text(left + row["mb"] / 2, y, f"{row['mb']:,.0f}", color=ink, **place)
            left += row["mb"]
        axes.plot([link["budget_mb"]] * 2, [y - 0.32, y + 0.32], color=style.INK, linewidth=2)
        note = f"{left:,.0f} of {link['budget_mb']:,.0f} MB"
        axes.text(link["budget_mb"], y - 0.36, note, ha="right", va="bottom", fontsize=style.SMALL)
    handles = [Patch(color=colour, label=task) for task, colour in colours.items()]
    handles += [Patch(color=style.INK, alpha=shade, label=stage) for stage, shade in SHADES.items()]
    style.key(figure, handles, ncols=2)
    axes.set_yticks(range(len(links)), list(links))
    axes.set(xlabel="uplink megabytes (1 MB = 10⁶ bytes)", ylim=(len(links) - 0.6, -0.75))
    return figure


@style.styled
def best_by_budget(sweep: Mapping[str, Sequence[Mapping[str, float]]], measure: str) -> Figure:
    """Return the best objective, called `measure`, at multiples of the budgets, scaled together and one at a time."""
    figure = style.canvas(WIDTH, 0.8 * WIDTH)
    axes = figure.add_subplot()
    widths = dict(zip(LINKS, (5.0, 1.6, 1.6), strict=True))  # lines that coincide are both seen
    for name, colour in LINKS.items():
        points = sweep[name]
        line = {"color": colour, "linewidth": widths[name], "marker": "o", "markersize": widths[name] + 1.5}
        axes.plot([p["factor"] for p in points], [p["objective"] for p in points], **line)
    now = [p["objective"] for p in sweep["both links"] if p["factor"] == 1]
    axes.plot([1] * len(now), now, "o", color=style.INK, markersize=8, markeredgecolor="white")
    axes.annotate("this plan", (1, now[0]), (8, 8), textcoords="offset points", fontweight="bold")
    style.key(
        figure,
        [Line2D([], [], color=colour, linewidth=widths[name], label=name) for name, colour in LINKS.items()],
        columnspacing=1.0,
    )
    axes.set(xlabel="budget, as a multiple of this one", ylabel=measure)
    axes.grid(axis="y")
    return figure
