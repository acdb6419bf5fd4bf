"""Sparse convolution against the dense one, in float64; the compiled rules against the tensor ones."""

import pytest
import torch
import torch.nn.functional as F

from flcav.perception.ops import rulebook
from flcav.perception.ops.rulebook import build_strided_rulebook, build_submanifold_rulebook, decode_keys, encode_cells
from flcav.perception.ops.sparse import SparseTensor, StridedConv3d, SubmanifoldConv3d, second_core, sparse_convolution

GRIDS = [((9, 14, 11), 2, 0.15), ((5, 20, 7), 3, 0.4), ((4, 3, 3), 1, 1.0), ((6, 9, 8), 2, 0.01)]
STRIDED = [
    ((3, 3, 3), (2, 2, 2), (1, 1, 1)),
    ((3, 3, 3), (2, 2, 2), (0, 1, 1)),
    ((3, 1, 1), (2, 1, 1), (0, 0, 0)),
]


def scene(shape, samples, share, channels=5):
    """Return an occupancy, float64 features of the occupied cells, and the cells as a sparse tensor."""
    generator = torch.Generator().manual_seed(7)
    occupied = torch.rand(samples, *shape, generator=generator) < share
    cells = occupied.nonzero()
    features = torch.randn(len(cells), channels, dtype=torch.float64, generator=generator, requires_grad=True)
    return occupied, cells, features, SparseTensor(features, encode_cells(cells, shape), shape, samples)


def dense_of(features, cells, shape, samples):
    grid = torch.zeros(samples, *shape, features.shape[1], dtype=features.dtype)
    return grid.index_put(tuple(cells.t()), features).permute(0, 4, 1, 2, 3)


def assert_same(dense, sparse, features, weight):
    assert dense.shape == sparse.shape
    assert (dense - sparse).abs().max() < 1e-9
    weights = torch.randn(dense.shape, dtype=torch.float64)
    ours = torch.autograd.grad((sparse * weights).sum(), (features, weight))
    theirs = torch.autograd.grad((dense * weights).sum(), (features, weight))
    for one, other in zip(ours, theirs, strict=True):
        assert (one - other).abs().max() < 1e-9


@pytest.mark.parametrize(("shape", "samples", "share"), GRIDS)
def test_submanifold_is_the_dense_convolution_on_its_voxels(shape, samples, share):
    occupied, cells, features, x = scene(shape, samples, share)
    layer = SubmanifoldConv3d(5, 6).double()
    kernel = layer.weight.view(3, 3, 3, 5, 6).permute(4, 3, 0, 1, 2)
    dense = F.conv3d(dense_of(features, cells, shape, samples), kernel, padding=1) * occupied[:, None]
    assert_same(dense, layer(x).dense(), features, layer.weight)


@pytest.mark.parametrize(("kernel", "stride", "padding"), STRIDED)
@pytest.mark.parametrize(("shape", "samples", "share"), GRIDS)
def test_strided_is_the_dense_convolution(shape, samples, share, kernel, stride, padding):
    _, cells, features, x = scene(shape, samples, share)
    layer = StridedConv3d(5, 6, kernel, stride, padding).double()
    weight = layer.weight.view(*kernel, 5, 6).permute(4, 3, 0, 1, 2)
    dense = F.conv3d(dense_of(features, cells, shape, samples), weight, stride=stride, padding=padding)
    assert_same(dense, layer(x).dense(), features, layer.weight)


@pytest.mark.parametrize(("shape", "samples", "share"), GRIDS)
def test_gradients_on_two_cores_have_the_same_bits(shape, samples, share):
    _, _, features, x = scene(shape, samples, share, channels=16)
    layer = SubmanifoldConv3d(16, 32).double()

    def gradients() -> tuple[torch.Tensor, ...]:
        return torch.autograd.grad(layer(x).features.sin().sum(), (features, layer.weight))

    alone = gradients()
    with second_core():
        both = gradients()
    assert all(torch.equal(one, other) for one, other in zip(alone, both, strict=True))


