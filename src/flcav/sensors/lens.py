"""Pinhole camera model with Brown-Conrady distortion: projection and unprojection.

Optical frame: x right, y down, z forward along the optical axis. Pixel (column u, row v); the centre of the first pixel
is at (0, 0), as in OpenCV. With a = x / z, b = y / z and r^2 = a^2 + b^2 (Brown 1966, OpenCV's order of coefficients):

    a' = a (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 a b + p2 (r^2 + 2 a^2),      u = fx a' + cx
    b' = b (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 b^2) + 2 p2 a b,      v = fy b' + cy
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from flcav.arrays import Array, Array32
from flcav.config import Config

BODY_FROM_OPTICAL: Array = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # rotation of axes
NEWTON_STEPS = 12  # iterations of the inversion of the distortion


class Lens(Config):
    """Image size, intrinsics and distortion of a camera."""

    width: int = Field(default=640, ge=16, le=8192)  # image width [px]
    height: int = Field(default=384, ge=16, le=8192)  # image height [px]
    fov_deg: float = Field(default=90.0, gt=1, lt=170)  # horizontal field of view; ignored if `fx` is given
    fx: float | None = Field(default=None, ge=1, le=1e6)  # horizontal focal length [px]; default: from `fov_deg`
    fy: float | None = Field(default=None, ge=1, le=1e6)  # vertical focal length [px]; default: `fx`
    cx: float | None = Field(
        default=None, ge=-1e6, le=1e6
    )  # column of the principal point [px]; default: the image's centre
    cy: float | None = Field(default=None, ge=-1e6, le=1e6)  # row of the principal point [px]; default: image's centre
    k1: float = 0.0  # radial distortion, coefficient of r^2 (Brown-Conrady model, as in OpenCV)
    k2: float = 0.0  # radial distortion, coefficient of r^4
    p1: float = 0.0  # tangential distortion, first coefficient
    p2: float = 0.0  # tangential distortion, second coefficient
    k3: float = 0.0  # radial distortion, coefficient of r^6

    @model_validator(mode="after")
    def _check_distortion(self) -> "Lens":
        corners = unproject(self, [(u, v) for u in (0, self.width - 1) for v in (0, self.height - 1)])
        if not np.isfinite(corners).all():
            raise ValueError("this distortion folds the image over: no direction falls on its corners")
        return self

    def intrinsics(self) -> Array:
        """Return the (3, 3) camera matrix [px], which maps a', b', 1 to pixels u, v, 1."""
        focal = self.width / 2 / np.tan(np.radians(self.fov_deg) / 2) if self.fx is None else self.fx
        vertical = focal if self.fy is None else self.fy
        cx = (self.width - 1) / 2 if self.cx is None else self.cx
        cy = (self.height - 1) / 2 if self.cy is None else self.cy
        return np.array([[focal, 0, cx], [0, vertical, cy], [0, 0, 1.0]])

    def distortion(self) -> Array:
        """Return the (5,) distortion coefficients k1, k2, p1, p2, k3."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])


def project_optical(lens: Lens, points: ArrayLike) -> Array:
    """Project points (N, 3) [m] of the optical frame to pixels (N, 2) u, v; NaN for those with z <= 0."""
    return project_points(lens.intrinsics(), lens.distortion(), points)


def project_points(intrinsics: Array, distortion: Array, points: ArrayLike) -> Array:
    """Project points as `project_optical` does, given the camera matrix (3, 3) [px] and the distortion (5,)."""
    x, y, z = np.asarray(points, np.float64).reshape(-1, 3).T
    z = np.where(z > 1e-9, z, np.nan)
    fx, fy, cx, cy = _focus(intrinsics)
    return _distort(distortion, np.stack((x / z, y / z), axis=1)) * (fx, fy) + (cx, cy)


def unproject(lens: Lens, pixels: ArrayLike) -> Array:
    """Unproject pixels (N, 2) u, v to undistorted a, b (N, 2): points of the plane z = 1 of the optical frame.

    By Newton's method; NaN where no direction is found that the distortion maps to the pixel.
    """
    return unproject_pixels(lens.intrinsics(), lens.distortion(), np.asarray(pixels, np.float64).reshape(-1, 2))


def compute_pixel_rays(lens: Lens) -> Array32:
    """Return the viewing rays of the pixels' centres: (height * width, 3) unit vectors, optical frame; read-only."""
    intrinsics, distortion = lens.intrinsics().ravel().tolist(), lens.distortion().tolist()
    return _directions(lens.width, lens.height, tuple(intrinsics), tuple(distortion))


@lru_cache(maxsize=16)
def _directions(width: int, height: int, intrinsics: tuple[float, ...], distortion: tuple[float, ...]) -> Array32:
    v, u = np.mgrid[:height, :width]
    pixels = np.stack((u.ravel(), v.ravel()), axis=1).astype(np.float64)
    plane = unproject_pixels(np.reshape(intrinsics, (3, 3)), np.array(distortion), pixels)
    rays = np.concatenate((plane, np.ones((len(plane), 1))), axis=1)
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    rays.flags.writeable = False
    return rays


def unproject_pixels(intrinsics: Array, distortion: Array, pixels: Array) -> Array:
    """Unproject pixels as `unproject` does, given the camera matrix (3, 3) [px] and the distortion (5,)."""
    fx, fy, cx, cy = _focus(intrinsics)
    wanted = (pixels - (cx, cy)) / (fx, fy)
    if not distortion.any():
        return wanted
    plane, step = wanted.copy(), 1e-6
    along_a, along_b = np.array((step, 0.0)), np.array((0.0, step))
    for _ in range(NEWTON_STEPS):
        error = _distort(distortion, plane) - wanted
        by_a = (_distort(distortion, plane + along_a) - _distort(distortion, plane - along_a)) / (2 * step)
        by_b = (_distort(distortion, plane + along_b) - _distort(distortion, plane - along_b)) / (2 * step)
        slope = by_a[:, 0] * by_b[:, 1] - by_a[:, 1] * by_b[:, 0]
        slope = np.where(slope > 1e-3, slope, np.nan)  # where the distortion folds over, it has no inverse
        plane = plane - np.stack(
            (
                (by_b[:, 1] * error[:, 0] - by_b[:, 0] * error[:, 1]) / slope,
                (by_a[:, 0] * error[:, 1] - by_a[:, 1] * error[:, 0]) / slope,
            ),
            axis=1,
        )
    return np.where(np.abs(_distort(distortion, plane) - wanted).max(axis=1, keepdims=True) < 1e-7, plane, np.nan)


def _distort(distortion: Array, plane: Array) -> Array:
    k1, k2, p1, p2, k3 = distortion
    a, b = plane.T
    square = a**2 + b**2
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    return np.stack(
        (
            a * radial + 2 * p1 * a * b + p2 * (square + 2 * a**2),
            b * radial + p1 * (square + 2 * b**2) + 2 * p2 * a * b,
        ),
        axis=1,
    )


def _focus(intrinsics: Array) -> tuple[float, float, float, float]:
    return intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
