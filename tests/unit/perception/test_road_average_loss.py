"""The loss of federated distillation against independent sums, and where it has no gradient."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from flcav.geometry import Boxes
from flcav.perception.objects.config import SecondConfig, tiny_config
from flcav.perception.objects.distillation import (
    DistillationTerms,
    contrastive_loss,
    distillation_loss,
    info_nce,
    match_boxes,
    pool_boxes,
    regression_loss,
)
from flcav.perception.objects.loss import (
    SMOOTH_L1_BETA,
    Targets,
    assign_anchors,
    cell_size,
    decode_variance,
    encode_variance,
)
from flcav.perception.objects.model import HeadOutput, head_shape, second
from flcav.perception.objects.predict import predict
from flcav.perception.objects.samples import Sample

CONFIG: SecondConfig = tiny_config()
NARROW = replace(  # quick to train
    CONFIG,
    range_m=(0, -16, -3, 40, 16, 1),
    sparse_channels=(4, 4, 4, 4),
    sparse_out=4,
    bev_layers=(0, 0),
    bev_channels=(4, 4),
    bev_up_channels=(4, 4),
)


def cars(*places: tuple[float, float], sd: float | None = None, yaw: float = 0.0) -> Boxes:
    rows = [(x, y, -1.0, 4.4, 1.8, 1.6, yaw) for x, y in places]
    boxes = Boxes.from_array(np.array(rows).reshape(-1, 7), "Car")
    variance = None if sd is None else np.full((len(boxes), 7), sd**2)
    return Boxes(boxes.center, boxes.size, boxes.yaw, boxes.label, None, variance)


def test_info_nce_is_the_negative_logarithm_of_a_softmax_over_cosines() -> None:
    rng = np.random.default_rng(1)
    queries, keys, positive, temperature = rng.normal(size=(3, 8)), rng.normal(size=(5, 8)), np.array([4, 0, 2]), 0.2
    wanted = []
    for query, own in zip(queries, positive, strict=True):
        cosine = [float(query @ key / np.linalg.norm(query) / np.linalg.norm(key)) for key in keys]
        power = np.exp(np.array(cosine) / temperature)
        wanted.append(-np.log(power[own] / power.sum()))
    found = info_nce(torch.from_numpy(queries), torch.from_numpy(keys), torch.from_numpy(positive), temperature)
    np.testing.assert_allclose(found.numpy(), wanted, rtol=1e-9)


def test_pooling_takes_the_mean_inside_a_turned_box() -> None:
    rows, columns = head_shape(CONFIG)
    dx, dy = cell_size(CONFIG)
    x = CONFIG.range_m[0] + (np.arange(columns) + 0.5) * dx
    y = CONFIG.range_m[1] + (np.arange(rows) + 0.5) * dy
    plane = np.stack(np.broadcast_arrays(x[None], y[:, None]))  # features: x and y of the cell
    pooled = pool_boxes(torch.from_numpy(plane), cars((20.3, -7.1), (31.0, 5.5), yaw=0.7), CONFIG)
    np.testing.assert_allclose(pooled.numpy(), [[20.3, -7.1], [31.0, 5.5]], atol=1e-6)  # linear: those of the centre
    strip = torch.from_numpy((np.abs(y[:, None] - 5.5) < 2) * np.ones(columns))[None]
    along, across = cars((20.0, 5.5)), cars((20.0, 5.5), yaw=np.pi / 2)
    assert float(pool_boxes(strip, along, CONFIG)) == pytest.approx(1.0)
    assert float(pool_boxes(strip, across, CONFIG)) < 0.95  # an end sticks out


def test_own_boxes_match_the_nearest_of_their_class_once() -> None:
    own, road = cars((10.0, 0.0), (10.5, 0.0), (30.0, 0.0)), cars((10.4, 0.3), (33.0, 0.0))
    mine, theirs = match_boxes(own, road)
    assert list(zip(mine.tolist(), theirs.tolist(), strict=True)) == [(1, 0)]
    lorry = Boxes(road.center, road.size, road.yaw, np.array(["truck", "truck"]))
    assert not len(match_boxes(own, lorry)[0])
    assert not len(match_boxes(Boxes.empty(), road)[0])


def test_the_contrast_of_a_frame_is_that_of_its_matched_boxes_with_all_others() -> None:
    rng = np.random.default_rng(2)
    features = torch.from_numpy(rng.normal(size=(1, 6, *head_shape(CONFIG))))
    road, own = cars((10.0, 0.0), (20.0, 5.0), (30.0, -8.0)), cars((20.5, 5.2), (40.0, 10.0))
    sample = Sample(np.zeros((0, 4), np.float32), road, own=own)
    query = pool_boxes(features[0], own[[0]], CONFIG).numpy()[0]
    keys = np.concatenate([pool_boxes(features[0], each, CONFIG).numpy() for each in (road, own[[1]])])
    cosine = keys @ query / np.linalg.norm(keys, axis=1) / np.linalg.norm(query)
    wanted = np.log(np.exp(cosine / 0.1).sum()) - cosine[1] / 0.1
    assert float(contrastive_loss(features, [sample], CONFIG, 0.1)) == pytest.approx(wanted)
    alone = Sample(sample.points, road[:0], own=own)
    assert float(contrastive_loss(features, [alone], CONFIG, 0.1)) == 0
    assert float(contrastive_loss(features, [Sample(sample.points, road)], CONFIG, 0.1)) == 0


def test_regression_is_a_mean_weighted_by_inverse_variance() -> None:
    rng = np.random.default_rng(3)
    count = 4
    predicted, residual = rng.normal(size=(9, 7)), rng.normal(size=(count, 7))
    turn, way = rng.normal(size=(9, 2)), np.array([0, 1, 1, 0])
    variance, rows = rng.uniform(0.01, 1, size=(count, 7)), np.array([1, 3, 4, 8])
    error = predicted[rows] - residual
    error[:, 6] = np.sin(error[:, 6])
    size = np.abs(error)
    each = np.where(size < SMOOTH_L1_BETA, size**2 / 2 / SMOOTH_L1_BETA, size - SMOOTH_L1_BETA / 2)
    wanted = sum(2 * np.average(each[:, k], weights=1 / variance[:, k]) for k in range(7))
    entropy = np.log(np.exp(turn[rows]).sum(1)) - turn[rows, way]
    wanted += np.average(entropy, weights=1 / variance[:, 6])

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values)

    output = HeadOutput(torch.zeros(1, 9, 1), tensor(predicted)[None], tensor(turn)[None])
    parts = tensor(rows), torch.zeros(9), tensor(residual), torch.ones(count), tensor(way)
    assert float(regression_loss(output, [Targets(*parts, tensor(variance))])) == pytest.approx(wanted)
    nothing = Targets(*(part[:0] for part in parts))
    assert float(regression_loss(output, [nothing])) == 0


def test_variances_of_boxes_and_residuals_are_each_others_inverse() -> None:
    rng = np.random.default_rng(4)
    boxes, anchors = rng.uniform(1, 5, size=(2, 6, 7))
    variance = rng.uniform(0.01, 1, size=(6, 7))
    np.testing.assert_allclose(decode_variance(encode_variance(variance, boxes, anchors), boxes, anchors), variance)
    targets = assign_anchors(Sample(np.zeros((0, 4), np.float32), cars((20.0, 3.0), sd=0.2)), CONFIG)
    assert targets.variance is not None
    diagonal = np.hypot(4.4, 1.8)
    wanted = [*(0.2 / diagonal,) * 2, 0.2 / 1.6, 0.2 / 4.4, 0.2 / 1.8, 0.2 / 1.6, 0.2]
    np.testing.assert_allclose(np.sqrt(targets.variance[0].numpy()), wanted, rtol=1e-6)


@pytest.mark.parametrize("terms", [DistillationTerms(), DistillationTerms(regression=False)])
def test_confidence_falls_only_where_the_road_saw_free_ground(terms: DistillationTerms) -> None:
    torch.manual_seed(0)
    network = second(NARROW)
    rng = np.random.default_rng(5)
    points = np.column_stack((rng.uniform(1, 47, 300), rng.uniform(-20, 20, 300), np.full(300, -1.8), np.zeros(300)))
    free = np.stack(np.meshgrid(np.arange(30.2, 36, 0.4), np.arange(-15.8, -10, 0.4)), -1).reshape(-1, 2)
    sample = Sample(points.astype(np.float32), cars((12.0, 4.0), sd=0.1), free=free.astype(np.float32))
    kept: list[torch.Tensor] = []
    answer = network.answer

    def watched(features: torch.Tensor) -> HeadOutput:
        output = answer(features)
        output.score.retain_grad()
        kept.append(output.score)
        return output

    network.answer = watched  # pyright: ignore[reportAttributeAccessIssue]
    distillation_loss(network, [sample], terms).backward()
    gradient = kept[0].grad
    assert gradient is not None
    moved = gradient[0, :, 0].numpy()
    targets = assign_anchors(sample, network.config)
    columns = head_shape(network.config)[1]
    place = np.arange(len(moved)) // 2
    x = network.config.range_m[0] + (place % columns + 0.5) * cell_size(network.config)[0]
    y = network.config.range_m[1] + (place // columns + 0.5) * cell_size(network.config)[1]
    inside, outside = (np.maximum(np.abs(x - 33), np.abs(y + 13)) < reach_m for reach_m in (2.5, 3.5))
    positive = np.zeros(len(moved), dtype=bool)
    positive[targets.positive.numpy()] = True
    assert (moved[inside] > 0).all()  # a step against the gradient lowers these scores
    assert (moved[positive] < 0).all()
    assert (moved[~outside & ~positive] == 0).all()
    blind = Sample(sample.points, Boxes.empty(), free=sample.free[:0] if sample.free is not None else None)
    network.zero_grad()
    distillation_loss(network, [blind], terms).backward()
    assert all(p.grad is None or not p.grad.any() for p in network.parameters())


def test_a_network_answers_the_same_from_its_feature_map() -> None:
    torch.manual_seed(0)
    network = second(NARROW).eval()
    points = np.random.default_rng(6).uniform((0, -20, -2, 0), (45, 20, 0, 1), size=(200, 4)).astype(np.float32)
    with torch.inference_mode():
        voxels = network.voxels(torch.from_numpy(points), torch.zeros(200, dtype=torch.int64), 1)
        other = network.answer(network.map_features(voxels))
        assert torch.equal(predict(network, [points]).box, other.box)
