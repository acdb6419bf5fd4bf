"""Oriented 3D bounding boxes: transforms, corners, point-in-box and segment-box tests."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flcav.arrays import Array, Array32, Ints, Mask, Words
from flcav.geometry.poses import (
    angles_of,
    heading_vectors,
    inverse,
    left_vectors,
    pose,
    rotations,
    rotations_about_z,
    transform_points,
    wrap_angle,
    yaw_of,
)
from flcav.interface.notebook import Displayed

REACH_SLACK_M = 0.01  # for rounding of points in single precision
LEVEL_RAD = 1e-6  # pitch and roll of a box that is upright


@dataclass(frozen=True)
class Boxes(Displayed):
    """N oriented 3D bounding boxes, upright (yaw only) or tilted, in one frame, which the containing record states.

    Raises ValueError where the lengths or shapes of the arrays do not match.

    >>> from flcav import Boxes
    >>> cars = Boxes.from_array([[10.0, 2.0, 0.8, 4.4, 1.8, 1.6, 0.0]], "Car")
    >>> cars.corners()[0, 0]  # bottom, front left
    array([12.2,  2.9,  0. ])
    """

    center: Array  # (N, 3) geometric centre x, y, z [m]
    size: Array  # (N, 3) length, width and height: extents along x, y and z of the box frame [m]
    yaw: Array  # (N,) heading, counter-clockwise from the frame's x axis [rad]
    label: Words  # (N,) class name
    score: Array | None = None  # (N,) confidence in [0, 1]
    variance: Array | None = None  # (N, 7) of x, y, z [m^2], length, width, height [m^2], yaw [rad^2]
    tilt: Array | None = None  # (N, 2) pitch and roll [rad], as in `pose`; None: upright
    speed: Array | None = None  # (N,) over ground, along the heading [m/s]; NaN: unknown

    def __post_init__(self) -> None:
        n = len(self.center)
        shapes = {
            "center": (n, 3),
            "size": (n, 3),
            "yaw": (n,),
            "label": (n,),
            "score": (n,),
            "variance": (n, 7),
            "tilt": (n, 2),
            "speed": (n,),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"Boxes.{name} has shape {value.shape}, expected {shape}")

    def __len__(self) -> int:
        return len(self.center)

    def __getitem__(self, index: ArrayLike | slice) -> "Boxes":
        """Return the boxes that an index array, a boolean mask or a slice selects."""
        if not isinstance(index, slice):
            index = np.asarray(index)
            index = index if index.dtype == bool else index.astype(np.int64)
        optional = (self.score, self.variance, self.tilt, self.speed)
        chosen = (None if values is None else values[index] for values in optional)
        return Boxes(self.center[index], self.size[index], self.yaw[index], self.label[index], *chosen)

    @classmethod
    def empty(cls) -> "Boxes":
        """Return a record of 0 boxes."""
        return cls.from_array(np.zeros((0, 7)), np.zeros(0, dtype=str))

    @classmethod
    def from_array(cls, array: ArrayLike, label: ArrayLike, score: ArrayLike | None = None) -> "Boxes":
        """Return boxes from (N, 7) rows x, y, z, length, width, height [m], yaw [rad] and (N,) labels (or one for all).

        `score` is (N,), if given.
        """
        rows = np.asarray(array, dtype=np.float64).reshape(-1, 7)
        labels = np.broadcast_to(np.asarray(label, dtype=np.str_), len(rows))
        scores = None if score is None else np.asarray(score, dtype=np.float64)
        return cls(rows[:, :3], rows[:, 3:6], rows[:, 6], labels, scores)

    def array(self) -> Array:
        """Return (N, 7) rows x, y, z, length, width, height [m], yaw [rad]."""
        return np.concatenate((self.center, self.size, self.yaw[:, None]), axis=1)

    def columns(self) -> dict[str, NDArray]:
        """Return each quantity as a column (N,), with the scores if known, for `pandas.DataFrame`."""
        names = ("x", "y", "z", "length", "width", "height", "yaw")
        columns: dict[str, NDArray] = {"label": self.label, **dict(zip(names, self.array().T))}
        return columns if self.score is None else columns | {"score": self.score}

    def transform(self, target_from_source: Array) -> "Boxes":
        """Return the boxes in the target frame of a rigid (4, 4) transform.

        Its roll and pitch move the centres; they turn tilted boxes, and leave upright ones upright. Variances of the
        centre are the diagonal of the rotated covariance R diag(v) R^T; those of size and yaw stay, and so do all under
        translations.
        """
        center = transform_points(target_from_source, self.center)
        yaw, tilt = wrap_angle(self.yaw + yaw_of(target_from_source)), self.tilt
        if tilt is not None:
            turned, *tilts = angles_of(target_from_source[:3, :3] @ self.rotations())
            yaw, tilt = wrap_angle(turned), np.stack(tilts, axis=1)
        variance = self.variance
        if variance is not None:
            turned = variance[:, :3] @ np.square(target_from_source[:3, :3]).T
            variance = np.concatenate((turned, variance[:, 3:]), axis=1)
        return replace(self, center=center, yaw=yaw, variance=variance, tilt=tilt)

    def rotations(self) -> Array:
        """Return (N, 3, 3) rotation matrices from the box frames to the frame of the centres."""
        return rotations_about_z(self.yaw) if self.tilt is None else rotations(self.yaw, *self.tilt.T)

    def pose(self, i: int) -> Array:
        """Return the (4, 4) pose of box `i`: the transform from its frame, with the origin at its centre."""
        pitch, roll = (0.0, 0.0) if self.tilt is None else self.tilt[i]
        x, y, z = self.center[i]
        return pose(x, y, z, self.yaw[i], pitch, roll)

    def corners(self) -> Array:
        """Return (N, 8, 3) corners [m]: the bottom four counter-clockwise from front left, then the top four."""
        signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
        unit = np.concatenate((np.c_[signs, np.full(4, -0.5)], np.c_[signs, np.full(4, 0.5)]))
        local = unit[None] * self.size[:, None]
        if self.tilt is not None:
            return np.einsum("nij,nkj->nki", self.rotations(), local) + self.center[:, None]
        cos, sin = np.cos(self.yaw)[:, None], np.sin(self.yaw)[:, None]
        x = local[..., 0] * cos - local[..., 1] * sin
        y = local[..., 0] * sin + local[..., 1] * cos
        return np.stack((x, y, local[..., 2]), axis=-1) + self.center[:, None]


def turned_boxes(center: Array, size: Array, rotation: Array, label: Words) -> Boxes:
    """Return boxes with the given rotation matrices, as upright boxes if none leans by more than `LEVEL_RAD`.

    Args:
        center: (M, 3) centres [m].
        size: (M, 3) length, width, height [m].
        rotation: (M, 3, 3) rotation matrices from the box frames.
        label: (M,) class names.
    """
    yaw, *tilts = angles_of(rotation)
    tilt = np.stack(tilts, axis=1)
    return Boxes(center, size, yaw, label, tilt=tilt if (np.abs(tilt) > LEVEL_RAD).any() else None)


def spread_over_footprints(boxes: Boxes, along: int, across: int) -> Array:
    """Return (N, along * across, 2) cell centres x, y [m] of an even grid on the footprint of each box."""
    parts = (np.arange(along) + 0.5) / along - 0.5, (np.arange(across) + 0.5) / across - 0.5
    part = np.stack(np.meshgrid(*parts, indexing="ij"), axis=-1).reshape(-1, 2)
    reach = part[None] * boxes.size[:, None, :2]
    forward, left = heading_vectors(boxes.yaw)[:, None], left_vectors(boxes.yaw)[:, None]
    return boxes.center[:, None, :2] + reach[..., :1] * forward + reach[..., 1:] * left


def points_in_boxes(points: ArrayLike, boxes: Boxes, margin_m: float = 0.0) -> Mask:
    """Return (N, P) whether each of P points lies in each of N boxes, enlarged by `margin_m` on every side.

    `points` is (P, >= 3), x, y, z [m] first, in the frame of the boxes. Faces count as inside.
    """
    xyz = np.asarray(points)[:, :3].astype(np.float64)
    x, y = np.ascontiguousarray(xyz[:, :2].T)
    inside = np.zeros((len(boxes), len(xyz)), dtype=bool)
    for i in range(len(boxes)):
        half = boxes.size[i] / 2 + margin_m
        reach = np.hypot(half[0], half[1]) if boxes.tilt is None else np.linalg.norm(half)
        near = np.flatnonzero((np.abs(x - boxes.center[i, 0]) <= reach) & (np.abs(y - boxes.center[i, 1]) <= reach))
        offset = xyz[near] - boxes.center[i]
        local = _turn_back(offset, boxes.yaw[i]) if boxes.tilt is None else offset @ boxes[[i]].rotations()[0]
        inside[i, near] = (np.abs(local) <= half).all(axis=1)
    return inside


def count_points_in_boxes(points: Array32, boxes: Boxes, boxes_from_points: Array) -> Ints:
    """Count the points (P, >= 3), x, y, z [m], in each of N boxes: (N,); faces count as inside.

    `boxes_from_points` is the (4, 4) transform between the frames. For large clouds: the points are sorted by x, and
    only those near a box are transformed.
    """
    x, y = np.ascontiguousarray(points[:, :2].T)
    order = np.argsort(x)
    x, y = x[order], y[order]
    reach = np.linalg.norm(boxes.size, axis=1) / 2 + REACH_SLACK_M
    center = transform_points(inverse(boxes_from_points), boxes.center)
    first, end = np.searchsorted(x, center[:, 0] - reach), np.searchsorted(x, center[:, 0] + reach, "right")
    near = [
        order[low:high][np.abs(y[low:high] - aside) <= far]
        for low, high, aside, far in zip(first, end, center[:, 1], reach, strict=True)
    ]
    box = np.repeat(np.arange(len(boxes)), [len(rows_near) for rows_near in near])
    rows = np.concatenate(near) if near else np.zeros(0, np.int64)
    moved = transform_points(boxes_from_points, points[rows, :3].astype(np.float64))
    offset = moved - boxes.center[box]
    tilted = boxes.tilt is not None
    local = np.einsum("pi,pij->pj", offset, boxes.rotations()[box]) if tilted else _turn_back(offset, boxes.yaw[box])
    return np.bincount(box[(np.abs(local) <= boxes.size[box] / 2).all(axis=1)], minlength=len(boxes))


def _turn_back(offset: Array, yaw: ArrayLike) -> Array:
    """Rotate offsets (P, 3) [m] from box centres into the box frames, whose `yaw` [rad] is a number or (P,)."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    dx, dy, dz = offset.T
    return np.stack((dx * cos + dy * sin, dy * cos - dx * sin, dz), axis=1)


