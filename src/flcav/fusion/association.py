"""Association of LiDAR detections with boxes in a camera's pictures, which corrects the camera's extrinsics.

A car detected by the LiDAR is projected into the picture. Its distance to a box of the picture is the Mahalanobis
distance of their four sides, whose covariance is that of the extrinsics, propagated to the sides, plus that of both
detections. Pairs within a gate of this distance are assigned by their likelihood against that of remaining unpaired
(Kuhn, "The Hungarian method", 1955). The pairs of all pictures of a camera determine its extrinsics, by a robust
least-squares fit of the sides with the calibration as a prior; association and fit alternate until the pairs no longer
change, `ROUNDS` times at most (as in Besl, McKay, "A method for registration of 3-D shapes", 1992, for points).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.optimize import least_squares, linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from flcav.arrays import Array, Ints, Mask
from flcav.dataset.rectangles import HALF_PX
from flcav.geometry import Boxes, rotations, transform_points
from flcav.sensors.lens import project_points

SIDE_PX, SIDE_SHARE = 2.0, 0.08  # standard deviation of a side: hypot of pixels and of a share of the box's size
GATE = chi2.ppf(0.999, (1, 2, 3, 4))  # largest squared distance of a pair, by the number of sides that count
LEAST = 0.01  # least gain of a pair within the gate, as a share of the gate less its squared distance
ROUNDS = 12  # most repetitions of association and fit
STILL_M = 0.5  # cars of several pictures with centres nearer than this, LiDAR frame, are one stationary car
NEAREST_M = 1.0  # least depth of every point of a car in front of the camera
BORDER_PX = 1.5  # a side this near to the border of the picture may lie outside
# Of a car's outline, in shares of half its length, of half its width, and of its height above its floor: sills, waist
# and bonnet, roof. Mirrors are part of the width.
OUTLINE = np.array(
    [
        (x * a, y * b, z)
        for a, b, z in ((0.75, 0.88, 0.0), (1.0, 0.72, 0.25), (0.93, 0.92, 0.52), (0.52, 0.66, 0.98))
        for x in (-1, 1)
        for y in (-1, 1)
    ]
)


@dataclass(frozen=True)
class AssociatedCamera:
    """A camera calibrated to a LiDAR: extrinsics with their covariance, intrinsics and picture size."""

    camera_from_lidar: Array  # (4, 4) [m], optical frame
    covariance: Array  # (6, 6) of the error `apply_error` takes: rotation [rad], translation [m], optical frame
    intrinsics: Array  # (3, 3) [px]
    distortion: Array  # (5,) as in `flcav.sensors.lens`
    size: tuple[int, int]  # width, height [px]


@dataclass(frozen=True)
class PairedShot:
    """Cars detected by a LiDAR and boxes detected in a camera's picture at one instant."""

    cars: Boxes  # (N,) LiDAR frame
    boxes: Array  # (M, 4) x1 y1 x2 y2 [px] from the picture's upper left corner


@dataclass(frozen=True)
class Pairs:
    """The pairs of one shot, and the cars and boxes without a partner."""

    car: Ints  # (P,) index into the shot's cars
    box: Ints  # (P,) index into the shot's boxes
    residual_px: Array  # (P,) root mean square of the offsets of the sides that lie inside the picture
    lone_cars: Ints  # (L,) index of cars that project into the picture and have no pair
    lone_boxes: Ints  # (Q,) index of boxes without a pair

    def __len__(self) -> int:
        return len(self.car)


@dataclass(frozen=True)
class Association:
    """The pairs of each shot, and the camera's extrinsics that they were made with."""

    pairs: tuple[Pairs, ...]
    view: AssociatedCamera
    settled: bool  # whether the pairs converged; False: they still changed after the last round


def spread_of_calibration(rotation_deg: float, position_m: float) -> Array:
    """Return the (6, 6) covariance of extrinsics with these standard deviations about and along each axis.

    It is diagonal: rotation [rad^2], then translation [m^2].
    """
    return np.diag(np.repeat((np.radians(rotation_deg), position_m), 3) ** 2)


def apply_error(camera_from_lidar: Array, error: Array) -> Array:
    """Return extrinsics (4, 4) [m] moved by `error` (6,): rotation vector [rad], then shift [m], optical frame."""
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(error[:3]).as_matrix()
    moved[:3, 3] = error[3:]
    return moved @ camera_from_lidar


