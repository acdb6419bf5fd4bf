"""Batch normalisation with ReLU against torch's own."""

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from flcav.perception.ops.norm import NormReLU


@pytest.mark.parametrize("shape", [(50, 6), (3, 6, 5, 4)])
def test_equals_batch_norm_then_relu(shape):
    torch.manual_seed(0)
    ours = NormReLU(6).double()
    theirs = (nn.BatchNorm1d if len(shape) == 2 else nn.BatchNorm2d)(6, eps=1e-3, momentum=0.1).double()
    for name in ("weight", "bias"):
        nn.init.normal_(getattr(theirs, name))
        getattr(ours, name).data.copy_(getattr(theirs, name).data)
    for _ in range(3):
        x = torch.randn(shape, dtype=torch.float64) * 3 + 5
        x.requires_grad_()
        y, expected = ours(x), F.relu(theirs(x))
        assert torch.allclose(y, expected, atol=1e-10)
        weights = torch.randn(shape, dtype=torch.float64)
        got = torch.autograd.grad((y * weights).sum(), (x, ours.weight, ours.bias))
        wanted = torch.autograd.grad((expected * weights).sum(), (x, theirs.weight, theirs.bias))
        assert all(torch.allclose(a, b, atol=1e-9) for a, b in zip(got, wanted, strict=True))
    assert theirs.running_var is not None
    assert torch.allclose(ours.running_variance, theirs.running_var)
    ours.eval()
    theirs.eval()
    x = torch.randn(shape, dtype=torch.float64)
    assert torch.allclose(ours(x), F.relu(theirs(x)), atol=1e-10)