def segments_meet_boxes(starts: ArrayLike, ends: ArrayLike, boxes: Boxes) -> Mask:
    """Return (S, N) whether each of S segments meets each of N boxes, by the slab method (Kay and Kajiya, 1986).

    `starts` and `ends` are (S, 3), x, y, z [m] in the frame of the boxes. Faces belong to the box.
    """
    start, end = np.asarray(starts, dtype=np.float64), np.asarray(ends, dtype=np.float64)
    axes = boxes.rotations()
    local = np.einsum("sni,nij->snj", start[:, None] - boxes.center, axes)
    along = np.einsum("si,nij->snj", end - start, axes)
    half = boxes.size / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half - local) / along, (half - local) / along
    # A segment parallel to a slab gives 0/0 or an infinity above: it is in the slab for its whole length, or never.
    parallel = along == 0
    within = np.abs(local) <= half
    near = np.where(parallel, np.where(within, -np.inf, np.inf), np.minimum(first, second))
    far = np.where(parallel, np.where(within, np.inf, -np.inf), np.maximum(first, second))
    enters = near.max(axis=-1, initial=0.0)
    leaves = far.min(axis=-1, initial=1.0)
    return enters <= leaves


def concatenate(parts: Sequence[Boxes]) -> Boxes:
    """Concatenate `parts` in order; the result has scores, variances and speeds if every non-empty part has them.

    If all parts are empty, the first one is returned, with or without (empty) scores; without parts, `Boxes.empty()`.
    """
    parts = [part for part in parts if len(part)] or parts[:1]
    if not parts:
        return Boxes.empty()

    def joined(name: str) -> NDArray | None:
        values = [getattr(part, name) for part in parts]
        return None if any(value is None for value in values) else np.concatenate(values)

    tilt = None
    if any(part.tilt is not None for part in parts):
        tilt = np.concatenate([np.zeros((len(part), 2)) if part.tilt is None else part.tilt for part in parts])
    rows = np.concatenate([part.array() for part in parts])
    labels = np.concatenate([part.label for part in parts])
    joint = (joined("score"), joined("variance"), tilt, joined("speed"))
    return Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], labels, *joint)
