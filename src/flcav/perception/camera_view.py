"""What a camera saw, and where on its picture points of the scene fall: those of a LiDAR's sweep, corners of boxes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.formats.kitti import Calibration, read_calibration
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, transform_points
from flcav.perception.images import Picture, read_picture
from flcav.sensors.lens import projected

Array = NDArray[np.float64]

LEAST_AHEAD = 0.5  # cosine of the angle between the axes of a camera and of the LiDAR
NEAREST_M = 0.1  # in front of the camera
BESIDE = 0.5  # pixels are known as far beside the picture, in its widths and heights; further off, distortion folds


@dataclass(frozen=True)
class CameraView:
    """One picture and how the camera stands to the frame of the points: a LiDAR's, or the world's.

    The camera's frame is optical: x right, y down, z ahead; the centre of the first pixel is at (0, 0).
    """

    picture: Picture  # (H, W, 3) sRGB
    camera_from_points: Array  # (4, 4)
    intrinsics: Array  # (3, 3) [px]
    distortion: Array  # (5,) k1 k2 p1 p2 k3

    def project(self, points: NDArray) -> Array:
        """Return the pixels (N, 2) u, v of points (N, 3); NaN behind the camera or far off its picture."""
        seen = transform_points(self.camera_from_points, np.asarray(points, np.float64))
        seen[seen[:, 2] < NEAREST_M] = np.nan
        straight = projected(self.intrinsics, np.zeros(5), seen)
        size = np.array(self.picture.shape[1::-1])
        near = np.all((straight > -BESIDE * size) & (straight < (1 + BESIDE) * size), axis=1)
        return projected(self.intrinsics, self.distortion, np.where(near[:, None], seen, np.nan))

    def shows(self, points: NDArray) -> NDArray[np.bool_]:
        """Return which of the points (N, 3) lie within the picture; some may be hidden by others."""
        pixels = self.project(points) + 0.5
        return np.all((pixels >= 0) & (pixels < self.picture.shape[1::-1]), axis=1)


def recorded_view(data: Dataset, number: int, lidar: str) -> CameraView | None:
    """Return the view of the camera that looks most nearly where `lidar` does in a frame; None where none does.

    It stands as the agent believes it to.
    """
    frame = data.frame(number)
    lidar_from_world = inverse(frame.assumed_world_from_sensor(lidar))
    ahead = {name: float((lidar_from_world @ frame.assumed_world_from_sensor(name))[0, 2]) for name in frame.images}
    camera = max(ahead, key=ahead.__getitem__, default=None)
    if camera is None or ahead[camera] < LEAST_AHEAD:
        return None
    return CameraView(
        data.plane(number, camera, "rgb"),
        inverse(lidar_from_world @ frame.assumed_world_from_sensor(camera)),
        frame.assumed.intrinsics[camera],
        frame.assumed.distortion[camera],
    )


def kitti_view(picture: Picture, calibration: Calibration) -> CameraView:
    """Return the view of KITTI's left colour camera; what its projection shifts becomes part of where it stands."""
    intrinsics = calibration.image_from_camera[:, :3]
    shifted = np.eye(4)
    shifted[:3, 3] = np.linalg.solve(intrinsics, calibration.image_from_camera[:, 3])
    return CameraView(picture, shifted @ calibration.camera_from_lidar, intrinsics, np.zeros(5))


def view_beside(points: Path) -> CameraView | None:
    """Return the view that lies beside a point cloud of a KITTI folder; None where there is none.

    Raises `InputError` where there is one that cannot be read.
    """
    folder, name = points.absolute().parent.parent, points.stem
    picture, calibration = folder / "image_2" / f"{name}.png", folder / "calib" / f"{name}.txt"
    if not (picture.is_file() and calibration.is_file()):
        return None
    return kitti_view(read_picture(picture), read_calibration(calibration))
