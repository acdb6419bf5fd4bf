from dataclasses import replace

import numpy as np
import pytest

from flcav.fusion.average import Navigation, Sighting, average_boxes, report_boxes
from flcav.fusion.pose_graph import correct_poses, match_posts, segment_posts
from flcav.geometry import Boxes, inverse, pose, transform_points

pytest.importorskip("gtsam")
STATED = Navigation(0.5, np.radians(2.0))
POSTS = np.array([(12.0, 9.0), (-8.0, 9.0), (25.0, -9.0), (3.0, -9.0)])
VARIANCE = np.full((1, 7), 0.05**2)


def cars(at_s: float) -> Boxes:
    """Six cars, two of which drive at 10 m/s."""
    x = np.array([0.0, 8.0, 16.0, 24.0, -6.0 + 10 * at_s, 30.0 - 10 * at_s])
    rows = np.column_stack((x, [5.0, 5.5, 5.0, 5.5, -2.0, 2.0], np.full(6, 0.8), np.tile((4.4, 1.8, 1.6), (6, 1))))
    yaw = np.array([0, 0, 0, 0, 0, np.pi])
    return Boxes(rows[:, :3], rows[:, 3:6], yaw, np.full(6, "car"), np.full(6, 0.9), np.repeat(VARIANCE, 6, axis=0))


def look(agent: str, world_from_agent: np.ndarray, at_s: float, navigation: Navigation | None, posts=None) -> Sighting:
    own = cars(at_s).transform(inverse(world_from_agent))
    feet = np.zeros((0, 2))
    if posts is not None:
        feet = transform_points(inverse(world_from_agent), np.column_stack((posts, np.zeros(len(posts)))))[:, :2]
    return Sighting(agent, at_s, world_from_agent, own, feet, navigation)


def misplace(sighting: Sighting, x: float, y: float, yaw: float) -> Sighting:
    off = sighting.world_from_agent @ pose(0, 0, 0, yaw)
    off[:2, 3] += x, y
    return replace(sighting, world_from_agent=off)


TRUE = pose(10.0, 0.0, 0.0, 0.3)


@pytest.mark.parametrize("by", ["objects that a road sensor sees", "posts on the map"])
def test_a_vehicle_is_put_where_it_is(by: str) -> None:
    vehicle = misplace(look("cav0", TRUE, 0.0, STATED, POSTS if "posts" in by else None), 0.6, -0.4, np.radians(2.5))
    sightings = [vehicle]
    if "objects" in by:
        sightings.append(look("pole1", pose(0, 8, 6), 0.0, None))
    corrected = correct_poses(sightings, POSTS if "posts" in by else np.zeros((0, 2)), 0.0)
    off = inverse(TRUE) @ corrected[0].world_from_agent
    assert np.linalg.norm(off[:2, 3]) < 0.1
    assert abs(np.degrees(np.arctan2(off[1, 0], off[0, 0]))) < 0.3
    known = corrected[0].navigation
    assert known is not None
    assert known.position_m < STATED.position_m / 3
    assert known.heading_rad < STATED.heading_rad


def test_without_objects_and_posts_navigation_stands() -> None:
    vehicle = misplace(look("cav0", TRUE, 0.0, STATED), 0.6, -0.4, 0.02)
    (corrected,) = correct_poses([vehicle], np.zeros((0, 2)), 0.0)
    np.testing.assert_allclose(corrected.world_from_agent, vehicle.world_from_agent, atol=1e-6)


def test_a_clock_is_set_by_objects_that_move() -> None:
    pole = pose(0, 8, 6)
    sightings = [look("pole1", pole, t, None) for t in (0.0, 0.5, 1.0)]
    for t in (0.0, 0.5, 1.0):
        seen = look("cav0", TRUE, t, Navigation(0.01, 0.001))
        sightings.append(replace(seen, time_s=t + 0.2))
    corrected = correct_poses(sightings, np.zeros((0, 2)), 1.0)
    times = [each.time_s for each in corrected if each.agent == "cav0"]
    np.testing.assert_allclose(times, [0.0, 0.5, 1.0], atol=0.03)


def test_what_is_told_carries_the_uncertainty_of_the_pose() -> None:
    sighting = look("cav0", pose(0, 0), 0.0, STATED)
    variance, plain = report_boxes(sighting).boxes.variance, sighting.boxes.variance
    assert variance is not None
    assert plain is not None
    arm = sighting.boxes.center[:, [1, 0]] * STATED.heading_rad
    np.testing.assert_allclose(variance[:, :2] - plain[:, :2], STATED.position_m**2 + arm**2)
    np.testing.assert_allclose(variance[:, 6] - plain[:, 6], STATED.heading_rad**2)
    surveyed = report_boxes(replace(sighting, navigation=None)).boxes.variance
    assert surveyed is not None
    np.testing.assert_allclose(surveyed, plain)


def test_labels_of_misplaced_vehicles_come_together() -> None:
    sightings = [look("pole1", pose(0, 8, 6), 0.0, None)]
    sightings += [
        misplace(look(f"cav{n}", TRUE, 0.0, STATED, POSTS), *off)
        for n, off in enumerate(((0.9, 0.9, 0.05), (-0.9, 0.8, -0.04)))
    ]
    naive = average_boxes([report_boxes(replace(each, navigation=None)) for each in sightings], 0.0)
    fixed = average_boxes([report_boxes(each) for each in correct_poses(sightings, POSTS, 0.0)], 0.0)
    assert len(naive.boxes) > 6
    assert len(fixed.boxes) == 6


def test_posts_are_matched_once_and_only_near() -> None:
    seen = look("cav0", pose(0, 0), 0.0, STATED, POSTS[:2])
    pairs = match_posts(seen, np.vstack((POSTS[0] + 0.3, POSTS[0] + 0.5, POSTS[1] + 5.0)))
    assert len(pairs) == 1
    np.testing.assert_allclose(pairs[0][1], POSTS[0] + 0.3)


def test_posts_are_segmented_from_columns_and_walls_are_not() -> None:
    rng = np.random.default_rng(0)
    z = np.linspace(0.3, 3.0, 25)
    post = np.column_stack((np.full(25, 6.0), np.full(25, -4.0), z)) + rng.normal(0, 0.02, (25, 3))
    wall = np.column_stack((rng.uniform(-5, 5, 400), np.full(400, 8.0), rng.uniform(0, 3, 400)))
    stone = np.column_stack((np.full(8, -6.0), np.full(8, -6.0), np.linspace(0, 0.8, 8)))
    sweep = np.vstack((post, wall, stone)) - (0, 0, 1.7)
    np.testing.assert_allclose(segment_posts(sweep.astype(np.float32), 1.7), [(6.0, -4.0)], atol=0.06)
