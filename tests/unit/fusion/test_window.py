"""The road average over a window of spins: surer and more exact than of one spin, and moved along with its objects."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flcav.fusion.average import Navigation, NavigationErrors, Sighting
from flcav.fusion.distillation import Distillation, Guidance, average_spin
from flcav.fusion.road import RoadView
from flcav.geometry import Boxes, inverse, pose, transform_points
from flcav.interface.progress import ignore_progress
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.objects.model import second_tiny
from flcav.perception.weights import to_arrays
from flcav.runs.extras.distillation import labelling as road_average
from flcav.runs.extras.distillation.labelling import RoadAverageLabels
from flcav.runs.frames import Frames, list_window
from flcav.runs.labels import pseudo_labels, sightings
from flcav.runs.labels.pseudo_labels import label_detected, label_frames
from flcav.runs.recipe import EDGE
from flcav.runs.stages.regions import Labelling
from flcav.runs.stages.settings import RegionInputs
from flcav.sensors.frame import Annotations, Calibration, Frame

CONFIG = second_tiny().config
ACCURATE = Navigation(0.01, 0.001)
GRID = RegionInputs(region="grid", plan="", pretrain="", frames="", place="", group_range_m=0.0, recorded=False)
PLACE, HIDDEN = (15.0, 4.0), (20.0, -6.0)
SPEED_MPS = 10.0


def car(x: float, y: float, sd: float = 0.3, z: float = 0.8, label: str = "Car") -> Boxes:
    box = Boxes.from_array(np.array([(x, y, z, 4.4, 1.8, 1.6, 0.0)]), label, np.array([0.9]))
    return replace(box, variance=np.full((1, 7), sd**2))


def vehicle(agent: str, time_s: float, boxes: Boxes) -> Sighting:
    return Sighting(agent, time_s, np.eye(4), boxes, navigation=ACCURATE)


def pole(time_s: float, boxes: Boxes) -> Sighting:
    return Sighting("pole 3", time_s, np.eye(4), boxes)


def variance(told: Guidance) -> np.ndarray:
    assert told.boxes.variance is not None
    return told.boxes.variance[0]


def test_a_box_of_a_window_is_nearer_the_object_than_that_of_one_spin() -> None:
    rng, off_m = np.random.default_rng(0), {}
    for _ in range(100):
        told = {
            (agent, time_s): vehicle(agent, time_s, car(*(PLACE + rng.normal(0, 0.3, 2))))
            for agent in ("cav0", "cav1")
            for time_s in (-0.5, 0.0, 0.5)
        }
        middle = [each for (_, time_s), each in told.items() if time_s == 0]
        around = [each for (_, time_s), each in told.items() if time_s != 0]
        for name, more in (("spin", []), ("window", around)):
            box = average_spin(middle, [], CONFIG, 0.5, around=more)[0].boxes
            off_m.setdefault(name, []).append(np.linalg.norm(box.center[0, :2] - PLACE))
    one, window = (np.sqrt(np.mean(np.square(off_m[name]))) for name in ("spin", "window"))
    assert one == pytest.approx(0.3, rel=0.15)  # two dimensions, the mean of two vehicles
    assert window < 0.7 * one  # of six boxes


def test_a_box_of_a_window_is_surer_where_other_agents_or_surer_boxes_are_in_it() -> None:
    middle = [vehicle("cav0", 0.0, car(*PLACE, sd=0.4)), pole(0.0, Boxes.empty())]
    nearer = [vehicle("cav0", 0.5, car(*PLACE, sd=0.2))]
    seen = [pole(time_s, car(*PLACE, sd=0.2, label="car")) for time_s in (-0.5, 0.5)]
    (spin,), (window,), (both,) = (average_spin(middle, [], CONFIG, 0.5, around=more) for more in ([], nearer, seen))
    assert (variance(window) < 0.6 * variance(spin)).all()
    assert (variance(both) < 0.3 * variance(spin)).all()
    assert (spin.confirmed.tolist(), both.confirmed.tolist()) == ([False], [True])  # the road has it in two spins of 3
    (repeated,) = average_spin(middle, [], CONFIG, 0.5, around=[replace(middle[0], time_s=0.5)])
    assert (variance(repeated)[2:] >= 0.99 * variance(spin)[2:]).all()  # nobody is surer by repeating


def test_a_moving_object_is_moved_to_the_time_of_the_vehicle_s_frame() -> None:
    def at(time_s: float) -> Boxes:
        return car(SPEED_MPS * time_s + PLACE[0], PLACE[1], sd=0.1, label="car")

    seen = [pole(time_s, at(time_s)) for time_s in (-0.5, -0.3)]
    hidden = [pole(0.0, Boxes.empty()), vehicle("cav0", 0.0, Boxes.empty()), vehicle("cav1", 0.1, Boxes.empty())]
    now, later = average_spin(hidden, [], CONFIG, 0.5, around=seen)
    assert (now.confirmed.tolist(), later.confirmed.tolist()) == ([True], [True])
    np.testing.assert_allclose(now.boxes.center[0, :2], PLACE, atol=0.2)  # it was last seen 3 m before
    np.testing.assert_allclose(later.boxes.center[0, :2], (PLACE[0] + 0.1 * SPEED_MPS, PLACE[1]), atol=0.3)
    assert not len(average_spin(hidden, [], CONFIG, 0.5)[0].boxes)


def test_what_the_road_has_in_less_than_half_of_its_spins_is_confirmed_by_nobody() -> None:
    own = [vehicle("cav0", time_s, car(*PLACE)) for time_s in (0.0, -0.5, 0.5)]
    for spins, confirmed in ((1, False), (2, True)):
        road = [pole(t, car(*PLACE, label="car") if n < spins else Boxes.empty()) for n, t in enumerate((-0.5, 0.5, 0))]
        (told,) = average_spin([own[0], road[2]], [], CONFIG, 0.5, around=[*own[1:], *road[:2]])
        assert told.confirmed.tolist() == [confirmed]


def test_a_vehicle_is_sure_of_what_it_has_in_the_mean_of_its_spins() -> None:
    middle = [vehicle(agent, 0.0, car(*PLACE)) for agent in ("cav0", "cav1")]
    empty = [vehicle("cav1", time_s, Boxes.empty()) for time_s in (-0.5, 0.5)]
    assert average_spin(middle, [], CONFIG, 0.6)[0].confirmed.tolist() == [True]
    (told, _) = average_spin(middle, [], CONFIG, 0.6, around=empty)
    assert told.confirmed.tolist() == [False]


def frame(key: Any) -> Frame:
    """Return a vehicle's frame at the origin, whose LiDAR, 1.8 m up, has returns from a car at `HIDDEN`."""
    hits = np.c_[np.random.default_rng(0).uniform(-0.8, 0.8, (30, 2)) + HIDDEN, np.full((30, 1), -1.0)]
    still, none = np.zeros((0, 3)), np.zeros(0)
    nothing = Annotations(np.zeros(0, np.str_), Boxes.empty(), still, still, np.zeros(0, np.int64), none)
    mounts = Calibration({"lidar": pose(0, 0, 1.8)})
    sweep = np.c_[hits, np.full(30, 0.3)].astype(np.float32)
    return Frame(key.scene, key.index, key.time_s, key.agent, np.eye(4), mounts, mounts, {"lidar": sweep}, nothing)


