"""Strict reading of KITTI's object detection files: point clouds, calibrations, labels, and whole folders.

KITTI labels boxes in its rectified camera frame (x right, y down, z ahead): the location is the centre of a box's
bottom face, and the rotation about y is zero along x. Records of this module are in KITTI's LiDAR frame (x ahead,
y left, z up).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Never

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flcav.config import InputError, path_within, read_file
from flcav.dataset.formats.clouds import describe_numbers, find_millimetres, has_kitti_layout
from flcav.dataset.formats.reading import LARGEST_M, check_cloud, check_headings, check_rotation
from flcav.dataset.payloads import open_image, turn_upright
from flcav.geometry import Array, Boxes, heading_vectors, inverse, transform_points, wrap_angle

LAYOUT, POINT = "4 columns of float32", "x, y, z [m], intensity 0 to 1"
POINT_BYTES = 16  # x, y, z [m], reflectance [0, 1], each float32
LABEL_FIELDS = 15  # of a ground-truth label; a detection has a 16th, its score
MATRICES = {"P2": (3, 4), "R0_rect": (3, 3), "Tr_velo_to_cam": (3, 4)}
RENAMED = {"R_rect": "R0_rect", "Tr_velo_cam": "Tr_velo_to_cam"}
CLASSES = frozenset({"Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc"})
PICTURES = "image_2"
SUFFIXES = {"calib": "txt", "velodyne": "bin", PICTURES: "png", "label_2": "txt"}
FOLDERS = ("training", "testing")
TRUNCATION = np.array([0.0, 0.25, 0.75])  # shares outside the image for the tracking benchmark's levels
LEVELS = (0, 1, 2, 3)  # of occlusion
ASSUMED_SIZE = (375, 1242)  # height, width [px] of a missing image: those of most of KITTI's images
OFF_CENTRE = 0.1  # share of that size by which twice KITTI's principal points differ from it, at most
MARGIN_PX = 1.0  # KITTI's labels extend up to a pixel beyond the image


@dataclass(frozen=True)
class KittiCalibration:
    """Extrinsics and projection matrix of the left colour camera (camera 2)."""

    camera_from_lidar: Array  # (4, 4) [m], rectified camera frame
    image_from_camera: Array  # (3, 4) projection to pixels


def read_points(path: Path) -> NDArray[np.float32]:
    """Return points (N, 4) of a point cloud: x, y, z [m] and reflectance [0, 1], LiDAR frame.

    Raises `InputError` where the file is missing, empty, truncated within a point, of another layout by its numbers,
    or holds a number that is not finite or an intensity outside 0 to 1.
    """
    data = read_file(path)
    if not data:
        raise InputError(f"{path}: empty; a point cloud holds {POINT_BYTES} bytes for each point")
    if not has_kitti_layout(data):
        _refuse_points(data, path)
    return np.frombuffer(bytearray(data), dtype="<f4").reshape(-1, 4)


def _refuse_points(data: bytes, path: Path) -> Never:
    """Raise `InputError`, naming what the bytes are instead of a point cloud."""
    if data.isascii() and b"\0" not in data:
        raise InputError(f"{path}: a text file; wanted are {LAYOUT}: {POINT}")
    if (largest := find_millimetres(data)) is not None:
        raise InputError(f"{path}: coordinates up to {largest:.0f}, millimetres by their size; wanted are metres")
    if (layout := describe_numbers(data)) not in ("", LAYOUT):
        raise InputError(f"{path}: {layout} by its numbers; wanted are {LAYOUT}: {POINT}")
    if len(data) % POINT_BYTES:
        raise InputError(
            f"{path}: truncated; {len(data)} bytes are not a multiple of {POINT_BYTES}, the size of a point"
        )
    check_cloud(np.frombuffer(data, "<f4").reshape(-1, 4), path)
    raise InputError(f"{path}: no point cloud by its numbers; wanted are {LAYOUT}: {POINT}")


def read_calibration(path: Path) -> KittiCalibration:
    """Return the calibration of a frame from its file, which has the matrices in MATRICES.

    Files of the tracking benchmark have the other names in RENAMED, without a colon.

    Raises `InputError` for a missing, malformed or singular matrix.
    """
    named = (line.replace(":", " ", 1).split(None, 1) for line in read_lines(path))
    rows = {RENAMED.get(row[0], row[0]): row[-1] for row in named}
    matrices = {}
    for name, (height, width) in MATRICES.items():
        try:
            matrices[name] = np.array(rows[name].split(), dtype=np.float64).reshape(height, width)
        except (KeyError, ValueError):
            raise InputError(f"{path}: needs {height * width} numbers after '{name}:'") from None
        if not np.isfinite(matrices[name]).all() or np.linalg.matrix_rank(matrices[name][:, :3]) < 3:
            raise InputError(f"{path}: the numbers after '{name}:' are no projection and no pose")
    for name in ("R0_rect", "Tr_velo_to_cam"):
        try:
            matrices[name][:, :3] = check_rotation(matrices[name][:, :3])
        except ValueError as error:
            raise InputError(f"{path}: '{name}' {error}") from None
    rectified, camera = np.eye(4), np.eye(4)
    rectified[:3, :3] = matrices["R0_rect"]
    camera[:3] = matrices["Tr_velo_to_cam"]
    return KittiCalibration(camera_from_lidar=rectified @ camera, image_from_camera=matrices["P2"])


@dataclass(frozen=True)
class Objects:
    """The N labelled objects of a frame, and its K DontCare regions."""

    boxes: Boxes  # (N,) LiDAR frame, KITTI's class names
    truncation: Array  # (N,) share outside the image
    occlusion: NDArray[np.int64]  # (N,) 0 fully visible, 1 partly and 2 largely occluded, 3 unknown, -1 none of these
    alpha: Array  # (N,) observation angle [rad]
    rectangle: Array  # (N, 4) left, top, right, bottom [px]
    unlabelled: Array = field(default_factory=lambda: np.zeros((0, 4)))  # (K, 4) of DontCare regions [px]

    @classmethod
    def none(cls) -> "Objects":
        """Return a record of no objects."""
        return cls(Boxes.empty(), np.zeros(0), np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 4)))


def read_objects(path: Path, calibration: KittiCalibration, *, levels: bool = False) -> Objects:
    """Return the labelled objects of a frame from its label file.

    Boxes are upright in the LiDAR frame: the tilt of about a degree between camera and LiDAR is neglected in their
    orientation, but not in their position. Scores are kept where every row has one. With `levels`, truncation is given
    in the levels of KITTI's tracking benchmark, and converted to shares. Raises `InputError` where the file is missing
    or a line is not a label.
    """
    return parse_objects(dict(enumerate(read_lines(path), 1)), path, calibration, levels=levels)


def parse_objects(
    lines: Mapping[int, str], path: Path, calibration: KittiCalibration, *, levels: bool = False
) -> Objects:
    """Return the labelled objects of a frame, from lines of the file at `path`, by number: see `read_objects`."""
    label, rows, unlabelled = [], [], []
    for number, line in lines.items():
        kind, *fields = line.split()
        try:
            values = [float(field) for field in fields]
        except ValueError:
            values = []
        if len(values) + 1 not in (LABEL_FIELDS, LABEL_FIELDS + 1) or not np.isfinite(values).all():
            raise InputError(f"{path}: line {number} is no KITTI label: a class and {LABEL_FIELDS - 1} numbers or 15")
        if kind == "DontCare":
            unlabelled.append(values[3:7])
        else:
            label.append(kind)
            rows.append(values)
    scores = np.array([row[14] for row in rows]) if rows and all(len(row) == LABEL_FIELDS for row in rows) else None
    numbers = np.array([row[:14] for row in rows]).reshape(-1, 14)
    height, width, length, x, y, z, rotation = numbers[:, 7:].T
    lidar_from_camera = inverse(calibration.camera_from_lidar)
    center = transform_points(lidar_from_camera, np.stack((x, y - height / 2, z), axis=1))
    check_headings(rotation, path)
    cos, sin = heading_vectors(rotation).T
    ahead = np.stack((cos, np.zeros_like(rotation), -sin), axis=1)  # camera frame
    ahead = ahead @ lidar_from_camera[:3, :3].T
    yaw = wrap_angle(np.arctan2(ahead[:, 1], ahead[:, 0]))
    size = np.stack((length, width, height), axis=1)
    return Objects(
        Boxes(center, size, yaw, np.array(label, dtype=np.str_), scores),
        truncation=_read_levels(numbers[:, 0]) if levels else numbers[:, 0],
        occlusion=np.where(np.isin(numbers[:, 1], LEVELS), numbers[:, 1], -1).astype(np.int64),
        alpha=numbers[:, 2],
        rectangle=numbers[:, 3:7],
        unlabelled=np.array(unlabelled).reshape(-1, 4),
    )


def _read_levels(truncation: Array) -> Array:
    """Return the shares for the levels of truncation 0, 1 and 2; other numbers are returned unchanged."""
    known = np.isin(truncation, range(len(TRUNCATION)))
    return np.where(known, TRUNCATION[np.where(known, truncation, 0).astype(int)], truncation)


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file that are not blank; raises `InputError` where it is missing or no text."""
    try:
        return [line for line in read_file(path).decode("utf-8-sig").splitlines() if line.strip()]
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file") from None


