"""Training in bfloat16: the same network, nearly the same loss and gradient, the same inference."""

from dataclasses import replace

import pytest
import torch

from flcav.perception.device import multiplies_bfloat16
from flcav.perception.objects.config import tiny_config
from flcav.perception.objects.model import second
from flcav.perception.objects.predict import predict
from flcav.perception.objects.task import OBJECTS

CPU = torch.device("cpu")


def networks():
    config = tiny_config()
    for lower in (False, True):
        torch.manual_seed(0)
        yield second(replace(config, bfloat16=lower))


@pytest.mark.skipif(not multiplies_bfloat16(CPU), reason="this processor does not multiply in bfloat16")
def test_bfloat16_changes_the_loss_and_its_gradient_a_little(sample):
    losses, gradients = [], []
    for network in networks():
        loss = OBJECTS.loss(network.train(), [sample])
        losses.append(float(loss.detach()))
        gradients.append(torch.cat([each.flatten() for each in torch.autograd.grad(loss, list(network.parameters()))]))
        assert loss.dtype == torch.float32
        assert all(parameter.dtype == torch.float32 for parameter in network.parameters())
    assert losses[0] != losses[1]
    assert losses[1] == pytest.approx(losses[0], rel=0.01)
    assert torch.cosine_similarity(*gradients, dim=0) > 0.99


def test_inference_is_in_full_precision(sample):
    with torch.inference_mode():
        full, lower = (predict(network.eval(), [sample.points]) for network in networks())
    assert torch.equal(full.score, lower.score)
    assert torch.equal(full.box, lower.box)
