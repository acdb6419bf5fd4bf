"""Matching of lane lines by the rule of the CULane benchmark, and their F1.

Every line is drawn 30 pixels wide in a picture 1640 pixels wide, as CULane's are; pictures of another size are scaled
to that width. Two lines match where the intersection over union (IoU) of their pixels is above 0.5, each with at most
one other, in the assignment of largest total IoU. F1 is the harmonic mean of the shares of found and of true lines that
match (Pan et al., "Spatial As Deep: Spatial CNN for Traffic Scene Understanding", AAAI 2018).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw
from scipy.optimize import linear_sum_assignment

from flcav.arrays import Array, Mask

CULANE_PX = 1640  # width of CULane's pictures
LINE_PX = 30  # width of a drawn line in them
OVERLAP = 0.5  # IoU above which two lines match


def match_lines(found: Sequence[Array], wanted: Sequence[Array], size: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the pairs of a found and a wanted line that match, by index.

    Lines are polylines (K, 2) of u, v [px] in a picture of `size` (width, height), the first pixel's centre at (0, 0).
    """
    if not found or not wanted:
        return []
    one, other = ([draw_line(line, size) for line in lines] for lines in (found, wanted))
    overlaps = np.array([[intersection_over_union(a, b) for b in other] for a in one])
    rows, columns = linear_sum_assignment(-np.where(overlaps > OVERLAP, overlaps, 0.0))
    return [(int(i), int(j)) for i, j in zip(rows, columns) if overlaps[i, j] > OVERLAP]


def draw_line(line: Array, size: tuple[int, int]) -> Mask:
    """Return the pixels (rows, CULANE_PX) of a line, `LINE_PX` wide with round ends, in the scaled picture."""
    factor = CULANE_PX / size[0]
    points = [(float(u), float(v)) for u, v in (np.asarray(line) + 0.5) * factor - 0.5]
    image = Image.new("1", (CULANE_PX, round(size[1] * factor)))
    draw = ImageDraw.Draw(image)
    draw.line(points, fill=1, width=LINE_PX, joint="curve")
    half = LINE_PX / 2
    for u, v in (points[0], points[-1]):
        draw.ellipse((u - half, v - half, u + half, v + half), fill=1)
    return np.asarray(image)


def intersection_over_union(one: Mask, other: Mask) -> float:
    """Return the IoU of two masks of one shape; 0 for empty ones."""
    both = int(np.count_nonzero(one & other))
    return both / max(int(np.count_nonzero(one)) + int(np.count_nonzero(other)) - both, 1)


def f1_score(hits: ArrayLike, found: ArrayLike, wanted: ArrayLike) -> Array:
    """Return 2 hits / (found + wanted) (...), the F1 of numbers of lines (...); NaN where no line is wanted."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.asarray(wanted) > 0, 2 * np.asarray(hits) / (np.asarray(found) + np.asarray(wanted)), np.nan)
