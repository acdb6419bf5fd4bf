"""Targets: coding, matching, what is left out, and augmentation."""

import dataclasses

import numpy as np
import pytest
import torch

from flcav.geometry import Boxes, points_in_boxes
from flcav.perception.objects import Sample, second_tiny
from flcav.perception.objects.augment import augment, transform_sample
from flcav.perception.objects.config import Augmentation
from flcav.perception.objects.loss import (
    anchor_boxes,
    assign_anchors,
    decode_residuals,
    direction_of,
    encode_residuals,
    mark_free_cells,
    second_loss,
)
from flcav.perception.objects.model import head_shape
from flcav.perception.objects.samples import crop_to_range

CONFIG = second_tiny().config
NO_POINTS = np.zeros((0, 4), dtype=np.float32)


def cars(*rows):
    return Boxes.from_array([(x, y, -1.0, 4.4, 1.8, 1.6, yaw) for x, y, yaw in rows], "Car")


def negatives(sample):
    targets = assign_anchors(sample, CONFIG)
    mask = targets.weight.numpy() > 0
    mask[targets.positive.numpy()] = False
    return mask.reshape(*head_shape(CONFIG), 2)


def test_decode_inverts_encode():
    rng = np.random.default_rng(0)
    anchors = anchor_boxes(CONFIG)[rng.integers(0, 7200, 50)]
    boxes = anchors + rng.normal(0, 0.3, anchors.shape)
    boxes[:, 6] = rng.uniform(-np.pi, np.pi, 50)
    back = decode_residuals(encode_residuals(boxes, anchors), direction_of(boxes[:, 6]), anchors)
    assert np.allclose(back[:, :6], boxes[:, :6])
    assert np.allclose(np.exp(1j * back[:, 6]), np.exp(1j * boxes[:, 6]))


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 2.8, -1.4])
def test_every_object_in_range_gets_an_anchor_that_says_it(yaw):
    sample = Sample(NO_POINTS, cars((10.3, 5.1, yaw), (30.7, -12.2, yaw)))
    targets = assign_anchors(sample, CONFIG)
    anchors = anchor_boxes(CONFIG)[targets.positive.numpy()]
    said = decode_residuals(targets.residual.double().numpy(), targets.direction.numpy(), anchors)
    truth = sample.boxes.array()
    near = np.linalg.norm(said[:, None, :3] - truth[None, :, :3], axis=2)
    assert set(near.argmin(1)) == {0, 1}
    assert near.min(1).max() < 1e-4
    assert np.allclose(np.exp(1j * said[:, 6]), np.exp(1j * yaw), atol=1e-4)


def test_an_object_out_of_range_is_neither_positive_nor_negative():
    outside = Sample(NO_POINTS, cars((48.5, 0.0, 0.0)))
    assert not len(assign_anchors(outside, CONFIG).positive)
    assert not negatives(outside)[30, 59].any()
    assert negatives(outside)[30, 40].all()


def test_ignored_objects_silence_their_anchors():
    sample = Sample(NO_POINTS, Boxes.empty(), cars((20.0, 0.0, 0.5)))
    mask = negatives(sample)
    assert not mask[30, 25].any()
    assert mask[30, 45].all()
    assert mask[10, 25].all()


def test_negatives_only_where_the_ground_is_known_to_be_free():
    y, x = np.meshgrid(np.arange(-24, 24, 0.4), np.arange(0, 24, 0.4), indexing="ij")
    free = np.stack((x.ravel(), y.ravel()), 1).astype(np.float32)
    mask = negatives(Sample(NO_POINTS, cars((40.0, 0.0, 0.0)), free=free))
    assert mask[:, :30].all()
    assert not mask[:, 30:].any()
    assert len(assign_anchors(Sample(NO_POINTS, cars((40.0, 0.0, 0.0)), free=free), CONFIG).positive)
    assert not negatives(Sample(NO_POINTS, Boxes.empty(), free=free[:0])).any()


