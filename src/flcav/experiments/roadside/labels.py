"""Labels of the trained road detector beside those of an ideal one, on sweeps of vehicles near a pole.

The ideal detector labels every object of which its LiDAR has ten returns or more, at any distance. What the trained one
lacks of that is counted: objects beyond its field, objects that it misses, and boxes that are not exact.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flcav.config import parse_config
from flcav.dataset.ground import Ground
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.fusion.detector import load_road_network
from flcav.fusion.labels import label_sample
from flcav.fusion.road import RoadView
from flcav.geometry import Boxes, inverse
from flcav.perception.metrics.matching import assign_targets
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import CONFIGURATIONS
from flcav.perception.objects.truth import choose_lidar, in_range, network_from_lidar
from flcav.runs.frames import Frames, group_frames
from flcav.runs.labels.pseudo_labels import Spin, road_views, select_frames_near
from flcav.runs.poles import find_sites
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

RECIPE: Mapping[str, Any] = {
    "town": "grid",
    "seed": 7325,
    "split": "test",
    "scenes": 8,
    "spins_per_scene": 2,
    "every_s": 6.0,
    "cavs": 4,
    "poles": "all",
}
NETWORK = "tiny"  # of the vehicles, as in the demo
NEAR_M = 60.0  # farthest vehicle from the pole, as in the demo
FOUND, EXACT = 0.5, 0.7  # IoU of a found box, in bird's-eye view, and of an exact one, in 3D

Views = Mapping[Spin, Mapping[int, RoadView]]


@dataclass(frozen=True)
class RoadLabels:
    """Numbers of labels by single poles; those of the ideal detector are `beyond`, `missed`, `coarse` and `exact`."""

    sweeps: int  # of vehicles, counted for each pole that is near
    beyond: int  # labels of the ideal detector outside the field of the trained one
    missed: int  # inside, without a box of the trained one at the bird's-eye IoU `FOUND`
    coarse: int  # found, at a 3D IoU below `EXACT`
    exact: int  # found, at a 3D IoU of `EXACT` or more
    other: int  # labels of the trained detector on objects that the ideal one does not label, at `FOUND`
    false: int  # and on none, parts of trucks and buses included

    @property
    def ideal(self) -> int:
        """Return the number of labels of the ideal detector."""
        return self.beyond + self.missed + self.coarse + self.exact


def measure_road_labels(folder: Path) -> RoadLabels:
    """Record vehicles and poles into `folder`; return the labels that each pole alone gives the vehicles near it."""
    record(EmbeddedSource(parse_config(Recipe, dict(RECIPE), "labels")), folder)
    data = Dataset.open(folder)
    grouped = group_frames(data, folder.name)
    split, config = Frames(data, grouped.vehicles, grouped.poles), CONFIGURATIONS[NETWORK]
    sites = find_sites(split, None)
    counts = np.zeros(7, dtype=np.int64)
    for pole, place in zip(sites.number.tolist(), sites.position, strict=True):
        counts += count_labels(split, select_frames_near(split, place[None, :2], NEAR_M), pole, config)
    return RoadLabels(*counts.tolist())


def count_labels(split: Frames, frames: Sequence[int], pole: int, config: SecondConfig) -> tuple[int, ...]:
    """Return the fields of `RoadLabels` of the sensor on a pole, for vehicles' frames of a split and their network."""
    spins = {_spin(split, i) for i in frames}
    trained, ideal = (road_views(split, [pole], own, spins) for own in (True, False))
    field = _keep_field(split, ideal)
    beyond = missed = coarse = exact = other = false = 0
    for i in frames:
        every, inside, told = (_label(split, i, views, config) for views in (ideal, field, trained))
        graded = grade_labels(inside, told)
        beyond += len(every) - len(inside)
        missed, coarse, exact = missed + graded[0], coarse + graded[1], exact + graded[2]
        rest = _find_others(told, every)
        wrong = _find_others(rest, _list_objects(split, i, config))
        other, false = other + len(rest) - len(wrong), false + len(wrong)
    return len(frames), beyond, missed, coarse, exact, other, false


def grade_labels(ideal: Boxes, told: Boxes) -> tuple[int, int, int]:
    """Return how many of the `ideal` labels `told` misses, and finds coarsely and exactly; both in one frame."""
    found = int((assign_targets(_sure(told), ideal, FOUND, "bev") >= 0).sum())
    exact = int((assign_targets(_sure(told), ideal, EXACT) >= 0).sum())
    return len(ideal) - found, found - exact, exact


def _find_others(told: Boxes, known: Boxes) -> Boxes:
    """Return the boxes that find none of the `known`."""
    return told[assign_targets(_sure(told), known, FOUND, "bev") < 0]


def _list_objects(split: Frames, i: int, config: SecondConfig) -> Boxes:
    """Return all annotated objects of a vehicle's frame, in its network's frame."""
    frame = split.data.frame(i)
    boxes = frame.annotations.boxes.transform(inverse(frame.world_from_sensor(choose_lidar(frame))))
    move = network_from_lidar(frame, config)
    return boxes if move is None else boxes.transform(move)


def _sure(boxes: Boxes) -> Boxes:
    return replace(boxes, score=np.ones(len(boxes)))


def _spin(split: Frames, i: int) -> Spin:
    return split.data.keys[i].scene, split.data.keys[i].index


def _label(split: Frames, i: int, views: Views, config: SecondConfig) -> Boxes:
    """Return the labels by road sensors alone of a vehicle's frame, in its network's frame and range."""
    frame, told = split.data.frame(i), [*views.get(_spin(split, i), {}).values()]
    sample = label_sample(frame, Boxes.empty(), told, config, choose_lidar(frame), Ground(split.data).relief)
    return sample.boxes[in_range(sample.boxes, config)]


def _keep_field(split: Frames, views: Views) -> Views:
    """Return the views with those boxes alone that lie in the field of the trained road detector."""
    config = load_road_network().config
    kept: dict[Spin, dict[int, RoadView]] = {}
    for spin, own in views.items():
        for pole, view in own.items():
            (number,) = (i for i in split.poles[pole] if _spin(split, i) == spin)
            frame = split.data.frame(number)
            boxes = view.boxes.transform(inverse(frame.world_from_sensor(choose_lidar(frame))))
            kept.setdefault(spin, {})[pole] = replace(view, boxes=view.boxes[in_range(boxes, config)])
    return kept
