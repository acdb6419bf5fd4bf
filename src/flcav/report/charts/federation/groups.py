"""Accuracy of federations over the megabytes of their uplink."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from flcav.report import style

COLOURS = (style.INK, style.BLUE, style.ORANGE)


class Reached(Protocol):
    """A federation's accuracy after each round, by what its vehicles have sent [MB], from before the first."""

    @property
    def up_mb(self) -> Sequence[float]:
        """The megabytes, ascending."""
        ...

    @property
    def accuracy(self) -> Sequence[float]:
        """The accuracies."""
        ...


@style.styled
def draw_by_megabytes(found: Mapping[str, Mapping[str, Mapping[str, Reached]]], names: Sequence[str]) -> Figure:
    """Return the accuracy of every seed by uplink, a panel per setting, with a dot where each federation ends.

    `found` is by setting, seed and name.
    """
    figure = style.canvas(7.2, 3.4)
    panels = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for panel, (setting, seeds) in zip(panels, found.items(), strict=True):
        for name, colour in zip(names, COLOURS, strict=False):
            for number, own in enumerate(seeds.values()):
                mb, accuracy = np.asarray(own[name].up_mb), np.asarray(own[name].accuracy)
                panel.plot(mb, accuracy, color=colour, linewidth=0.9, alpha=0.8, label=None if number else name)
                panel.plot(mb[-1:], accuracy[-1:], "o", color=colour, markersize=3)
        panel.set(xlabel="uplink of the vehicles [MB]", title=setting)
    panels[0].set(ylabel="accuracy")
    style.key(figure, panels[0].get_legend_handles_labels()[0], ncols=3)
    return figure
