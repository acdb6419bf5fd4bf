"""From simulation to reality: what sets their clouds apart, and how well a detector that never saw a real one does.

Two recordings of the same scenes are compared with KITTI's frames: with the LiDAR of the `kitti` rig, and with one that
has its beams alone, on Lambertian surfaces. The detector is the one that comes with the package.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from flcav.dataset.formats.kitti.read import KittiFolder, KittiFrame
from flcav.dataset.store import Dataset
from flcav.experiments.sim_to_real.clouds import Labelled, describe
from flcav.experiments.studies.run import DATA, record_split
from flcav.geometry import Boxes, inverse
from flcav.perception.images import kitti_view
from flcav.perception.metrics import average_precision, match
from flcav.perception.metrics.matching import assign_targets
from flcav.perception.objects.detect import detect
from flcav.perception.objects.evaluate import LOWEST_SCORE, OVERLAPS, number_or_none, of_class
from flcav.perception.objects.infer import ObjectFound, box_rows, boxes_of_rows
from flcav.perception.objects.model import Second
from flcav.perception.ops.rotated import Kind
from flcav.pipeline.provenance import Provenance, provenance
from flcav.pipeline.steps import Notify, Step, run_steps
from flcav.records import LEFT_OUT, Class, Record
from flcav.report import style
from flcav.report.pictures.clouds import CloudNumbers, real_frame

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


@dataclass(frozen=True)
class RealScore:
    """What was found of one class in real frames, under one measure of overlap."""

    label: Class
    kind: Kind
    iou: float
    targets: int
    found: int  # those that score `SHOWN` or more, as `false_positives`
    false_positives: int
    ap: float | None  # None without targets


@dataclass(frozen=True)
class LabelledCar:
    """A labelled car of a real frame."""

    distance_m: float
    found_at: tuple[float, ...]  # limits of IoU


@dataclass(frozen=True)
class Story:
    """What was found and missed in a real frame; the labels stay where they are: they are KITTI's."""

    frame: str
    boxes: tuple[ObjectFound, ...]
    cars: tuple[LabelledCar, ...]


@dataclass(frozen=True)
class SimToReal(Record):
    """The comparison of clouds, and the detections in real frames."""

    clouds: Mapping[str, CloudNumbers]  # by where they are from
    scores: tuple[RealScore, ...]
    frames: tuple[Story, ...]
    provenance: Annotated[Provenance | None, LEFT_OUT] = None  # not in results of before


def run_sim_to_real(
    network: Second,
    kitti: Path,
    out: Path,
    *,
    jobs: int,
    notify: Notify,
    stale: str = "refuse",
    engine: str = "processes",
) -> SimToReal:
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
    return SimToReal(clouds, *detections(network, real), provenance(RECIPE["seed"]))


def labelled(data: Dataset, number: int) -> Labelled:
    """Return the cloud and the cars and vans of a recorded frame."""
    frame = data.frame(number)
    boxes = frame.annotations.boxes.transformed(inverse(frame.world_from_sensor(LIDAR)))
    return frame.lidar[LIDAR], boxes[np.isin(boxes.label, ("car", "van"))]


def detections(network: Second, frames: Sequence[KittiFrame]) -> tuple[tuple[RealScore, ...], tuple[Story, ...]]:
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
            hits = int(matches.hit[matches.score >= SHOWN].sum())
            wrong = int((~matches.hit[matches.score >= SHOWN]).sum())
            ap = number_or_none(average_precision(matches))
            scores.append(RealScore(name, kind, overlap, int(matches.targets.sum()), hits, wrong, ap))
    return tuple(scores), tuple(map(_story, frames, found))


def shown(boxes: Boxes, frame: KittiFrame) -> Boxes:
    """Return the boxes whose centre the frame's image shows."""
    return boxes[kitti_view(frame.image, frame.calibration).shows(boxes.center)]


def draw_frame(kitti: Path, story: Story) -> bytes:
    """Return the picture of one frame of the results: its cloud from above and its image, with boxes."""
    folder = KittiFolder.open(kitti)
    frame = folder.frame(folder.names.index(story.frame))
    view = kitti_view(frame.image, frame.calibration)
    cars, hit = of_class(frame.objects.boxes, "Car"), np.array([0.5 in car.found_at for car in story.cars], dtype=bool)
    return style.png(real_frame(story.frame, frame.points, view, cars, hit, boxes_of_rows(story.boxes)))


def _neutral(frame: KittiFrame, name: str) -> Boxes:
    boxes = frame.objects.boxes
    return boxes[np.array([NEUTRAL.get(str(label)) == name for label in boxes.label], dtype=bool)]


def _story(frame: KittiFrame, found: Boxes) -> Story:
    """Return the frame's found boxes, and of each labelled car its distance and the limits of IoU it was found at."""
    boxes = frame.objects.boxes
    cars = of_class(boxes, "Car")
    score = found.score if found.score is not None else np.ones(len(found))
    found = found[score >= SHOWN]
    distances = np.hypot(cars.center[:, 0], cars.center[:, 1]).round(1).tolist()
    hit = {overlap: assign_targets(of_class(found, "Car"), cars, overlap).tolist() for overlap in (0.5, 0.7)}
    labelled = tuple(
        LabelledCar(distance, tuple(overlap for overlap, targets in hit.items() if number in targets))
        for number, distance in enumerate(distances)
    )
    return Story(frame.name, box_rows(found), labelled)
