"""Association of LiDAR detections with boxes in a camera's pictures, which corrects the camera's extrinsics.

A car found by the LiDAR is projected into the picture. Its distance to a box of the picture is that of their four sides
in standard deviations, in which the uncertainty of the extrinsics and that of both detections have a part. Pairs within
a gate of this distance are assigned by their likelihood against that of staying alone (Kuhn, "The Hungarian method",
1955). Pairs of all pictures of a camera give its extrinsics, by a robust fit of the sides with the calibration as a
prior, and these give better pairs: both are repeated until the pairs stay, `ROUNDS` times at most (Besl, McKay, "A
method for registration of 3-D shapes", 1992, have this for points).
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

SIDE_PX, SIDE_SHARE = 2.0, 0.08  # standard deviation of a side: hypot of pixels and of a share of the box's own size
GATE = chi2.ppf(0.999, (1, 2, 3, 4))  # largest squared distance of a pair, by the number of sides that count
LEAST = 0.01  # least gain of a pair within the gate, as a share of what its squared distance leaves of the gate
ROUNDS = 12  # most repetitions of association and fit
STILL_M = 0.5  # cars of several pictures nearer to each other than this, LiDAR frame, are one that stands
NEAREST_M = 1.0  # least depth of all of a car before the camera
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
    """A camera beside a LiDAR: its extrinsics, how far they may be off, its intrinsics and its picture's size."""

    camera_from_lidar: Array  # (4, 4), optical frame
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
    """The pairs of one shot, and what has no partner."""

    car: Ints  # (P,) index into the shot's cars
    box: Ints  # (P,) index into the shot's boxes
    residual_px: Array  # (P,) root mean square of the offsets of the sides that lie inside the picture
    lone_cars: Ints  # cars that project into the picture
    lone_boxes: Ints

    def __len__(self) -> int:
        return len(self.car)


@dataclass(frozen=True)
class Association:
    """The pairs of each shot, and the view that they were made with."""

    pairs: tuple[Pairs, ...]
    view: AssociatedCamera
    settled: bool  # whether the pairs stayed; False: they still changed after the last round


def spread_of_calibration(rotation_deg: float, position_m: float) -> Array:
    """Return the (6, 6) covariance of extrinsics with these standard deviations about and along each axis."""
    return np.diag(np.repeat((np.radians(rotation_deg), position_m), 3) ** 2)


def apply_error(camera_from_lidar: Array, error: Array) -> Array:
    """Return extrinsics (4, 4) moved by `error` (6,): a rotation vector [rad], then a shift [m], optical frame."""
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(error[:3]).as_matrix()
    moved[:3, 3] = error[3:]
    return moved @ camera_from_lidar


def measure_error(true: Array, view: AssociatedCamera) -> float:
    """Return the squared error of a view's extrinsics in its standard deviations: 6 in the mean, if those are right.

    `true`: the camera's (4, 4) pose of the LiDAR. The error is what `apply_error` takes to the true extrinsics.
    """
    moved = true @ np.linalg.inv(view.camera_from_lidar)
    error = np.concatenate((Rotation.from_matrix(moved[:3, :3]).as_rotvec(), moved[:3, 3]))
    return float(error @ np.linalg.solve(view.covariance, error))


def correct_extrinsics(shots: Sequence[PairedShot], calibrated: AssociatedCamera, rounds: int = ROUNDS) -> Association:
    """Return the pairs of all shots of one camera, and its view with corrected extrinsics and their covariance.

    The extrinsics of `calibrated` are the prior of the fit. Without a pair they stay. After `rounds` fits the pairs are
    taken as they are, settled or not.
    """
    view, pairs = calibrated, tuple(pair(shot, calibrated) for shot in shots)
    settled = not any(map(len, pairs))
    for _ in range(rounds):
        if settled:
            break
        view, before = fit_extrinsics(shots, pairs, calibrated), pairs
        pairs = tuple(pair(shot, view) for shot in shots)
        settled = not any(map(len, pairs)) or _list_partners(pairs) == _list_partners(before)
    return Association(pairs, view, settled)


def _list_partners(pairs: Sequence[Pairs]) -> list[tuple[list[int], list[int]]]:
    """Return the cars and the boxes of each shot's pairs."""
    return [(each.car.tolist(), each.box.tolist()) for each in pairs]


