"""Two plans side by side: what was predicted of them, and what training reached."""

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flcav.report import style

COLOURS = {"equal-stages": style.ORANGE, "joint": style.BLUE}
NAMES = {"equal-stages": "equal stages", "joint": "joint plan"}
STAGES = {"pretrain": "pretrained", "edge": "edge FL", "cloud": "edge +\ncloud FL"}
ASIDE = 0.07  # so that two plans' intervals do not hide each other


@style.styled
def predicted_and_realised(results: Mapping[str, Any], town: str) -> Figure:
    """Return AP50 of both plans after each stage in `town`, and joint minus equal stages, seed by seed."""
    figure = style.canvas(9.0, 3.9)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_ap(left, results, town)
    _draw_differences(right, results, town)
    handles = [Line2D([], [], color=colour, marker="o", label=NAMES[name]) for name, colour in COLOURS.items()]
    handles += [
        Line2D([], [], color=style.MUTED, linestyle=(0, (3, 2)), marker="D", mfc="white", label="predicted"),
        Line2D([], [], color=style.MUTED, marker="o", label="trained: mean, 95 % over seeds"),
        Line2D([], [], color=style.MUTED, linestyle="", marker=".", label="one seed"),
    ]
    style.key(figure, handles)
    return figure


def _draw_ap(axes: Axes, results: Mapping[str, Any], town: str) -> None:
    for side, (name, colour) in zip((-ASIDE, ASIDE), COLOURS.items(), strict=True):
        places = [number + side for number in range(len(STAGES))]
        realised = results["summary"]["realised"][town][name]
        predicted = results["summary"]["predicted"][name]
        axes.plot(
            places, [predicted[stage] for stage in STAGES], color=colour, linestyle=(0, (3, 2)), marker="D", mfc="white"
        )
        axes.plot(places, [realised[stage]["mean"] for stage in STAGES], color=colour, marker="o", linewidth=1.8)
        for place, stage in zip(places, STAGES, strict=True):
            axes.plot([place] * 2, [realised[stage]["low"], realised[stage]["high"]], color=colour, linewidth=1)
            for seed in results["seeds"]:
                axes.plot(place, seed["realised"][town][name][stage]["ap50"], ".", color=colour, alpha=0.5)
    axes.set_xticks(range(len(STAGES)), list(STAGES.values()))
    axes.set_title(f"AP50 on {town} after each stage", fontweight="bold")
    axes.grid(axis="y")


def _draw_differences(axes: Axes, results: Mapping[str, Any], town: str) -> None:
    summary = results["summary"]
    for place, stage in enumerate(STAGES):
        mean = summary["realised_difference"][town][stage]
        axes.plot([place] * 2, [mean["low"], mean["high"]], color=style.INK, linewidth=1.2)
        axes.plot(place, mean["mean"], "o", color=style.INK)
        axes.plot(place - ASIDE, summary["predicted_difference"][stage], "D", color=style.MUTED, mfc="white")
        for seed in results["seeds"]:
            axes.plot(place + ASIDE, seed["differences"][town][stage]["mean"], ".", color=style.MUTED)
    axes.axhline(0, color=style.MUTED, linewidth=0.8)
    axes.set_xticks(range(len(STAGES)), list(STAGES.values()))
    axes.set_title("joint plan minus equal stages", fontweight="bold")
    axes.grid(axis="y")