def is_drive(folder: Path) -> bool:
    """Return whether a folder is a drive of KITTI: it holds the sweeps, and no `training` or `testing`.

    Its labels have levels of truncation, as those of the tracking benchmark, and it may have a single calibration file.
    """
    return (folder / "velodyne").is_dir() and folder.name not in FOLDERS


def find_part(folder: Path, part: str, number: str) -> Path:
    """Return the file of a frame in `training`, `testing` or a drive; `part` is a key of `SUFFIXES`."""
    common = folder / "calib.txt"
    if part == "calib" and is_drive(folder) and common.is_file():
        return common
    return folder / part / f"{number}.{SUFFIXES[part]}"


@dataclass(frozen=True)
class KittiFrame:
    """A frame of the benchmark."""

    name: str  # "000008"
    points: NDArray[np.float32]  # (N, 4) x, y, z [m], reflectance; LiDAR frame
    calibration: KittiCalibration
    objects: Objects
    image: NDArray[np.uint8]  # (H, W, 3) red, green, blue; (0, 0, 3) where there is none
    size: tuple[int, int]  # height, width of the image [px]; by `assume_size` where there is none


class KittiFolder:
    """A KITTI folder: the frames of a split, or all frames with a point cloud."""

    def __init__(self, folder: Path, names: list[str]) -> None:
        self.folder = folder
        self.names = names

    @classmethod
    def open(cls, path: Path | str, split: str | None = None, *, pictures: bool = True) -> "KittiFolder":
        """Open the frames of the KITTI folder `path` that `ImageSets/<split>.txt` lists, or all of `training`.

        The split "test" is read from `testing`, any other from `training`. Raises `InputError` where the folder, the
        list or a file of a frame is missing; images may be missing unless `pictures`.
        """
        root, part_of = Path(path), "testing" if split == "test" else "training"
        folder = root if is_drive(root) and split is None else root / part_of
        if not folder.is_dir():
            raise InputError(f"{root}: no KITTI folder; it holds no '{part_of}'")
        if split is None:
            names = sorted(file.stem for file in (folder / "velodyne").glob("*.bin"))
        else:
            names = read_split(root / "ImageSets" / f"{split}.txt")
        for name in names:
            for part in SUFFIXES:
                path = find_part(folder, part, name)
                if (pictures or part != PICTURES) and not path.is_file():
                    raise InputError(f"{path}: missing; every frame needs one")
        return cls(folder, names)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def sweeps(self) -> list[Path]:
        """Return the files of the frames' point clouds."""
        return [find_part(self.folder, "velodyne", name) for name in self.names]

    def has_image(self, name: str) -> bool:
        """Return whether the frame `name` has an image."""
        return find_part(self.folder, PICTURES, name).is_file()

    def frame(self, i: int) -> KittiFrame:
        """Return frame `i`; raises `InputError` for a malformed file, or a label that does not fit the image."""
        paths = {part: find_part(self.folder, part, self.names[i]) for part in SUFFIXES}
        calibration = read_calibration(paths["calib"])
        image = _read_image(paths[PICTURES]) if paths[PICTURES].is_file() else np.zeros((0, 0, 3), np.uint8)
        objects = read_objects(paths["label_2"], calibration, levels=is_drive(self.folder))
        height, width = image.shape[:2] if image.size else (None, None)
        check_objects(objects, width, height, paths["label_2"])
        size = assume_size(calibration, objects) if height is None or width is None else (height, width)
        return KittiFrame(self.names[i], read_points(paths["velodyne"]), calibration, objects, image, size)


