"""The protocol of an exporter, its options, and the split of a dataset's scenes."""

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import Config, InputError
from flcav.dataset.store import Dataset
from flcav.geometry import points_in_boxes, transform_points
from flcav.progress import Report
from flcav.sensors.frame import Frame


class ExportOptions(Config):
    """What can be asked of an export; a format that has no use for what is asked refuses it."""

    labels: Literal["signs", "actors"] = "signs"  # YOLO has one list of classes
    validation: float = Field(default=0.2, ge=0, lt=1)  # share of the scenes that validate
    min_pixels: int = Field(default=1, ge=1)  # 2D labels of what shows fewer are left out
    min_points: int = Field(default=1, ge=0)  # objects with fewer points of the LiDAR in their box are not labelled
    calibration: Literal["true", "assumed"] = "true"  # which of a frame's two calibrations is written


@dataclass(frozen=True)
class Exported:
    """What an export wrote of a dataset, and which of its frames it did not."""

    counts: Counter[str]  # of what was written, by name
    left_out: Counter[tuple[str, str]] = field(default_factory=Counter)  # (why, which) -> how many frames


# Writes a dataset in one format into an empty folder; raises `InputError` where it lacks what the format needs.
Exporter = Callable[[Dataset, Path, ExportOptions, Report], Exported]


def read_frame(dataset: Dataset, i: int, options: ExportOptions) -> Frame:
    """Return frame `i` with the calibration that is asked for in the place of the true one."""
    frame = dataset.frame(i)
    return frame if options.calibration == "true" else replace(frame, calibration=frame.assumed)


def points_in_each_box(frame: Frame, sensor: str, points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return (M,) how many of the (N, >= 3) points of a LiDAR or radar lie in the box of each annotation.

    Readers of an export count them so. A frame's `annotations.points` differ: those are of the actor itself, whose
    points may lie beyond its box, and others' within.
    """
    world = transform_points(frame.world_from_sensor(sensor), points[:, :3].astype(np.float64))
    return points_in_boxes(world, frame.annotations.boxes).sum(axis=1)


def lacks(dataset: Dataset, name: str, needed: str, who: str = "the dataset") -> InputError:
    """Return the error that says what a format misses in a dataset, or in one of its agents."""
    return InputError(f"{dataset.folder}: cannot be exported to {name}, which needs {needed}; {who} has none")


def check_rectified(frame: Frame, camera: str, name: str) -> None:
    """Raise `InputError` where a camera distorts, whose images the format `name` wants rectified."""
    if np.any(frame.calibration.distortion.get(camera, 0)):
        raise InputError(
            f"{frame.key}: '{camera}' distorts; {name} wants rectified images, so record without distortion"
        )


SPLITS = ("train", "val", "test")


def split_scenes(dataset: Dataset, options: ExportOptions) -> Mapping[str, str]:
    """Return scene -> "train", "val" or "test". A scene is never divided: its frames show the same cars.

    A dataset recorded for validation or for testing goes there whole; raises `InputError` where a share that validates
    is asked for all the same. Of any other, the last scenes validate: that share of them, rounded up, but never all.
    """
    scenes = list(dict.fromkeys(key.scene for key in dataset.keys))
    recorded_for = str(dataset.manifest.recipe.get("split", ""))
    for split in ("val", "test"):
        if recorded_for.startswith(split):
            if "validation" in options.model_fields_set:
                raise InputError(
                    f"{dataset.folder}: its recipe says 'split: {recorded_for}', so --validation is not for it"
                )
            return dict.fromkeys(scenes, split)
    held_out = min(math.ceil(options.validation * len(scenes)), len(scenes) - 1)
    first = len(scenes) - held_out
    return {scene: "val" if i >= first else "train" for i, scene in enumerate(scenes)}


def split_validated(dataset: Dataset, options: ExportOptions, name: str) -> Mapping[str, str]:
    """Return `split_scenes` for a format `name` that trains on no dataset unless scenes of it validate.

    Raises `InputError` where the only scene trains, unless it is asked that none validates.
    """
    split_of = split_scenes(dataset, options)
    if set(split_of.values()) == {"train"} and options.validation:
        raise InputError(
            f"{dataset.folder}: cannot be exported to {name}, which needs scenes that validate beside those that "
            "train; it is one scene: record two or more, or leave the validation empty with --validation 0"
        )
    return split_of
