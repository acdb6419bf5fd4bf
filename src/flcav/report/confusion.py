"""Confusion matrices side by side."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.report import style

SHADES = LinearSegmentedColormap.from_list("shares", ["white", style.BLUE])
SIDE_IN, LABELS_IN = 3.6, 1.1


@style.styled
def confusions(counts: Mapping[str, NDArray[np.int64]], classes: Sequence[str]) -> Figure:
    """Return a panel per title: of each class's pictures (row), the share that was taken for each class (column).

    `counts` are (classes, classes) numbers of pictures; a class without pictures is an empty row.
    """
    names = [name.replace("_", " ") for name in classes]
    figure = style.canvas(SIDE_IN * len(counts) + LABELS_IN, SIDE_IN + LABELS_IN)
    panels = np.atleast_1d(figure.subplots(1, len(counts), sharey=True))
    for axes, (title, matrix) in zip(panels, counts.items(), strict=True):
        shares = matrix / np.maximum(matrix.sum(1, keepdims=True), 1)
        axes.imshow(shares, cmap=SHADES, vmin=0, vmax=1)
        for row, column in np.argwhere(matrix > 0):
            share = shares[row, column]
            ink = "white" if share > 0.5 else style.INK
            place = {"ha": "center", "va": "center", "fontsize": style.SMALL - 1}
            axes.text(column, row, f"{100 * share:.0f}" if share >= 0.005 else "·", color=ink, **place)
        axes.set_xticks(range(len(names)), names, rotation=45, ha="right", rotation_mode="anchor")
        axes.set_yticks(range(len(names)), names)
        axes.set_xlabel("found")
        axes.set_title(f"{title}: {np.trace(matrix) / matrix.sum():.1%} of {matrix.sum()}")
    panels[0].set_ylabel("recorded; % of the row")
    return figure
