"""Charts of lifelong learning: the measure on each condition, by round of a run, and by condition over seeds."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from flcav.report import style
from flcav.report.charts.runs import name_measure
from flcav.runs.extras.lifelong.rows import LifelongArm
from flcav.runs.results.run import Run
from flcav.statistics.estimates import Estimate

COLOURS = (style.BLUE, style.VERMILLION, style.GREEN, style.ORANGE, style.PURPLE, style.SKY)  # of conditions, in turn
ARM_COLOURS = (style.BLUE, style.ORANGE, style.MUTED)  # of arms, in turn
SHORT = 8  # characters of a name that fits below an axis as it is
APART = 0.06  # horizontal distance of arms


def draw_lifelong(run: Run) -> dict[str, Figure]:
    """Return the chart of each task of a run by the name of its picture; empty without lifelong learning."""
    arms = {task: [arm for arm in run.lifelong or () if arm.task == task] for task in run.recipe.tasks}
    return {f"lifelong_{task.replace(':', '_')}": draw_rounds(of_task) for task, of_task in arms.items() if of_task}


@style.styled
def draw_rounds(arms: Sequence[LifelongArm]) -> Figure:
    """Return the measure on validation frames of each condition by round, from its beginning: a panel per arm.

    The first point of a condition is that of the network before training there; the dashed line is the reachable score.
    """
    figure = style.canvas(6.4, 0.6 + 1.8 * len(arms))
    panels = figure.subplots(len(arms), sharex=True, sharey=True, squeeze=False)[:, 0]
    for panel, arm in zip(panels, arms, strict=True):
        start = 0
        for number, passed in enumerate(arm.passed):
            panel.axvline(start - 0.5, color=style.RULE, linewidth=0.8)
            for condition, scores in passed.scores.items():
                colour = COLOURS[arm.conditions.index(condition) % len(COLOURS)]
                rounds = start + np.arange(len(scores))
                panel.plot(rounds, scores, color=colour, marker="o", markersize=3, linewidth=1.2)
            length = max(len(other.passed[number].scores[passed.condition]) for other in arms)
            colour = COLOURS[number % len(COLOURS)]
            panel.hlines(passed.reachable, start, start + length - 1, color=colour, linestyle="dashed", linewidth=0.8)
            start += length
        panel.set(title=arm.arm, ylabel=arm.measure)
        panel.grid(axis="y")
    panels[-1].set(xlabel="rounds of all conditions, one after another")
    panels[-1].set_xticks([])
    lines = [
        panels[0].plot([], [], color=COLOURS[number % len(COLOURS)], label=condition)[0]
        for number, condition in enumerate(arms[0].conditions)
    ]
    style.key(figure, lines)
    return figure


@style.styled
def draw_conditions(found: Mapping[str, Mapping[str, Sequence[Estimate]]], measure: str) -> Figure:
    """Return the measure with its interval on each condition (a panel), pretrained and after each condition.

    `found` is by tested condition, in order, and by arm: pretrained, then after each condition.
    """
    conditions = [*found]
    turn = 40 if max(map(len, conditions)) > SHORT else 0
    figure = style.canvas(2.4 * len(conditions), 3.5)
    panels = figure.subplots(1, len(conditions), sharey=True, squeeze=False)[0]
    for number, (panel, (condition, arms)) in enumerate(zip(panels, found.items(), strict=True)):
        for place, ((arm, means), colour) in enumerate(zip(arms.items(), ARM_COLOURS, strict=False)):
            at = np.arange(len(means)) + APART * (place - (len(arms) - 1) / 2)
            panel.plot(at, [estimate.mean for estimate in means], color=colour, marker="o", markersize=3, label=arm)
            for x, estimate in zip(at.tolist(), means, strict=True):
                style.interval(panel, x, estimate, color=colour, linewidth=1.0)
        panel.axvspan(number + 0.5, number + 1.5, color=style.SIDEWALK, zorder=0)
        panel.set_xticks(
            range(len(conditions) + 1), ["start", *conditions], rotation=turn, ha="right" if turn else "center"
        )
        panel.set(title=f"tested in {condition}")
        panel.grid(axis="y")
    every = [estimate for arms in found.values() for means in arms.values() for estimate in means]
    panels[0].set(ylabel=name_measure(measure, every))
    style.key(figure, panels[0].get_legend_handles_labels()[0])
    return figure
