"""Camera images: read from datasets and folders, checked, resized; and projection of points into them.

A `CameraView` is the image of a camera mounted near a LiDAR, with the calibration that projects points of the LiDAR's
sweep and corners of boxes into it.
"""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageEnhance, UnidentifiedImageError

from flcav.arrays import Array, Bytes, Mask
from flcav.config import InputError
from flcav.dataset.formats.kitti import KittiCalibration, read_calibration
from flcav.dataset.layout import MANIFEST
from flcav.dataset.payloads import open_image, turn_upright
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, transform_points
from flcav.network.ledger import from_names, to_names
from flcav.sensors.frame import Frame
from flcav.sensors.lens import project_points

Picture = Bytes  # (H, W, 3) sRGB
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
SMALLEST_PX, LARGEST_PX = 32, 8192  # bounds of an image's width and height
LEAST_AHEAD = 0.5  # least cosine of the angle between the camera's optical axis and the LiDAR's x axis
NEAREST_M = 0.1  # near plane: least depth in front of the camera
BESIDE = 0.5  # margin around the image, in its widths and heights, in which the distortion polynomial is used


def read_pictures(path: Path, frames: Sequence[int] | None = None) -> Iterator[tuple[Path, Picture]]:
    """Yield path and image of a PNG, JPEG or WebP file, a folder of such files, or `frames` of a dataset (None: all).

    Raises `InputError` for any other path, and for an image that is damaged, not RGB or of a size out of bounds.
    """
    if (path / MANIFEST).is_file():
        data = Dataset.open(path)
        return ((path / f"{frame.key}/{camera}", rgb) for frame, camera, rgb in read_recorded(data, frames))
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
        if not files:
            raise InputError(f"{path}: neither a dataset nor a folder with {', '.join(SUFFIXES)} files")
        return ((file, read_picture(file)) for file in files)
    if not path.is_file():
        raise InputError(f"{path}: no such file or folder")
    return iter([(path, read_picture(path))])


def read_recorded(data: Dataset, frames: Sequence[int] | None = None) -> Iterator[tuple[Frame, str, Picture]]:
    """Yield frame, camera name and image of a dataset's frames (None: all); raises `InputError` if there is no image.

    Also raises `InputError` as `check_picture` does.
    """
    seen = False
    for number in data.numbers(frames):
        frame = data.frame(number)
        for camera in data.cameras(number):
            seen = True
            rgb = data.plane(number, camera, "rgb")  # the image's other planes are not read
            yield frame, camera, check_picture(rgb, f"{data.folder} {frame.key}/{camera}")
    if not seen:
        raise InputError(f"{data.folder}: no camera pictures in its frames; record it with cameras")


def pack_pictures(data: Dataset, number: int) -> dict[str, Bytes]:
    """Return the image files of a frame, as recorded, and the names of its cameras as arrays of a message."""
    files = {f"picture.{camera}": data.plane_path(number, camera, "rgb") for camera in data.cameras(number)}
    arrays = {name: np.frombuffer(path.read_bytes(), dtype=np.uint8) for name, path in files.items()}
    return {"cameras": from_names(data.cameras(number)), **arrays}


def unpack_pictures(arrays: Mapping[str, Bytes]) -> dict[str, Picture]:
    """Return the images in the arrays of a message by camera: the inverse of `pack_pictures`."""
    cameras = to_names(arrays["cameras"]).tolist()
    files = {camera: open_image(io.BytesIO(arrays[f"picture.{camera}"].tobytes())) for camera in cameras}
    return {camera: np.asarray(turn_upright(file)) for camera, file in files.items()}


def read_picture(path: Path) -> Picture:
    """Return the RGB or palette image of a PNG, JPEG or WebP file, upright; raises `InputError` for any other file."""
    try:
        with open_image(path) as image:
            channels, mode = len(image.getbands()), image.mode
            if mode not in ("RGB", "P"):
                raise InputError(f"{path}: a picture of {channels} channels ({mode}); 3 are wanted: red, green, blue")
            pixels = np.asarray(turn_upright(image).convert("RGB"))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a picture, or a damaged one") from None
    return check_picture(pixels, path)


def check_picture(pixels: Bytes, origin: str | Path) -> Picture:
    """Return the image as it is; raises `InputError` unless it is (H, W, 3) with sides of 32 to 8192 pixels."""
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise InputError(f"{origin}: a picture of shape {pixels.shape}; (H, W, 3) red, green, blue is wanted")
    height, width = pixels.shape[:2]
    if not (min(height, width) >= SMALLEST_PX and max(height, width) <= LARGEST_PX):
        bounds = f"{SMALLEST_PX} to {LARGEST_PX}"
        raise InputError(f"{origin}: a picture of {width} x {height} pixels; sides of {bounds} are wanted")
    return pixels


