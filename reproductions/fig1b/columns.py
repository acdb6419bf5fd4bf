"""A figure with a column per task: sensor data, preprocessed input, activations of layers, output."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from flcav.report import style

Draw = Callable[[Axes], None]
ROWS = ("sensor", "processing", "network", "output")
WIDTH_IN, HEIGHT_IN = 13.0, 9.0
ASPECT = 0.6  # height of a panel, divided by its width
FROM_ABOVE: dict[str, Any] = {"xlim": (-28, 28), "ylim": (0, 33.6), "aspect": "auto"}  # limits of axes for a sweep [m]
BEHIND_M, ABOVE_M = 9.0, 5.0  # viewpoint of a sweep in perspective, from its sensor
SHOWN_MAPS = 3  # number of feature maps shown per layer, the most active ones
ACTIVE = LinearSegmentedColormap.from_list("active", ["#f4f7fa", style.SKY, style.BLUE, "#00284a"])


@dataclass(frozen=True)
class Layer:
    """Output of a layer for one sample."""

    name: str
    values: NDArray[np.float32]  # (C, H, W) maps or (C,) a vector

    @property
    def shape(self) -> str:
        """Return the shape as text, such as "16 × 5 × 5"."""
        return " × ".join(str(side) for side in self.values.shape)


@dataclass(frozen=True)
class Column:
    """The column of one task: drawing functions and captions by row (`ROWS`)."""

    title: str
    draws: Mapping[str, Draw]  # by row
    captions: Mapping[str, str]


@style.styled
def task_columns(columns: Sequence[Column]) -> Figure:
    """Return the figure with a column per task and a row for each of `ROWS`."""
    figure = style.canvas(WIDTH_IN, HEIGHT_IN)
    panels = figure.subplots(len(ROWS), len(columns), squeeze=False)
    for number, column in enumerate(columns):
        for row, axes in zip(ROWS, panels[:, number], strict=True):
            style.hide_axes(axes)
            column.draws[row](axes)
            axes.set_box_aspect(ASPECT)
            axes.set_xlabel(column.captions[row], color=style.MUTED, fontsize=style.SMALL)
        panels[0, number].set_title(column.title, fontweight="bold", loc="center", fontsize=style.TEXT + 2, pad=8)
    for row, axes in zip(ROWS, panels[:, 0], strict=True):
        axes.set_ylabel(row, fontweight="bold", fontsize=style.TEXT + 1, labelpad=10, color=style.INK)
    return figure


def show_picture(axes: Axes, picture: NDArray[np.uint8], *, smooth: bool = True) -> None:
    """Show an RGB picture, its pixels as squares unless `smooth`."""
    height, width = picture.shape[:2]
    interpolation = "antialiased" if smooth else "nearest"
    axes.imshow(picture, extent=(0, width, height, 0), interpolation=interpolation)


def show_layers(axes: Axes, layers: Sequence[Layer]) -> None:
    """Draw the layers from left to right: the `SHOWN_MAPS` most active feature maps, or a vector as a column."""
    x = 0.0
    for number, layer in enumerate(layers):
        x += _slab(axes, x, layer, lower=number % 2 == 1)
    middle, half = 0.4, ASPECT * (x + 0.1) / 2
    axes.set(xlim=(-0.2, x - 0.1), ylim=(middle - half, middle + half), aspect="auto")


def _slab(axes: Axes, x: float, layer: Layer, *, lower: bool) -> float:
    """Draw a layer with its left edge at `x`; return the distance to the left edge of the next one."""
    width = 0.0
    if layer.values.ndim == 1:
        column = np.abs(layer.values)[:, None] / max(float(np.abs(layer.values).max()), 1e-9)
        axes.imshow(column, cmap=ACTIVE, extent=(x, x + 0.16, 0.1, 1.5), aspect="auto", interpolation="nearest")
        width, middle = 0.16, x + 0.08
    else:
        maps = np.abs(layer.values)
        strongest = np.argsort(-maps.mean((1, 2)), kind="stable")[:SHOWN_MAPS][::-1]
        size = 0.55 + 0.25 * np.log2(max(maps.shape[1:]) / 4) / 3
        for depth, channel in enumerate(strongest):
            shown = np.clip(maps[channel] / max(float(np.quantile(maps[channel], 0.995)), 1e-9), 0, 1)
            place = Affine2D().scale(0.55 * size, size).skew_deg(0, 24).translate(x + 0.16 * depth, 0.75 - size / 2)
            image = axes.imshow(shown, cmap=ACTIVE, extent=(0, 1, 0, 1), interpolation="nearest", zorder=3 + depth)
            image.set_transform(place + axes.transData)
            corners = place.transform(np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]))
            axes.plot(*corners.T, color=style.MUTED, linewidth=0.5, zorder=3 + depth)
        width = 0.16 * (len(strongest) - 1) + 0.55 * size
        middle = x + width / 2
    words = {"ha": "center", "va": "top", "fontsize": style.SMALL - 2}
    axes.text(middle, -0.34 if lower else 0.02, f"{layer.name}\n{layer.shape}", color=style.MUTED, **words)
    return width + 0.24


def show_probabilities(axes: Axes, probabilities: Mapping[str, float]) -> None:
    """Draw a bar per class."""
    names, shares = [name.replace("_", " ") for name in probabilities], list(probabilities.values())
    best = int(np.argmax(shares))
    bars = axes.barh(names, shares, color=[style.BLUE if i == best else style.RULE for i in range(len(names))])
    axes.bar_label(bars, fmt="%.2f", padding=3, fontsize=style.SMALL, color=style.INK)
    for number, name in enumerate(names):
        axes.text(-0.03, number, name, ha="right", va="center", fontsize=style.SMALL)
    axes.set(xlim=(-0.45, 1.2), xticks=[], yticks=[])
    axes.invert_yaxis()


def show_anchors(axes: Axes, picture: NDArray[np.uint8], stride: int, anchors: Sequence[tuple[float, float]]) -> None:
    """Show a picture in grey with the coarsest grid cells, and the anchors (width, height [px]) side by side."""
    grey = picture.mean(axis=2, keepdims=True).repeat(3, axis=2)
    show_picture(axes, (128 + 0.5 * grey).clip(0, 255).astype(np.uint8))
    height, width = picture.shape[:2]
    axes.vlines(np.arange(0, width + 1, stride), 0, height, color="white", linewidth=0.5)
    axes.hlines(np.arange(0, height + 1, stride), 0, width, color="white", linewidth=0.5)
    left = (width - sum(size[0] for size in anchors) - 12 * (len(anchors) - 1)) / 2
    for across, down in anchors:
        box = Rectangle((left, (height - down) / 2), across, down, fill=False, edgecolor=style.BLUE, linewidth=1.4)
        axes.add_patch(box)
        left += across + 12


def show_voxels(axes: Axes, points: NDArray[np.float32], range_m: Sequence[float], cell_m: float) -> None:
    """Draw from above the number of occupied voxels in each column of cells, `cell_m` wide."""
    x0, y0, z0, x1, y1, z1 = range_m
    inside = ((points[:, :3] >= (x0, y0, z0)) & (points[:, :3] < (x1, y1, z1))).all(1)
    voxels = np.unique(((points[inside, :3] - (x0, y0, z0)) / cell_m).astype(int), axis=0)
    shape = (round((x1 - x0) / cell_m), round((y1 - y0) / cell_m))
    count = np.zeros(shape)
    np.add.at(count, tuple(voxels[:, :2].T), 1)
    shown = np.sqrt(count)[::-1, ::-1]
    axes.imshow(shown, cmap=ACTIVE, vmax=2.5, extent=(-y1, -y0, x0, x1), interpolation="antialiased")
    axes.set(**FROM_ABOVE)


def show_sweep(axes: Axes, points: NDArray[np.float32], range_m: Sequence[float], height_m: float) -> None:
    """Draw a sweep in perspective from behind and above its sensor, coloured by height, within the network's range."""
    x1, half = range_m[3], range_m[4]
    near = points[(points[:, 0] > 1) & (points[:, 0] < x1) & (np.abs(points[:, 1]) < half)]
    depth = near[:, 0] + BEHIND_M
    across, up = -near[:, 1] / depth, (near[:, 2] - ABOVE_M) / depth
    order = np.argsort(-depth)
    height = np.clip((near[order, 2] + height_m) / 4, 0, 1)
    axes.scatter(across[order], up[order], s=0.7, c=height, cmap="viridis", linewidths=0, rasterized=True)
    axes.set(xlim=(-0.8, 0.8), ylim=(-0.76, 0.2))


def show_raster(axes: Axes, raster: NDArray[np.float32], colours: Sequence[str | tuple[float, ...] | None]) -> None:
    """Draw the layers (L, H, W) of a raster over each other in their colours; layers with colour None are left out."""
    picture = np.ones((*raster.shape[1:], 3))
    for layer, colour in zip(raster, colours, strict=True):
        if colour is not None:
            picture[layer > 0] = colour
    axes.imshow(picture, interpolation="nearest")