def assume_size(calibration: KittiCalibration, objects: Objects) -> tuple[int, int]:
    """Return the height and width [px] of a missing image: `ASSUMED_SIZE`, unless the camera's is another.

    Another camera has its principal point elsewhere than at about half of that size; the point is taken to be the
    middle of its image, which is as large as the rectangles of the labels at least.
    """
    assumed, centred = np.array(ASSUMED_SIZE), 2 * calibration.image_from_camera[[1, 0], 2] + 1
    if (np.abs(centred - assumed) <= OFF_CENTRE * assumed).all():
        return ASSUMED_SIZE
    corners = np.concatenate((objects.rectangle, objects.unlabelled))[:, [3, 2]]
    height, width = np.ceil(np.maximum(centred, corners.max(axis=0, initial=0.0) + 1)).astype(int).tolist()
    return height, width


def check_objects(objects: Objects, width: int | None, height: int | None, path: Path) -> None:
    """Raise `InputError` where a label of the file `path` is impossible in an image of `width` x `height` pixels.

    Both are None where there is no image.
    """
    if unknown := sorted(set(objects.boxes.label.tolist()) - CLASSES):
        raise InputError(f"{path}: unknown class '{unknown[0]}'; KITTI has {', '.join(sorted(CLASSES))}, DontCare")
    left, top, right, bottom = objects.rectangle.T
    inside = (left >= -MARGIN_PX) & (top >= -MARGIN_PX) & (left < right) & (top < bottom)
    of = "" if width is None else f" of {width} x {height}"
    if width is not None and height is not None:
        inside &= (right < width + MARGIN_PX) & (bottom < height + MARGIN_PX)
    checks = {
        "a size that is not positive": (objects.boxes.size > 0).all(axis=1),
        f"a side above {LARGEST_M:g} m; sizes are wanted in metres": (objects.boxes.size <= LARGEST_M).all(axis=1),
        f"a rectangle that is not within the image{of}": inside,
        "a truncation outside 0 to 1": (objects.truncation >= 0) & (objects.truncation <= 1),
        "an occlusion that is none of 0, 1, 2, 3": np.isin(objects.occlusion, LEVELS),
    }
    for what, good in checks.items():
        if not good.all():
            raise InputError(f"{path}: object {int(np.argmin(good)) + 1} has {what}")


def read_split(path: Path) -> list[str]:
    """Return the names of the frames that a file in `ImageSets` lists.

    Raises `InputError` where a name is listed twice, or leads out of the folders of frames.
    """
    try:
        names = read_file(path).decode("utf-8-sig").split() if path.exists() else None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file") from None
    if names is None:
        raise InputError(f"{path}: no such list of frames")
    if len(set(names)) != len(names):
        raise InputError(f"{path}: names the frame {max(names, key=names.count)} twice")
    for name in names:
        path_within(path.parents[1], name, path)
    return names


def _read_image(path: Path) -> NDArray[np.uint8]:
    try:
        with open_image(path) as image:
            return np.asarray(turn_upright(image).convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise InputError(f"{path}: not an image") from None
