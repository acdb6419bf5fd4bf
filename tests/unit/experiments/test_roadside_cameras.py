"""Who is associated with whom: pairs of a camera and a LiDAR counted by hand, and their row of Fig. 4's table."""

from dataclasses import replace

import numpy as np

from flcav.fusion.association import PairedShot, Pairs
from flcav.fusion.registration import Offset
from flcav.geometry import Boxes
from flcav.reproductions.fig4.cameras import (
    CALIBRATED,
    CORRECTED,
    EXACT,
    VISIBLE_PX,
    Associated,
    CameraResult,
    Known,
    judge_pairs,
    name_actors,
)
from flcav.reproductions.fig4.run import Fig4, fig4_tables
from flcav.runs.provenance import provenance
from flcav.sensors.frame import Annotations, Calibration, Frame, Views

NONE = np.zeros(0, np.int64)


def frame() -> Frame:
    """Return a frame of a car, a van that hardly shows, a bus, and a car beside the picture, world frame."""
    places = [(20.0, 0.0), (30.0, 5.0), (40.0, 0.0), (10.0, 30.0)]
    kinds = ["car", "van", "bus", "car"]
    shown = np.array([(100, 100, 140, 130), (200, 100, 204, 104), (300, 100, 400, 160), (np.nan,) * 4], dtype=float)
    views = Views(shown, shown, np.array([900, VISIBLE_PX - 1, 5000, 0]), np.zeros(4), np.zeros(4))
    annotations = Annotations(
        np.array(["a", "b", "c", "d"]),
        Boxes.from_array([(x, y, 0.8, 4.4, 1.8, 1.6, 0) for x, y in places], kinds),
        np.zeros((4, 3)),
        np.zeros((4, 3)),
        np.full(4, 9),
        np.zeros(4),
        views={"left": views},
    )
    mounts = Calibration({"lidar": np.eye(4)})
    return Frame("s", 0, 0.0, "pole1", np.eye(4), mounts, mounts, {}, annotations)


def found(*places: tuple[float, float]) -> Boxes:
    rows = [(x, y, 0.8, 4.4, 1.8, 1.6, 0) for x, y in places]
    return Boxes.from_array(rows, "Car", np.full(len(rows), 0.9))


def test_actors_are_those_that_overlap_by_half() -> None:
    cars = found((20.3, 0.0), (30.0, 5.0), (40.0, 0.0), (10.0, 30.0), (60.0, 0.0))
    boxes = np.array([(102, 100, 141, 131), (300, 100, 395, 160), (130, 100, 170, 130)], dtype=float)
    _, known = name_actors(frame(), "lidar", "left", PairedShot(cars, boxes))
    assert known.cars.tolist() == [0, 1, -1, 3, -1]  # a bus is no car, and at 60 m there is nothing
    assert known.boxes.tolist() == [0, 2, -1]
    assert known.visible.tolist() == [True, False, False, False, False]


def test_without_annotated_actors_nobody_is_known() -> None:
    whole = frame()
    none = np.zeros((0, 4))
    views = {"left": Views(none, none, NONE, np.zeros(0), np.zeros(0))}
    boxes = whole.annotations.boxes[:0]
    empty = Annotations(np.zeros(0, str), boxes, np.zeros((0, 3)), np.zeros((0, 3)), NONE, np.zeros(0), views=views)
    shot = PairedShot(found((20.0, 0.0)), np.array([(100.0, 100.0, 140.0, 130.0)]))
    _, known = name_actors(replace(whole, annotations=empty), "lidar", "left", shot)
    assert (known.cars.tolist(), known.boxes.tolist(), known.visible.tolist()) == ([-1], [-1], [False])


def test_a_pair_is_right_if_both_are_one_actor() -> None:
    known = [Known(np.array([4, 7, -1]), np.array([7, 4, -1]), np.array([True, False, False]))]
    pairs = [Pairs(np.array([0, 1, 2]), np.array([1, 0, 2]), np.array([1.0, 5.0, 9.0]), NONE, NONE)]
    judged = judge_pairs(pairs, known, Offset(1.0, 2.0))
    assert (judged.pairs, judged.right, judged.found, judged.residual_px) == (3, 2, 1, 5.0)  # no actor is not right
    wrong = replace(pairs[0], box=np.array([0, 1, 2]), lone_cars=np.array([5]))
    judged = judge_pairs([wrong], known, Offset(1.0, 2.0))
    assert (judged.right, judged.found, judged.lone_cars, judged.lone_boxes) == (0, 0, 1, 0)
    assert judge_pairs([replace(wrong, car=NONE, box=NONE, residual_px=np.zeros(0))], known, Offset(0, 0)).pairs == 0


def test_a_camera_has_a_row_for_each_choice_of_extrinsics() -> None:
    off = Offset(30.0, 2.5)
    told = Associated(off, 4.25, pairs=8, right=6, found=5, lone_cars=2, lone_boxes=1, residual_px=12.34)
    camera = CameraResult("left", 20, 10, 9, dict.fromkeys((CALIBRATED, CORRECTED, EXACT), told), True)
    intervals = 9
    arms = ("first suite alone", "three suites as calibrated", "three suites registered")
    found: dict[str, tuple[int, ...]] = dict.fromkeys(arms, (0,) * intervals)
    ranges: dict[str, float] = dict.fromkeys(arms, 0.0)
    result = Fig4((), (0,) * intervals, found, ranges, (camera,), provenance())
    rows = fig4_tables(result)["cameras"].splitlines()
    assert len(rows) == 2 + 3
    assert rows[2] == "| left | as calibrated | 30 cm, 2.50° | 4.2 | 10 | 9 | 5 (0.50) | 8 | 6 (0.75) | 2 | 1 | 12.3 |"
    assert "of 10 cars 5 are rightly associated as calibrated, off by 2.50 degrees" in result.sentences()[-1]
    assert Fig4.from_json(result.as_json(), "x") == result
    moving = replace(result, cameras=(replace(camera, settled=False),))
    assert [each.sentences()[-1].endswith("; the pairs had not settled") for each in (result, moving)] == [False, True]