def measure_error(true: Array, view: AssociatedCamera) -> float:
    """Return the squared Mahalanobis distance of a camera's extrinsics from the true ones; its mean is 6 if consistent.

    `true`: the camera's (4, 4) pose of the LiDAR [m]. The error is what `apply_error` takes to the true extrinsics.
    """
    moved = true @ np.linalg.inv(view.camera_from_lidar)
    error = np.concatenate((Rotation.from_matrix(moved[:3, :3]).as_rotvec(), moved[:3, 3]))
    return float(error @ np.linalg.solve(view.covariance, error))


def correct_extrinsics(shots: Sequence[PairedShot], calibrated: AssociatedCamera, rounds: int = ROUNDS) -> Association:
    """Return the pairs of all shots of one camera, and the camera with corrected extrinsics and their covariance.

    The extrinsics of `calibrated` are the prior of the fit; without any pair they are returned unchanged. After
    `rounds` fits the pairs are returned whether or not they have converged.
    """
    view = calibrated
    pairs = tuple(pair(shot, calibrated) for shot in shots)
    settled = not any(map(len, pairs))
    for _ in range(rounds):
        if settled:
            break
        view = fit_extrinsics(shots, pairs, calibrated)
        previous = pairs
        pairs = tuple(pair(shot, view) for shot in shots)
        settled = not any(map(len, pairs)) or _list_partners(pairs) == _list_partners(previous)
    return Association(pairs, view, settled)


def _list_partners(pairs: Sequence[Pairs]) -> list[tuple[list[int], list[int]]]:
    """Return the indices of the cars and of the boxes of each shot's pairs."""
    return [(shot_pairs.car.tolist(), shot_pairs.box.tolist()) for shot_pairs in pairs]


def pair(shot: PairedShot, view: AssociatedCamera) -> Pairs:
    """Return the assignment of least cost of a shot's cars to its boxes, and those that remain unpaired.

    A car and a box whose squared distance exceeds the `GATE` of their sides are never paired. The cost is -2 log of the
    density of the offsets, up to a constant: the squared distance plus the log-determinant of the covariance. Leaving
    both unpaired costs the gate plus the log-determinant of the box's covariance alone, without that of the extrinsics.
    A pair within the gate that costs more is made only between cars and boxes that are otherwise unpaired.
    """
    sides, slope = _project_with_slope(shot.cars, view)
    seen = np.flatnonzero(np.isfinite(sides).all(axis=1))
    gain = np.zeros((len(seen), len(shot.boxes)))  # cost of leaving both unpaired less that of the pair; 0: no pair
    offset_px = np.zeros_like(gain)
    for row, car in enumerate(seen):
        covariance = slope[car] @ view.covariance @ slope[car].T
        for column, box in enumerate(shot.boxes):
            inside = sides_inside(sides[car], view) & sides_inside(box, view)
            if not inside.any():
                continue
            offset, sigma = (box - sides[car])[inside], side_px(box)
            # Scaled by the box's standard deviation, so that the covariance of the detections is the identity.
            scaled = covariance[np.ix_(inside, inside)] / sigma**2 + np.eye(len(offset))
            margin = GATE[len(offset) - 1] - offset @ np.linalg.solve(scaled, offset) / sigma**2
            offset_px[row, column] = np.sqrt((offset**2).mean())
            if margin > 0:
                gain[row, column] = max(margin - np.linalg.slogdet(scaled)[1], LEAST * margin)
    row, column = linear_sum_assignment(gain, maximize=True)
    # The assignment pairs as many as it can; pairs without a gain are dropped.
    paired = gain[row, column] > 0
    row, column = row[paired], column[paired]
    return Pairs(
        seen[row],
        column.astype(np.int64),
        offset_px[row, column],
        np.setdiff1d(seen, seen[row]),
        np.setdiff1d(np.arange(len(shot.boxes)), column),
    )