def pair(shot: PairedShot, view: AssociatedCamera) -> Pairs:
    """Return the pairs of a shot's cars and boxes of least cost, and what remains alone.

    Pairs with a squared distance beyond the `GATE` of their sides are none. The cost is -2 log of the density of the
    offsets, but for a constant: the squared distance plus the log-determinant of the covariance. A car and a box that
    stay alone cost the gate plus the log-determinant of the box's own covariance, without that of the extrinsics. A
    pair within the gate that costs more is made only of what stays alone otherwise.
    """
    sides, slope = _project_with_slope(shot.cars, view)
    seen = np.flatnonzero(np.isfinite(sides).all(axis=1))
    gain = np.zeros((len(seen), len(shot.boxes)))  # cost of staying alone less that of the pair; 0: no pair
    offset_px = np.zeros_like(gain)
    for row, car in enumerate(seen):
        spread = slope[car] @ view.covariance @ slope[car].T
        for column, box in enumerate(shot.boxes):
            inside = sides_inside(sides[car], view) & sides_inside(box, view)
            if not inside.any():
                continue
            off, own = (box - sides[car])[inside], side_px(box)
            whole = spread[np.ix_(inside, inside)] / own**2 + np.eye(len(off))  # in units of the box's own
            left = GATE[len(off) - 1] - off @ np.linalg.solve(whole, off) / own**2
            offset_px[row, column] = np.sqrt((off**2).mean())
            if left > 0:
                gain[row, column] = max(left - np.linalg.slogdet(whole)[1], LEAST * left)
    row, column = linear_sum_assignment(gain, maximize=True)
    made = gain[row, column] > 0
    row, column = row[made], column[made]
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
    """Return the view whose extrinsics fit the pairs best, and their covariance.

    By least squares of the sides' offsets in standard deviations, under a Cauchy loss, and of the error of `calibrated`
    in its own: rotation and translation are corrected as far as the pairs show them. A car that stands at one place in
    several pictures counts as much as one in a single picture, since its offsets are alike in all of them. In
    the covariance the sides of one car inside the picture count as one together, since they do not err by themselves.
    """
    cars = [shot.cars[own.car] for shot, own in zip(shots, pairs, strict=True)]
    boxes = np.concatenate([shot.boxes[own.box] for shot, own in zip(shots, pairs, strict=True)])
    points = np.concatenate([outline_cars(each) for each in cars])
    sigma = np.array([side_px(box) for box in boxes])[:, None]
    centers = np.concatenate([each.center for each in cars])
    share = 1 / (cdist(centers, centers) < STILL_M).sum(axis=1, keepdims=True)
    whiten = np.linalg.inv(np.linalg.cholesky(calibrated.covariance))

    def residuals(error: Array) -> Array:
        moved = replace(calibrated, camera_from_lidar=apply_error(calibrated.camera_from_lidar, error))
        sides = _sides(points, moved)
        inside = sides_inside(sides, moved) & sides_inside(boxes, moved)
        off = np.where(inside & np.isfinite(sides), (boxes - sides) / sigma, 0.0)
        # Its square is the Cauchy loss; the prior stays Gaussian.
        robust = np.sign(off) * np.sqrt(share * np.log1p(off**2))
        return np.concatenate((robust.ravel(), whiten @ error))

    found = least_squares(residuals, np.zeros(6), x_scale=np.sqrt(np.diag(calibrated.covariance)))
    slope, prior = found.jac[:-6].reshape(-1, 4, 6), found.jac[-6:]
    sides = np.maximum(slope.any(axis=2).sum(axis=1), 1)[:, None, None]
    covariance = np.linalg.inv(np.tensordot(slope / sides, slope, ((0, 1), (0, 1))) + prior.T @ prior)
    return replace(
        calibrated, camera_from_lidar=apply_error(calibrated.camera_from_lidar, found.x), covariance=covariance
    )


def outline_cars(cars: Boxes) -> Array:
    """Return the (N, K, 3) points of cars' outlines, in the frame of their boxes [m]."""
    own = OUTLINE * (0.5, 0.5, 1.0) - (0, 0, 0.5)
    tilt = np.zeros((len(cars), 2)) if cars.tilt is None else cars.tilt
    turned = rotations(cars.yaw, tilt[:, 0], tilt[:, 1])
    return cars.center[:, None] + np.einsum("nij,nkj->nki", turned, own * cars.size[:, None])


def side_px(box: Array) -> float:
    """Return the standard deviation of a side of a box (4,) [px]."""
    return float(np.hypot(SIDE_PX, SIDE_SHARE * np.sqrt((box[2] - box[0]) * (box[3] - box[1]))))


def sides_inside(boxes: Array, view: AssociatedCamera) -> Mask:
    """Return (..., 4) whether each side of boxes (..., 4) lies inside the picture: not on its border."""
    return (boxes > BORDER_PX) & (boxes < np.array(view.size * 2) - BORDER_PX)


def _sides(points: Array, view: AssociatedCamera) -> Array:
    """Return the boxes (N, 4) around what the picture shows of outlines (N, K, 3), LiDAR frame; NaN where nothing."""
    n, k, _ = points.shape
    seen = transform_points(view.camera_from_lidar, points.reshape(-1, 3))
    before = np.all(seen[:, 2].reshape(n, k) > NEAREST_M, axis=1)
    pixels = project_points(view.intrinsics, view.distortion, seen).reshape(n, k, 2) + HALF_PX
    hulls = shapely.convex_hull(shapely.multipoints(np.where(before[:, None, None], pixels, -1.0)))
    shown = shapely.intersection(hulls, shapely.box(0, 0, *view.size))
    return np.where(np.asarray(shapely.area(shown))[:, None] > 0, shapely.bounds(shown), np.nan)


def _project_with_slope(cars: Boxes, view: AssociatedCamera) -> tuple[Array, Array]:
    """Return the boxes (N, 4) of `_sides` of cars, and their (N, 4, 6) derivative by an error of the extrinsics."""
    points, step = outline_cars(cars), 1e-5
    moved = [
        _sides(points, replace(view, camera_from_lidar=apply_error(view.camera_from_lidar, step * axis)))
        for axis in np.eye(6)
    ]
    sides = _sides(points, view)
    return sides, np.stack([(each - sides) / step for each in moved], axis=2)
