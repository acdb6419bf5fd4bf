"""A sweep's points, and boxes in their frame, drawn on what a camera saw."""

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.perception.camera_view import CameraView
from flcav.report import style

EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
TICK = 1.3  # of the way from the middle of a box to its front
ALONG = np.linspace(0, 1, 33)  # of an edge: distortion bends it, and it may end behind the camera
DISTANCES_M = Normalize(0, 60, clip=True)
DISTANCE_COLOURS = ListedColormap(colormaps["turbo"](np.linspace(0.08, 0.92, 64))[::-1])


def show_view(axes: Axes, view: CameraView) -> None:
    """Show the picture; `axes` are in its pixels."""
    height, width = view.picture.shape[:2]
    axes.imshow(view.picture)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    style.bare(axes)


def points_on_picture(axes: Axes, points: NDArray[np.float32], view: CameraView) -> ScalarMappable:
    """Draw the points (N, >=3) that the picture shows, coloured by distance; return what a colour bar needs."""
    shown = points[view.shows(points[:, :3]), :3]
    distance = np.linalg.norm(shown, axis=1)
    order = np.argsort(-distance, kind="stable")
    scale = ScalarMappable(DISTANCES_M, DISTANCE_COLOURS)
    pixels = view.project(shown[order]).T
    axes.scatter(*pixels, s=1.6, color=scale.to_rgba(distance[order]), linewidths=0, alpha=0.8, rasterized=True)
    return scale


def boxes_on_picture(axes: Axes, boxes: Boxes, view: CameraView, colour: str, *, width: float = 1.0) -> None:
    """Draw the edges of boxes (in the points' frame) as far as they are in front of the camera.

    A tick on the ground through its front says which way each box heads.
    """
    corners = boxes.corners()
    foot, front = corners[:, :4].mean(axis=1), corners[:, (0, 3)].mean(axis=1)
    ticks = np.stack((foot, foot + TICK * (front - foot)), axis=1)
    ends = np.concatenate((corners[:, EDGES], ticks[:, None]), axis=1)  # (boxes, edges, 2, 3)
    along = ends[:, :, :1] + ALONG[:, None] * (ends[:, :, 1:] - ends[:, :, :1])
    lines = LineCollection(
        list(view.project(along.reshape(-1, 3)).reshape(-1, len(ALONG), 2)),
        colors=colour,
        linewidths=width,
        path_effects=[withStroke(linewidth=width + 1.0, foreground="white")],
        zorder=3,
    )
    axes.add_collection(lines, autolim=False)
