"""Charts of sensor placement: coverage of errors, and gains of vehicles by pole against their predictors."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from flcav.report import style
from flcav.statistics.estimates import Estimate

FRAME_COLOURS = (style.BLUE, style.ORANGE)  # of two choices of frames


@style.styled
def draw_correlations(
    seeds: Mapping[str, Mapping[str, Sequence[float]]], means: Mapping[str, Mapping[str, Estimate]]
) -> Figure:
    """Return rank correlations of poles' gains with predictors: a dot per seed, the mean with its 95 % interval.

    `seeds` and `means` are by predictor and choice of frames.
    """
    figure = style.canvas(7.6, 0.62 * len(seeds) + 1.0)
    axes = figure.add_subplot()
    axes.axvline(0, color=style.MUTED, linewidth=1)
    for row, (predictor, by_frames) in enumerate(seeds.items()):
        for number, (frames, values) in enumerate(by_frames.items()):
            y, colour = row + 0.3 * (number - (len(by_frames) - 1) / 2), FRAME_COLOURS[number]
            mean = means[predictor][frames]
            axes.plot(values, [y] * len(values), "o", color=colour, markersize=4, alpha=0.4, markeredgewidth=0)
            if mean.low is not None and mean.high is not None:
                axes.plot([mean.low, mean.high], [y, y], color=colour, linewidth=2)
            axes.plot(mean.mean, y, "s", color=colour, markersize=6, label=frames if row == 0 else None)
    axes.set_yticks(range(len(seeds)), list(seeds))
    axes.set(xlim=(-1, 1), ylim=(len(seeds) - 0.5, -0.5))
    axes.set_xlabel("rank correlation with the gain in AP50; dots: seeds, squares: mean, 95 % interval")
    axes.grid(axis="x")
    style.key(figure, axes.get_legend_handles_labels()[0])
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
