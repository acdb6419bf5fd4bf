"""What every format's exporter has in common."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from flcav.config import Config, InputError
from flcav.dataset.store import Dataset
from flcav.progress import Report
from flcav.sensors.frame import Frame


class ExportOptions(Config):
    """What can be asked of an export; a format takes no notice of what does not concern it."""

    labels: Literal["signs", "actors"] = "signs"  # YOLO has one list of classes
    validation: float = Field(default=0.2, ge=0, lt=1)  # share of the scenes that validate
    min_pixels: int = Field(default=1, ge=1)  # 2D labels of what shows fewer are left out
    calibration: Literal["true", "assumed"] = "true"  # which of a frame's two calibrations is written


# Writes a dataset in one format into an empty folder and returns counts of what it wrote, by name. Raises `InputError`
# where the dataset lacks what the format needs.
Exporter = Callable[[Dataset, Path, ExportOptions, Report], Counter[str]]


def read_frame(dataset: Dataset, i: int, options: ExportOptions) -> Frame:
    """Return frame `i` with the calibration that is asked for in the place of the true one."""
    frame = dataset.frame(i)
    return frame if options.calibration == "true" else replace(frame, calibration=frame.assumed)


def lacks(dataset: Dataset, name: str, needed: str, who: str = "the dataset") -> InputError:
    """Return the error that says what a format misses in a dataset, or in one of its agents."""
    return InputError(f"{dataset.folder}: cannot be exported to {name}, which needs {needed}; {who} has none")


def check_rectified(frame: Frame, camera: str, name: str) -> None:
    """Raise `InputError` where a camera distorts, whose images the format `name` wants rectified."""
    if np.any(frame.calibration.distortion.get(camera, 0)):
        raise InputError(
            f"{frame.key}: '{camera}' distorts; {name} wants rectified images, so record without distortion"
        )
