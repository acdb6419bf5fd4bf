"""A whole folder in KITTI's layout, read strictly: every file that a split names is there and fits the others."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flcav.config import InputError
from flcav.dataset.formats.kitti.frame import Calibration, Objects, read_calibration, read_objects, read_points

CLASSES = frozenset({"Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc"})
SUFFIXES = {"calib": "txt", "velodyne": "bin", "image_2": "png", "label_2": "txt"}
MARGIN_PX = 1.0  # real labels end up to a pixel beyond the image


@dataclass(frozen=True)
class KittiFrame:
    """One frame of the benchmark."""

    name: str  # "000008"
    points: NDArray[np.float32]  # (N, 4) x, y, z [m], reflectance; LiDAR frame
    calibration: Calibration
    objects: Objects
    image: NDArray[np.uint8]  # (H, W, 3) red, green, blue


class KittiFolder:
    """The frames of `training`: of one list of `ImageSets`, or all that have a point cloud; of "test", `testing`."""

    def __init__(self, folder: Path, names: list[str]) -> None:
        self.folder = folder
        self.names = names

    @classmethod
    def open(cls, path: Path | str, split: str | None = None) -> "KittiFolder":
        """Return the KITTI folder `path`; raises `InputError` where a file of a frame is missing."""
        root, part_of = Path(path), "testing" if split == "test" else "training"
        folder = root / part_of
        if not folder.is_dir():
            raise InputError(f"{root}: no KITTI folder; it holds no '{part_of}'")
        if split is None:
            names = sorted(file.stem for file in (folder / "velodyne").glob("*.bin"))
        else:
            names = _split(root / "ImageSets" / f"{split}.txt")
        for name in names:
            for part, suffix in SUFFIXES.items():
                if not (folder / part / f"{name}.{suffix}").is_file():
                    raise InputError(f"{folder / part / f'{name}.{suffix}'}: missing; every frame needs one")
        return cls(folder, names)

    def __len__(self) -> int:
        return len(self.names)

    def frame(self, i: int) -> KittiFrame:
        """Return frame `i`; raises `InputError` for a file that is not as it should be."""
        paths = {part: self.folder / part / f"{self.names[i]}.{suffix}" for part, suffix in SUFFIXES.items()}
        calibration = read_calibration(paths["calib"])
        image = _read_image(paths["image_2"])
        objects = read_objects(paths["label_2"], calibration)
        _check(objects, image.shape[1], image.shape[0], paths["label_2"])
        return KittiFrame(self.names[i], read_points(paths["velodyne"]), calibration, objects, image)


def _check(objects: Objects, width: int, height: int, path: Path) -> None:
    if unknown := sorted(set(objects.boxes.label.tolist()) - CLASSES):
        raise InputError(f"{path}: unknown class '{unknown[0]}'; KITTI has {', '.join(sorted(CLASSES))}, DontCare")
    left, top, right, bottom = objects.rectangle.T
    inside = (left >= -MARGIN_PX) & (top >= -MARGIN_PX) & (right < width + MARGIN_PX) & (bottom < height + MARGIN_PX)
    checks = {
        "a size that is not positive": (objects.boxes.size > 0).all(axis=1),
        f"a rectangle that is not within the image of {width} x {height}": inside & (left < right) & (top < bottom),
        "a truncation outside 0 to 1": (objects.truncation >= 0) & (objects.truncation <= 1),
        "an occlusion that is none of 0, 1, 2, 3": np.isin(objects.occlusion, range(4)),
    }
    for what, good in checks.items():
        if not good.all():
            raise InputError(f"{path}: object {int(np.argmin(good)) + 1} has {what}")


def _split(path: Path) -> list[str]:
    try:
        names = path.read_text(encoding="utf-8").split()
    except FileNotFoundError:
        raise InputError(f"{path}: no such list of frames") from None
    if len(set(names)) != len(names):
        raise InputError(f"{path}: names a frame twice")
    return names


def _read_image(path: Path) -> NDArray[np.uint8]:
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise InputError(f"{path}: not an image") from None
