"""Labels by the road average on made-up scenes: what is kept, what is dropped, and where ground is known to be free."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flcav.config import InputError, parse_config
from flcav.fusion.average import YAW, Navigation, NavigationErrors, Sighting
from flcav.fusion.distillation import (
    Distillation,
    Guidance,
    average_spin,
    build_context,
    distil_sample,
    pack_sighting,
    place_in,
    share_of_free_ground,
    unpack_sighting,
)
from flcav.fusion.road import RoadView
from flcav.geometry import Boxes, concatenate, inverse, pose
from flcav.network.ledger import BudgetExceeded, Ledger, LinkMegabytes
from flcav.perception.objects.model import second_tiny
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.truth import FrameTruth
from flcav.perception.weights import to_arrays
from flcav.runs.extras.distillation import labelling as road_average
from flcav.runs.extras.distillation.labelling import RoadAverageLabels
from flcav.runs.frames import Frames
from flcav.runs.labels import quality
from flcav.runs.labels.quality import measure_labels, read_label_history
from flcav.runs.recipe import CLOUD, EDGE
from flcav.runs.results.training import FoundTargets
from flcav.runs.stages.regions import Labelling
from flcav.runs.stages.settings import RegionInputs
from flcav.sensors.frame import Annotations, Calibration, Frame
from flcav.world.map.layers import MapLane, MapLayers

CONFIG = second_tiny().config
ACCURATE = Navigation(0.01, 0.001)
GRID = RegionInputs(region="grid", plan="", pretrain="", frames="", place="", group_range_m=0.0, recorded=False)
BOTH, ROAD_ALONE, OUT_OF_SIGHT, GHOST, UNSURE = (12.0, 3.0), (20.0, -6.0), (30.0, 15.0), (25.0, 4.0), (35.0, 16.0)


def boxes(
    *places: tuple[float, float], label: str = "Car", score: float = 0.9, sd: float = 0.2, z: float = 0.8
) -> Boxes:
    rows = [(x, y, z, 4.4, 1.8, 1.6, 0.0) for x, y in places]
    found = Boxes.from_array(np.array(rows).reshape(-1, 7), label, np.full(len(rows), score))
    return replace(found, variance=np.full((len(rows), 7), sd**2))


def view(found: Boxes) -> RoadView:
    """Return a view of free ground at y < 10, but within 3 m of a box."""
    x, y = np.meshgrid(np.arange(0.2, 48, 0.4), np.arange(-23.8, 24, 0.4), indexing="ij")
    away = np.array([np.hypot(x - a, y - b) > 3 for a, b in found.center[:, :2]]).all(axis=0)
    return RoadView(found, np.array([0.0, -24.0]), (y < 10) & away, np.zeros(x.shape, bool))


def spin(world_from_vehicle: np.ndarray | None = None) -> tuple[list[Sighting], RoadView]:
    at = np.eye(4) if world_from_vehicle is None else world_from_vehicle
    sure, unsure = boxes(BOTH, OUT_OF_SIGHT, GHOST), boxes(UNSURE, score=0.3)
    told = concatenate([sure, unsure]).transform(inverse(at))
    vehicle = Sighting("cav0", 1.0, at, told, navigation=ACCURATE)
    seen = concatenate([boxes(BOTH, ROAD_ALONE, label="van", sd=0.1), boxes((8.0, -12.0), label="bus")])
    return [vehicle, Sighting("pole 0", 1.0, np.eye(4), seen)], view(seen)


def lane_through(place: tuple[float, float], yaw: float) -> MapLayers:
    """Return the map of one lane, 16 m along `yaw`, with `place` in its middle."""
    line = np.array(place) + np.array([[-8.0], [8.0]]) * (np.cos(yaw), np.sin(yaw))
    return MapLayers((), (), (MapLane("l", "driving", line, 3.5, 13.9, "", "", "", ()),), (), (), ())


def near(found: Boxes, place: tuple[float, float]) -> bool:
    return bool((np.hypot(*(found.center[:, :2] - place).T) < 0.5).any())


def test_the_average_has_what_the_road_sees_and_what_it_cannot_see_but_a_vehicle_is_sure_of() -> None:
    sightings, seen = spin()
    (guidance,) = average_spin(sightings, [seen], CONFIG, threshold=0.6)
    cars = guidance.boxes[guidance.boxes.label == "Car"]
    assert len(cars) == 3
    assert all(near(cars, place) for place in (BOTH, ROAD_ALONE, OUT_OF_SIGHT))  # not GHOST: free; not UNSURE
    sure = guidance.boxes[guidance.confirmed]
    assert near(sure, BOTH)
    assert near(sure, ROAD_ALONE)
    assert not near(sure, OUT_OF_SIGHT)
    assert guidance.boxes.label[guidance.boxes.label != "Car"].tolist() == ["bus"]
    (lower,) = average_spin(sightings, [seen], CONFIG, threshold=0.25)
    assert near(lower.boxes, UNSURE)
    assert not near(lower.boxes, GHOST)
    (blind,) = average_spin(sightings[:1], [], CONFIG, threshold=0.6)
    assert near(blind.boxes, GHOST)  # nobody saw that the ground is free


def test_two_vehicles_confirm_an_object_that_each_is_sure_of() -> None:
    def told(*scores: float, threshold: float) -> list[list[bool]]:
        seen = [
            Sighting(f"cav{n}", 1.0, np.eye(4), boxes(UNSURE, score=score), navigation=ACCURATE)
            for n, score in enumerate(scores)
        ]
        return [each.confirmed.tolist() for each in average_spin(seen, [], CONFIG, threshold)]

    assert told(0.5, threshold=0.6) == [[]]
    assert told(0.5, 0.5, threshold=0.4) == [[True], [True]]
    assert told(0.5, 0.5, threshold=0.6) == [[False], [False]]  # 1 - .5 * .5 is no probability: both run one network
    assert told(0.9, 0.5, threshold=0.6) == [[False], [False]]
    assert told(0.9, 0.5, 0.8, threshold=0.6) == [[True]] * 3


def test_nobody_tells_of_anything_and_that_is_an_average_too() -> None:
    nothing = Sighting("cav0", 1.0, np.eye(4), Boxes.empty(), navigation=ACCURATE)
    pole = Sighting("pole 0", 1.0, np.eye(4), Boxes.empty())
    (guidance,) = average_spin([nothing, pole], [view(Boxes.empty())], CONFIG, 0.5)
    assert not len(Guidance.from_message(guidance.message()).boxes)


def test_a_reversed_label_is_turned_by_the_lane_it_is_on() -> None:
    told = replace(boxes(BOTH, ROAD_ALONE), yaw=np.full(2, np.pi - 0.1))
    sightings = [
        Sighting("cav0", 1.0, np.eye(4), told, navigation=ACCURATE),
        Sighting("pole 0", 1.0, np.eye(4), replace(told, label=np.full(2, "car"))),
    ]
    (as_told,) = average_spin(sightings, [], CONFIG, 0.6)
    np.testing.assert_allclose(as_told.boxes.yaw, np.pi - 0.1, atol=1e-6)
    (turned,) = average_spin(sightings, [], CONFIG, 0.6, context=build_context(lane_through(BOTH, 0.0)))
    on_lane = np.hypot(*(turned.boxes.center[:, :2] - BOTH).T) < 0.5
    assert abs(turned.boxes.yaw[on_lane]) < 0.1  # between the lane's heading and what was told of the axis
    np.testing.assert_allclose(turned.boxes.yaw[~on_lane], np.pi - 0.1, atol=1e-6)
    assert turned.boxes.variance is not None
    assert as_told.boxes.variance is not None
    assert turned.boxes.variance[on_lane, YAW] < as_told.boxes.variance[on_lane, YAW]


def test_a_pose_graph_places_a_vehicle_by_what_it_and_the_road_see() -> None:
    pytest.importorskip("gtsam")
    both = boxes((12.0, 3.0), (20.0, -6.0), (30.0, 9.0), sd=0.05)
    off = pose(0.6, -0.5)  # by its navigation; it is at the origin
    seen = Sighting("cav0", 1.0, off, both, navigation=Navigation(0.6, 0.01))
    sightings = [seen, Sighting("pole 0", 1.0, np.eye(4), replace(both, label=np.full(3, "car")))]
    (guidance,) = average_spin(sightings, [], CONFIG, 0.5, posts=np.zeros((0, 2)))
    assert np.hypot(*guidance.world_from_agent[:2, 3]) < 0.2
    (told,) = average_spin(sightings, [], CONFIG, 0.5)
    error = [np.linalg.norm(g.boxes.center[:, :2] - both.center[:, :2], axis=1).max() for g in (guidance, told)]
    assert error[0] < 0.3 < error[1]


def test_a_pose_adds_its_uncertainty_across_the_line_of_sight() -> None:
    seen = Sighting("cav0", 0.0, pose(10, 0), Boxes.empty(), navigation=Navigation(0.3, 0.02))
    placed = place_in(boxes((50.0, 0.0), sd=0.1), np.ones(1, dtype=bool), seen).boxes
    np.testing.assert_allclose(placed.center[0, :2], (40.0, 0.0))
    assert placed.variance is not None
    wanted = [0.01 + 0.09, 0.01 + 0.09 + (40 * 0.02) ** 2, 0.01, 0.01, 0.01, 0.01, 0.01 + 0.02**2]
    np.testing.assert_allclose(placed.variance[0], wanted)


def test_guidance_is_in_the_frame_of_the_pose_that_the_vehicle_told() -> None:
    at = pose(3.0, -2.0, 0.0, 0.4)
    sightings, seen = spin(at)
    (guidance,) = average_spin(sightings, [seen], CONFIG, 0.6)
    assert near(guidance.boxes.transform(at), ROAD_ALONE)
    np.testing.assert_array_equal(guidance.world_from_agent, at)


def test_messages_keep_boxes_in_single_precision_and_weigh_little() -> None:
    sightings, seen = spin()
    message = pack_sighting(sightings[0])
    back = unpack_sighting("cav0", message)
    np.testing.assert_allclose(back.boxes.array(), sightings[0].boxes.array(), rtol=1e-6)
    assert (back.time_s, back.navigation, back.agent) == (1.0, ACCURATE, "cav0")
    assert back.boxes.variance is not None
    np.testing.assert_allclose(back.boxes.variance, np.full((4, 7), 0.2**2), rtol=1e-6)
    (guidance,) = average_spin(sightings, [seen], CONFIG, 0.6)
    told = guidance.message()
    again = Guidance.from_message(told)
    np.testing.assert_allclose(again.boxes.array(), guidance.boxes.array(), rtol=1e-6, atol=1e-6)
    assert again.boxes.label.tolist() == guidance.boxes.label.tolist()
    assert again.confirmed.tolist() == guidance.confirmed.tolist()
    rows = 15 * 4  # bytes of a box: seven numbers, a score, seven variances
    for sent in (message, told):  # both have four boxes; the rest are a pose and names
        assert 4 * rows < len(sent) < 4 * rows + 700


def frame(places: list[tuple[float, float]]) -> Frame:
    """Return a vehicle's frame at the origin whose LiDAR, 1.8 m up, has returns from cars at `places`."""
    rng = np.random.default_rng(0)
    hits = [np.c_[rng.uniform(-0.8, 0.8, (30, 2)) + place, rng.uniform(-1.4, -0.4, 30)] for place in places]
    sweep = np.c_[np.concatenate(hits), np.full(30 * len(places), 0.3)].astype(np.float32)
    still, none = np.zeros((0, 3)), np.zeros(0)
    nothing = Annotations(np.zeros(0, np.str_), Boxes.empty(), still, still, np.zeros(0, np.int64), none)
    mounts = Calibration({"lidar": pose(0, 0, 1.8)})
    return Frame("s", 0, 0.0, "cav0", np.eye(4), mounts, mounts, {"lidar": sweep}, nothing)


