"""The training loop: AdamW on augmented mini-batches, a learning-rate schedule, validation with early stopping.

Training is deterministic in its seed, and a run resumed from a checkpoint ends with the same weights.
"""

import copy
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from flcav.arrays import Array, Ints
from flcav.config import DamagedFile, InputError
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import suggest
from flcav.perception.task import ConfigT, NetworkT, SampleT, Task
from flcav.perception.training.checkpoint import AdamW, RunState, load_checkpoint, save_checkpoint
from flcav.statistics.streams import stream

CLIP_NORM = 10.0  # largest norm of the gradient
Watch = Callable[[int, Mapping[str, float]], None]  # called with the number of steps taken and scalars by name
Correct = Callable[[nn.Module], None]  # called before each step, to change the gradients of the network's parameters


def constant(done: float) -> float:
    """Return 1, the constant schedule."""
    return 1.0


def one_cycle(done: float) -> float:
    """Return the one-cycle schedule: the share of the peak learning rate after a share `done` in [0, 1] of the steps.

    It rises from 1/25 to 1 over the first 30 % and falls to 1/10000, both along a cosine (Smith and Topin,
    "Super-Convergence", 2018).
    """
    warm, low, floor = 0.3, 1 / 25, 1e-4
    if done < warm:
        return 1 - (1 - low) * (1 + math.cos(math.pi * done / warm)) / 2
    return floor + (1 - floor) * (1 + math.cos(math.pi * (done - warm) / (1 - warm))) / 2


SCHEDULES: dict[str, Callable[[float], float]] = {"constant": constant, "one_cycle": one_cycle}


def _unwatched(step: int, values: Mapping[str, float]) -> None:
    pass


@dataclass(frozen=True)
class Checkpointing:
    """File and interval of the checkpoints of a run."""

    path: Path
    every: int = 50  # steps between checkpoints
    of: str = ""  # part of the run's identity in addition to the arguments of `train`, such as its data


@dataclass(frozen=True)
class Validation:
    """Validation during a training, and the rule of early stopping."""

    score: Callable[[nn.Module], float]  # validation score of a network; more is better
    every: int  # steps between validations
    patience: int | None = None  # validations without a new best after which training stops; None: never

    def is_over(self, scores: Sequence[float]) -> bool:
        """Return whether training stops: none of the last `patience` of `scores` is above all scores before them."""
        if self.patience is None:
            return False
        return len(scores) > self.patience and max(scores[-self.patience :]) <= max(scores[: -self.patience])


@dataclass(frozen=True)
class TrainingHistory:
    """Losses and validation scores of a training."""

    losses: Array  # (steps,) loss of each batch; fewer than the requested steps after early stopping
    scores: Array  # (validations,)


