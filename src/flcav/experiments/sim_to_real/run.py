"""Sim-to-real gap: statistics of simulated and KITTI's clouds, and AP on KITTI of a detector trained in simulation.

KITTI's frames are compared with two recordings of the same simulated scenes: with the LiDAR of the `kitti` rig, and
with one that has only its beams, on Lambertian surfaces. The detector is the package's own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flcav.dataset.formats.kitti.files import KittiFolder, KittiFrame
from flcav.dataset.store import Dataset
from flcav.experiments.sim_to_real.clouds import CloudNumbers, Labelled, summarise_clouds
from flcav.experiments.splits import open_split, record_split
from flcav.geometry import Boxes, inverse
from flcav.perception.images import kitti_view
from flcav.perception.kitti_benchmark import in_image, truth_of
from flcav.perception.metrics import average_precision, match, round_or_none
from flcav.perception.metrics.matching import assign_targets
from flcav.perception.objects.evaluate import OVERLAPS
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import LOWEST_SCORE, ObjectFound, boxes_to_rows, detect, rows_to_boxes
from flcav.perception.objects.truth import CARS, select_class
from flcav.perception.ops.rotated import Kind
from flcav.pipeline.engine import Notify, Step, run_steps
from flcav.pipeline.provenance import Provenance, provenance
from flcav.report import style
from flcav.report.charts.clouds import CloudSeries, cloud_statistics
from flcav.report.pictures.clouds import real_frame
from flcav.storage.records import Class, Record

RECIPE: dict[str, Any] = {  # of the simulated scenes
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
SHOWN = 0.3  # lowest score of the detections that are counted and listed by frame


@dataclass(frozen=True)
class RealScore:
    """Detections of one class in real frames, matched at one limit of one kind of IoU."""

    label: Class
    kind: Kind
    iou: float
    targets: int
    found: int  # with a score of `SHOWN` or more, as `false_positives`
    false_positives: int
    ap: float | None  # None without targets


@dataclass(frozen=True)
class LabelledCar:
    """A labelled car of a real frame."""

    distance_m: float
    found_at: tuple[float, ...]  # limits of IoU at which a detection matches it


@dataclass(frozen=True)
class FrameResult:
    """Detections and misses in a real frame; KITTI's labels themselves are not copied."""

    frame: str
    boxes: tuple[ObjectFound, ...]
    cars: tuple[LabelledCar, ...]


@dataclass(frozen=True)
class SimToReal(Record):
    """Results of the experiment: statistics of clouds, detections by class, and by real frame."""

    clouds: Mapping[str, CloudNumbers]  # by origin: `REAL`, or a name in `RIGS`
    scores: tuple[RealScore, ...]
    frames: tuple[FrameResult, ...]
    provenance: Provenance


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
    """Compare simulated clouds with those of the folder `kitti`, and evaluate `network` on its frames.

    Simulated frames are recorded in `out` by `run_steps`. Raises `InputError` where `kitti` is no KITTI folder.
    """
    folder = KittiFolder.open(kitti, pictures=False)
    real = [folder.frame(number) for number in range(len(folder))]
    steps = [
        Step(name.replace(" ", "-"), record_split, {"recipe": {**RECIPE, "vehicle_rig": rig}})
        for name, rig in RIGS.items()
    ]
    run_steps(steps, out, jobs=jobs, notify=notify, stale=stale, engine=engine)
    clouds = {REAL: summarise_clouds((frame.points, select_class(frame.objects.boxes, "Car")) for frame in real)}
    for name, step in zip(RIGS, steps, strict=True):
        data = open_split(out / step.name)
        clouds[name] = summarise_clouds(labelled(data, number) for number in range(len(data)))
    return SimToReal(clouds, *detections(network, real), provenance(RECIPE["seed"]))


def labelled(data: Dataset, number: int) -> Labelled:
    """Return the cloud (N, 4) of a recorded frame and the boxes of its cars and vans, LiDAR frame."""
    frame = data.frame(number)
    boxes = frame.annotations.boxes.transform(inverse(frame.world_from_sensor(LIDAR)))
    return frame.lidar[LIDAR], boxes[np.isin(boxes.label, CARS)]


def detections(network: Second, frames: Sequence[KittiFrame]) -> tuple[tuple[RealScore, ...], tuple[FrameResult, ...]]:
    """Return AP by class, kind and limit of IoU over real frames, and the detections and misses of each frame.

    As in KITTI's evaluation, similar classes are neutral. Detections outside the image are left out.
    """
    found = [in_image(detect(network, frame.points, score_threshold=LOWEST_SCORE), frame) for frame in frames]
    truths, scores = [truth_of(frame) for frame in frames], []
    for name in network.config.classes:
        own = [select_class(boxes, name) for boxes in found]
        targets, neutral = (
            [select_class(boxes, name) for boxes in side]
            for side in ([truth.targets for truth in truths], [truth.neutral for truth in truths])
        )
        for kind, overlap in OVERLAPS:
            matches = match(own, targets, neutral, overlap, kind)
            hits = int(matches.hit[matches.score >= SHOWN].sum())
            wrong = int((~matches.hit[matches.score >= SHOWN]).sum())
            ap = round_or_none(average_precision(matches))
            scores.append(RealScore(name, kind, overlap, int(matches.targets.sum()), hits, wrong, ap))
    return tuple(scores), tuple(map(_story, frames, found))


def draw_clouds(results: SimToReal) -> bytes:
    """Return a PNG of the statistics of all clouds."""
    return style.png(cloud_statistics({name: _series(numbers) for name, numbers in results.clouds.items()}))


def draw_frame(kitti: Path, story: FrameResult) -> bytes | None:
    """Return a PNG of one frame of the results: cloud from above and image, with labelled cars and detections.

    None of a frame without an image.
    """
    folder = KittiFolder.open(kitti, pictures=False)
    frame = folder.frame(folder.names.index(story.frame))
    if not frame.image.size:
        return None
    view = kitti_view(frame.image, frame.calibration)
    cars, hit = (
        select_class(frame.objects.boxes, "Car"),
        np.array([0.5 in car.found_at for car in story.cars], dtype=bool),
    )
    return style.png(real_frame(story.frame, frame.points, view, cars, hit, rows_to_boxes(story.boxes)))


def _series(numbers: CloudNumbers) -> CloudSeries:
    street = [(float(np.mean([float(m) for m in row.ahead_m.split("-")])), row.intensity) for row in numbers.ground]
    cars = [(car.distance_m, car.returns) for car in numbers.cars]
    return CloudSeries(numbers.returns_per_range, numbers.intensity_quantiles, street, cars)


def _story(frame: KittiFrame, found: Boxes) -> FrameResult:
    """Return the frame's detections, and each labelled car's distance and the limits of IoU it was found at."""
    boxes = frame.objects.boxes
    cars = select_class(boxes, "Car")
    score = found.score if found.score is not None else np.ones(len(found))
    found = found[score >= SHOWN]
    distances = np.hypot(cars.center[:, 0], cars.center[:, 1]).round(1).tolist()
    hit = {overlap: assign_targets(select_class(found, "Car"), cars, overlap).tolist() for overlap in (0.5, 0.7)}
    labelled = tuple(
        LabelledCar(distance, tuple(overlap for overlap, targets in hit.items() if number in targets))
        for number, distance in enumerate(distances)
    )
    return FrameResult(frame.name, boxes_to_rows(found), labelled)
