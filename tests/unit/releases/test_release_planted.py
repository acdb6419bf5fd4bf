"""Candidates planted in the head of the packaged network: one class, one output each, refused by the guard of it.

The layers below the head answer once; each candidate is the head alone, so that the test takes seconds, not minutes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.geometry import concatenate
from flcav.machine.threads import use_threads
from flcav.perception.objects.model import Second
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import find_shipped, load_network
from flcav.releases.verification.comparison import MeasuredNetwork, compare_pair, draw_scenes, measure_results
from flcav.releases.verification.guards import pair_classes
from flcav.releases.verification.testing import PLAIN, ConditionResults, choose_test_frames, run_condition
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

pytestmark = pytest.mark.slow

RECIPE = {
    "town": "suburb",
    "weather": {"classes": ["clear", "heavy_rain", "fog"]},
    "seed": 9431,
    "scenes": 60,
    "spins_per_scene": 1,
    "cavs": 3,
    "warmup_s": 45.0,
    "every_s": 4.0,
    "vehicle_rig": "kitti_lidar",
    "split": "test",
}
CLASSES = ("Car", "Pedestrian", "Cyclist")
Edit = Callable[[Second, int], None]  # of a network, in one class


@dataclass(frozen=True)
class Driving:
    """The packaged network's answers: the maps that its head reads, and its results."""

    maps: list[Tensor]
    measured: MeasuredNetwork


def head_rows(network: Second, output: int, width: int, label: int, part: int) -> list[int]:
    """Return the head's rows of one number of an output, whose rows begin at `output`, for the anchors of a class."""
    each, anchors = network.anchors_per_cell // len(CLASSES), network.anchors_per_cell
    return [output * anchors + width * anchor + part for anchor in range(label * each, (label + 1) * each)]


def add_to_score(by: float) -> Edit:
    def edit(network: Second, label: int) -> None:
        network.head.bias[head_rows(network, 0, 3, label, label)] += by

    return edit


def add_to_box(part: int, by: float) -> Edit:
    def edit(network: Second, label: int) -> None:
        network.head.bias[head_rows(network, 3, 7, label, part)] += by

    return edit


def add_to_variances(by: float, *parts: int) -> Edit:
    def edit(network: Second, label: int) -> None:
        for part in parts or range(7):
            network.head.bias[head_rows(network, 12, 7, label, part)] += by

    return edit


def reverse(network: Second, label: int) -> None:
    first, second = (head_rows(network, 10, 2, label, part) for part in (0, 1))
    for values in (network.head.weight, network.head.bias):
        values[first + second] = values[second + first].clone()


@pytest.fixture(scope="module")
def driving(tmp_path_factory: pytest.TempPathFactory) -> Driving:
    use_threads(1)
    folder = tmp_path_factory.mktemp("planted") / "test"
    record(EmbeddedSource(parse_config(Recipe, RECIPE, "test")), folder)
    network, maps = load_network(OBJECTS, find_shipped(OBJECTS)), []
    answer = network.answer

    def keep(features: Tensor):
        maps.append(features)
        return answer(features)

    network.answer = keep
    frames = choose_test_frames([folder], network)
    return Driving(maps, measure_results(run_condition(network, frames, PLAIN)))


def run_head(driving: Driving, network: Second, label: int) -> ConditionResults:
    """Return the results in which the boxes of a class are those of `network`; the others stay."""
    others = [index for index in range(len(CLASSES)) if index != label]
    with torch.no_grad():
        for other in others:
            add_to_score(-50.0)(network, other)
    answers, tested = iter(driving.maps), driving.measured.tested
    network.map_features = lambda voxels: next(answers)
    network.voxels = lambda points, sample, samples: points
    own = run_condition(network, tested.frames, PLAIN)
    found = [
        concatenate([before[before.label != CLASSES[label]], after])
        for before, after in zip(tested.detections, own.detections, strict=True)
    ]
    return replace(tested, detections=tuple(found))


def find_lost(driving: Driving, candidate: ConditionResults) -> list[str]:
    pairs = [*pair_classes(driving.measured, measure_results(candidate))]
    times = draw_scenes(pairs[0].scene, 200)
    found = (compare_pair(pair, times, len(pairs))[0] for pair in pairs)
    return [f"{each.by} {each.name}" for each in found if each.judgement == "lost"]


@pytest.mark.parametrize(
    ("label", "edit", "lost"),
    [
        ("Cyclist", add_to_score(1.5), "false Cyclist"),
        ("Pedestrian", add_to_score(1.0), "false Pedestrian"),
        ("Pedestrian", add_to_score(-1.5), "found Pedestrian"),
        ("Car", add_to_score(-3.0), "found Car"),
        ("Car", reverse, "heading Car"),
        ("Pedestrian", reverse, "heading Pedestrian"),
        ("Car", add_to_box(0, 0.05), "bias Car x too large"),
        ("Pedestrian", add_to_box(2, 0.18), "error Pedestrian height above ground"),
        ("Pedestrian", add_to_box(4, 0.22), "error Pedestrian width"),
        ("Car", add_to_box(5, 0.15), "bias Car height too large"),
        ("Pedestrian", add_to_variances(-3.6), "variance Pedestrian x too small"),
        ("Car", add_to_variances(-3.6, 2), "variance Car height above ground too small"),
        ("Pedestrian", add_to_variances(3.6, 5), "variance Pedestrian height too large"),
    ],
)
def test_a_planted_fault_of_one_class_and_one_output_is_lost_by_name(
    driving: Driving, label: str, edit: Edit, lost: str
):
    network = load_network(OBJECTS, find_shipped(OBJECTS))
    with torch.no_grad():
        edit(network, CLASSES.index(label))
    assert lost in find_lost(driving, run_head(driving, network, CLASSES.index(label)))


def test_the_network_itself_loses_nothing(driving: Driving):
    network = load_network(OBJECTS, find_shipped(OBJECTS))
    found = run_head(driving, network, 0)
    assert find_lost(driving, found) == []
    for before, after in zip(driving.measured.tested.detections, found.detections, strict=True):
        assert np.array_equal(np.sort(before.array(), axis=0), np.sort(after.array(), axis=0))