def split_of(times_s: tuple[float, ...], middle: tuple[int, ...], scenes: tuple[str, ...] = ("s",)) -> Frames:
    """Return two vehicles' frames of spins at `times_s` in each scene, `middle` of which are for training."""
    keys = [
        SimpleNamespace(scene=scene, index=index, agent=f"cav{n}", time_s=time_s)
        for scene in scenes
        for index, time_s in enumerate(times_s)
        for n in range(2)
    ]
    manifest = SimpleNamespace(recipe={"seed": 1})
    about = {"frame": lambda i: frame(keys[i]), "world_from_agent": lambda i: frame(keys[i]).world_from_agent}
    data = SimpleNamespace(keys=keys, manifest=manifest, town=lambda: None, **about)
    return Frames(cast(Any, data), tuple(i for i, key in enumerate(keys) if key.index in middle), {})


@pytest.mark.parametrize(("window_s", "told", "labelled"), [(0.5, 5 * 2, True), (0.0, 2 * 2, False)])
def test_labels_are_of_windows_and_each_frame_is_sent_once(
    window_s: float, told: int, labelled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    split = split_of((59.5, 60.0, 60.5, 61.0, 61.5), middle=(1, 3))  # the windows share the spin at 60.5
    free, blocked = np.zeros((1, 1), bool), [1, 3]  # spins in which the road sensor cannot see the car
    views = {
        ("s", spin): {
            3: RoadView(Boxes.empty() if spin in blocked else car(*HIDDEN, label="car"), np.zeros(2), free, free)
        }
        for spin in range(5)
    }
    asked: list[Any] = []

    def see(split: Frames, poles: Any, trained: bool, spins: set[tuple[str, int]]) -> dict[Any, Any]:
        asked.extend(sorted(spins))
        return {spin: views[spin] for spin in spins}

    monkeypatch.setattr(road_average, "road_views", see)
    monkeypatch.setattr(sightings, "detect_in", lambda network, frames, **how: [car(*PLACE, z=-1.0)])
    how, errors = Distillation(window_s=window_s), NavigationErrors(position_m=0.05, heading_deg=0.1)
    book = Ledger(LinkMegabytes(1.0, 0.0))
    labels = RoadAverageLabels(how, errors, Labelling(split, split.vehicles, (3,), CONFIG, 0.6, GRID, book, EDGE))
    labels.renew(1, to_arrays(second_tiny()))
    sent = [(each.direction, each.client) for each in book.entries]
    assert (sent.count(("up", "grid/cav0")), sent.count(("up", "grid/cav1"))) == (told / 2, told / 2)
    assert sent.count(("down", "grid/cav0")) == 2
    assert asked == [("s", spin) for spin in (range(5) if window_s else blocked)]
    found = [sample.boxes for name in labels for sample in labels[name]]
    assert len(found) == 4
    for boxes in found:
        assert len(boxes) == labelled  # two of three spins of the road sensor have it; the middle one has not
        assert (np.abs(boxes.center[:, :2] - HIDDEN) < 0.3).all()


def test_a_window_is_of_the_same_vehicle_and_scene_and_no_longer_than_it_is_said() -> None:
    split = split_of((0.0, 0.4, 0.5, 0.9, 1.0), middle=(2,), scenes=("a", "b"))
    first, other = split.vehicles[:2]  # of cav0 and cav1 in the same spin
    near = {window_s: list_window(split, [first], window_s) for window_s in (0.0, 0.1, 0.5)}
    assert [len(each) for each in near.values()] == [1, 2, 5]
    assert {(split.data.keys[i].agent, split.data.keys[i].scene) for i in near[0.5]} == {("cav0", "a")}
    assert list_window(split, [other, first], 0.5) == tuple(range(10))


def test_a_clock_is_off_by_as_much_in_all_spins_of_a_scene_and_posts_are_told_with_a_pose_graph(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    split = split_of((0.0, 0.5, 1.0), middle=(0, 1, 2), scenes=tuple(f"s{n}" for n in range(100)))
    monkeypatch.setattr(sightings, "detect_in", lambda network, frames, **how: [car(*PLACE, z=-1.0)])
    monkeypatch.setattr(sightings, "segment_posts", lambda points, height_m: np.array([(3.0, 4.0)]))

    def off_s(how: Distillation, errors: NavigationErrors) -> np.ndarray:
        told = [sightings.make_sighting(cast(Any, None), split.data, i, how, errors)[0] for i in split.vehicles]
        late = [each.time_s - split.data.keys[i].time_s for i, each in zip(split.vehicles, told, strict=True)]
        assert all(len(each.posts) == how.pose_graph for each in told)
        return np.array(late).reshape(100, 3, 2)  # scenes, spins, vehicles

    late = off_s(Distillation(pose_graph=True), NavigationErrors(clock_s=0.2))
    np.testing.assert_allclose(np.ptp(late, axis=1), 0, atol=1e-9)
    assert late[:, 0].std() == pytest.approx(0.2, rel=0.15)
    assert abs(np.corrcoef(late[:, 0].T)[0, 1]) < 0.3  # each vehicle has its own
    np.testing.assert_allclose(off_s(Distillation(), NavigationErrors()), 0, atol=1e-9)


def test_road_boxes_reach_a_vehicle_s_frame_by_the_pose_that_it_tells_of(monkeypatch: pytest.MonkeyPatch) -> None:
    split = split_of((0.0, 0.5), middle=(0, 1))
    free = np.zeros((1, 1), bool)
    view = RoadView(car(*HIDDEN, label="car"), np.zeros(2), free, free)
    monkeypatch.setattr(pseudo_labels, "road_views", lambda *about: {("s", 0): {3: view}, ("s", 1): {3: view}})
    for module in (pseudo_labels, sightings):
        monkeypatch.setattr(module, "detect_in", lambda network, frames, **how: [Boxes.empty()])
    network = second_tiny()

    def labels(errors: NavigationErrors) -> np.ndarray:
        about = (split, split.vehicles, (3,), "grid", ignore_progress)
        found = label_frames(label_detected(network, 0.6, split), *about, poses=errors)
        return np.concatenate([sample.boxes.center[:, :2] for name in sorted(found) for sample in found[name]])

    np.testing.assert_allclose(labels(NavigationErrors()), np.tile(HIDDEN, (4, 1)), atol=1e-6)
    errors = NavigationErrors(position_m=0.1, heading_deg=0.5)
    told = [sightings.make_sighting(network, split.data, i, Distillation(), errors)[0] for i in split.vehicles]
    known = [each.world_from_agent for each in sorted(told, key=lambda each: each.agent)]
    wanted = [transform_points(inverse(at), np.array([(*HIDDEN, 0.0)]))[0, :2] for at in known]
    np.testing.assert_allclose(labels(errors), wanted, atol=1e-6)
    assert np.linalg.norm(labels(errors) - HIDDEN, axis=1).min() > 0.02
