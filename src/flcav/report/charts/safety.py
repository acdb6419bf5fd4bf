"""Chart of the trade-off of safety distances: risk against mean speed, a line per kind of margin."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from flcav.report import style

PANELS = ("time below 1.5 s to collision [%]", "hard brakes a drive", "collisions at fault")
COLOURS = (style.MUTED, style.BLUE)


@style.styled
def draw_trade_off(lines: Mapping[str, Sequence[tuple[float, float, float, float]]]) -> Figure:
    """Return three panels against mean speed; a point is (mean speed [m/s], share near, hard brakes, collisions)."""
    figure = style.canvas(9.0, 3.0)
    panels = figure.subplots(1, len(PANELS))
    for number, (axes, title) in enumerate(zip(panels, PANELS)):
        for (name, points), colour in zip(lines.items(), COLOURS):
            values = np.array(points)
            height = values[:, number + 1] * (100 if number == 0 else 1)
            axes.plot(values[:, 0], height, "o-", color=colour, markersize=4, label=name)
        axes.set(xlabel="mean speed [m/s]", title=title)
        axes.set_ylim(bottom=0)
        axes.grid(axis="y")
    style.key(figure, panels[0].get_lines())
    return figure