def test_features_that_need_no_gradient_get_none():
    _, _, _, x = scene((5, 6, 7), 1, 0.3)
    layer = SubmanifoldConv3d(5, 6).double()
    layer(x.with_features(x.features.detach())).features.sum().backward()
    assert layer.weight.grad is not None


def test_birds_eye_stacks_layers_as_channels():
    _, cells, features, x = scene((3, 5, 4), 2, 0.3)
    stacked = dense_of(features, cells, (3, 5, 4), 2)  # (B, C, D, H, W)
    assert torch.equal(x.birds_eye(), stacked.permute(0, 2, 1, 3, 4).flatten(1, 2))


def test_keys_and_cells_are_inverse():
    _, cells, _, x = scene((4, 5, 6), 3, 0.5)
    assert torch.equal(decode_keys(x.keys, x.shape), cells)
    assert (x.keys.diff() > 0).all()


def assert_same_pairs(compiled, plain):
    assert (compiled.counts, compiled.targets) == (plain.counts, plain.targets)
    assert torch.equal(compiled.source, plain.source)
    assert torch.equal(compiled.target, plain.target)


@pytest.mark.parametrize(("shape", "samples", "share"), GRIDS)
def test_the_grouped_sum_of_other_devices_equals_the_compiled_one(shape, samples, share):
    x = scene(shape, samples, share)[3]
    compiled = build_submanifold_rulebook(x.keys, shape)
    plain = rulebook._build_submanifold_rulebook(x.keys, shape[1] + 2, shape[2] + 2)
    pairs = [(compiled, plain)]
    for kernel, stride, padding in STRIDED:
        one, _, out_shape = build_strided_rulebook(x.keys, shape, kernel, stride, padding, samples)
        pairs.append(
            (one, rulebook._build_strided_rulebook(x.keys, shape, kernel, stride, padding, out_shape, samples)[0])
        )
    for one, other in pairs:
        weight = torch.randn(len(one.counts), 5, 6, dtype=torch.float64, requires_grad=True)
        a, b = sparse_convolution(x.features, weight, one), sparse_convolution(x.features, weight, other)
        assert torch.allclose(a, b, atol=1e-12)
        for ours, theirs in zip(
            *(torch.autograd.grad(y.square().sum(), (x.features, weight)) for y in (a, b)), strict=True
        ):
            assert torch.allclose(ours, theirs, atol=1e-10)


@pytest.mark.parametrize(("shape", "samples", "share"), GRIDS)
def test_compiled_rules_equal_the_tensor_rules(shape, samples, share):
    x = scene(shape, samples, share)[3]
    compiled = build_submanifold_rulebook(x.keys, shape)
    plain = rulebook._build_submanifold_rulebook(x.keys, shape[1] + 2, shape[2] + 2)
    assert_same_pairs(compiled, plain)
    for kernel, stride, padding in STRIDED:
        compiled, keys, out_shape = build_strided_rulebook(x.keys, shape, kernel, stride, padding, samples)
        plain, plain_keys = rulebook._build_strided_rulebook(x.keys, shape, kernel, stride, padding, out_shape, samples)
        assert torch.equal(keys, plain_keys)
        assert_same_pairs(compiled, plain)


def test_blocks_shorter_than_an_offset_give_the_same():
    _, cells, features, x = scene((9, 14, 11), 2, 0.3, channels=70)  # blocks of 53 pairs
    layer = SubmanifoldConv3d(70, 70).double()
    kernel = layer.weight.view(3, 3, 3, 70, 70).permute(4, 3, 0, 1, 2)
    dense = F.conv3d(dense_of(features, cells, (9, 14, 11), 2), kernel, padding=1)
    wanted = dense.permute(0, 2, 3, 4, 1)[tuple(cells.t())]
    assert (layer(x).features - wanted).abs().max() < 1e-9


def test_training_after_inference():
    _, _, _, x = scene((5, 6, 7), 1, 0.3)
    layer = SubmanifoldConv3d(5, 6).double()
    with torch.inference_mode():
        layer(x)
    layer(x).features.sum().backward()
    assert layer.weight.grad is not None
