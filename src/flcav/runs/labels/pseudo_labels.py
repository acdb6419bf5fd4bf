"""Pseudo-labels by the pretrained network and roadside sensors, and ground truth as labels."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from flcav.dataset.ground import DatasetGround
from flcav.fusion.average import NavigationErrors, PoseSource
from flcav.fusion.labels import label_sample
from flcav.fusion.road import RoadView, build_road_view, label_ideally, road_detector
from flcav.geometry import Boxes
from flcav.interface.progress import Report
from flcav.network.ledger import Ledger, send_message
from flcav.perception.metrics import match
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import FrameTruth, asked_of, choose_lidar
from flcav.perception.task import Task
from flcav.runs.frames import Frames
from flcav.runs.labels.sightings import navigate
from flcav.runs.recipe import EDGE
from flcav.sensors.frame import Frame

Spin = tuple[str, int]  # scene, and number of the LiDAR's revolution in the scene
LabelFrame = Callable[[int, Frame, Sequence[RoadView]], Sample]  # labels a frame, see `label_frames`

EXACT = NavigationErrors()  # poses without errors
PRECISION = 0.9  # least precision of pseudo-labels, on validation frames


def fit_label_threshold(network: Second, splits: Sequence[Frames]) -> float:
    """Return the score threshold of pseudo-labels: the lowest with a precision of `PRECISION` on validation frames.

    A detection is right if it matches a target at IoU 0.5. Where no score has that precision, the threshold is 1.
    """
    frames = [split.data.frame(i) for split in splits for i in split.vehicles]
    truths = [asked_of(frame, network.config) for frame in frames]
    return find_precise_score(detect_in(network, frames), truths, PRECISION)


def find_precise_score(found: Sequence[Boxes], truths: Sequence[FrameTruth], least: float) -> float:
    """Return the lowest score threshold at which the precision of detections, at IoU 0.5, is at least `least`.

    `found` and `truths` are by frame. The threshold is 1 where no score has that precision.
    """
    matches = match(found, [truth.targets for truth in truths], [truth.neutral for truth in truths], 0.5)
    precision = np.cumsum(matches.hit) / np.arange(1, len(matches.hit) + 1)
    good = np.flatnonzero(precision >= least)
    return float(matches.score[good[-1]]) if len(good) else 1.0


def annotated_samples(
    task: Task, config: Any, split: Frames, frames: Sequence[int], region: str
) -> dict[str, Sequence[Any]]:
    """Return the vehicles' samples with their recorded annotations, by "region/vehicle"."""
    numbers_by_vehicle: dict[str, list[int]] = {}
    for i in frames:
        numbers_by_vehicle.setdefault(f"{region}/{split.data.keys[i].agent}", []).append(i)
    return {name: task.samples(split.data, config, numbers) for name, numbers in numbers_by_vehicle.items()}


def label_detected(network: Second, threshold: float, split: Frames) -> LabelFrame:
    """Return the labelling of frames by the detections of the frozen `network` that score `threshold` or more."""
    relief = DatasetGround(split.data).relief

    def label(i: int, frame: Frame, views: Sequence[RoadView]) -> Sample:
        (detections,) = detect_in(network, [frame], score_threshold=threshold)
        return label_sample(frame, detections, views, network.config, choose_lidar(frame), relief)

    return label


def label_frames(
    label: LabelFrame,
    split: Frames,
    frames: Sequence[int],
    poles: Sequence[int],
    region: str,
    report: Report,
    book: Ledger | None = None,
    trained: bool = False,
    poses: PoseSource = EXACT,
) -> dict[str, list[Sample]]:
    """Return the vehicles' samples as `label` makes them, by "region/vehicle".

    `label` receives a frame's number, the frame with the pose of the vehicle's navigation (`poses`) in place of the
    true one, and the views of roadside sensors on `poles` at its spin, by the package's road detector if `trained`,
    else by an ideal one. Vehicles receive the views in messages, which enter `book` as downlinks; stage III passes no
    ledger, since its labels are those of stage II.
    """
    data = split.data
    views = road_views(split, poles, trained, {(data.keys[i].scene, data.keys[i].index) for i in frames})
    samples: dict[str, list[Sample]] = {}
    for done, i in enumerate(frames):
        key, frame = data.keys[i], data.frame(i)
        seen = [*views.get((key.scene, key.index), {}).values()]
        name = f"{region}/{key.agent}"
        if book is not None:
            about: Any = {"stage": EDGE, "task": OBJECTS.name, "link": "wireless", "direction": "down", "client": name}
            seen = [RoadView.from_message(send_message(book, view.message(), **about)) for view in seen]
        known = replace(frame, world_from_agent=navigate(data, i, poses)[0])
        samples.setdefault(name, []).append(label(i, known, seen))
        report(done, len(frames), "labels")
    return samples


def road_views(
    split: Frames, poles: Sequence[int], trained: bool, spins: Collection[Spin]
) -> dict[Spin, dict[int, RoadView]]:
    """Return the views of the sensors on `poles` in `spins`, by spin and number of the pole.

    `trained`: by the package's road detector instead of an ideal one.
    """
    ground = DatasetGround(split.data)
    views: dict[Spin, dict[int, RoadView]] = {}
    find = road_detector(split.data) if trained and poles else None
    for pole in poles:
        for i in split.poles.get(pole, ()):
            key = split.data.keys[i]
            if (key.scene, key.index) not in spins:
                continue
            frame = split.data.frame(i)
            boxes = label_ideally(frame) if find is None else find(i)
            view = build_road_view(frame, boxes, choose_lidar(frame), ground.relief, ground.below(i))
            views.setdefault((key.scene, key.index), {})[pole] = view
    return views


def select_frames_near(split: Frames, sites: np.ndarray, range_m: float) -> tuple[int, ...]:
    """Return the vehicles' frames within `range_m` [m] of a site (P, 2), world frame [m]; without sites, all frames."""
    if not len(sites):
        return split.vehicles

    def near(i: int) -> bool:
        place = split.data.frame(i).world_from_agent[:2, 3]
        return bool((np.linalg.norm(sites - place, axis=1) <= range_m).any())

    return tuple(i for i in split.vehicles if near(i))
