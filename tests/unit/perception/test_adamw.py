"""AdamW, against `torch.optim.AdamW`."""

import subprocess
import sys

import pytest
import torch
from torch import nn

from flcav.perception.training.checkpoint import BETAS, EPSILON, WEIGHT_DECAY, AdamW

RATES = (1e-3, 4e-3, 2e-3, 5e-4)


def network() -> nn.Module:
    torch.manual_seed(3)
    made = nn.Sequential(nn.Linear(6, 5), nn.BatchNorm1d(5), nn.Linear(5, 2))
    made[0].bias.requires_grad_(False)  # a parameter without a gradient
    return made


def set_gradients(own: nn.Module, number: int) -> None:
    own.zero_grad()
    inputs = torch.randn(8, 6, generator=torch.Generator().manual_seed(number))
    own(inputs).square().sum().backward()


def test_its_steps_are_those_of_pytorch_to_the_bit() -> None:
    own, theirs = network(), network()
    ours = AdamW(own, 1.0)
    other = torch.optim.AdamW(
        theirs.parameters(), betas=BETAS, eps=EPSILON, weight_decay=WEIGHT_DECAY, fused=True, amsgrad=False
    )
    for number, rate in enumerate(RATES):
        set_gradients(own, number)
        set_gradients(theirs, number)
        ours.learning_rate = other.param_groups[0]["lr"] = rate
        ours.step()
        other.step()
        for name, value in own.state_dict().items():
            assert torch.equal(value, theirs.state_dict()[name]), name


def test_it_goes_on_from_its_state() -> None:
    whole, cut = network(), network()
    first, second = AdamW(whole, 1e-3), AdamW(cut, 1e-3)
    for number in range(2):
        set_gradients(whole, number)
        first.step()
    cut.load_state_dict(whole.state_dict())
    second.restore({name: [each.clone() for each in held] for name, held in first.state().items()})
    for own, optimizer in ((whole, first), (cut, second)):
        set_gradients(own, 2)
        optimizer.step()
    assert all(torch.equal(value, cut.state_dict()[name]) for name, value in whole.state_dict().items())


def test_the_state_of_another_network_is_refused() -> None:
    with pytest.raises(ValueError, match=r"first: \(5, 6\) instead of \(4, 6\)"):
        AdamW(nn.Linear(6, 4), 1e-3).restore(AdamW(nn.Linear(6, 5), 1e-3).state())


def test_without_a_gradient_nothing_changes() -> None:
    own = network()
    before = {name: value.clone() for name, value in own.state_dict().items()}
    AdamW(own, 1e-3).step()
    assert all(torch.equal(value, before[name]) for name, value in own.state_dict().items())


@pytest.mark.slow
def test_training_does_without_the_compiler() -> None:
    code = """
import sys
import torch
from flcav.perception.training.checkpoint import AdamW
own = torch.nn.Linear(2, 1)
own(torch.ones(1, 2)).sum().backward()
torch.nn.utils.clip_grad_norm_(own.parameters(), 1.0)
AdamW(own, 0.1).step()
sys.exit("torch._dynamo" in sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
