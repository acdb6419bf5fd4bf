"""The sign detector: its published size, targets and loss by brute force, windows, mAP on cases by hand, the toy."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from flcav.perception.ops.boxes import complete_iou
from flcav.perception.signs.evaluate import ClassPrecision, SignTruth, mean_average_precision
from flcav.perception.signs.loss import BOX, CLASS, LEVELS, MOST_TIMES, OBJECT, assign_levels, detection_loss
from flcav.perception.signs.model import CONFIGURATIONS, STRIDES, SignDetector, SignsConfig, decode_boxes, decode_level
from flcav.perception.signs.predict import SignDetections, detect_in_picture
from flcav.perception.signs.samples import GREY, Sample, crop_sample, draw_mosaic, draw_window, join_mosaic
from flcav.perception.signs.task import SIGNS, SignsTask
from flcav.perception.task import build_network
from flcav.perception.training import train

TINY = replace(CONFIGURATIONS["n"], window_px=(96, 64), classes=("a", "b", "c"))
NO_BOXES = np.zeros((0, 4))
PAINT = np.array([(230, 20, 20), (20, 20, 230), (230, 230, 20)], np.uint8)


def painted(seed: int, width: int = 96, height: int = 64) -> Sample:
    """Return a noisy picture with a square of one class in its left and one in its right half."""
    random = np.random.default_rng(seed)
    picture = random.integers(60, 140, (height, width, 3)).astype(np.uint8)
    side, label = random.integers(10, 24, 2), random.integers(0, 3, 2)
    x = random.integers(1, width // 2 - 25, 2) + np.array([0, width // 2])
    y = random.integers(1, height - 25, 2)
    for s, number, left, top in zip(side, label, x, y, strict=True):
        picture[top : top + s, left : left + s] = PAINT[number]
    boxes = np.stack((x, y, x + side, y + side), 1).astype(float)
    return Sample(picture, boxes, label.astype(np.int64), NO_BOXES)


def parameters(network: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def folded(network: torch.nn.Module) -> int:
    """Return the parameters where each normalisation is folded into its convolution, which leaves its bias."""
    norms = [module.num_features for module in network.modules() if isinstance(module, torch.nn.BatchNorm2d)]
    return parameters(network) - sum(norms)


def test_published_sizes():
    many = tuple(f"class{number}" for number in range(80))
    n, s = (SignDetector(replace(CONFIGURATIONS[name], classes=many)) for name in ("n", "s"))
    assert (folded(n), folded(s)) == (1_867_405, 7_225_885)
    assert parameters(s) == 7_235_389
    assert parameters(SignDetector(CONFIGURATIONS["n"])) == pytest.approx(1.77e6, rel=0.005)
    assert parameters(SignDetector(CONFIGURATIONS["s"])) == pytest.approx(7.04e6, rel=0.005)


def test_raw_predictions_have_a_cell_for_every_stride_and_few_objects_at_first():
    raw = build_network(SIGNS, TINY, 0).eval()(torch.rand(2, 3, 64, 96))
    assert [tuple(maps.shape) for maps in raw] == [(2, 3, 64 // s, 96 // s, 8) for s in STRIDES]
    assert all(maps[..., 4].sigmoid().mean() < 0.01 for maps in raw)


def test_boxes_are_decoded_about_cell_and_anchor():
    raw = torch.zeros(1, 3, 2, 4, 8)
    raw[0, 1, 1, 2, :4] = torch.tensor([math.log(3), 0, math.log(3), 0])  # shares 0.75, 0.5, 0.75, 0.5
    width, height = TINY.anchors_px[0][1]
    x, y, w, h = (2 + 1.0) * 8, (1 + 0.5) * 8, width * 1.5**2, height
    found = decode_level(raw, 0, TINY)[0, 1, 1, 2]
    assert found.tolist() == pytest.approx([x - w / 2, y - h / 2, x + w / 2, y + h / 2], rel=1e-5)


def expected_places(samples, config, level):
    """Return (image, anchor, row, column, label) of every assignment, box by box."""
    stride, out = STRIDES[level], []
    rows, columns = samples[0].picture.shape[0] // stride, samples[0].picture.shape[1] // stride
    for image, sample in enumerate(samples):
        for (x1, y1, x2, y2), label in zip(sample.boxes, sample.label, strict=True):
            x, y = (x1 + x2) / 2 / stride, (y1 + y2) / 2 / stride
            column, row = min(int(x), columns - 1), min(int(y), rows - 1)
            beside = column - 1 if x - column < 0.5 else column + 1
            above = row - 1 if y - row < 0.5 else row + 1
            for anchor, (w, h) in enumerate(config.anchors_px[level]):
                times = max((x2 - x1) / w, w / (x2 - x1), (y2 - y1) / h, h / (y2 - y1))
                if times < MOST_TIMES:
                    cells = [(row, column), (row, beside), (above, column)]
                    inside = [(r, c) for r, c in cells if 0 <= r < rows and 0 <= c < columns]
                    out += [(image, anchor, r, c, int(label)) for r, c in inside]
    return out


def found_places(one):
    return zip(*(t.tolist() for t in (one.image, one.anchor, one.row, one.column, one.label)), strict=True)


def test_targets_are_those_of_the_definition():
    samples = [painted(seed) for seed in range(4)]
    for level, one in enumerate(assign_levels(samples, TINY)):
        assert sorted(found_places(one)) == sorted(expected_places(samples, TINY, level))
    assert sum(len(one.image) for one in assign_levels(samples, TINY)) > 20


def test_every_target_can_be_reached_by_its_anchor():
    for level, one in enumerate(assign_levels([painted(seed) for seed in range(4)], TINY)):
        cell = torch.stack((one.column, one.row), 1)
        center = (one.box[:, :2] + one.box[:, 2:]) / 2 / STRIDES[level] - cell
        assert bool(((center >= -0.5) & (center <= 1.5)).all())


def test_the_loss_is_the_sum_of_its_parts():
    samples = [painted(0), replace(painted(1), ignore=np.array([[0.0, 0, 30, 30]]))]
    generator = torch.Generator().manual_seed(0)
    raw = [torch.randn(2, 3, 64 // s, 96 // s, 8, generator=generator) for s in STRIDES]
    targets = assign_levels(samples, TINY)
    expected = 0.0
    for level, (maps, one) in enumerate(zip(raw, targets, strict=True)):
        wanted, counted = torch.zeros(maps.shape[:4]), one.counted[:, None].repeat(1, 3, 1, 1)
        boxes, classes = [], []
        for i, (image, anchor, row, column, label) in enumerate(found_places(one)):
            cell = maps[image, anchor, row, column]
            size = torch.tensor(TINY.anchors_px[level][anchor])
            box = decode_boxes(cell[:4], torch.tensor([column, row]), size, STRIDES[level])
            overlap = float(complete_iou(box[None], one.box[i : i + 1]))
            boxes.append(1 - overlap)
            right = torch.zeros(3)
            right[label] = 1
            share = cell[5:].sigmoid()
            classes.append(float(-(right * share.log() + (1 - right) * (1 - share).log()).mean()))
            wanted[image, anchor, row, column] = max(float(wanted[image, anchor, row, column]), overlap, 0)
            counted[image, anchor, row, column] = True
        share = maps[..., 4].sigmoid()
        each = -(wanted * share.log() + (1 - wanted) * (1 - share).log())
        expected += OBJECT * LEVELS[level] * float(each[counted].mean())
        if boxes:
            expected += BOX * float(np.mean(boxes)) + CLASS * float(np.mean(classes))
    assert not targets[0].counted.all()
    assert float(detection_loss(raw, targets, TINY)) == pytest.approx(expected, rel=1e-4)


def test_half_precision_hardly_changes_the_loss():
    samples = [painted(seed) for seed in range(4)]
    network = build_network(SIGNS, TINY, 0)
    pictures = torch.from_numpy(np.stack([sample.picture for sample in samples])).permute(0, 3, 1, 2).float() / 255
    whole = detection_loss(network(pictures), assign_levels(samples, TINY), TINY)
    loss = SIGNS.loss(network, samples)
    assert loss.dtype == torch.float32
    assert loss.item() == pytest.approx(whole.item(), rel=0.02)


def test_pictures_without_signs_have_a_loss():
    network = build_network(SIGNS, TINY, 0)
    empty = Sample(painted(0).picture, NO_BOXES, np.zeros(0, np.int64), NO_BOXES)
    loss = SIGNS.loss(network, [empty, empty])
    loss.backward()
    assert torch.isfinite(loss)
    assert loss > 0


def is_painted(sample: Sample, box, label: int) -> bool:
    x, y = (np.array(box[:2]) + box[2:]) / 2
    return bool(np.abs(sample.picture[int(y), int(x)].astype(int) - PAINT[label]).max() < 30)


def test_boxes_go_with_their_pixels_into_windows_and_mosaics():
    for seed in range(30):
        random = np.random.default_rng(seed)
        parts = [(draw_window(painted(seed + i), 48, 32, TINY, random), 48 * (i % 2), 32 * (i // 2)) for i in range(4)]
        for sample in (draw_window(painted(seed), 96, 64, TINY, random), join_mosaic(parts, 96, 64)):
            assert sample.picture.shape == (64, 96, 3)
            assert all(is_painted(sample, box, label) for box, label in zip(sample.boxes, sample.label, strict=True))
            assert (sample.boxes >= 0).all()
            assert (sample.boxes <= [96, 64, 96, 64]).all()


def test_a_cut_ignores_what_it_leaves_too_little_of():
    sample = Sample(
        np.zeros((40, 40, 3), np.uint8), np.array([[0.0, 0, 10, 10], [20, 20, 30, 30]]), np.array([0, 1]), NO_BOXES
    )
    part = crop_sample(sample, (6, 0, 40, 40), (80, 80), TINY)
    assert part.boxes.tolist() == [[28, 40, 48, 60]]
    assert part.label.tolist() == [1]
    assert part.ignore.tolist() == [[0, 0, 8, 20]]
    assert (part.picture[:, -8:] == GREY).all()


def test_training_sees_windows_of_one_size_the_same_for_a_seed():
    samples = [painted(seed, 140, 100) for seed in range(5)]
    one, other = ([draw_mosaic(samples, i, TINY, np.random.default_rng(i)) for i in range(5)] for _ in range(2))
    assert all(sample.picture.shape == (64, 96, 3) for sample in one)
    assert all(np.array_equal(a.picture, b.picture) for a, b in zip(one, other, strict=True))


def test_mosaics_look_for_rare_classes():
    common, rare = painted(0, 140, 100), painted(1, 140, 100)
    samples = [replace(common, label=np.zeros_like(common.label))] * 9 + [replace(rare, label=np.full(2, 2))]
    random = np.random.default_rng(0)
    seen = np.concatenate([draw_mosaic(samples, 0, TINY, random).label for _ in range(200)])
    assert (seen == 2).sum() > 0.15 * (seen == 0).sum()  # though it is in a tenth of the pictures


def found(*rows) -> SignDetections:
    """Return detections of rows (x, y, side, class, score)."""
    array = np.array(rows, dtype=float).reshape(-1, 5)
    box = np.concatenate((array[:, :2], array[:, :2] + array[:, 2:3]), 1)
    return SignDetections(box, array[:, 3].astype(np.int64), array[:, 4])


def truth(*rows, neutral=NO_BOXES) -> SignTruth:
    one = found(*((*row, 1.0) for row in rows))
    return SignTruth(one.box, one.label, neutral)


def test_map_of_cases_by_hand():
    classes = ("a", "b")
    perfect = mean_average_precision([found((10, 10, 20, 0, 0.9))], [truth((10, 10, 20, 0))], classes, 6)
    assert (perfect.map50, perfect.map50_95) == (1, 1)
    assert perfect.classes[1] == ClassPrecision("b", None, None, 0)
    assert [row.map50 for row in perfect.sizes] == [None, 1, None]
    half = [found((10, 10, 20, 0, 0.9)), found()]
    missed = mean_average_precision(half, [truth((10, 10, 20, 0))] * 2, classes, 6)
    assert missed.map50 == pytest.approx(51 / 101)  # precision 1 at 51 of the 101 recalls of COCO
    false_first = [found((60, 60, 20, 0, 0.95), (10, 10, 20, 0, 0.9))]
    assert mean_average_precision(false_first, [truth((10, 10, 20, 0))], classes, 6).map50 == pytest.approx(0.5)
    shifted = mean_average_precision([found((13, 10, 20, 0, 0.9))], [truth((10, 10, 20, 0))], classes, 6)
    assert shifted.map50 == 1
    assert shifted.map50_95 == pytest.approx(0.5)  # IoU 17 / 23: right at 0.5, 0.55, ..., 0.7
    wrong = mean_average_precision([found((10, 10, 20, 1, 0.9))], [truth((10, 10, 20, 0))], classes, 6)
    assert wrong.map50 == 0


def test_neutral_and_tiny_findings_are_no_mistakes():
    classes, target = ("a", "b"), (10, 10, 20, 0)
    neutral = np.array([[60.0, 60, 70, 80]])
    right = (10, 10, 20, 0, 0.5)
    for extra in ((61, 61, 9, 0, 0.9), (61, 61, 9, 1, 0.9), (100, 100, 4, 0, 0.9)):
        assert mean_average_precision([found(right, extra)], [truth(target, neutral=neutral)], classes, 6).map50 == 1
    mistake = mean_average_precision([found(right, (100, 100, 9, 0, 0.9))], [truth(target)], classes, 6)
    assert mistake.map50 == pytest.approx(0.5)


def test_nothing_found_and_nothing_to_find():
    nothing = mean_average_precision([found()], [truth()], ("a",), 6)
    assert nothing.map50 is None
    assert nothing.score == 0
    assert mean_average_precision([found()], [truth((10, 10, 20, 0))], ("a",), 6).map50 == 0


def test_any_size_of_picture_is_looked_at():
    network = build_network(SIGNS, SignsConfig(width=0.25, depth=0.33), 0)
    for shape in ((64, 96, 3), (37, 131, 3)):
        seen = detect_in_picture(network, np.zeros(shape, np.uint8), threshold=0.0)
        assert len(seen)
        assert (seen.box >= 0).all()
        assert (seen.box <= [shape[1], shape[0]] * 2).all()
        assert (np.diff(seen.score) <= 0).all()
    assert network.training


@pytest.mark.slow
class WithoutAugmentation(SignsTask):
    def draw(self, samples, index, config, rng):
        return samples[index]


@pytest.mark.slow
def test_it_learns_eight_pictures():
    samples = [painted(seed) for seed in range(8)]
    network = build_network(SIGNS, TINY, 0)

    def map50() -> float:
        seen = [detect_in_picture(network, sample.picture, threshold=0.01) for sample in samples]
        truths = [SignTruth(s.boxes, s.label, s.ignore) for s in samples]
        return mean_average_precision(seen, truths, TINY.classes, 6).score

    assert map50() < 0.1
    losses = train(WithoutAugmentation(), network, samples, steps=60, seed=0).losses
    assert losses[-20:].mean() < losses[:20].mean()
    assert map50() > 0.8
