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

Spin = tuple[str, int]  # scene, and number in the scene
LabelFrame = Callable[[int, Frame, Sequence[RoadView]], Sample]  # labels a frame, see `label_frames`

EXACT = NavigationErrors()
PRECISION = 0.9  # least precision of pseudo-labels, on validation frames


def fit_label_threshold(network: Second, splits: Sequence[Frames]) -> float:
    """Return the score threshold of pseudo-labels: the lowest with a precision of `PRECISION` on validation frames.

    Detections are right that match a target at IoU 0.5. Where no score has that precision, the threshold is 1.
    """
    frames = [split.data.frame(i) for split in splits for i in split.vehicles]
    truths = [asked_of(frame, network.config) for frame in frames]
    return find_precise_score(detect_in(network, frames), truths, PRECISION)


def find_precise_score(found: Sequence[Boxes], truths: Sequence[FrameTruth], least: float) -> float:
    """Return the lowest score from which on a share `least` of the boxes found in frames match a target at IoU 0.5.

    It is 1 where no score has that precision.
    """
    matches = match(found, [t.targets for t in truths], [t.neutral for t in truths], 0.5)
    precision = np.cumsum(matches.hit) / np.arange(1, len(matches.hit) + 1)
    good = np.flatnonzero(precision >= least)
    return float(matches.score[good[-1]]) if len(good) else 1.0


def annotated_samples(
    task: Task, config: Any, split: Frames, frames: Sequence[int], region: str
) -> dict[str, Sequence[Any]]:
    """Return each vehicle's samples with their recorded annotations, by "region/vehicle"."""
    own: dict[str, list[int]] = {}
    for i in frames:
        own.setdefault(f"{region}/{split.data.keys[i].agent}", []).append(i)
    return {name: task.samples(split.data, config, numbers) for name, numbers in own.items()}


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
    """Return each vehicle's samples, by "region/vehicle", as `label` makes them.

    `label` is given a frame's number, the frame with the pose of the vehicle's navigation (`poses`), and the messages
    of the sensors on `poles`, by the package's road detector if `trained`, else by an ideal one. The messages enter
    `book` as downlinks; stage III passes none, since its labels are those of stage II.
    """
    data = split.data
    views = road_views(split, poles, trained, {(data.keys[i].scene, data.keys[i].index) for i in frames})
    samples: dict[str, list[Sample]] = {}
    for done, i in enumerate(frames):
        key, frame = data.keys[i], data.frame(i)
        told, name = [*views.get((key.scene, key.index), {}).values()], f"{region}/{key.agent}"
        if book is not None:
            about: Any = {"stage": EDGE, "task": OBJECTS.name, "link": "wireless", "direction": "down", "client": name}
            told = [RoadView.from_message(send_message(book, view.message(), **about)) for view in told]
        known = replace(frame, world_from_agent=navigate(data, i, poses)[0])
        samples.setdefault(name, []).append(label(i, known, told))
        report(done, len(frames), "labels")
    return samples


def road_views(
    split: Frames, poles: Sequence[int], trained: bool, spins: Collection[Spin]
) -> dict[Spin, dict[int, RoadView]]:
    """Return what sensors see in `spins`, by spin and number of the pole, of `poles`: see `label_frames`."""
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
    """Return the vehicles' frames taken within `range_m` of one of the sites (P, 2), world [m]; without sites, all."""
    if not len(sites):
        return split.vehicles

    def near(i: int) -> bool:
        place = split.data.frame(i).world_from_agent[:2, 3]
        return bool((np.linalg.norm(sites - place, axis=1) <= range_m).any())

    return tuple(i for i in split.vehicles if near(i))