def fit_extrinsics(
    shots: Sequence[PairedShot], pairs: Sequence[Pairs], calibrated: AssociatedCamera
) -> AssociatedCamera:
    """Return the camera with the extrinsics that fit the pairs best, and their covariance.

    Least squares of the sides' normalised offsets, under a Cauchy loss, and of the normalised error of `calibrated` as
    a Gaussian prior: rotation and translation are corrected as far as the pairs determine them. A stationary car that
    several pictures show has the weight of a car in a single one, since its offsets are correlated. In the covariance
    the sides of one car inside the picture have together the weight of one, since their errors are correlated, too.
    """
    cars = [shot.cars[pairs_of_shot.car] for shot, pairs_of_shot in zip(shots, pairs, strict=True)]
    boxes = np.concatenate([shot.boxes[pairs_of_shot.box] for shot, pairs_of_shot in zip(shots, pairs, strict=True)])
    points = np.concatenate([outline_cars(shot_cars) for shot_cars in cars])
    sigma = np.array([side_px(box) for box in boxes])[:, None]
    centers = np.concatenate([shot_cars.center for shot_cars in cars])
    weight = 1 / (cdist(centers, centers) < STILL_M).sum(axis=1, keepdims=True)
    whiten = np.linalg.inv(np.linalg.cholesky(calibrated.covariance))

    def residuals(error: Array) -> Array:
        moved = replace(calibrated, camera_from_lidar=apply_error(calibrated.camera_from_lidar, error))
        sides = _sides(points, moved)
        inside = sides_inside(sides, moved) & sides_inside(boxes, moved)
        offset = np.where(inside & np.isfinite(sides), (boxes - sides) / sigma, 0.0)
        # Cauchy loss: the square of this residual is log(1 + offset^2). The prior stays quadratic, hence Gaussian.
        robust = np.sign(offset) * np.sqrt(weight * np.log1p(offset**2))
        return np.concatenate((robust.ravel(), whiten @ error))

    fit = least_squares(residuals, np.zeros(6), x_scale=np.sqrt(np.diag(calibrated.covariance)))
    slope = fit.jac[:-6].reshape(-1, 4, 6)
    prior = fit.jac[-6:]
    sides = np.maximum(slope.any(axis=2).sum(axis=1), 1)[:, None, None]
    covariance = np.linalg.inv(np.tensordot(slope / sides, slope, ((0, 1), (0, 1))) + prior.T @ prior)
    return replace(
        calibrated, camera_from_lidar=apply_error(calibrated.camera_from_lidar, fit.x), covariance=covariance
    )


def outline_cars(cars: Boxes) -> Array:
    """Return the points (N, K, 3) on the surfaces of cars by `OUTLINE`, in the frame of their boxes [m]."""
    outline = OUTLINE * (0.5, 0.5, 1.0) - (0, 0, 0.5)
    tilt = np.zeros((len(cars), 2)) if cars.tilt is None else cars.tilt
    turned = rotations(cars.yaw, tilt[:, 0], tilt[:, 1])
    return cars.center[:, None] + np.einsum("nij,nkj->nki", turned, outline * cars.size[:, None])


def side_px(box: Array) -> float:
    """Return the standard deviation of a side of a box (4,) [px]."""
    return float(np.hypot(SIDE_PX, SIDE_SHARE * np.sqrt((box[2] - box[0]) * (box[3] - box[1]))))


def sides_inside(boxes: Array, view: AssociatedCamera) -> Mask:
    """Return (..., 4) whether each side of boxes (..., 4) [px] lies inside the picture, not on its border."""
    return (boxes > BORDER_PX) & (boxes < np.array(view.size * 2) - BORDER_PX)


def _sides(points: Array, view: AssociatedCamera) -> Array:
    """Return the boxes (N, 4) [px] of the visible part of outlines (N, K, 3) [m], LiDAR frame; NaN where none is."""
    n, k, _ = points.shape
    seen = transform_points(view.camera_from_lidar, points.reshape(-1, 3))
    in_front = np.all(seen[:, 2].reshape(n, k) > NEAREST_M, axis=1)
    pixels = project_points(view.intrinsics, view.distortion, seen).reshape(n, k, 2) + HALF_PX
    hulls = shapely.convex_hull(shapely.multipoints(np.where(in_front[:, None, None], pixels, -1.0)))
    shown = shapely.intersection(hulls, shapely.box(0, 0, *view.size))
    return np.where(np.asarray(shapely.area(shown))[:, None] > 0, shapely.bounds(shown), np.nan)


def _project_with_slope(cars: Boxes, view: AssociatedCamera) -> tuple[Array, Array]:
    """Return the boxes (N, 4) [px] of `_sides`, and their derivative (N, 4, 6) by an error of the extrinsics."""
    points, step = outline_cars(cars), 1e-5
    moved = [
        _sides(points, replace(view, camera_from_lidar=apply_error(view.camera_from_lidar, step * axis)))
        for axis in np.eye(6)
    ]
    sides = _sides(points, view)
    return sides, np.stack([(shifted - sides) / step for shifted in moved], axis=2)
