"""Turned-box overlap against shapely."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity
from shapely.geometry import box as rectangle

from flcav.perception.ops.boxes import intersection_area, iou, nms


def footprint(row):
    x, y, _, length, width, _, yaw = row
    shape = affinity.rotate(rectangle(-length / 2, -width / 2, length / 2, width / 2), yaw, (0, 0), use_radians=True)
    return affinity.translate(shape, x, y)


def slow_iou(a, b, kind):
    shared = footprint(a).intersection(footprint(b)).area
    if kind == "bev":
        return shared / (a[3] * a[4] + b[3] * b[4] - shared)
    shared *= max(0.0, min(a[2] + a[5] / 2, b[2] + b[5] / 2) - max(a[2] - a[5] / 2, b[2] - b[5] / 2))
    return shared / (np.prod(a[3:6]) + np.prod(b[3:6]) - shared)


@pytest.mark.parametrize("kind", ["3d", "bev"])
@pytest.mark.parametrize("far_m", [0.0, 1e5])
def test_iou_is_shapelys(kind, far_m):
    rng = np.random.default_rng(0)
    boxes = np.c_[
        rng.uniform(-4, 4, (24, 2)), rng.uniform(-1, 1, 24), rng.uniform(0.3, 5, (24, 3)), rng.uniform(-7, 7, 24)
    ]
    boxes[5:10, 6] = boxes[:5, 6] = 0.3  # parallel edges
    boxes[10] = boxes[11]
    a, b = boxes[:12].copy(), boxes[8:].copy()
    a[:, :2] += far_m
    b[:, :2] += far_m
    got = iou(torch.from_numpy(a), torch.from_numpy(b), kind).numpy()
    near_a, near_b = a - [far_m, far_m, 0, 0, 0, 0, 0], b - [far_m, far_m, 0, 0, 0, 0, 0]
    expected = np.array([[slow_iou(p, q, kind) for q in near_b] for p in near_a])
    assert np.abs(got - expected).max() < 1e-9


ROW = st.tuples(*[st.floats(-3, 3)] * 3, *[st.floats(0.1, 6)] * 3, st.floats(-4, 4))


@settings(max_examples=60, deadline=None)
@given(ROW, ROW)
def test_intersection_is_symmetric_and_bounded(one, other):
    a, b = torch.tensor([one], dtype=torch.float64), torch.tensor([other], dtype=torch.float64)
    area = float(intersection_area(a, b))
    assert abs(area - float(intersection_area(b, a))) < 1e-9
    assert -1e-12 <= area <= min(one[3] * one[4], other[3] * other[4]) + 1e-9
    assert abs(area - footprint(one).intersection(footprint(other)).area) < 1e-8


def test_equal_boxes_overlap_fully_and_distant_ones_not():
    row = torch.tensor([[3.0, -2, 0, 4, 2, 1.5, 0.7]])
    far = row + torch.tensor([50.0, 0, 0, 0, 0, 0, 0])
    assert iou(row, row)[0, 0] == pytest.approx(1, abs=1e-12)
    assert iou(row, far)[0, 0] == 0
    assert iou(row[:0], far).shape == (0, 1)


def test_nms_is_the_greedy_rule():
    rng = np.random.default_rng(3)
    rows = np.c_[rng.uniform(-8, 8, (60, 2)), np.zeros(60), np.tile([4, 2, 1.5], (60, 1)), rng.uniform(-3, 3, 60)]
    scores = rng.random(60)
    kept = []
    for i in np.argsort(-scores):
        if all(slow_iou(rows[i], rows[j], "bev") <= 0.1 for j in kept):
            kept.append(i)
    assert nms(torch.from_numpy(rows), torch.from_numpy(scores), overlap=0.1).tolist() == kept
    assert nms(torch.from_numpy(rows), torch.from_numpy(scores), overlap=0.1, keep=3).tolist() == kept[:3]
