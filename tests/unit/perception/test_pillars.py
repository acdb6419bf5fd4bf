"""Statistics of pillars against a loop over the points, and the network that takes them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.geometry import Boxes
from flcav.perception.objects.config import pillars_config
from flcav.perception.objects.loss import anchor_boxes
from flcav.perception.objects.model import head_shape, second
from flcav.perception.objects.predict import detect
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.ops.grids import BINS_M, STATISTICS, pillar_statistics
from flcav.perception.training import train_steps

RANGE_M, PILLAR_M, GROUND_M = (0, -4, -3, 8, 4, 1), (0.5, 0.4, 4), -1.8


def statistics(clouds):
    points = torch.from_numpy(np.concatenate(clouds))
    sample = torch.repeat_interleave(torch.arange(len(clouds)), torch.tensor([len(cloud) for cloud in clouds]))
    return pillar_statistics(points, sample, len(clouds), RANGE_M, PILLAR_M, GROUND_M).numpy()


def looped(cloud):
    """The statistics by a loop over pillars."""
    out = np.zeros((STATISTICS, 20, 16), np.float64)
    for row in range(20):
        for column in range(16):
            at = (cloud[:, :2] - (RANGE_M[0], RANGE_M[1])) / PILLAR_M[:2]
            own = (np.floor(at) == (column, row)).all(1) & (cloud[:, 2] >= RANGE_M[2]) & (cloud[:, 2] < RANGE_M[5])
            if not own.any():
                continue
            height = cloud[own, 2] - GROUND_M
            middle = at[own].mean(0) - (column, row) - 0.5
            numbers = (np.log(1 + own.sum()) / 2, height.max(), height.min(), height.mean(), cloud[own, 3].mean())
            ends = zip(BINS_M, (*BINS_M[1:], np.inf), strict=True)
            bins = [((height >= low) & (height < high)).any() for low, high in ends]
            out[:, row, column] = (*numbers, *middle, *bins)
    return out


def cloud(rng, count):
    return rng.uniform((-1, -5, -3.5, 0), (9, 5, 1.5, 1), (count, 4)).astype(np.float32)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 400), st.integers(0, 400), st.integers(0, 2**31))
def test_statistics_are_those_of_a_loop_over_pillars(first, second_, seed):
    rng = np.random.default_rng(seed)
    clouds = [cloud(rng, first), cloud(rng, second_)]
    found = statistics(clouds)
    for own, of in zip(found, clouds, strict=True):
        np.testing.assert_allclose(own, looped(of.astype(np.float64)), atol=2e-5)


def test_the_order_of_points_does_not_matter():
    rng = np.random.default_rng(0)
    points = cloud(rng, 3000)
    np.testing.assert_allclose(statistics([points]), statistics([points[rng.permutation(len(points))]]), atol=1e-5)


def test_the_heads_grid_is_that_of_the_voxels():
    config = pillars_config()
    assert head_shape(config) == (48, 48)
    assert len(anchor_boxes(config)) == 48 * 48 * 2


def test_no_intensity_is_no_input():
    torch.manual_seed(0)
    network = second(replace(pillars_config(), intensity=False)).eval()
    points = cloud(np.random.default_rng(0), 500)
    other = points * np.array((1, 1, 1, 0.5), np.float32)
    with torch.inference_mode():
        of = torch.zeros(500, dtype=torch.int64)
        maps = [network.voxels(torch.from_numpy(each), of, 1) for each in (points, other)]
    assert all(isinstance(each, torch.Tensor) for each in maps)
    np.testing.assert_array_equal(np.asarray(maps[0]), np.asarray(maps[1]))


@pytest.mark.slow
def test_it_learns_to_find_a_box():
    """Overfitting: after training on one sweep with two cars it finds both, and nothing else of a high score."""
    rng = np.random.default_rng(1)
    boxes = Boxes.from_array(
        np.array([(12.0, 3.0, -1.0, 4.4, 1.8, 1.6, 0.1), (24.0, -6.0, -1.0, 4.4, 1.8, 1.6, 1.5)]), "Car"
    )
    ground = np.c_[rng.uniform((0, -24), (48, 24), (8000, 2)), rng.normal(-1.8, 0.01, 8000)]
    cars = [
        box[:3] + rng.uniform(-0.5, 0.5, (200, 3)) * (box[3:6] if abs(box[6]) < 0.5 else box[[4, 3, 5]])
        for box in boxes.array()
    ]
    points = np.concatenate((ground, *cars))
    sample = Sample(np.c_[points, np.full(len(points), 0.3)].astype(np.float32), boxes)
    torch.manual_seed(0)
    network = second(pillars_config())
    first = float(OBJECTS.loss(network, [sample]).detach())
    train_steps(OBJECTS, network, [sample], steps=160, batch=1, learning_rate=2e-3, seed=0)
    assert float(OBJECTS.loss(network, [sample]).detach()) < first / 3
    found = detect(network, sample.points, score_threshold=0.3)
    away = np.linalg.norm(found.center[:, None, :2] - boxes.center[None, :, :2], axis=2)
    assert len(found) == 2
    assert away.min(0) == pytest.approx([0, 0], abs=0.6)
