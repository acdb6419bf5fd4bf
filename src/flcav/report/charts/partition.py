"""Non-IID data: what each vehicle of a region was dealt."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from flcav.report import style
from flcav.runs.extras.partition.rows import Partitioned
from flcav.runs.extras.partition.section import list_partitions
from flcav.runs.results.run import Run

SAMPLES = "samples"  # in place of classes, where a task has none


def draw_partitions(run: Run) -> dict[str, Figure]:
    """Return the chart of a run's partitions by the name of its picture."""
    dealt = {" · ".join(names): partition for *names, partition in list_partitions(run)}
    return {"partition": draw_dealt(dealt)}


@style.styled
def draw_dealt(dealt: Mapping[str, Partitioned]) -> Figure:
    """Return stacked bars of each vehicle's labels by class: a panel per partition, by its title."""
    figure = style.canvas(6.4, 0.8 + 0.5 * len(dealt) + 0.17 * sum(len(each.vehicles) for each in dealt.values()))
    ratios = [len(each.vehicles) + 1 for each in dealt.values()]
    panels = figure.subplots(len(dealt), squeeze=False, gridspec_kw={"height_ratios": ratios})[:, 0]
    classes = sorted({label for each in dealt.values() for own in each.vehicles.values() for label in own.labels})
    colours = dict(zip(classes or [SAMPLES], _colours(max(len(classes), 1)), strict=True))
    for panel, (title, each) in zip(panels, dealt.items(), strict=True):
        names = [name.rpartition("/")[2] for name in each.vehicles]
        left = np.zeros(len(names))
        for label, colour in colours.items():
            held = [own.labels.get(label, 0) if classes else own.samples for own in each.vehicles.values()]
            panel.barh(names, held, left=left, color=colour, height=0.7)
            left += held
        panel.invert_yaxis()
        panel.set(title=f"{title}: by {each.by}")
        panel.grid(axis="x")
    panels[-1].set(xlabel="labels" if classes else SAMPLES)
    style.key(figure, [Patch(color=colour, label=label) for label, colour in colours.items()], ncols=4)
    return figure


def _colours(count: int) -> list[str]:
    own = [style.BLUE, style.ORANGE, style.GREEN, style.VERMILLION, style.PURPLE, style.SKY, style.MUTED, style.RULE]
    return [own[number % len(own)] for number in range(count)]
