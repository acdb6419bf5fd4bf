"""Chart of non-IID data: labels of each vehicle by class, as a partition dealt them."""

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
    """Return stacked bars of the vehicles' labels by class: a panel per partition, by title."""
    figure = style.canvas(
        6.4, 0.8 + 0.5 * len(dealt) + 0.17 * sum(len(partition.vehicles) for partition in dealt.values())
    )
    ratios = [len(partition.vehicles) + 1 for partition in dealt.values()]
    panels = figure.subplots(len(dealt), squeeze=False, gridspec_kw={"height_ratios": ratios})[:, 0]
    classes = sorted(
        {label for partition in dealt.values() for vehicle in partition.vehicles.values() for label in vehicle.labels}
    )
    colours = dict(zip(classes or [SAMPLES], _colours(max(len(classes), 1)), strict=True))
    for panel, (title, partition) in zip(panels, dealt.items(), strict=True):
        names = [name.rpartition("/")[2] for name in partition.vehicles]
        left = np.zeros(len(names))
        for label, colour in colours.items():
            held = [
                vehicle.labels.get(label, 0) if classes else vehicle.samples for vehicle in partition.vehicles.values()
            ]
            panel.barh(names, held, left=left, color=colour, height=0.7)
            left += held
        panel.invert_yaxis()
        panel.set(title=f"{title}: by {partition.by}")
        panel.grid(axis="x")
    panels[-1].set(xlabel="labels" if classes else SAMPLES)
    style.key(figure, [Patch(color=colour, label=label) for label, colour in colours.items()], ncols=4)
    return figure


def _colours(count: int) -> list[str]:
    palette = [
        style.BLUE,
        style.ORANGE,
        style.GREEN,
        style.VERMILLION,
        style.PURPLE,
        style.SKY,
        style.MUTED,
        style.RULE,
    ]
    return [palette[number % len(palette)] for number in range(count)]