def train(
    task: Task[ConfigT, NetworkT, SampleT],
    network: NetworkT,
    samples: Sequence[SampleT],
    *,
    steps: int,
    batch: int | None = None,
    learning_rate: float | None = None,
    schedule: str | None = None,
    seed: int,
    checkpointing: Checkpointing | None = None,
    validation: Validation | None = None,
    watch: Watch = _unwatched,
    progress: Report = ignore_progress,
    correct: Correct | None = None,
    optimizer: AdamW | None = None,
) -> TrainingHistory:
    """Train `network` in place for `steps` optimiser steps; hyperparameters default to `task.practice`.

    Each epoch goes through the samples in a new random order. With the `patience` of `validation`, training may stop
    early, and the network gets the weights of the best validation. With `checkpointing`, an interrupted run is resumed
    from its file and ends with the same weights. `watch` receives loss, learning rate and validation score; `correct`
    changes the gradients before they are clipped. Training continues with the moments of `optimizer`, which it updates;
    None: they start at zero. A damaged checkpoint is reported, and training starts anew. Raises `InputError` without
    samples, for an unknown schedule, and if the checkpoint belongs to another run.
    """
    batch = task.practice.batch if batch is None else batch
    learning_rate = task.practice.learning_rate if learning_rate is None else learning_rate
    schedule = task.practice.schedule if schedule is None else schedule
    if not samples:
        raise InputError("training on 0 samples: at least one is wanted")
    if schedule not in SCHEDULES:
        raise InputError(f"schedule '{schedule}': choose one of {', '.join(SCHEDULES)}{suggest(schedule, SCHEDULES)}")
    network.train()
    optimizer = optimizer or AdamW(network, learning_rate)
    waits = None if validation is None else (validation.every, validation.patience)
    settings = [task.name, repr(network.config), steps, batch, learning_rate, schedule, seed, waits]
    identity = f"{json.dumps(settings)} on {len(samples)} samples {checkpointing.of if checkpointing else ''}"
    done, begun = RunState(), copy.deepcopy(network.state_dict()) if checkpointing else {}
    if checkpointing:
        try:
            done = load_checkpoint(checkpointing.path, identity, network, optimizer)
        except DamagedFile as error:
            progress(0, steps, str(error))
            network.load_state_dict(begun)
            optimizer = AdamW(network, learning_rate)
    order = batches(len(samples), batch, steps, seed)
    config: Any = network.config  # an attribute of every network of a task
    for number in range(len(done.losses), steps):
        if validation and validation.is_over(done.scores):
            break
        rate = learning_rate * SCHEDULES[schedule](number / steps)
        optimizer.learning_rate = rate
        drawn = [
            task.draw(samples, int(index), config, stream(seed, "augment", number, place))
            for place, index in enumerate(order[number])
        ]
        done.losses.append(step(task, network, optimizer, drawn, correct))
        watch(number + 1, {"loss": done.losses[-1], "learning rate": rate})
        if validation and (number + 1) % validation.every == 0:
            _validate(validation, network, done)
            watch(number + 1, {"score": done.scores[-1]})
        progress(number + 1, steps, _note(done))
        if checkpointing and (number + 1) % checkpointing.every == 0:
            save_checkpoint(checkpointing.path, identity, done, network, optimizer)
    if done.best is not None:
        network.load_state_dict(done.best)
    return TrainingHistory(np.array(done.losses), np.array(done.scores))


def train_steps(
    task: Task[ConfigT, NetworkT, SampleT],
    network: NetworkT,
    samples: Sequence[SampleT],
    *,
    steps: int,
    batch: int | None = None,
    learning_rate: float,
    seed: int,
    watch: Watch = _unwatched,
    correct: Correct | None = None,
    optimizer: AdamW | None = None,
) -> float:
    """Train `network` in place at a constant learning rate, as a federated client does.

    Returns the mean loss, 0 for 0 steps; raises as `train` does. `watch`, `correct` and `optimizer` are as in `train`.
    """
    history = train(
        task,
        network,
        samples,
        steps=steps,
        batch=batch,
        learning_rate=learning_rate,
        schedule="constant",
        seed=seed,
        watch=watch,
        correct=correct,
        optimizer=optimizer,
    )
    return float(history.losses.mean()) if steps else 0.0


def step(
    task: Task[ConfigT, NetworkT, SampleT],
    network: NetworkT,
    optimizer: AdamW,
    samples: Sequence[SampleT],
    correct: Correct | None = None,
) -> float:
    """Take one optimiser step on a batch, with the gradient's norm clipped to `CLIP_NORM`, and return the loss.

    `correct` changes the gradient before it is clipped.
    """
    loss = task.loss(network, samples)
    network.zero_grad()
    loss.backward()
    if correct is not None:
        correct(network)
    torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)
    optimizer.step()
    return float(loss.detach())


def batches(samples: int, batch: int, steps: int, seed: int) -> Ints:
    """Return the sample indices of the batches (steps, batch): shuffled epochs one after another, cut into batches.

    A batch has at most as many samples as there are.
    """
    batch = min(batch, samples)
    passes = [stream(seed, "order", i).permutation(samples) for i in range(-(-steps * batch // samples))]
    order = np.concatenate([np.zeros(0, dtype=np.int64), *passes])
    return order[: steps * batch].reshape(steps, batch)


def _validate(validation: Validation, network: nn.Module, done: RunState) -> None:
    score = validation.score(network)
    if validation.patience is not None and score > max(done.scores, default=-np.inf):
        done.best = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    done.scores.append(score)


def _note(done: RunState) -> str:
    loss = f"loss {np.mean(done.losses[-20:]):.3f}"
    return f"{loss}, score {done.scores[-1]:.3f} (best {max(done.scores):.3f})" if done.scores else loss
