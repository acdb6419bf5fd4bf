"""From simulation to reality: what sets their clouds apart, and how well a detector that never saw a real one does.

Two recordings of the same scenes are compared with KITTI's frames: with the LiDAR of the `kitti` rig, and with one that
has its beams alone, on Lambertian surfaces. The detector is the one that comes with the package.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from flcav.dataset.formats.kitti.folder import KittiFolder, KittiFrame
from flcav.dataset.store import Dataset
from flcav.experiments.clouds import Labelled, describe
from flcav.experiments.recording import DATA, record_split
from flcav.geometry import Boxes, inverse
from flcav.perception.camera_view import kitti_view
from flcav.perception.metrics import average_precision, match
from flcav.perception.metrics.matching import assign_targets
from flcav.perception.objects.detect import detect
from flcav.perception.objects.evaluate import LOWEST_SCORE, OVERLAPS, number_or_none, of_class
from flcav.perception.objects.infer import box_rows
from flcav.perception.objects.model import Second
from flcav.pipeline.provenance import provenance
from flcav.pipeline.steps import Notify, Step, run_steps
from flcav.report import style
from flcav.report.clouds import real_frame

RECIPE: dict[str, Any] = {
    "town": "suburb",
    "seed": 21,
    "scenes": 4,
    "warmup_s": 60.0,
    "spins_per_scene": 3,
    "every_s": 8.0,
    "cavs": 2,
}
RIGS: dict[str, Any] = {
    "simulated": "kitti_lidar",
    "beams alone": {"lidars": {"velodyne": {"mount": {"z": 1.73}, "settings": {"beams": "hdl64e"}}}},
}
REAL = "KITTI"
LIDAR = "velodyne"
SHOWN = 0.3  # score from which a detection counts as found in the lists of frames
NEUTRAL = {"Van": "Car", "Truck": "Car", "Tram": "Car", "Misc": "Car", "Person_sitting": "Pedestrian"}


def run_sim_to_real(
    network: Second,
    kitti: Path,
    out: Path,
    *,
    jobs: int,
    notify: Notify,
    stale: str = "refuse",
    engine: str = "processes",
) -> dict[str, Any]:
    """Return the comparison of clouds, and the detections of `network` in the frames of the folder `kitti`.

    Frames are recorded in `out`, as `run_steps` does. Raises `InputError` where that is no KITTI folder.
    """
    folder = KittiFolder.open(kitti)
    real = [folder.frame(number) for number in range(len(folder))]
    steps = [
        Step(name.replace(" ", "-"), record_split, {"recipe": {**RECIPE, "vehicle_rig": rig}})
        for name, rig in RIGS.items()
    ]
    run_steps(steps, out, jobs=jobs, notify=notify, stale=stale, engine=engine)
    clouds = {REAL: describe((frame.points, of_class(frame.objects.boxes, "Car")) for frame in real)}
    for name, step in zip(RIGS, steps, strict=True):
        data = Dataset.open(out / step.name / DATA)
        clouds[name] = describe(labelled(data, number) for number in range(len(data)))
    return {"clouds": clouds, **detections(network, real), "provenance": asdict(provenance(RECIPE["seed"]))}


def labelled(data: Dataset, number: int) -> Labelled:
    """Return the cloud and the cars and vans of a recorded frame."""
    frame = data.frame(number)
    boxes = frame.annotations.boxes.transformed(inverse(frame.world_from_sensor(LIDAR)))
    return frame.lidar[LIDAR], boxes[np.isin(boxes.label, ("car", "van"))]


def detections(network: Second, frames: Sequence[KittiFrame]) -> dict[str, Any]:
    """Return AP per class, kind of overlap and IoU over real frames, and of each frame what was found and missed.

    As on KITTI, vans and the like are neutral, and so is whatever a frame's image does not show.
    """
    found = [shown(detect(network, frame.points, score_threshold=LOWEST_SCORE), frame) for frame in frames]
    scores = []
    for name in network.config.classes:
        own = [of_class(boxes, name) for boxes in found]
        targets = [of_class(frame.objects.boxes, name) for frame in frames]
        neutral = [_neutral(frame, name) for frame in frames]
        for kind, overlap in OVERLAPS:
            matches = match(own, targets, neutral, overlap, kind)
            row = {"class": name, "kind": kind, "iou": overlap, "targets": int(matches.targets.sum())}
            hits = int(matches.hit[matches.score >= SHOWN].sum())
            wrong = int((~matches.hit[matches.score >= SHOWN]).sum())
            ap = number_or_none(average_precision(matches))
            scores.append(row | {"found": hits, "false_positives": wrong, "ap": ap})
    return {"scores": scores, "frames": [_story(frame, boxes) for frame, boxes in zip(frames, found, strict=True)]}


def shown(boxes: Boxes, frame: KittiFrame) -> Boxes:
    """Return the boxes whose centre the frame's image shows."""
    return boxes[kitti_view(frame.image, frame.calibration).shows(boxes.center)]


def draw_frame(kitti: Path, story: Mapping[str, Any]) -> bytes:
    """Return the picture of one frame of the results: its cloud from above and its image, with boxes."""
    folder = KittiFolder.open(kitti)
    frame = folder.frame(folder.names.index(story["frame"]))
    view = kitti_view(frame.image, frame.calibration)
    return style.png(real_frame(frame.points, view, of_class(frame.objects.boxes, "Car"), story))


def _neutral(frame: KittiFrame, name: str) -> Boxes:
    boxes = frame.objects.boxes
    return boxes[np.array([NEUTRAL.get(str(label)) == name for label in boxes.label], dtype=bool)]


def _story(frame: KittiFrame, found: Boxes) -> dict[str, Any]:
    """Return the frame's found boxes, and of its labelled cars the distance and the IoU limits at which each was found.

    The labels themselves stay where they are: they are KITTI's.
    """
    boxes = frame.objects.boxes
    cars = of_class(boxes, "Car")
    score = found.score if found.score is not None else np.ones(len(found))
    found = found[score >= SHOWN]
    distances = np.hypot(cars.center[:, 0], cars.center[:, 1]).round(1).tolist()
    targets: list[dict[str, Any]] = [{"distance_m": distance, "found_at": []} for distance in distances]
    for overlap in (0.5, 0.7):
        for target in assign_targets(of_class(found, "Car"), cars, overlap):
            if target >= 0:
                targets[target]["found_at"].append(overlap)
    return {"frame": frame.name, "boxes": box_rows(found), "cars": targets}
