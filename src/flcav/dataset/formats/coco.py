"""Export to COCO: `images/<split>` and `annotations/<labels>_<split>.json`, separate for signs and actors.

Instance masks are in COCO's compressed run-length encoding (RLE). Lin et al., "Microsoft COCO", ECCV 2014.
"""

import json
from collections import Counter
from pathlib import Path
from typing import TypedDict

import numpy as np
from faster_coco_eval.core import mask as coco_mask
from numpy.typing import NDArray

from flcav.config import Json
from flcav.dataset.formats.writing import (
    Exported,
    ExportFormat,
    ExportOptions,
    count_unlabelled,
    count_unwritten,
    missing_data_error,
    split_scenes,
    write_file,
)
from flcav.dataset.payloads import encode_png
from flcav.dataset.rectangles import CLASSES, select_rectangles
from flcav.dataset.store import Dataset
from flcav.geometry import Array
from flcav.interface.progress import Report
from flcav.sensors.frame import SEMANTICS, Frame


def export_coco(dataset: Dataset, out: Path, options: ExportOptions, progress: Report) -> Exported:
    """Write every image of `dataset` with its bounding boxes and masks: see `ExportFormat`."""
    if dataset.manifest.imported:
        raise missing_data_error(dataset, "COCO", "the visible pixels of objects")
    split_of = split_scenes(dataset, options)
    tables = {(labels, split): _empty(labels) for labels in CLASSES for split in split_of.values()}
    exported = Exported(Counter(images=0, signs=0, actors=0))
    counts = exported.counts
    for i, key in enumerate(dataset.keys):
        frame = dataset.frame(i)
        split = split_of[key.scene]
        for camera, picture in frame.images.items():
            path = out / "images" / split / f"{frame.key}_{camera}.png"
            write_file(path, encode_png(picture.rgb))
            counts["images"] += 1
            image = _image(frame, camera, path.name, counts["images"])
            for labels in CLASSES:
                table = tables[labels, split]
                table["images"].append(image)
                exported.left_out.update(count_unlabelled(frame, camera, labels, options.min_pixels))
                for annotation in _annotations(frame, camera, labels, options.min_pixels):
                    counts[labels] += 1
                    table["annotations"].append({"id": counts[labels], "image_id": image["id"], **annotation})
        exported.left_out.update(count_unwritten("COCO", frame, frame.images))
        progress(i + 1, len(dataset), "")
    if not counts["images"]:
        raise missing_data_error(dataset, "COCO", "camera images")
    for (labels, split), table in tables.items():
        write_file(out / "annotations" / f"{labels}_{split}.json", json.dumps(table, allow_nan=False))
    return exported


EXPORT = ExportFormat(export_coco, ("validation", "min_pixels"))


class Table(TypedDict):
    """The content of a COCO annotation file."""

    info: dict[str, str]
    images: list[dict[str, Json]]
    annotations: list[dict[str, Json]]
    categories: list[dict[str, Json]]


def encode_run_lengths(mask: NDArray[np.bool_]) -> dict[str, Json]:
    """Return COCO's compressed run-length encoding of a mask (H, W): {"size": [H, W], "counts": text}."""
    encoded = coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": list(mask.shape), "counts": encoded["counts"].decode("ascii")}


def mask_sign(semantic: NDArray[np.uint8], box: Array, pixels: int) -> NDArray[np.bool_]:
    """Return the mask (H, W) of a sign: the pixels of signs and lights in its visible `box` (4,) [px].

    Where these are not as many as its visible `pixels`, since another sign shows in the box, it is the whole box. The
    box is left, top, right, bottom from the image's corner; `semantic` (H, W) is the image of classes.
    """
    left, top, right, bottom = box.astype(int)
    mask = np.zeros(semantic.shape, np.bool_)
    inside = semantic[top:bottom, left:right]
    own = (inside == SEMANTICS["traffic_sign"]) | (inside == SEMANTICS["traffic_light"])
    mask[top:bottom, left:right] = own if own.sum() == pixels else True
    return mask


def _empty(labels: str) -> Table:
    kind = {"signs": "sign", "actors": "actor"}[labels]
    categories: list[dict[str, Json]] = [
        {"id": i + 1, "name": name, "supercategory": kind} for i, name in enumerate(CLASSES[labels])
    ]
    return {"info": {"description": f"flcav {labels}"}, "images": [], "annotations": [], "categories": categories}


def _image(frame: Frame, camera: str, file_name: str, number: int) -> dict[str, Json]:
    height, width = frame.images[camera].rgb.shape[:2]
    return {
        "id": number,
        "file_name": file_name,
        "width": width,
        "height": height,
        "scene": frame.scene,
        "agent": frame.agent,
        "camera": camera,
        "time_s": frame.time_s,
    }


def _annotations(frame: Frame, camera: str, labels: str, min_pixels: int) -> list[dict[str, Json]]:
    rectangles = select_rectangles(frame, camera, labels, min_pixels)
    image = frame.images[camera]
    assert image.semantic is not None
    annotations = []
    for label, box, pixels, row in zip(rectangles.label, rectangles.box, rectangles.pixels, rectangles.row):
        left, top, right, bottom = box.tolist()
        about: dict[str, Json] = {
            "category_id": int(label) + 1,
            "bbox": [left, top, right - left, bottom - top],
            "area": int(pixels),
            "iscrowd": 0,
        }
        if labels == "actors":
            about["segmentation"] = encode_run_lengths(image.instance == row + 1)
            about["track"] = str(frame.annotations.track[row])
            about["occlusion"] = float(frame.annotations.views[camera].occlusion[row])
        else:
            about["segmentation"] = encode_run_lengths(mask_sign(image.semantic, box, int(pixels)))
            about["distance_m"] = float(frame.annotations.signs[camera].distance_m[row])
        annotations.append(about)
    return annotations