def resize_picture(picture: Picture, width: int, height: int) -> Picture:
    """Return the image resampled bilinearly to `width` x `height` pixels, with antialiasing when it shrinks."""
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BILINEAR))


def recoloured(picture: Picture, gain: float, saturation: float) -> Picture:
    """Return the image with its brightness scaled by `gain` and its saturation by `saturation`."""
    coloured = ImageEnhance.Color(Image.fromarray(picture)).enhance(saturation)
    return np.asarray(ImageEnhance.Brightness(coloured).enhance(gain))


@dataclass(frozen=True)
class CameraView:
    """A camera image with its calibration relative to the frame of the points: a LiDAR's, or the world frame.

    The camera's frame is optical: x right, y down, z forward; the centre of the first pixel is at (0, 0).
    """

    picture: Picture  # (H, W, 3) sRGB
    camera_from_points: Array  # (4, 4) [m]
    intrinsics: Array  # (3, 3) [px]
    distortion: Array  # (5,) Brown-Conrady k1 k2 p1 p2 k3, as `flcav.sensors.lens`

    def project(self, points: NDArray) -> Array:
        """Return pixel coordinates u, v (N, 2) of points (N, 3) [m]; NaN behind the near plane or far off the image."""
        seen = transform_points(self.camera_from_points, np.asarray(points, np.float64))
        seen[seen[:, 2] < NEAREST_M] = np.nan
        # Far outside the image the distortion polynomial folds back into it: only points near the image are distorted.
        straight = project_points(self.intrinsics, np.zeros(5), seen)
        size = np.array(self.picture.shape[1::-1])
        near = np.all((straight > -BESIDE * size) & (straight < (1 + BESIDE) * size), axis=1)
        return project_points(self.intrinsics, self.distortion, np.where(near[:, None], seen, np.nan))

    def shows(self, points: NDArray) -> Mask:
        """Return the mask (N,) of points (N, 3) [m] that project into the image; occlusion is not considered."""
        pixels = self.project(points) + 0.5
        return np.all((pixels >= 0) & (pixels < self.picture.shape[1::-1]), axis=1)


def recorded_view(data: Dataset, number: int, lidar: str) -> CameraView | None:
    """Return the view of the camera whose axis is closest to the x axis of `lidar` in frame `number`.

    Poses and intrinsics are the agent's assumed calibration. None if no camera's axis is within 60 degrees.
    """
    return find_view(data.frame(number), lidar, lambda camera: data.plane(number, camera, "rgb"))


def find_view(frame: Frame, lidar: str, read: Callable[[str], Picture] | None = None) -> CameraView | None:
    """Return the view of `recorded_view` in a frame; `read` returns the image of a camera (None: the frame's)."""
    lidar_from_world = inverse(frame.assumed_world_from_sensor(lidar))
    ahead = {name: float((lidar_from_world @ frame.assumed_world_from_sensor(name))[0, 2]) for name in frame.images}
    camera = max(ahead, key=ahead.__getitem__, default=None)
    if camera is None or ahead[camera] < LEAST_AHEAD:
        return None
    return CameraView(
        frame.images[camera].rgb if read is None else read(camera),
        inverse(lidar_from_world @ frame.assumed_world_from_sensor(camera)),
        frame.assumed.intrinsics[camera],
        frame.assumed.distortion[camera],
    )


def kitti_view(picture: Picture, calibration: KittiCalibration) -> CameraView:
    """Return the view of KITTI's left colour camera relative to the LiDAR.

    The fourth column of its 3 x 4 projection matrix becomes a translation of the extrinsics.
    """
    intrinsics = calibration.image_from_camera[:, :3]
    shifted = np.eye(4)
    shifted[:3, 3] = np.linalg.solve(intrinsics, calibration.image_from_camera[:, 3])
    return CameraView(picture, shifted @ calibration.camera_from_lidar, intrinsics, np.zeros(5))


def view_beside(points: Path) -> CameraView | None:
    """Return the view of a point cloud in a KITTI folder, from `image_2` and `calib`; None where either is missing.

    Raises `InputError` if one of them cannot be read.
    """
    folder = points.absolute().parent.parent
    name = points.stem
    picture = folder / "image_2" / f"{name}.png"
    calibration = folder / "calib" / f"{name}.txt"
    if not (picture.is_file() and calibration.is_file()):
        return None
    return kitti_view(read_picture(picture), read_calibration(calibration))
