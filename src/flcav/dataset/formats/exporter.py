"""What every format's exporter has in common."""

from collections import Counter
from collections.abc import Callable
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
