"""Road perception: labels from the map, tracing of lane lines, the ground plane, and measures, each by another way."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch.nn import functional

from flcav.dataset.road_labels import (
    BROKEN,
    CROSSING,
    IGNORED,
    ROAD_CLASSES,
    SOLID,
    RoadLabels,
    SeenLine,
    leads_away,
)
from flcav.geometry import pose
from flcav.perception.road import evaluate
from flcav.perception.road.evaluate import count_pixels, mean_overlap, measure_offsets, overlaps
from flcav.perception.road.lines import GroundPlane, TracedLine, trace_lines
from flcav.perception.road.loss import DICE, SMOOTH_PX, WEIGHTS, segmentation_loss
from flcav.perception.road.model import STRIDE, RoadNetwork
from flcav.perception.road.predict import predict_logits, segment_picture
from flcav.perception.road.samples import Sample, draw_window
from flcav.perception.road.task import ROAD, RoadTask
from flcav.sensors.frame import Calibration
from flcav.sensors.lens import BODY_FROM_OPTICAL, Lens, project_points

LENS = Lens(width=640, height=384, fov_deg=60.0)
MOUNT = pose(0.5, 0.0, 1.5) @ BODY_FROM_OPTICAL
PLANE = GroundPlane(MOUNT, LENS.intrinsics(), LENS.distortion())
CLASSES = len(ROAD_CLASSES)


def project(ground):
    """Return the pixels of points (K, 2) on the ground, by the inverse of the mount."""
    points = np.column_stack((ground, np.zeros(len(ground)), np.ones(len(ground))))
    return project_points(LENS.intrinsics(), LENS.distortion(), (np.linalg.inv(MOUNT) @ points.T).T[:, :3])


def shares_of(*lines):
    """Return the probabilities of cells with these lines (ground (K, 2), class), a cell and a half wide."""
    shares = np.zeros((CLASSES, 96, 160), np.float32)
    rows = np.arange(96)
    for ground, label in lines:
        cells = (project(ground) + 0.5) / STRIDE - 0.5
        column = np.interp(-rows, -cells[:, 1], cells[:, 0], left=np.nan, right=np.nan)
        away = np.abs(np.arange(160) - column[:, None])
        shares[label] = np.maximum(shares[label], np.nan_to_num(np.clip(1.6 - away, 0, 1)))
    return shares


def straight(y, first=5.0, last=38.0):
    return np.column_stack((np.linspace(first, last, 80), np.full(80, float(y))))


def test_the_ground_plane_is_the_inverse_of_the_projection():
    ground = np.random.default_rng(0).uniform((5, -4), (40, 4), (50, 2))
    assert np.allclose(PLANE.locate(project(ground)), ground)
    assert np.isnan(PLANE.locate(np.array([[320.0, 10.0]]))).all()  # above the horizon


def test_the_ground_of_a_pole_is_below_its_mount():
    calibration = Calibration(
        {"camera": np.linalg.inv(pose(0, 0, 1.5)) @ MOUNT}, {"camera": LENS.intrinsics()}, {"camera": LENS.distortion()}
    )
    frame: Any = SimpleNamespace(assumed=calibration)
    ground = straight(1.0)
    assert np.allclose(GroundPlane.of(frame, "camera", 1.5).locate(project(ground)), ground)


def test_lines_are_traced_with_kind_and_place_where_they_are_drawn():
    found = trace_lines(shares_of((straight(1.7), SOLID), (straight(-1.7), BROKEN), (straight(-4.8, 9), SOLID)), PLANE)
    grounds = [line.ground for line in found if line.ground is not None]
    assert len(grounds) == len(found)
    order = np.argsort([ground[0, 1] for ground in grounds])
    found = [found[row] for row in order]
    assert [line.solid for line in found] == [True, False, True]
    for line, row, y in zip(found, order, (-4.8, -1.7, 1.7), strict=True):
        assert np.abs(grounds[row][:, 1] - y).max() < 0.15
        assert grounds[row][-1, 0] > 33
        assert (np.diff(line.pixels[:, 1]) < 0).all()


def test_a_gap_of_a_few_rows_is_bridged_and_a_line_across_is_none():
    shares = shares_of((straight(1.7), SOLID))
    rows = np.flatnonzero(shares[SOLID].any(axis=1))
    shares[:, rows[20:24]] = 0
    assert len(trace_lines(shares, PLANE)) == 1
    shares[:, rows[6:13]] = 0
    assert len(trace_lines(shares, PLANE)) == 2
    across = np.zeros_like(shares)
    across[SOLID, 60:62, 10:150] = 1
    assert trace_lines(across, PLANE) == []


def test_lines_end_at_the_reach_and_short_ones_are_left_out():
    (line,) = trace_lines(shares_of((straight(1.0, 5, 80), SOLID)), PLANE)
    assert line.ground is not None
    assert np.hypot(*(line.ground - (0.5, 0)).T).max() <= 40
    assert trace_lines(shares_of((straight(1.0, 6, 9), SOLID)), PLANE) == []
    assert len(trace_lines(shares_of((straight(1.0, 6, 9), SOLID)))) == 1  # without a plane its length is unknown


def test_what_leads_away_is_as_high_in_the_picture_as_it_must():
    assert leads_away(np.array([[0.0, 100], [100, 80]]))
    assert not leads_away(np.array([[0.0, 100], [200, 80]]))
    assert not leads_away(np.array([[0.0, 100], [0, 90]]))


def test_offsets_are_distances_from_the_true_line_by_range():
    truth = SeenLine(np.zeros((2, 2)), np.array([[4.0, 1.0, 0.0], [30.0, 1.0, 0.0]]), "solid")
    found = TracedLine(np.zeros((4, 2)), True, 1.0, np.array([[3.0, 1.2], [6.0, 1.1], [9.0, 0.7], [25.0, 1.5]]))
    total, count = measure_offsets(found, truth, np.array([0.5, 0.0]))
    assert count.tolist() == [2, 0, 1]  # the first lies before the true line's beginning
    assert total == pytest.approx([0.1 + 0.3, 0, 0.5])


@pytest.mark.parametrize(("score", "counts"), [(0.6, (2, 2, 2)), (0.9, (1, 1, 2))])
def test_lines_count_from_the_score_of_the_task_on(score, counts, monkeypatch):
    lines = [(straight(1.6), 0.95), (straight(-1.6), 0.7)]
    traced = [TracedLine(project(ground), True, score, ground) for ground, score in lines]
    seen = tuple(SeenLine(project(ground), np.pad(ground, ((0, 0), (0, 1))), "solid") for ground, _ in lines)
    labels = RoadLabels(np.zeros((384, 640), np.uint8), seen)
    stubs = {
        "list_pictures": lambda data, frames: [(0, "camera")],
        "read_recorded_picture": lambda *_: None,
        "_labels": lambda *_: labels,
        "segment_picture": lambda *_: (None, labels.classes),
        "DatasetGround": lambda data: SimpleNamespace(height_of=lambda number: 0.0),
        "GroundPlane": SimpleNamespace(of=lambda *_: PLANE),
        "trace_lines": lambda *_: traced,
    }
    for name, stub in stubs.items():
        monkeypatch.setattr(evaluate, name, stub)
    frame = SimpleNamespace(weather=None)
    data: Any = SimpleNamespace(frame=lambda number: frame, keys=[SimpleNamespace(scene="a")])
    task, unused = RoadTask(), cast("RoadNetwork", None)
    monkeypatch.setattr(task, "threshold", score)
    arrays = task.outcomes(unused, data, [0]).arrays
    assert tuple(int(arrays[name].sum()) for name in ("hits", "found", "wanted")) == counts


def test_iou_by_class_is_that_of_sets_of_pixels():
    rng = np.random.default_rng(1)
    truth, found = rng.integers(0, 4, (2, 30, 40)).astype(np.uint8)
    truth[:5] = IGNORED
    confusion = count_pixels(truth, found)
    by_hand = []
    for label in range(4):
        one, other = (
            set(zip(*np.nonzero((image == label) & (truth != IGNORED)), strict=True)) for image in (truth, found)
        )
        by_hand.append(len(one & other) / len(one | other))
    assert overlaps(confusion)[:4] == pytest.approx(by_hand)
    assert np.isnan(overlaps(confusion)[4:]).all()
    assert mean_overlap(confusion) == pytest.approx(np.mean(by_hand))
    assert mean_overlap(np.stack((confusion, 2 * confusion))) == pytest.approx([np.mean(by_hand)] * 2)


@pytest.fixture
def network():
    torch.manual_seed(0)
    return RoadNetwork(replace(ROAD.configurations["tiny"], window_px=(64, 32)))


def some_sample(seed=0):
    rng = np.random.default_rng(seed)
    classes = rng.integers(0, CLASSES, (32, 64)).astype(np.uint8)
    classes[:4] = IGNORED
    return Sample(rng.integers(0, 255, (32, 64, 3)).astype(np.uint8), classes)


def test_the_loss_is_weighted_entropy_and_dice_of_the_counted_pixels(network):
    samples = [some_sample(0), some_sample(1)]
    network.eval()  # the same statistics in both computations
    with torch.no_grad():
        ours = float(segmentation_loss(network, samples))
        logits = predict_logits(network, [sample.picture for sample in samples])
    large = functional.interpolate(logits, size=(32, 64), mode="bilinear", align_corners=False).softmax(1).numpy()
    entropy, count = 0.0, 0
    both, either = np.zeros(CLASSES), np.zeros(CLASSES)
    for sample, shares in zip(samples, large, strict=True):
        for row in range(4, 32):
            for column in range(64):
                label = sample.classes[row, column]
                entropy -= WEIGHTS[label] * np.log(shares[label, row, column])
                both[label] += shares[label, row, column]
                either += shares[:, row, column]
                either[label] += 1
                count += 1
    dice = (2 * both + SMOOTH_PX) / (either + SMOOTH_PX)
    assert ours == pytest.approx(entropy / count + DICE * (1 - dice[1:].mean()), rel=1e-3)


def test_ignored_pixels_have_no_gradient(network):
    sample = some_sample()
    changed = replace(sample, classes=np.full_like(sample.classes, IGNORED))
    loss = segmentation_loss(network, [changed])
    loss.backward()
    assert float(loss.detach()) == pytest.approx(DICE * 0, abs=1e-6)
    assert all(float(one.grad.abs().max()) == 0 for one in network.parameters() if one.grad is not None)


def test_pictures_of_any_size_have_a_class_for_every_pixel(network):
    for height, width in ((50, 70), (64, 96)):
        shares, classes = segment_picture(network, np.zeros((height, width, 3), np.uint8))
        assert classes.shape == (height, width)
        assert shares.shape == (CLASSES, -(-height // STRIDE), -(-width // STRIDE))
        assert np.allclose(shares.sum(0), 1, atol=1e-5)


def test_a_window_keeps_each_class_on_its_colour():
    colours = np.arange(CLASSES, dtype=np.uint8) * 30
    classes = np.repeat(np.arange(96) // 14, 160).reshape(96, 160).astype(np.uint8)
    sample = Sample(np.repeat(colours[classes][..., None], 3, axis=2), classes)
    for seed in range(8):
        window = draw_window(
            sample, replace(ROAD.configurations["tiny"], window_px=(64, 48)), np.random.default_rng(seed)
        )
        assert window.picture.shape == (48, 64, 3)
        assert window.classes.shape == (48, 64)
        inner = [label for label in range(1, CLASSES) if (window.classes == label).sum() > 300]
        means = [float(window.picture[window.classes == label].mean()) for label in inner]
        assert means == sorted(means)
        assert set(np.unique(window.classes)) <= {*range(CLASSES), IGNORED}
    assert CROSSING in classes
