"""KITTI's benchmark: which objects count, how AP|R40 is made, and the same figures as another implementation."""

import importlib.util
import os
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from flcav.config import InputError
from flcav.dataset.formats.kitti import KittiCalibration
from flcav.dataset.formats.kitti.files import read_points
from flcav.dataset.formats.rig import find_rig
from flcav.geometry import Boxes
from flcav.perception import networks
from flcav.perception.kitti_benchmark import (
    COUNTS,
    IGNORED,
    LEVELS,
    OTHER,
    BenchmarkEvaluation,
    ClassFrame,
    average_precision_r40,
    compare_kitti_rig,
    count_matches,
    detection_states,
    find_thresholds,
    label_states,
    project_boxes,
)
from flcav.perception.networks import evaluate
from flcav.perception.objects.model import second_tiny
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import KnownLidar

SHARED = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[3].parent / "shared" / "data"))
PEER = SHARED / "peers/OpenPCDet/pcdet/datasets/kitti/kitti_object_eval_python/eval.py"


@pytest.mark.parametrize(
    ("label", "height", "occlusion", "truncation", "states"),
    [
        ("Car", 40.5, 0, 0.15, (COUNTS, COUNTS, COUNTS)),
        ("Car", 40.0, 0, 0.0, (IGNORED, COUNTS, COUNTS)),
        ("Car", 25.0, 0, 0.0, (IGNORED, IGNORED, IGNORED)),
        ("Car", 80.0, 1, 0.0, (IGNORED, COUNTS, COUNTS)),
        ("Car", 80.0, 2, 0.0, (IGNORED, IGNORED, COUNTS)),
        ("Car", 80.0, 3, 0.0, (IGNORED, IGNORED, IGNORED)),
        ("Car", 80.0, 0, 0.3, (IGNORED, COUNTS, COUNTS)),
        ("Car", 80.0, 0, 0.5, (IGNORED, IGNORED, COUNTS)),
        ("Car", 80.0, 0, 0.51, (IGNORED, IGNORED, IGNORED)),
        ("Van", 80.0, 0, 0.0, (IGNORED, IGNORED, IGNORED)),
        ("Van", 10.0, 3, 0.9, (IGNORED, IGNORED, IGNORED)),
        ("Truck", 80.0, 0, 0.0, (OTHER, OTHER, OTHER)),
    ],
)
def test_objects_count_by_height_occlusion_and_truncation(
    label: str, height: float, occlusion: int, truncation: float, states: tuple[int, ...]
):
    given = np.array([label]), np.array([height]), np.array([occlusion]), np.array([truncation])
    assert tuple(int(label_states("Car", *given, level)[0]) for level in LEVELS.values()) == states


def test_detections_below_the_height_are_ignored():
    labels, height = np.array(["Car", "Car", "Cyclist", "Cyclist"]), np.array([40.0, 39.9, 50.0, 10.0])
    assert detection_states("Car", labels, height, LEVELS["easy"]).tolist() == [COUNTS, IGNORED, OTHER, IGNORED]
    assert detection_states("Car", labels, height, LEVELS["hard"]).tolist() == [COUNTS, COUNTS, OTHER, IGNORED]


def frame(score: Any, label: Any, overlap: Any, **changes: Any) -> ClassFrame:
    count = len(score)
    return ClassFrame(
        score=np.array(score),
        detection=np.array(changes.get("detection", [COUNTS] * count), np.int64),
        label=np.array(label, np.int64),
        overlap=np.array(overlap, float).reshape(count, len(label)),
        excused=np.array(changes.get("excused", [False] * count)),
    )


def found(hits: int, targets: int, wrong: list[float]) -> list[ClassFrame]:
    """Return frames of one object each, of which the first are found with scores from 0.9 down, and false positives."""
    scores = np.linspace(0.9, 0.5, hits).tolist()
    frames = [frame([scores[i]] if i < hits else [], [COUNTS], [[0.8]] if i < hits else []) for i in range(targets)]
    return [*frames, *(frame([score], [], [[]]) for score in wrong)]


def test_average_precision_by_hand():
    assert average_precision_r40(found(40, 40, []), 0.7) == pytest.approx(39 / 40)  # recall 0 takes one of 40 scores
    assert average_precision_r40(found(80, 80, []), 0.7) == 1
    assert average_precision_r40(found(40, 80, []), 0.7) == pytest.approx(20 / 40)  # half of the recall
    assert average_precision_r40(found(80, 80, [0.95] * 80), 0.7) == pytest.approx(0.5)  # best at the end: 80 of 160
    assert average_precision_r40(found(80, 80, [0.1]), 0.7) == 1  # below every score
    assert average_precision_r40(found(80, 80, []), 0.8) == 0  # an overlap is above the limit, or none
    assert average_precision_r40(found(0, 3, [0.9]), 0.7) == 0
    assert average_precision_r40(found(0, 0, [0.9]), 0.7) is None