def test_free_cells_are_row_y_column_x():
    mask = mark_free_cells(np.array([[0.1, -23.9], [47.9, 23.9], [-1, 0], [50, 0]], dtype=np.float32), CONFIG)
    assert mask.sum() == 2
    assert mask[0, 0]
    assert mask[-1, -1]


def test_augmentation_moves_everything_together():
    rng = np.random.default_rng(0)
    points = np.ones((400, 4), dtype=np.float32)
    points[:, :3] = rng.uniform((9.5, 1.5, -3.5), (14.5, 6.5, 1.5), (400, 3))
    sample = Sample(points, cars((12.0, 4.0, 0.4)), cars((12.5, 4.5, 1.0)), points[:, :2].copy())
    for seed in range(5):
        moved = augment(sample, Augmentation(), np.random.default_rng(seed))
        for before, after in ((sample.boxes, moved.boxes), (sample.ignore, moved.ignore)):
            inside, still = points_in_boxes(points, before), points_in_boxes(moved.points, after)
            assert (inside != still).sum() <= 2  # float32 on a face
        assert moved.free is not None
        assert np.allclose(moved.free, moved.points[:, :2], atol=1e-4)
        assert np.array_equal(moved.points[:, 3], points[:, 3])


def test_augmentation_is_undone_by_its_inverse():
    sample = Sample(np.array([[5, 2, -1, 0.3]], dtype=np.float32), cars((12.0, 4.0, 0.4)))
    back = transform_sample(transform_sample(sample, 1, 0.25, 1.02), 1, -0.25, 1 / 1.02)
    assert np.allclose(back.points, sample.points, atol=1e-5)
    assert np.allclose(back.boxes.array(), sample.boxes.array())


def test_samples_are_immutable():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Sample(NO_POINTS, Boxes.empty()).points = NO_POINTS  # pyright: ignore[reportAttributeAccessIssue]


def test_no_point_is_left_out_that_an_augmentation_brings_into_range():
    rng = np.random.default_rng(0)
    points = rng.uniform((-60, -60, -4, 0), (60, 60, 2, 1), (4000, 4)).astype(np.float32)
    kept = {tuple(point) for point in crop_to_range(points, CONFIG)}
    low, high = CONFIG.range_m[:3], CONFIG.range_m[3:]
    for seed in range(20):
        moved = augment(Sample(points, Boxes.empty()), Augmentation(), np.random.default_rng(seed)).points[:, :3]
        inside = ((moved >= low) & (moved < high)).all(1)
        assert {tuple(point) for point in points[inside]} <= kept
    assert len(kept) < 0.5 * len(points)


def test_a_box_that_is_not_exact_is_found_but_not_learned():
    boxes = cars((20.0, 4.0, 0.1), (30.0, -8.0, 0.2))
    inexact = Sample(NO_POINTS, boxes, exact=np.array([True, False]))
    targets, everything = assign_anchors(inexact, CONFIG), assign_anchors(Sample(NO_POINTS, boxes), CONFIG)
    assert torch.equal(targets.positive, everything.positive)
    assert 0 < targets.exact.sum() < everything.exact.sum() == len(everything.positive)

    output = second_tiny().train()(_nothing_seen())
    moved = output._replace(box=output.box.detach().requires_grad_(True))
    second_loss(moved, [targets], CONFIG).backward()
    assert moved.box.grad is not None
    touched = moved.box.grad[0].abs().sum(1) > 0
    assert touched[targets.positive[targets.exact > 0]].any()
    assert not touched[targets.positive[targets.exact == 0]].any()


def _nothing_seen():
    points = torch.tensor([[20.0, 4.0, -1.0, 0.3], [20.1, 4.0, -1.0, 0.3], [30.0, -8.0, -1.0, 0.3]])
    return second_tiny().voxels(points, torch.zeros(3, dtype=torch.int64), 1)