def test_a_vehicle_learns_boxes_it_has_returns_from_and_negatives_from_the_road_alone() -> None:
    sightings, seen = spin()
    (guidance,) = average_spin(sightings, [seen], CONFIG, 0.6)
    own = boxes(BOTH, GHOST, z=-1.0)
    sample = distil_sample(frame([BOTH, OUT_OF_SIGHT, GHOST]), own, guidance, [seen], CONFIG, "lidar")
    assert len(sample.boxes) == 1
    assert near(sample.boxes, BOTH)
    assert near(sample.ignore, OUT_OF_SIGHT)  # not unlearned, since the road could not see it, nor confirmed by itself
    np.testing.assert_allclose(sample.boxes.center[:, 2], -1.0, atol=1e-6)
    assert near(sample.ignore, ROAD_ALONE)  # without a return of the vehicle
    assert near(sample.ignore, (8.0, -12.0))  # a bus
    assert sample.own is own
    assert sample.free is not None
    assert sample.free[:, 1].max() < 10  # beyond, nobody knows
    free = {(round(float(x), 1), round(float(y), 1)) for x, y in sample.free}
    assert any(np.hypot(x - GHOST[0], y - GHOST[1]) < 0.5 for x, y in free)  # the false detection is unlearned
    without = distil_sample(frame([BOTH]), own, guidance, [], CONFIG, "lidar")
    assert without.free is not None
    assert not len(without.free)