def test_ignored_objects_and_regions_excuse_detections():
    right = found(80, 80, [])
    for extra in (
        frame([0.99], [IGNORED], [[0.8]]),
        frame([0.99], [], [], detection=[IGNORED]),
        frame([0.99], [], [], detection=[OTHER]),
        frame([0.99], [], [], excused=[True]),
    ):
        assert average_precision_r40([*right, *[extra] * 80], 0.7) == 1
    for extra in (frame([0.99], [IGNORED], [[0.6]]), frame([0.99], [OTHER], [[0.8]])):
        assert average_precision_r40([*right, *[extra] * 80], 0.7) == pytest.approx(0.5)


def test_one_of_two_on_the_same_object_is_false_and_an_ignored_one_takes_it_last():
    double = [frame([0.9 - i / 1000, 0.4], [COUNTS], [[0.75], [0.95]]) for i in range(80)]
    assert average_precision_r40(double, 0.7) == 1  # at every threshold above 0.4 there is but one
    small = [frame([0.9 - i / 1000, 0.95], [COUNTS], [[0.75], [0.9]], detection=[COUNTS, IGNORED]) for i in range(80)]
    assert average_precision_r40(small, 0.7) == 0  # thresholds are sought by score, and that detection is too low


def test_false_positives_are_counted_at_a_threshold():
    frames = frame([0.9, 0.6, 0.5, 0.2], [COUNTS], [[0.8], [0.4], [0.0], [0.0]], excused=[False, False, True, False])
    assert count_matches(frames, 0.5, 0.3) == (1, 1)  # the third is excused, the fourth below the threshold
    assert count_matches(frames, 0.5, 0.1) == (1, 2)
    assert count_matches(frames, 0.85, 0.3) == (0, 2)


def test_thresholds_are_forty_steps_of_recall():
    scores = np.linspace(1, 0, 400, endpoint=False)
    assert find_thresholds(scores, 400)[:3] == pytest.approx([1 - 0 / 400, 1 - 9 / 400, 1 - 19 / 400])
    assert len(find_thresholds(scores, 400)) == 41
    assert len(find_thresholds(scores[:200], 400)) == 21
    assert find_thresholds(np.array([0.2, 0.7]), 2) == [0.7, 0.2]


def test_boxes_are_projected_into_the_image():
    camera = KittiCalibration(
        np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
        np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]),
    )
    boxes = Boxes.from_array([[12, 0, 0, 4, 2, 1.5, 0], [-12, 0, 0, 4, 2, 1.5, 0], [12, 30, 0, 4, 2, 1.5, 0]], "Car")
    ahead, behind, aside = project_boxes(boxes, camera, (375, 1242))
    np.testing.assert_allclose(ahead, [600 - 70, 180 - 52.5, 600 + 70, 180 + 52.5])
    assert behind.tolist() == [0, 0, 0, 0]
    assert aside[2] == aside[0] == 0


def test_the_benchmark_has_no_use_for_other_options(tmp_path: Path):
    (tmp_path / "training" / "velodyne").mkdir(parents=True)
    options: list[dict[str, Any]] = [{"agents": "all"}, {"within": "40,20"}, {"around": True}, {"tracks": True}]
    for option in options:
        with pytest.raises(InputError, match="KITTI's benchmark has no use for --"):
            evaluate("objects", tmp_path, **option)
    with pytest.raises(InputError, match="no frames to evaluate"):
        evaluate("objects", tmp_path)


def test_a_lidar_unlike_that_of_the_training_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "training" / "velodyne").mkdir(parents=True)
    found = BenchmarkEvaluation(
        frames=1, split=None, targets={}, benchmark=(), false_positives={}, threshold=0.3, bare=0
    )
    monkeypatch.setattr(networks, "evaluate_kitti", lambda *given: found)

    def told(beams: int, range_m: float) -> str:
        monkeypatch.setattr(networks, "find_trained_lidar", lambda *given: KnownLidar((beams, beams), range_m))
        return evaluate("objects", tmp_path).chosen.sentence

    unlike = "1 vehicle frame; unlike in the network's training the LiDAR"
    assert told(16, 40.0) == f"{unlike} has 64 beams, not 16 and reaches 120 m, not 40 m"
    assert told(64, 120.0) == "1 vehicle frame"
    rig = find_rig([], read_points)
    higher = compare_kitti_rig(tmp_path, rig, replace(OBJECTS.configurations["tiny"], ground_z_m=-2.2), KnownLidar())
    assert higher == "unlike in the network's training the LiDAR is 1.73 m above the ground, not 2.2 m (corrected)"
    (tmp_path / "frames.csv").write_text("number,frame,agent,time_s\n")  # an export: its LiDAR may be any
    assert told(16, 40.0) == "1 vehicle frame"


