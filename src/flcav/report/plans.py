"""Two plans side by side: what was predicted of them, and what training reached."""

from collections.abc import Mapping
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flcav.intervals import MeanOverSeeds
from flcav.report import style

COLOURS = {"equal-stages": style.ORANGE, "joint": style.BLUE}
NAMES = {"equal-stages": "equal stages", "joint": "joint plan"}
STAGES = {"pretrain": "pretrained", "edge": "edge FL", "cloud": "edge +\ncloud FL"}
ASIDE = 0.07  # so that two plans' intervals do not hide each other


@dataclass(frozen=True)
class StageReached:
    """A number after a stage: predicted, over seeds, and of each seed."""

    predicted: float
    trained: MeanOverSeeds
    seeds: tuple[float, ...]


ByStage = Mapping[str, StageReached]  # of each of `STAGES`


@style.styled
def predicted_and_realised(ap: Mapping[str, ByStage], differences: ByStage, town: str) -> Figure:
    """Return AP50 of both plans after each stage in `town`, and joint minus equal stages, seed by seed."""
    figure = style.canvas(9.0, 3.9)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_ap(left, ap, town)
    _draw_differences(right, differences)
    handles = [Line2D([], [], color=colour, marker="o", label=NAMES[name]) for name, colour in COLOURS.items()]
    handles += [
        Line2D([], [], color=style.MUTED, linestyle=(0, (3, 2)), marker="D", mfc="white", label="predicted"),
        Line2D([], [], color=style.MUTED, marker="o", label="trained: mean, 95 % over seeds"),
        Line2D([], [], color=style.MUTED, linestyle="", marker=".", label="one seed"),
    ]
    style.key(figure, handles)
    return figure


def _draw_ap(axes: Axes, ap: Mapping[str, ByStage], town: str) -> None:
    for side, (name, colour) in zip((-ASIDE, ASIDE), COLOURS.items(), strict=True):
        places = [number + side for number in range(len(STAGES))]
        reached = [ap[name][stage] for stage in STAGES]
        predicted = [each.predicted for each in reached]
        axes.plot(places, predicted, color=colour, linestyle=(0, (3, 2)), marker="D", mfc="white")
        axes.plot(places, [each.trained.mean for each in reached], color=colour, marker="o", linewidth=1.8)
        for place, each in zip(places, reached, strict=True):
            axes.plot([place] * 2, [each.trained.low, each.trained.high], color=colour, linewidth=1)
            for seed in each.seeds:
                axes.plot(place, seed, ".", color=colour, alpha=0.5)
    axes.set_xticks(range(len(STAGES)), list(STAGES.values()))
    axes.set_title(f"AP50 on {town} after each stage", fontweight="bold")
    axes.grid(axis="y")


def _draw_differences(axes: Axes, differences: ByStage) -> None:
    for place, stage in enumerate(STAGES):
        each = differences[stage]
        axes.plot([place] * 2, [each.trained.low, each.trained.high], color=style.INK, linewidth=1.2)
        axes.plot(place, each.trained.mean, "o", color=style.INK)
        axes.plot(place - ASIDE, each.predicted, "D", color=style.MUTED, mfc="white")
        for seed in each.seeds:
            axes.plot(place + ASIDE, seed, ".", color=style.MUTED)
    axes.axhline(0, color=style.MUTED, linewidth=0.8)
    axes.set_xticks(range(len(STAGES)), list(STAGES.values()))
    axes.set_title("joint plan minus equal stages", fontweight="bold")
    axes.grid(axis="y")
