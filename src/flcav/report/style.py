"""Style of all figures: greys for context, the colour-blind safe palette of Okabe and Ito (2008) for data.

Figures are drawn at the size of display, so that their smallest text is at least 9 pt.
"""

import io
import re
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from scipy.optimize import isotonic_regression

from flcav.statistics.estimates import Estimate

INK = "#222222"  # text, ground truth
MUTED = "#6b6b6b"  # axes, notes
RULE = "#c9c9c9"  # grid, borders
ROAD = "#dfdfdd"
SIDEWALK = "#f1f0ee"
BUILDING = "#cfc9c0"
TREE = "#cfdccb"
POINT = "#7d7d7d"  # a LiDAR return
GROUND = "#c4c4c4"  # a LiDAR return from the ground

BLUE = "#0072b2"
SKY = "#56b4e9"
ORANGE = "#e69f00"
VERMILLION = "#d55e00"
GREEN = "#009e73"
PURPLE = "#cc79a7"

HIT, MISSED, FALSE = BLUE, ORANGE, VERMILLION
TOWN_COLOURS = {"grid": BLUE, "ring": VERMILLION, "suburb": MUTED}
OTHER_COLOURS = (GREEN, PURPLE, ORANGE, SKY)  # of users' own towns, in turn
STAGE_COLOURS = (RULE, SKY, ORANGE)  # in the order of the stages

SMALL, TEXT = 9, 10  # [pt]

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": TEXT,
    "axes.titlesize": TEXT,
    "axes.labelsize": TEXT,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "legend.fontsize": SMALL,
    "text.color": INK,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": RULE,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "svg.hashsalt": "flcav",
}

styled = matplotlib.rc_context(STYLE)  # decorator of functions that draw


def canvas(width_in: float, height_in: float) -> Figure:
    """Return an empty figure of the given size [inch], without a window or global state."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def hide_axes(axes: Axes) -> None:
    """Remove ticks and frame, for maps and pictures."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def scale_bar(axes: Axes, length_m: float) -> None:
    """Draw a scale bar of `length_m` in the lower right corner of axes in metres."""
    x_low, x_high = axes.get_xlim()
    y_low, y_high = axes.get_ylim()
    right = x_high - 0.03 * (x_high - x_low)
    y = y_low + 0.03 * (y_high - y_low)
    axes.plot([right - length_m, right], [y, y], color=INK, linewidth=2, solid_capstyle="butt")
    axes.annotate(
        f"{length_m:g} m", (right - length_m / 2, y), (0, 3), textcoords="offset points", ha="center", fontsize=SMALL
    )


def key(owner: FigureBase | Axes, handles: Sequence[Artist], **changes: Any) -> None:
    """Add a legend of `handles`, which carry labels, in one line below `owner`; `changes`: options of the legend."""
    options: dict[str, Any] = {"loc": "outside lower center", "frameon": False, "handlelength": 1.2}
    spacing: dict[str, Any] = {"handletextpad": 0.5, "columnspacing": 1.4, "ncols": len(handles)}
    owner.legend(handles=handles, **{**options, **spacing, **changes})


def interval(axes: Axes, x: float, estimate: Estimate, **look: Any) -> None:
    """Draw the 95 % interval of an estimate as a vertical line at `x`, if there is one; `look`: options of `plot`."""
    if estimate.low is not None and estimate.high is not None:
        axes.plot([x, x], [estimate.low, estimate.high], **look)


def keep_apart(heights: Sequence[float], gap: float, top: float) -> list[float]:
    """Return heights of labels for lines that end at `heights`: `gap` apart, below `top`, and else as near as can be.

    The squared distances from the ends are least, by isotonic regression.
    """
    order = sorted(range(len(heights)), key=lambda i: -heights[i])
    steps = gap * np.arange(len(order))
    even = isotonic_regression(np.array([heights[i] for i in order]) + steps, increasing=False).x
    places = np.minimum(even, top) - steps
    return [float(places[order.index(i)]) for i in range(len(heights))]


VARIABLES = {  # colours of figures by the page's variable that takes their place
    INK: "ink", MUTED: "muted", RULE: "rule", ROAD: "road", SIDEWALK: "walk", BUILDING: "house", TREE: "tree",
    BLUE: "blue", SKY: "sky", ORANGE: "orange", VERMILLION: "red", GREEN: "green", PURPLE: "purple", "#ffffff": "page",
}  # fmt: skip


def svg(figure: Figure) -> str:
    """Return the figure as an SVG element in the colours and fonts of its page; equal figures give equal text."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "flcav"}):
        figure.savefig(buffer, format="svg", dpi=150, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'<style type="text/css">.*?</style>', "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"(/?)>', r"<g\1>", text)
    text = re.sub(r" font-family: [^;\"]*;?", "", text)
    text = re.sub(r'(<svg[^>]*?) width="([\d.]+)pt" height="[\d.]+pt"', r'\1 style="max-width: \2pt"', text, count=1)
    text = re.sub(r"font: (\d+\S* )?([\d.]+px) [^;\"]*", r"font-size: \2", text)
    for colour, name in VARIABLES.items():
        text = text.replace(f": {colour}", f": var(--{name})")
    return re.sub(r"\n\s*", "\n", text).strip()


def png(figure: Figure, dpi: int = 200) -> bytes:
    """Return the figure as a PNG file; equal figures give equal bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()
