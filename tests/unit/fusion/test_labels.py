from dataclasses import replace

import numpy as np

from flcav.fusion.labels import label_sample
from flcav.fusion.road import RoadView, build_road_view, label_ideally
from flcav.geometry import Boxes, pose, transform_points
from flcav.perception.objects.model import second_tiny
from flcav.sensors.frame import Annotations, Calibration, Frame
from flcav.world.map.relief import Relief

CONFIG = second_tiny().config
CAR = (4.4, 1.8, 1.6)
SEEN, MISSED, HIDDEN, GHOST, TRUCK = (15.0, 4.0), (20.0, -6.0), (35.0, 8.0), (28.0, -10.0), (10.0, -12.0)


def boxes(*places, category="car", z=0.8):
    rows = [[x, y, z, *CAR, 0.1] for x, y in places]
    return Boxes.from_array(np.array(rows).reshape(-1, 7), category)


def shell(place, count, rng, height=1.0):
    """Returns from an upright patch inside a car's box, world frame."""
    xyz = np.c_[rng.uniform(-0.8, 0.8, (count, 2)), rng.uniform(0.4, height, count)]
    return xyz + np.array((*place, 0.0))


def ground(x, y, step=0.3):
    grid = np.stack(
        np.meshgrid(np.arange(x[0], x[1], step), np.arange(y[0], y[1], step), indexing="ij"), axis=-1
    ).reshape(-1, 2)
    return np.c_[grid, np.zeros(len(grid))]


def frame(agent, world_from_agent, mount_z, points, actors, returns):
    agent_from_lidar = pose(0, 0, mount_z)
    lidar = points - (world_from_agent @ agent_from_lidar)[:3, 3]  # no rotation in these scenes
    sweep = np.c_[lidar, np.full(len(lidar), 0.3)].astype(np.float32)
    n = len(actors)
    truth = Annotations(
        np.array([f"veh{i}" for i in range(n)]),
        actors,
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        np.array(returns),
        np.zeros(n),
    )
    mounts = Calibration({"lidar": agent_from_lidar})
    return Frame("s", 0, 0.0, agent, world_from_agent, mounts, mounts, {"lidar": sweep}, truth)


def scene():
    rng = np.random.default_rng(0)
    actors = Boxes.from_array(
        np.array([[x, y, 0.8, *CAR, 0.1] for x, y in (SEEN, MISSED, HIDDEN, TRUCK)]), ["car", "van", "car", "truck"]
    )
    hit_by_ego = [shell(SEEN, 40, rng), shell(MISSED, 12, rng), shell(GHOST, 20, rng), shell(TRUCK, 30, rng)]
    ego = frame(
        "cav0", pose(0, 0), 1.8, np.concatenate([*hit_by_ego, ground((2, 8), (-5, 5))]), actors, [40, 12, 0, 30]
    )
    hit_by_road = [shell(place, 30, rng) for place in (SEEN, MISSED, HIDDEN, TRUCK)]
    floor = ground((18, 45), (-20, 20))
    away = np.linalg.norm(floor[:, None, :2] - actors.center[None, :, :2], axis=-1).min(axis=1) > 3
    road = frame("pole1", pose(30, 0, 6), 0.0, np.concatenate([*hit_by_road, floor[away]]), actors, [30, 30, 30, 30])
    detections = boxes(SEEN, GHOST, category="Car", z=-1.0)
    detections = Boxes(detections.center, detections.size, detections.yaw, detections.label, np.array([0.9, 0.8]))
    return ego, road, detections


def ideal_view(road):
    return build_road_view(road, label_ideally(road))


def near(found, place):
    return bool((np.hypot(*(found.center[:, :2] - place).T) < 0.5).any())


def test_without_a_road_sensor_the_labels_are_the_vehicles_own():
    ego, _, detections = scene()
    sample = label_sample(ego, detections, [], CONFIG)
    assert len(sample.boxes) == 2
    assert near(sample.boxes, SEEN)
    assert near(sample.boxes, GHOST)
    assert not len(sample.ignore)
    assert sample.free is not None
    assert sample.free[:, 0].max() < 9  # free ground only where the vehicle saw it


def test_the_road_adds_what_was_missed_and_drops_what_it_did_not_see():
    ego, road, detections = scene()
    sample = label_sample(ego, detections, [ideal_view(road)], CONFIG)
    assert near(sample.boxes, SEEN)
    assert near(sample.boxes, MISSED)
    assert not near(sample.boxes, GHOST)
    assert len(sample.boxes) == 2
    assert set(sample.boxes.label) == {"Car"}
    np.testing.assert_allclose(sample.boxes.center[:, 2], -1.0, atol=1e-9)  # in the vehicle's LiDAR frame