def test_the_share_of_free_ground_is_that_of_the_turned_footprint() -> None:
    seen = RoadView(Boxes.empty(), np.zeros(2), np.ones((25, 25), bool), np.zeros((25, 25), bool))  # 10 m x 10 m
    found = boxes((5.0, 5.0), (10.0, 5.0), (15.0, 5.0))
    np.testing.assert_allclose(share_of_free_ground(found, [seen]), [1, 0.5, 0])
    turned = replace(found, yaw=np.full(3, np.pi / 2))
    np.testing.assert_allclose(share_of_free_ground(turned, [seen]), [1, 0.5, 0])
    assert not share_of_free_ground(found, []).any()
    assert not len(share_of_free_ground(Boxes.empty(), [seen]))


def test_precision_and_recall_of_labels_count_targets_once_and_neutral_ones_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    truth = FrameTruth("s", boxes((10, 0), (20, 0), (30, 0), z=-1.0), boxes((40, 0), z=-1.0), Boxes.empty())
    truth = replace(truth, returns=np.array([19, 20, 500]))
    keys = [SimpleNamespace(agent="cav1"), SimpleNamespace(agent="cav0")]
    data = SimpleNamespace(keys=keys, frame=lambda i: frame([BOTH]))
    monkeypatch.setattr(quality, "asked_of", lambda frame, config: truth)
    points = np.zeros((0, 4), np.float32)
    first = Sample(points, boxes((10, 0), (20.3, 0), (40, 0), z=-1.0))  # two right, one on a neutral object
    second = Sample(points, boxes((10, 0), (10.1, 0), (25, 9), z=-1.0))  # one right, one twice, one wrong
    split = Frames(cast(Any, data), (0, 1), {})
    found = measure_labels(3, split, (0, 1), "grid", {"grid/cav0": [first], "grid/cav1": [second]}, CONFIG)
    assert (found.round, found.labels, found.targets) == (3, 5, 6)
    assert (found.precision, found.recall) == (pytest.approx(3 / 5), pytest.approx(3 / 6))
    assert (found.tight, found.size_m) == (pytest.approx(3 / 3), 0)  # .3 m along 4 m or more: IoU above .7
    assert found.offset_m == 0  # the median of 0, 0 and .3
    assert found.by_returns == (FoundTargets(5, 2, 2), FoundTargets(20, 2, 1), FoundTargets(100, 2, 0))
    low = Sample(points, replace(boxes((10.5, 0), z=-1.0), size=boxes((10.5, 0)).size - (0, 0, 0.4)))
    worse = measure_labels(3, split, (0, 1), "grid", {"grid/cav0": [low], "grid/cav1": [low]}, CONFIG)
    assert (worse.tight, worse.offset_m, worse.size_m) == (0, pytest.approx(0.5), pytest.approx(0.4))
    nothing = Sample(points, Boxes.empty())
    none = measure_labels(1, split, (0, 1), "grid", {"grid/cav0": [nothing], "grid/cav1": [nothing]}, CONFIG)
    assert (none.precision, none.recall) == (None, 0.0)
    assert none.tight is none.offset_m is none.size_m is None


