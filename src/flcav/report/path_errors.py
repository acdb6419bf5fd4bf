"""How far off predicted paths end, beside those of somebody who keeps heading and speed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flcav.report import style


@dataclass(frozen=True)
class Bar:
    """One error in metres, by seed."""

    name: str  # of who predicts
    mean: float
    seeds: Sequence[float]


Panels = Mapping[str, Mapping[str, Sequence[Bar]]]  # test -> slice, with its number of samples -> bars

COLOURS = (style.RULE, style.BLUE, style.SKY)
THICK = 0.26


@style.styled
def path_errors(panels: Panels) -> Figure:
    """Return a panel per test: for each slice the final error of each who predicts, every seed a dot."""
    figure = style.canvas(8.6, 3.3)
    axes_of = figure.subplots(1, len(panels), sharex=True, squeeze=False)[0]
    for number, (axes, (test, slices)) in enumerate(zip(axes_of, panels.items(), strict=True)):
        _draw(axes, slices)
        axes.set_title(test)
        axes.set_xlabel("final error after 3 s [m]")
        if number == 0:
            bars = next(iter(slices.values()))
            handles = [axes.barh([0], [0], color=colour, label=bar.name) for bar, colour in zip(bars, COLOURS)]
            style.key(figure, handles)  # pyright: ignore[reportArgumentType]
    return figure


def _draw(axes: Axes, slices: Mapping[str, Sequence[Bar]]) -> None:
    for place, bars in enumerate(slices.values()):
        for number, (bar, colour) in enumerate(zip(bars, COLOURS, strict=True)):
            y = place + (number - 1) * (THICK + 0.02)
            axes.barh(y, bar.mean, THICK, color=colour)
            axes.plot(bar.seeds, [y] * len(bar.seeds), "o", markersize=3, color=style.INK, markeredgewidth=0)
            axes.annotate(
                f"{bar.mean:.2f}",
                (max(bar.mean, *bar.seeds), y),
                (5, 0),
                textcoords="offset points",
                va="center_baseline",
                fontsize=style.SMALL,
            )
    axes.set_yticks(range(len(slices)), list(slices))
    axes.invert_yaxis()
    axes.margins(x=0.14)