@pytest.fixture(scope="module")
def peer() -> ModuleType:
    """Return OpenPCDet's evaluation, uncompiled and without what needs CUDA."""
    if not PEER.is_file():
        pytest.skip(f"no OpenPCDet at {PEER}")
    rotate = ModuleType("kitti_peer.rotate_iou")
    rotate.rotate_iou_gpu_eval = None  # type: ignore[attr-defined]
    package = ModuleType("kitti_peer")
    package.__path__ = []
    spec = importlib.util.spec_from_file_location("kitti_peer.eval", PEER)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules |= {"kitti_peer": package, "kitti_peer.rotate_iou": rotate, "kitti_peer.eval": module}
    spec.loader.exec_module(module)
    for name in ("get_thresholds", "compute_statistics_jit", "image_box_overlap"):
        setattr(module, name, getattr(module, name).py_func)
    return module


def _peer_ap(peer: ModuleType, frames: list[ClassFrame], limit: float) -> float:
    """Return the AP|R40 of OpenPCDet's functions, as its `eval_class` and `get_mAP_R40` call them."""

    def statistics(one: ClassFrame, threshold: float, counted: bool):
        detections, objects = np.zeros((len(one.score), 6)), np.zeros((len(one.label), 5))
        detections[:, 5] = one.score
        arguments = one.overlap, objects, detections, one.label, one.detection, np.zeros((0, 4))
        return peer.compute_statistics_jit(*arguments, 1, limit, threshold, counted)

    scores = np.concatenate([statistics(one, 0.0, False)[4] for one in frames])
    thresholds = peer.get_thresholds(scores, sum(int((one.label == COUNTS).sum()) for one in frames))
    precision = np.zeros((1, 1, 1, 41))
    for place, threshold in enumerate(thresholds):
        true, wrong = np.sum([statistics(one, threshold, True)[:2] for one in frames], axis=0)
        precision[0, 0, 0, place] = true / (true + wrong)
    for place in range(len(thresholds)):
        precision[..., place] = precision[..., place:].max()
    return float(peer.get_mAP_R40(precision)[0, 0, 0]) / 100


def test_another_implementation_comes_to_the_same(peer: ModuleType):
    rng = np.random.default_rng(3)
    for _ in range(4):
        frames = []
        for _ in range(12):
            count, objects = rng.integers(0, 7), rng.integers(0, 5)
            frames.append(
                frame(
                    rng.permutation(1000)[:count] / 1000,
                    rng.choice([COUNTS, COUNTS, IGNORED, OTHER], objects),
                    rng.uniform(0, 1, (count, objects)),
                    detection=rng.choice([COUNTS, COUNTS, COUNTS, IGNORED, OTHER], count),
                )
            )
        assert average_precision_r40(frames, 0.5) == pytest.approx(_peer_ap(peer, frames, 0.5), abs=1e-9)
    labels, levels = ["Car", "Van", "Truck", "Person_sitting", "Pedestrian", "Cyclist"], list(LEVELS.values())
    for _ in range(5):
        count = 12
        label, top = rng.choice(labels, count), rng.uniform(0, 50, count)
        height, occlusion, truncation = (
            rng.choice([24, 25, 26, 40, 41], count),
            rng.integers(0, 4, count),
            rng.random(count),
        )
        rectangle = np.c_[np.zeros(count), top, np.full(count, 9.0), top + height]
        notes = {"name": label, "bbox": rectangle, "occluded": occlusion, "truncated": truncation}
        for number, name in enumerate(("Car", "Pedestrian", "Cyclist")):
            for rank, level in enumerate(levels):
                _, ignored, other, _ = peer.clean_data(notes, {"name": label, "bbox": rectangle}, number, rank)
                px = rectangle[:, 3] - rectangle[:, 1]
                assert label_states(name, label, px, occlusion, truncation, level).tolist() == ignored
                assert detection_states(name, label, px, level).tolist() == other


@pytest.mark.skipif(not (SHARED / "kitti_frame").is_dir(), reason="no real KITTI frame: set FLCAV_REAL_DATA")
def test_a_network_that_finds_nothing_has_an_average_precision_of_0():
    found = evaluate("objects", SHARED / "kitti_frame", second_tiny())
    assert found.score == 0