def test_navigation_is_off_by_what_it_states() -> None:
    how = NavigationErrors(position_m=0.4, heading_deg=2.0)
    at = pose(100.0, -50.0, 0.0, 1.0)
    rng = np.random.default_rng(0)
    known = np.array([how.navigate(at, rng) for _ in range(2000)])
    np.testing.assert_allclose(known[:, :2, 3].std(axis=0), 0.4, rtol=0.1)
    turned = np.degrees(np.arctan2(known[:, 1, 0], known[:, 0, 0]) - 1.0)
    assert turned.std() == pytest.approx(2.0, rel=0.1)
    assert how.stated == Navigation(0.4, np.radians(2.0))
    exact = NavigationErrors()
    np.testing.assert_allclose(exact.navigate(at, rng), at)
    assert exact.stated.position_m == 0.01


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"terms": []}, "terms"),
        ({"terms": ["outputs"]}, "terms"),
        ({"temperature": 0}, "temperature"),
    ],
)
def test_settings_that_mean_nothing_are_refused(fields: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        parse_config(Distillation, fields, "distillation")


def test_each_round_sends_boxes_up_and_averages_down_and_labels_anew(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen = view(boxes(BOTH, ROAD_ALONE, label="car", sd=0.1))
    keys = [SimpleNamespace(scene="s", index=0, agent=f"cav{n}", time_s=0.0) for n in (1, 0)]
    spins = [frame([BOTH]), frame([BOTH, OUT_OF_SIGHT])]
    manifest = SimpleNamespace(recipe={"seed": 1})
    about = {"frame": lambda i: spins[i], "world_from_agent": lambda i: spins[i].world_from_agent}
    data = SimpleNamespace(keys=keys, manifest=manifest, town=lambda: "town", **about)
    monkeypatch.setattr(road_average, "map_layers", lambda town: lane_through(BOTH, np.pi))
    found = [boxes(BOTH, z=-1.0), boxes(BOTH, OUT_OF_SIGHT, z=-1.0)]
    monkeypatch.setattr(road_average, "road_views", lambda *about: {("s", 0): {3: seen}})
    seen_cars = {len(each.lidar["lidar"]): told for each, told in zip(spins, found, strict=True)}

    def detections(network, frames, **how):
        return [seen_cars[len(frames[0].lidar["lidar"])]]

    monkeypatch.setattr("flcav.runs.labels.sightings.detect_in", detections)
    truth = FrameTruth("s", boxes(BOTH, z=-1.0), Boxes.empty(), Boxes.empty())
    monkeypatch.setattr(quality, "asked_of", lambda frame, config: truth)
    how, errors = Distillation(), NavigationErrors(position_m=0.05, heading_deg=0.1)
    split = Frames(cast(Any, data), (0, 1), {})
    book, weights = Ledger(LinkMegabytes(1.0, 0.0)), to_arrays(second_tiny())
    about = Labelling(split, (0, 1), (3,), CONFIG, 0.6, GRID, book, EDGE)
    given: list[Any] = []

    def distil(*arguments: Any) -> Sample:
        given.append(arguments[3])
        return distil_sample(*arguments)

    monkeypatch.setattr(road_average, "distil_sample", distil)
    labels = RoadAverageLabels(how, errors, about, tmp_path)
    labels.send_views()
    assert {entry.bytes for entry in book.entries} == {len(seen.message())}
    assert [(entry.direction, entry.round) for entry in book.entries] == [("down", 0)] * 2
    own = labels["grid/cav0"]
    labels.renew(1, weights)
    assert [[view.message() for view in views] for views in given] == [[seen.message()]] * 2, "for the free ground"
    assert sorted(labels) == ["grid/cav0", "grid/cav1"]
    assert labels["grid/cav0"] is own  # a client holds it
    assert near(own[0].boxes, BOTH)
    assert np.abs(own[0].boxes.yaw) == pytest.approx(np.pi, abs=0.05)  # as the lane leads
    assert near(own[0].ignore, OUT_OF_SIGHT)
    sent = book.entries[2:]
    assert [(e.direction, e.client) for e in sent] == [(d, f"grid/cav{n}") for d in ("up", "down") for n in (1, 0)]
    assert {(e.stage, e.task, e.link, e.round) for e in sent} == {("edge", "objects", "wireless", 1)}
    assert abs(sent[1].bytes - sent[0].bytes - 15 * 4 - len("Car\n")) <= 8  # one box more, and padding of the header
    labels.renew(2, weights)
    labels.renew(2, weights)  # as after a stop
    history = read_label_history(tmp_path).rounds
    assert [(each.round, each.precision, each.recall) for each in history] == [(1, 1.0, 1.0), (2, 1.0, 1.0)]
    later = Ledger(LinkMegabytes(1.0, 0.0))
    last = RoadAverageLabels(how, errors, replace(about, book=later, stage=CLOUD))
    last.renew(1, weights)
    assert [replace(entry, stage="edge") for entry in later.entries] == list(sent)  # the same messages
    assert {entry.stage for entry in later.entries} == {"cloud"}
    np.testing.assert_array_equal(last["grid/cav0"][0].boxes.array(), own[0].boxes.array())
    assert read_label_history(tmp_path).rounds == history
    mapless, unused = how.model_copy(update={"map_context": False}), Ledger(LinkMegabytes(1.0, 0.0))
    as_told = RoadAverageLabels(mapless, errors, replace(about, book=unused, stage=CLOUD))
    as_told.renew(1, weights)
    assert as_told["grid/cav0"][0].boxes.yaw == pytest.approx(0, abs=0.05)
    with pytest.raises(BudgetExceeded, match="wireless uplink budget exceeded: grid/cav1"):
        RoadAverageLabels(how, errors, replace(about, book=Ledger(LinkMegabytes(1e-4, 0.0)))).renew(3, weights)
