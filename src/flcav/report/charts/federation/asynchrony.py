"""Accuracy of federations over the seconds of a simulated network."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from flcav.report import style

COLOURS = (style.INK, style.POINT, style.BLUE, style.GREEN, style.VERMILLION)


class Reached(Protocol):
    """A federation's accuracy after each round, by its clock [s], from the first weights on."""

    @property
    def seconds(self) -> Sequence[float]:
        """The times, ascending."""
        ...

    @property
    def accuracy(self) -> Sequence[float]:
        """The accuracies."""
        ...


@style.styled
def draw_trajectories(found: Mapping[str, Mapping[str, Mapping[str, Reached]]], names: Sequence[str]) -> Figure:
    """Return the mean accuracy over seeds by time, a panel per setting; `found` is by setting, seed and name."""
    figure = style.canvas(7.2, 3.4)
    panels = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for panel, (setting, seeds) in zip(panels, found.items(), strict=True):
        until = min(each.seconds[-1] for own in seeds.values() for each in own.values())
        grid = np.linspace(0.0, until, 200)
        for name, colour in zip(names, COLOURS, strict=False):
            rows = [_hold(seeds[seed][name], grid) for seed in seeds]
            panel.plot(grid, np.mean(rows, axis=0), color=colour, label=name, linewidth=1.4)
        panel.set(xlabel="seconds on the network", title=setting)
    panels[0].set(ylabel="accuracy")
    style.key(figure, panels[0].get_legend_handles_labels()[0], ncols=3)
    return figure


def _hold(own: Reached, grid: np.ndarray) -> np.ndarray:
    """Return the accuracy at each time: that of the last round that is over."""
    last = np.searchsorted(own.seconds, grid, side="right") - 1
    return np.asarray(own.accuracy)[last]
