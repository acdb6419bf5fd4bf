"""Export to Ultralytics YOLO: `images`, `labels` with a text file for each image, and `data.yaml`.

A row of a label file is a class number and the visible bounding box: x and y of its centre, width, height, as fractions
of the image's width and height.
"""

from collections import Counter
from pathlib import Path

import yaml

from flcav.dataset.formats.writing import (
    Exported,
    ExportFormat,
    ExportOptions,
    LeftOut,
    count_unlabelled,
    count_unwritten,
    find_visible_objects,
    missing_data_error,
    split_with_validation,
    write_file,
)
from flcav.dataset.payloads import encode_png
from flcav.dataset.rectangles import CLASSES, Rectangles, select_rectangles
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report

OTHERS = {  # what is labelled -> what is not, and how to have it
    "signs": LeftOut(
        "actors",
        "YOLO has one list of classes, by default signs and lights; --labels actors writes vehicles and pedestrians",
    ),
    "actors": LeftOut("signs", "--labels actors writes vehicles and pedestrians alone; signs are the default"),
}


def export_yolo(dataset: Dataset, out: Path, options: ExportOptions, progress: Report) -> Exported:
    """Write every image of `dataset` with its signs and lights, or its actors: see `ExportFormat`."""
    if dataset.manifest.imported:
        raise missing_data_error(dataset, "YOLO", "the visible pixels of objects")
    split_of = split_with_validation(dataset, options, "YOLO")
    exported, others = Exported(Counter({"images": 0, options.labels: 0})), OTHERS[options.labels]
    for i, key in enumerate(dataset.keys):
        frame = dataset.frame(i)
        split = split_of[key.scene]
        for camera, picture in frame.images.items():
            found = select_rectangles(frame, camera, options.labels, options.min_pixels)
            height, width = picture.rgb.shape[:2]
            name = f"{frame.key}_{camera}"
            write_file(out / "images" / split / f"{name}.png", encode_png(picture.rgb))
            write_file(out / "labels" / split / f"{name}.txt", format_label_file(found, width, height))
            exported.counts.update({"images": 1, options.labels: len(found)})
            exported.left_out.update(count_unlabelled(frame, camera, options.labels, options.min_pixels))
            exported.left_out[others] += len(find_visible_objects(frame, camera, others.what))
        exported.left_out.update(count_unwritten("YOLO", frame, frame.images))
        progress(i + 1, len(dataset), "")
    if not exported.counts["images"]:
        raise missing_data_error(dataset, "YOLO", "camera images")
    folders = {split: f"images/{split}" for split in ("train", "val", *split_of.values())}
    for folder in folders.values():  # Ultralytics requires the first two, even for a test
        (out / folder).mkdir(exist_ok=True)
    names = dict(enumerate(CLASSES[options.labels]))
    write_file(out / "data.yaml", yaml.safe_dump({**folders, "names": names}, sort_keys=False))
    return exported


EXPORT = ExportFormat(export_yolo, ("labels", "validation", "min_pixels"))


def format_label_file(found: Rectangles, width: int, height: int) -> str:
    """Return the text of the label file of an image of `width` x `height` pixels."""
    left, top, right, bottom = (found.box / (width, height, width, height)).T
    rows = zip(found.label, (left + right) / 2, (top + bottom) / 2, right - left, bottom - top)
    return "".join(f"{label} " + " ".join(f"{value:.6f}" for value in box) + "\n" for label, *box in rows)
