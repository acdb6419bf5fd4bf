"""Charts of sensor placement: coverage of errors, and gains of vehicles by pole against their predictors."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from flcav.report import style

SEED_COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.SKY, style.VERMILLION)
SEED_MARKERS = ("o", "s", "^")  # the next one once all colours are used


@style.styled
def draw_gains(panels: Mapping[tuple[str, str], Mapping[int, Sequence[tuple[float, float]]]]) -> Figure:
    """Return the gain in AP50 against predictors, with a row of panels per choice of frames.

    `panels` has, by (frames, predictor) and seed, a point (predictor, gain) for every pole.
    """
    rows, columns = (list(dict.fromkeys(key[axis] for key in panels)) for axis in (0, 1))
    figure = style.canvas(3.6 * len(columns), 2.6 * len(rows) + 0.4)
    drawn = np.atleast_2d(figure.subplots(len(rows), len(columns), sharey="row", sharex="col", squeeze=False))
    for (frames, predictor), seeds in panels.items():
        axes = drawn[rows.index(frames), columns.index(predictor)]
        axes.axhline(0, color=style.RULE, linewidth=1)
        for number, (seed, points) in enumerate(seeds.items()):
            x, y = np.array(points, dtype=np.float64).T
            colour = SEED_COLOURS[number % len(SEED_COLOURS)]
            marker = SEED_MARKERS[number // len(SEED_COLOURS) % len(SEED_MARKERS)]
            axes.plot(x, y, marker, color=colour, markersize=5, alpha=0.8, label=f"seed {seed}")
        axes.grid(axis="y")
        if frames == rows[-1]:
            axes.set_xlabel(f"{predictor} of the pole")
        if predictor == columns[0]:
            axes.set_ylabel(f"gain in AP50\n{frames}")
    style.key(figure, [line for line in drawn[0, 0].get_lines() if not line.get_label().startswith("_")])
    return figure


@style.styled
def draw_cover(
    shares: Mapping[str, Sequence[float]], kinds: Sequence[str], around: Mapping[str, Sequence[float | None]]
) -> Figure:
    """Return the shares of covered errors against the number of sensors, and errors around a pole by kind of scenario.

    `shares` are by town, for 1, 2, ... sensors; they are drawn relative to all errors, and to those in reach of any
    pole. `around` has by town the mean number of errors in reach of a pole for each of `kinds`, None without such a
    pole.
    """
    figure = style.canvas(12.0, 3.4)
    left, middle, right = figure.subplots(1, 3)
    others = iter(style.OTHER_COLOURS)
    colours = {town: style.TOWN_COLOURS.get(town) or next(others) for town in shares}
    for town, covered_by in shares.items():
        for axes, most in ((left, 1.0), (middle, covered_by[-1] or 1.0)):
            covered = [0.0, *(share / most for share in covered_by)]
            axes.plot(range(len(covered_by) + 1), covered, "o-", color=colours[town], markersize=4, label=town)
    for row, (town, means) in enumerate(around.items()):
        known = [(place, mean) for place, mean in enumerate(means) if mean is not None]
        places = [place + (row - (len(around) - 1) / 2) * 0.16 for place, _ in known]
        right.bar(places, [mean for _, mean in known], width=0.14, color=colours[town])
    for axes, base in ((left, "errors"), (middle, "errors in reach")):
        axes.set(xlim=(0, None), ylim=(0, 1.02), xlabel="sensors, placed best", ylabel=f"share of {base} covered")
    right.set_xticks(range(len(kinds)), kinds)
    right.set_ylabel("errors in reach of a pole, mean")
    for axes in (left, middle, right):
        axes.grid(axis="y")
    style.key(figure, left.get_lines())
    return figure
