"""Where networks run: the choice by name, and on a GPU the same numbers with one wait for each set of rules."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from flcav.cli.main import run
from flcav.config import InputError
from flcav.perception.device import CPU, select_device
from flcav.perception.objects import Sample
from flcav.perception.objects.config import tiny_config
from flcav.perception.objects.model import Second, second
from flcav.perception.objects.task import OBJECTS
from flcav.perception.ops import norm, rulebook
from flcav.perception.ops.rulebook import build_strided_rulebook, build_submanifold_rulebook, encode_cells
from flcav.perception.ops.sparse import sparse_convolution

SHAPE, SAMPLES = (9, 14, 11), 2
STRIDED = ((3, 3, 3), (2, 2, 2), (1, 1, 1))
with_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
without_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there")


@pytest.fixture
def keys():
    occupied = torch.rand(SAMPLES, *SHAPE, generator=torch.Generator().manual_seed(7)) < 0.2
    return encode_cells(occupied.nonzero(), SHAPE)


def network(device: torch.device, bfloat16: bool = False) -> Second:
    torch.manual_seed(0)
    return second(replace(tiny_config(), bfloat16=bfloat16)).to(device).train()


def loss_and_gradient(network: Second, sample: Sample) -> tuple[float, torch.Tensor]:
    loss = OBJECTS.loss(network, [sample])
    parts = torch.autograd.grad(loss, list(network.parameters()))
    return float(loss.detach()), torch.cat([part.flatten().cpu() for part in parts])


def apart(one: tuple[float, torch.Tensor], other: tuple[float, torch.Tensor]) -> tuple[float, float]:
    """Return how much two losses differ, relative to the first, and 1 - the cosine between their gradients."""
    return abs(other[0] / one[0] - 1), 1 - float(torch.cosine_similarity(one[1], other[1], dim=0))


class SizesAsked(TorchDispatchMode):
    """Collects the operations whose result, or its size, the host has to wait for."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        tags = {torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape} & set(func.tags)
        if func is torch.ops.aten.index.Tensor:
            tags = {index for index in args[1] if index is not None and index.dtype == torch.bool}
        if tags and kwargs.get("output_size") is None:
            self.found.append(str(func))
        return func(*args, **kwargs)


def test_a_device_has_a_name():
    assert select_device("cpu") == CPU
    assert select_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    with pytest.raises(InputError, match="device 'gpu': choose one of auto, cpu, cuda"):
        select_device("gpu")


@without_gpu
def test_a_gpu_that_is_not_there_is_one_sentence(tmp_path, capsys):
    (tmp_path / "sweep.bin").write_bytes(np.zeros((9, 4), np.float32).tobytes())
    with pytest.raises(SystemExit) as stopped:
        run(["infer", "objects", str(tmp_path / "sweep.bin"), "--device", "cuda"])
    assert stopped.value.code == 2
    assert "device 'cuda': torch finds no GPU it can use; choose cpu or auto" in capsys.readouterr().err


def test_the_tensor_rules_ask_for_all_sizes_at_once(keys, monkeypatch):
    waits = []
    to_list = torch.Tensor.tolist
    monkeypatch.setattr(torch.Tensor, "tolist", lambda tensor: waits.append(1) or to_list(tensor))
    with SizesAsked() as asked:
        keys.nonzero()
        assert asked.found == ["aten.nonzero.default"]
        rulebook._build_submanifold_rulebook(keys, SHAPE[1] + 2, SHAPE[2] + 2)
        rulebook._build_strided_rulebook(keys, SHAPE, *STRIDED, (5, 7, 6), SAMPLES)
    assert asked.found == ["aten.nonzero.default"]
    assert len(waits) == 2


def test_the_grouped_product_follows_autocast(keys):
    made = rulebook._build_submanifold_rulebook(keys, SHAPE[1] + 2, SHAPE[2] + 2)
    features = torch.randn(len(keys), 8, requires_grad=True)
    weight = torch.randn(27, 8, 6, requires_grad=True)
    full = sparse_convolution(features, weight, made)
    with torch.autocast("cpu", torch.bfloat16):
        half = sparse_convolution(features, weight, made)
    assert half.dtype == torch.bfloat16
    assert torch.allclose(half.float(), full, rtol=0.05, atol=0.2)
    gradients = torch.autograd.grad(half.float().sum(), (features, weight))
    for ours, theirs in zip(gradients, torch.autograd.grad(full.sum(), (features, weight)), strict=True):
        assert ours.dtype == torch.float32
        assert torch.cosine_similarity(ours.flatten(), theirs.flatten(), dim=0) > 0.999


@pytest.mark.slow
@pytest.mark.parametrize("bfloat16", [False, True])
def test_the_network_is_the_same_from_tensor_operations(sample, bfloat16, monkeypatch):
    compiled = loss_and_gradient(network(CPU), sample)
    monkeypatch.setattr(rulebook, "_compiled", lambda keys: False)
    monkeypatch.setattr(norm, "_written_out", lambda x: False)
    loss, gradient = apart(compiled, loss_and_gradient(network(CPU, bfloat16), sample))
    assert loss <= (0.02 if bfloat16 else 1e-4)
    assert gradient < (0.02 if bfloat16 else 0.0001)


@with_gpu
def test_rules_are_those_of_the_cpu_after_one_wait(keys):
    expected = [build_submanifold_rulebook(keys, SHAPE), *build_strided_rulebook(keys, SHAPE, *STRIDED, SAMPLES)[:1]]
    there = keys.cuda()
    for one, make in zip(
        expected,
        (
            lambda: build_submanifold_rulebook(there, SHAPE),
            lambda: build_strided_rulebook(there, SHAPE, *STRIDED, SAMPLES)[0],
        ),
        strict=True,
    ):
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode("warn")
        with warnings.catch_warnings(record=True) as waits:
            warnings.simplefilter("always")
            made = make()
        torch.cuda.set_sync_debug_mode("default")
        assert len(waits) == 1
        assert (made.counts, made.targets) == (one.counts, one.targets)
        assert torch.equal(made.source.cpu(), one.source)
        assert torch.equal(made.target.cpu(), one.target)


@with_gpu
@pytest.mark.parametrize("bfloat16", [False, True])
def test_a_gpu_finds_the_loss_and_gradient_of_the_cpu(sample, bfloat16):
    compiled = loss_and_gradient(network(CPU), sample)
    loss, gradient = apart(compiled, loss_and_gradient(network(torch.device("cuda"), bfloat16), sample))
    assert loss <= (0.02 if bfloat16 else 1e-4)
    assert gradient < (0.02 if bfloat16 else 0.0001)
