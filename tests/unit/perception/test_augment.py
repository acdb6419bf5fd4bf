"""Augmentation: returns stay on their objects, labels stay true, pasted objects meet nothing."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

from flcav.geometry import Boxes, points_in_boxes
from flcav.perception.objects import task
from flcav.perception.objects.augment import (
    DENSE,
    Cutouts,
    augment,
    cut_out_objects,
    fade_objects,
    in_bands,
    in_view,
    keep_returns,
    paste_objects,
    resize_objects,
    select_free,
    tilt_sample,
)
from flcav.perception.objects.config import Augmentation, SecondConfig, small_config
from flcav.perception.objects.samples import Sample, crop_to_range
from flcav.perception.objects.truth import MIN_RETURNS


def scene(seed: int, objects: int = 12, per_object: int = 20) -> Sample:
    """Return cars of random pose that do not stand in one another, with `per_object` returns each, and clutter."""
    rng = np.random.default_rng(seed)
    spots = rng.permutation(36)[:objects]
    height = rng.uniform(-1.2, -0.8, objects)
    center = np.column_stack((8 + 8 * (spots % 6), 8 * (spots // 6) - 20, height)).astype(np.float64)
    size = rng.uniform((3, 1.5, 1.4), (5, 2, 1.8), (objects, 3))
    boxes = Boxes(center, size, rng.uniform(-np.pi, np.pi, objects), np.full(objects, "Car"))
    local = rng.uniform(-0.49, 0.49, (objects, per_object, 3)) * size[:, None]
    cos, sin = np.cos(boxes.yaw)[:, None], np.sin(boxes.yaw)[:, None]
    x, y, z = np.moveaxis(local, 2, 0)
    on_objects = np.stack((x * cos - y * sin, x * sin + y * cos, z), 2) + center[:, None]
    points = np.concatenate((on_objects.reshape(-1, 3), rng.uniform((0, -30, 2), (60, 30, 3), (200, 3))))
    return Sample(np.column_stack((points, rng.random(len(points)))).astype(np.float32), boxes)


CONFIG = small_config()
EVERYTHING = Augmentation(
    turn_rad=0.7,
    scale=0.05,
    shift_m=1.0,
    resize=((0.8, 1.1), (0.8, 1.1), (0.8, 1.1)),
    tilt_rad=0.02,
    lift_m=0.2,
    drop=0.3,
    paste=3,
    view=0.5,
)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_every_object_that_is_to_be_found_keeps_returns_in_its_box(seed):
    changed = augment(scene(seed), EVERYTHING, np.random.default_rng(seed))
    assert (points_in_boxes(changed.points, changed.boxes).sum(1) >= MIN_RETURNS).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_resized_objects_keep_their_returns_and_their_foot(seed):
    before = scene(seed)
    factor = np.random.default_rng(seed).uniform(0.8, 1.1, (len(before.boxes), 3))
    after = resize_objects(before, factor)
    np.testing.assert_allclose(after.boxes.size, before.boxes.size * factor)
    foot, same = (b.center[:, 2] - b.size[:, 2] / 2 for b in (before.boxes, after.boxes))
    np.testing.assert_allclose(foot, same)
    own = np.repeat(np.arange(len(before.boxes)), 20)
    inside = points_in_boxes(after.points[: len(own)], after.boxes, margin_m=1e-4)
    assert inside[own, np.arange(len(own))].all()


def test_resizing_by_one_changes_nothing():
    before = scene(3)
    after = resize_objects(before, np.ones((len(before.boxes), 3)))
    np.testing.assert_allclose(after.points, before.points, atol=1e-5)
    np.testing.assert_allclose(after.boxes.array(), before.boxes.array(), atol=1e-12)


def test_a_tilt_raises_what_lies_up_the_slope():
    before = scene(4)
    after = tilt_sample(before, np.array((0.02, 0.0)), 0.1)
    np.testing.assert_allclose(
        after.boxes.center[:, 2] - before.boxes.center[:, 2], 0.1 + 0.02 * before.boxes.center[:, 0]
    )
    np.testing.assert_allclose(after.points[:, 2] - before.points[:, 2], 0.1 + 0.02 * before.points[:, 0], atol=1e-5)


def test_thinning_leaves_out_objects_without_returns_and_ignores_those_with_few():
    sample = scene(5)
    kept = np.ones(len(sample.points), dtype=bool)
    kept[:20] = False  # all of the first
    kept[20:37] = False  # all but three of the second
    thin = keep_returns(sample, kept)
    np.testing.assert_array_equal(thin.boxes.array(), sample.boxes[2:].array())
    np.testing.assert_array_equal(thin.ignore.array(), sample.boxes[1:2].array())


def test_a_view_ahead_ends_where_the_camera_does():
    directions = np.array([[1, 0.84, 0], [1, -0.84, 0], [1, 0.86, 0], [1, 0, 0.25], [1, 0, -0.27], [-1, 0, 0]])
    np.testing.assert_array_equal(in_view(directions.astype(np.float32)), [True, True, False, False, True, False])


def test_bands_are_as_far_apart_and_as_high_as_asked_for():
    elevation = np.radians(np.linspace(-25, 5, 30_001))
    points = np.column_stack((9 * np.cos(elevation), np.zeros_like(elevation), 9 * np.sin(elevation)))
    kept = in_bands(points.astype(np.float32), 2.0, 0.25, np.random.default_rng(1))
    assert kept.mean() == pytest.approx(0.125, abs=0.01)
    begins = np.degrees(elevation)[1:][kept[1:] & ~kept[:-1]]
    np.testing.assert_allclose(np.diff(begins), 2.0, atol=0.01)


def test_objects_lose_their_own_share_of_returns():
    sample = scene(5, objects=3, per_object=2000)
    faded = fade_objects(sample, np.array([0.0, 0.5, 0.9]), np.random.default_rng(0))
    np.testing.assert_allclose(points_in_boxes(faded.points, sample.boxes).sum(1), [2000, 1000, 200], atol=70)
    assert len(faded.points) == points_in_boxes(faded.points, sample.boxes).sum() + 200  # all of the clutter


def test_sparse_sweeps_are_not_thinned():
    how = Augmentation(turn_rad=0.0, scale=0.0, thin=1.0)
    dense = Sample(np.tile(scene(3).points, (60, 1)), Boxes.empty())
    assert len(dense.points) > DENSE > len(scene(3).points)
    assert len(augment(dense, how, np.random.default_rng(0)).points) < 0.6 * len(dense.points)
    assert len(augment(scene(3), how, np.random.default_rng(0)).points) == len(scene(3).points)


def test_pasted_objects_are_of_sweeps_that_are_as_dense():
    donors = [scene(7), replace(scene(11), points=np.tile(scene(11).points, (4, 1)))]
    known, rng = cut_out_objects(donors, CONFIG), np.random.default_rng
    empty = Sample(donors[0].points[-200:], Boxes.empty())
    assert len(known.swept) == len(known.boxes) == 24
    assert len(paste_objects(empty, known, 50, rng(0), 1.5).boxes) == 0
    assert len(paste_objects(empty, known, 50, rng(0), 2.5).boxes) == 12
    assert len(paste_objects(empty, known, 50, rng(0)).boxes) > 12


def footprint(box: Boxes) -> Polygon:
    return Polygon(box.corners()[0, :4, :2])


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_pasted_objects_meet_no_other_from_above(seed):
    both = paste_objects(
        scene(seed), cut_out_objects([scene(seed + 1), scene(seed + 2)], CONFIG), 17, np.random.default_rng(seed)
    )
    shapes = [footprint(both.boxes[i : i + 1]) for i in range(len(both.boxes))]
    new = range(12, len(shapes))
    assert len(new) <= 5
    for i in new:
        assert all(shapes[i].intersection(shapes[j]).area < 1e-9 for j in range(len(shapes)) if j != i)
    assert (points_in_boxes(both.points, both.boxes).sum(1) >= MIN_RETURNS).all()


def test_pasted_objects_bring_their_returns_and_push_the_scenes_out():
    donor = scene(7, objects=1)
    clutter = np.column_stack((donor.points[:5, :3], np.full(5, 9.0))).astype(np.float32)
    both = paste_objects(Sample(clutter, Boxes.empty()), cut_out_objects([donor], CONFIG), 1, np.random.default_rng(0))
    assert len(both.boxes) == 1
    assert not (both.points[:, 3] == 9).any()
    np.testing.assert_array_equal(np.sort(both.points[:, 0]), np.sort(donor.points[:20, 0]))


def test_nothing_is_pasted_where_there_is_no_room():
    sample = scene(8)
    assert not len(select_free(sample.boxes, sample.boxes))
    nothing = cut_out_objects([Sample(sample.points, Boxes.empty())], CONFIG)
    assert len(paste_objects(sample, nothing, 50, np.random.default_rng(0)).boxes) == 12


def test_a_sample_is_filled_up_with_objects_of_known_pose():
    donor = replace(scene(7), exact=np.arange(12) < 4)
    empty = Sample(scene(8).points[-200:], Boxes.empty())
    known = cut_out_objects([donor], CONFIG)
    assert len(known.boxes) == 4
    assert len(paste_objects(empty, known, 3, np.random.default_rng(0)).boxes) == 3
    assert len(paste_objects(scene(8), known, 12, np.random.default_rng(0)).boxes) == 12  # full already


def test_the_same_stream_changes_a_sample_the_same_way():
    one, two = (augment(scene(9), EVERYTHING, np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(one.points, two.points)
    assert one.boxes.array() == pytest.approx(two.boxes.array())


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_no_point_is_left_out_that_augmentation_brings_into_the_range(seed):
    rng = np.random.default_rng(seed)
    config = small_config()
    reach = 95
    points = rng.uniform((-reach, -reach, -6, 0), (reach, reach, 4, 1), (4000, 4)).astype(np.float32)
    points[:, 3] = np.arange(len(points))  # a number that stays with the point
    how = replace(config.augmentation, drop=0.0, view=0.0)
    moved = augment(Sample(points, Boxes.empty()), how, rng).points
    low, high = np.array(config.range_m[:3]), np.array(config.range_m[3:])
    within = ((moved[:, :3] >= low) & (moved[:, :3] < high)).all(1)
    assert set(moved[within, 3]) <= set(crop_to_range(points, config)[:, 3])


def test_a_margin_makes_the_boxes_of_its_class_larger_and_moves_no_return():
    boxes = Boxes(np.zeros((2, 3)), np.full((2, 3), 2.0), np.array([0.0, 1.0]), np.array(["Car", "Cyclist"]))
    sample = Sample(np.ones((3, 4), np.float32), boxes)
    how = Augmentation(turn_rad=0, scale=0, margin_m=(("Car", 0.2, -0.1, 0.4),))
    out = augment(sample, how, np.random.default_rng(0))
    np.testing.assert_array_equal(out.points, sample.points)
    np.testing.assert_allclose(out.boxes.size, [[2.2, 1.9, 2.4], [2, 2, 2]])
    np.testing.assert_allclose(out.boxes.center[:, 2] - out.boxes.size[:, 2] / 2, -1)


def test_clients_that_take_turns_keep_their_databases(monkeypatch: pytest.MonkeyPatch):
    made = []

    def count(samples: Iterable[Sample], config: SecondConfig) -> Cutouts:
        made.append(1)
        return cut_out_objects(samples, config)

    monkeypatch.setattr(task, "cut_out_objects", count)
    objects, clients = task.ObjectsTask(), [[scene(seed)] * 150 for seed in range(3)]
    for client in (0, 1, 2, 0, 1, 2):
        objects.draw(clients[client], 0, CONFIG, np.random.default_rng(0))
    assert len(made) == 3
    objects.draw([scene(4)] * 500, 0, CONFIG, np.random.default_rng(0))  # as many as are kept
    objects.draw(clients[0], 0, CONFIG, np.random.default_rng(0))
    assert len(made) == 5