def test_road_labels_without_a_return_from_the_vehicle_and_trucks_are_ignored():
    ego, road, detections = scene()
    sample = label_sample(ego, detections, [ideal_view(road)], CONFIG)
    assert near(sample.ignore, HIDDEN)
    assert near(sample.ignore, TRUCK)
    assert len(sample.ignore) == 2


def test_what_nobody_saw_is_not_known_to_be_free():
    ego, road, detections = scene()
    free = label_sample(ego, detections, [ideal_view(road)], CONFIG).free
    assert free is not None
    known = {(round(float(x), 1), round(float(y), 1)) for x, y in free}
    assert any(abs(x - 40) < 1 and abs(y + 15) < 1 for x, y in known)  # only the road saw this ground
    assert not any(10 < x < 17 and 10 < y < 20 for x, y in known)


def test_two_poles_that_label_one_car_give_one_label():
    ego, road, detections = scene()
    view = ideal_view(road)
    once, twice = (label_sample(ego, detections, views, CONFIG) for views in ([view], [view, view]))
    assert len(once.boxes) == len(twice.boxes)


def test_an_ideal_detector_labels_what_its_own_lidar_has_ten_returns_from():
    _, road, _ = scene()
    truth = road.annotations
    fewer = replace(truth, returns=np.array([9, 10, 0, 30]))
    view = ideal_view(replace(road, annotations=fewer))
    assert list(view.boxes.label) == ["van", "truck"]


def test_on_a_slope_the_labels_are_those_of_the_level():
    ego, road, detections = scene()
    corners = np.array([[-200.0, -200], [200, -200], [200, 200], [-200, 200]])
    slope = Relief(np.column_stack((corners, 4 + corners @ (0.06, -0.03))))

    def lift(each):  # upright sensors at another height, whose points follow the slope
        world = transform_points(each.world_from_sensor("lidar"), each.lidar["lidar"][:, :3].astype(np.float64))
        rise = slope.heights(*world[:, :2].T)
        base = slope.heights(*each.world_from_agent[:2, 3])
        points = each.lidar["lidar"].copy()
        points[:, 2] += rise - base
        moved = each.world_from_agent.copy()
        moved[2, 3] += base
        return replace(each, world_from_agent=moved, lidar={"lidar": points})

    level = build_road_view(road, label_ideally(road))
    view = build_road_view(lift(road), label_ideally(road), relief=slope)
    np.testing.assert_array_equal(view.ground, level.ground)
    np.testing.assert_array_equal(view.occupied, level.occupied)
    assert not np.array_equal(build_road_view(lift(road), label_ideally(road)).ground, level.ground)
    wanted = label_sample(ego, detections, [], CONFIG)
    found = label_sample(lift(ego), detections, [], CONFIG, relief=slope)
    assert wanted.free is not None
    assert found.free is not None
    np.testing.assert_array_equal(found.free, wanted.free)


def test_a_view_answers_outside_its_grid_and_weighs_what_it_sends():
    view = RoadView(boxes(SEEN), np.zeros(2), np.ones((4, 4), bool), np.zeros((4, 4), bool))
    np.testing.assert_array_equal(view.at(view.ground, np.array([[0.1, 0.1], [-1, 0], [9, 9]])), [True, False, False])
    assert 7 * 4 < len(view.message()) < 1000


def test_a_vehicle_labels_by_the_message_as_by_the_view():
    ego, road, detections = scene()
    view = build_road_view(road, label_ideally(road))
    told = RoadView.from_message(view.message())
    assert (told.ground.shape, told.ground.sum()) == (view.ground.shape, view.ground.sum())
    assert told.ground.size % 8  # packed bits end within a byte
    one, other = (label_sample(ego, detections, [each], CONFIG) for each in (view, told))
    assert np.array_equal(one.boxes.array(), other.boxes.array())
    assert one.boxes.label.tolist() == other.boxes.label.tolist()
    assert np.array_equal(one.ignore.array(), other.ignore.array())
    assert one.free is not None
    assert other.free is not None
    assert np.array_equal(one.free, other.free)


def test_beside_a_road_sensor_only_its_boxes_are_to_be_learned_exactly():
    ego, road, detections = scene()
    unseen = RoadView(Boxes.empty(), np.array([500.0, 500.0]), np.zeros((1, 1), bool), np.zeros((1, 1), bool))
    alone, helped, beside = (label_sample(ego, detections, v, CONFIG) for v in ([], [ideal_view(road)], [unseen]))
    assert alone.exact is None  # its own boxes are all there is
    assert helped.exact is not None
    assert helped.exact.all()  # both objects that the vehicle sees are labelled by the road
    assert beside.exact is not None
    assert not beside.exact.any()
