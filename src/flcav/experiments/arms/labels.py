"""Labels of the trained road detector beside those of an ideal one, on the frames that vehicles of stage II train on.

The ideal detector labels every object of which its LiDAR has ten returns or more, at any distance. What the trained one
lacks of that is counted: objects beyond its field, objects that it misses, and boxes that are not exact.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flcav.dataset.ground import Ground
from flcav.fusion.detector import load_road_network
from flcav.fusion.labels import label_sample
from flcav.fusion.road import RoadView
from flcav.geometry import Boxes, inverse
from flcav.perception.metrics.matching import assign_targets
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.truth import choose_lidar, in_range
from flcav.perception.task import find_configuration
from flcav.perception.tasks import task_named
from flcav.pipeline.arms import Names, resolve_settings
from flcav.pipeline.frames import Frames
from flcav.pipeline.labels.pseudo_labels import Spin, road_views, select_frames_near
from flcav.pipeline.labels.sources import choose_labels
from flcav.pipeline.recipe import EDGE, MAIN
from flcav.pipeline.results.run import Run
from flcav.pipeline.stages.placement import find_sites

FOUND, EXACT = 0.5, 0.7  # IoU of a found box, in bird's-eye view, and of an exact one, in 3D

Views = Mapping[Spin, Mapping[int, RoadView]]


@dataclass(frozen=True)
class RoadLabels:
    """Numbers of labels by road sensors in a region; the ideal detector's are the sum of the next four."""

    frames: int  # of vehicles
    beyond: int  # labels of the ideal detector outside the field of the trained one
    missed: int  # inside, without a box of the trained one at the bird's-eye IoU `FOUND`
    coarse: int  # found, at a 3D IoU below `EXACT`
    exact: int  # found, at a 3D IoU of `EXACT` or more
    more: int  # labels of the trained detector on none of the ideal one's

    @property
    def ideal(self) -> int:
        """Return the number of labels of the ideal detector."""
        return self.beyond + self.missed + self.coarse + self.exact


def count_road_labels(run: Run, work: Path, region: str, task: str) -> RoadLabels:
    """Return the labels of both detectors at the run's own poles in a region, whose steps' folders are in `work`."""
    recipe = run.recipe
    names = Names(
        resolve_settings(recipe, {each: choose_labels(each, own.labels) for each, own in recipe.tasks.items()})
    )
    split = Frames.open(work / names.recording(region, EDGE, task))
    placed = {arm: each for arm, own in run.arms.items() for each in own.placed if each.region == region}
    sites, near = find_sites(split, None), {pole for each in placed.values() for pole in each.chosen}
    places = sites.position[np.isin(sites.number, list(near)), :2]
    frames = select_frames_near(split, places, recipe.placement.group_range_m)
    config = find_configuration(task_named(task), recipe.tasks[task].network)
    return compare_road_labels(split, frames, placed[MAIN].chosen, config)


def compare_road_labels(split: Frames, frames: Sequence[int], poles: Sequence[int], config: SecondConfig) -> RoadLabels:
    """Return the labels that sensors on `poles` give vehicles' frames of a split, for a network of `config`."""
    spins = {_spin(split, i) for i in frames}
    trained, ideal = (road_views(split, poles, own, spins) for own in (True, False))
    field = _keep_field(split, ideal)
    counts = np.zeros(5, dtype=np.int64)
    for i in frames:
        every, inside, told = (_label(split, i, views, config) for views in (ideal, field, trained))
        missed, coarse, exact = grade_labels(inside, told)
        more = len(told) - int((assign_targets(_sure(told), every, FOUND, "bev") >= 0).sum())
        counts += (len(every) - len(inside), missed, coarse, exact, more)
    return RoadLabels(len(frames), *counts.tolist())


def grade_labels(ideal: Boxes, told: Boxes) -> tuple[int, int, int]:
    """Return how many of the `ideal` labels `told` misses, and finds coarsely and exactly; both in one frame."""
    found = int((assign_targets(_sure(told), ideal, FOUND, "bev") >= 0).sum())
    exact = int((assign_targets(_sure(told), ideal, EXACT) >= 0).sum())
    return len(ideal) - found, found - exact, exact


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
