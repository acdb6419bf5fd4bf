"""Overlap of upright rectangles against shapely and the papers' formulas, suppression against its definition."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import box

from flcav.perception.ops.boxes import complete_iou, rectangle_iou, rectangle_nms

sides = st.floats(0.5, 40)
places = st.floats(-30, 30)
rectangle = st.tuples(places, places, sides, sides).map(lambda r: (r[0], r[1], r[0] + r[2], r[1] + r[3]))


@settings(max_examples=60, deadline=None)
@given(rectangle, rectangle)
def test_iou_is_shapelys(one, other):
    a, b = box(*one), box(*other)
    found = rectangle_iou(torch.tensor([one], dtype=torch.float64), torch.tensor([other], dtype=torch.float64))
    assert float(found) == pytest.approx(a.intersection(b).area / a.union(b).area, abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(rectangle, rectangle)
def test_complete_iou_is_the_papers(one, other):
    a, b = box(*one), box(*other)
    overlap = a.intersection(b).area / a.union(b).area
    x1, y1, x2, y2 = a.union(b).bounds
    apart = a.centroid.distance(b.centroid) ** 2 / ((x2 - x1) ** 2 + (y2 - y1) ** 2)
    slants = [math.atan((r[2] - r[0]) / (r[3] - r[1])) for r in (one, other)]
    shape = 4 / math.pi**2 * (slants[0] - slants[1]) ** 2
    weight = shape / (1 - overlap + shape) if shape else 0.0
    found = complete_iou(torch.tensor([one], dtype=torch.float64), torch.tensor([other], dtype=torch.float64))
    assert float(found) == pytest.approx(overlap - apart - weight * shape, abs=1e-5)


def test_the_gradient_pulls_a_box_that_does_not_touch():
    start = torch.tensor([[0.0, 0, 2, 2]], requires_grad=True)
    complete_iou(start, torch.tensor([[5.0, 0, 7, 2]])).sum().backward()
    assert start.grad is not None
    assert start.grad[0, 0] + start.grad[0, 2] > 0  # to the right


def test_nms_keeps_what_no_better_kept_box_overlaps():
    random = np.random.default_rng(0)
    corner = random.uniform(0, 30, (60, 2))
    boxes = torch.from_numpy(np.concatenate((corner, corner + random.uniform(3, 12, (60, 2))), 1))
    scores = torch.from_numpy(random.uniform(size=60))
    kept: list[int] = []
    for i in scores.argsort(descending=True).tolist():
        shapes = [box(*boxes[j].tolist()) for j in kept]
        own = box(*boxes[i].tolist())
        if all(own.intersection(s).area / own.union(s).area <= 0.4 for s in shapes):
            kept.append(i)
    assert rectangle_nms(boxes, scores, 0.4).tolist() == kept
    assert 5 < len(kept) < 60
    assert rectangle_nms(boxes[:0], scores[:0], 0.4).tolist() == []
