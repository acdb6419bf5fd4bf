"""Training steps: samples in, changed weights out, the same for the same seed."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from flcav.config import InputError
from flcav.perception.objects.augment import Augmentation, augment
from flcav.perception.objects.loss import second_loss
from flcav.perception.objects.model import HeadOutput, Second
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.targets import assign
from flcav.seeds import stream

CLIP_NORM = 10.0


def adamw(network: Second, learning_rate: float) -> torch.optim.AdamW:
    """Return the optimiser SECOND is trained with here."""
    return torch.optim.AdamW(network.parameters(), learning_rate, betas=(0.9, 0.99), weight_decay=0.01, fused=True)


def predict(network: Second, clouds: Sequence[np.ndarray]) -> HeadOutput:
    """Return the raw predictions for a batch of point clouds (N_i, 4), LiDAR frame."""
    device = network.head.weight.device
    points = torch.from_numpy(np.concatenate(clouds)).to(device)
    sizes = torch.tensor([len(cloud) for cloud in clouds], device=device)
    sample = torch.repeat_interleave(torch.arange(len(clouds), device=device), sizes)
    return network(network.voxels(points, sample, len(clouds)))


def batch_loss(network: Second, samples: Sequence[Sample]) -> Tensor:
    """Return the loss of a batch, differentiable in the network's parameters."""
    targets = [assign(sample, network.config) for sample in samples]
    return second_loss(predict(network, [sample.points for sample in samples]), targets, network.config)


def step(network: Second, optimizer: torch.optim.Optimizer, samples: Sequence[Sample]) -> float:
    """Take one optimiser step on a batch and return its loss."""
    loss = batch_loss(network, samples)
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)
    optimizer.step()
    return float(loss.detach())


def train_steps(
    network: Second,
    samples: Sequence[Sample],
    *,
    steps: int,
    batch: int = 2,
    learning_rate: float,
    seed: int,
    augmentation: Augmentation | None = Augmentation(),
) -> float:
    """Train `network` in place at a constant learning rate and return the mean loss over the steps.

    Batches go through the samples in a random order, drawn anew each time round. Raises `InputError` without samples.
    """
    if not samples:
        raise InputError("training on 0 samples: at least one is wanted")
    network.train()
    optimizer = adamw(network, learning_rate)
    losses = [
        step(network, optimizer, [drawn(samples[i], augmentation, seed, number, i) for i in indices])
        for number, indices in enumerate(batches(len(samples), batch, steps, seed))
    ]
    return float(np.mean(losses)) if losses else 0.0


def batches(samples: int, batch: int, steps: int, seed: int) -> list[np.ndarray]:
    """Return the sample indices of each of `steps` batches: one shuffled pass after another."""
    batch = min(batch, samples)
    wanted = steps * batch
    passes = [stream(seed, "order", i).permutation(samples) for i in range(-(-wanted // samples))]
    return list(np.concatenate(passes)[:wanted].reshape(steps, batch)) if passes else []


def drawn(sample: Sample, augmentation: Augmentation | None, seed: int, number: int, index: int) -> Sample:
    """Return sample `index` as step `number` sees it."""
    return (
        sample if augmentation is None else augment(sample, augmentation, stream(seed, "augment", number, int(index)))
    )
