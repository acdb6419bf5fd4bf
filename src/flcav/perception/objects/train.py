"""Training: samples in, changed weights out, the same for the same seed, wherever it was interrupted."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flcav.config import InputError
from flcav.perception.objects.augment import augment
from flcav.perception.objects.checkpoint import load_checkpoint, save_checkpoint
from flcav.perception.objects.config import Augmentation
from flcav.perception.objects.loss import second_loss
from flcav.perception.objects.model import HeadOutput, Second
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.targets import assign
from flcav.progress import Report, silent
from flcav.seeds import stream

CLIP_NORM = 10.0
GLOBAL = Augmentation()  # of every sample, at every step


def constant(done: float) -> float:
    """Return 1: the learning rate stays."""
    return 1.0


def one_cycle(done: float) -> float:
    """Return the share of the peak learning rate when a share `done` in [0, 1] of the steps is over.

    From 1/25 up to 1 over the first 30 %, then down to 1/10000, both along a cosine (Smith and Topin, 2018).
    """
    warm, low, floor = 0.3, 1 / 25, 1e-4
    if done < warm:
        return 1 - (1 - low) * (1 + math.cos(math.pi * done / warm)) / 2
    return floor + (1 - floor) * (1 + math.cos(math.pi * (done - warm) / (1 - warm))) / 2


SCHEDULES: dict[str, Callable[[float], float]] = {"constant": constant, "one_cycle": one_cycle}


@dataclass(frozen=True)
class Checkpointing:
    """Where a run leaves off, and how often it says so."""

    path: Path
    every: int = 50  # steps


def train(
    network: Second,
    samples: Sequence[Sample],
    *,
    steps: int,
    batch: int = 2,
    learning_rate: float = 2e-3,
    schedule: str = "one_cycle",
    seed: int,
    augmentation: Augmentation | None = GLOBAL,
    checkpointing: Checkpointing | None = None,
    progress: Report = silent,
) -> NDArray[np.float64]:
    """Train `network` in place and return the loss of each of `steps` batches.

    Batches go through the samples in a random order, drawn anew each time round. With `checkpointing`, a run that was
    cut off goes on from its file to the very same weights. Raises `InputError` without samples, for an unknown
    schedule, and where the checkpoint is of another run.
    """
    if not samples:
        raise InputError("training on 0 samples: at least one is wanted")
    if schedule not in SCHEDULES:
        raise InputError(f"schedule '{schedule}': choose one of {', '.join(SCHEDULES)}")
    network.train()
    optimizer = adamw(network, learning_rate)
    identity = json.dumps([repr(network.config), steps, batch, learning_rate, schedule, seed, repr(augmentation)])
    identity += f" on {len(samples)} samples"
    losses = np.zeros(steps)
    first = load_checkpoint(checkpointing.path, identity, network, optimizer, losses) if checkpointing else 0
    order = batches(len(samples), batch, steps, seed)
    for number in range(first, steps):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * SCHEDULES[schedule](number / steps)
        drawn = [draw(samples[i], augmentation, seed, number, place) for place, i in enumerate(order[number])]
        losses[number] = step(network, optimizer, drawn)
        progress(number + 1, steps, f"loss {losses[max(0, number - 19) : number + 1].mean():.3f}")
        if checkpointing and (number + 1) % checkpointing.every == 0:
            save_checkpoint(checkpointing.path, identity, number + 1, network, optimizer, losses)
    return losses


def train_steps(
    network: Second,
    samples: Sequence[Sample],
    *,
    steps: int,
    batch: int = 2,
    learning_rate: float,
    seed: int,
    augmentation: Augmentation | None = GLOBAL,
) -> float:
    """Train `network` in place at a constant learning rate, as a federation's client does; return the mean loss."""
    losses = train(
        network,
        samples,
        steps=steps,
        batch=batch,
        learning_rate=learning_rate,
        schedule="constant",
        seed=seed,
        augmentation=augmentation,
    )
    return float(losses.mean()) if steps else 0.0


def adamw(network: Second, learning_rate: float) -> torch.optim.AdamW:
    """Return the optimiser SECOND is trained with here."""
    return torch.optim.AdamW(network.parameters(), learning_rate, betas=(0.9, 0.99), weight_decay=0.01, fused=True)


def step(network: Second, optimizer: torch.optim.Optimizer, samples: Sequence[Sample]) -> float:
    """Take one optimiser step on a batch and return its loss."""
    loss = batch_loss(network, samples)
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)
    optimizer.step()
    return float(loss.detach())


def batch_loss(network: Second, samples: Sequence[Sample]) -> Tensor:
    """Return the loss of a batch, differentiable in the network's parameters."""
    targets = [assign(sample, network.config) for sample in samples]
    return second_loss(predict(network, [sample.points for sample in samples]), targets, network.config)


def predict(network: Second, clouds: Sequence[NDArray[np.float32]]) -> HeadOutput:
    """Return the raw predictions for a batch of point clouds (N_i, 4), LiDAR frame."""
    device = network.head.weight.device
    points = torch.from_numpy(np.concatenate(clouds)).to(device)
    sizes = torch.tensor([len(cloud) for cloud in clouds], device=device)
    sample = torch.repeat_interleave(torch.arange(len(clouds), device=device), sizes)
    return network(network.voxels(points, sample, len(clouds)))


def batches(samples: int, batch: int, steps: int, seed: int) -> NDArray[np.int64]:
    """Return (steps, batch) sample indices: one shuffled pass after another, cut into batches."""
    batch = min(batch, samples)
    passes = [stream(seed, "order", i).permutation(samples) for i in range(-(-steps * batch // samples))]
    order = np.concatenate([np.zeros(0, dtype=np.int64), *passes])
    return order[: steps * batch].reshape(steps, batch)


def draw(sample: Sample, augmentation: Augmentation | None, seed: int, number: int, place: int) -> Sample:
    """Return the sample as step `number` sees it at a place of its batch."""
    return sample if augmentation is None else augment(sample, augmentation, stream(seed, "augment", number, place))
