"""Centralised training: the pretraining of stage I, and a control that takes as many steps as stage II."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flcav.interface.progress import Report
from flcav.perception.outcomes import score_network
from flcav.perception.task import Task
from flcav.perception.training import Checkpointing, Validation, train, train_steps
from flcav.perception.weights import save_network
from flcav.pipeline.federations.checkpoint import LAST
from flcav.pipeline.frames import Frames
from flcav.pipeline.learning import Learning
from flcav.pipeline.recipe import PRETRAIN
from flcav.pipeline.results.saved import WEIGHTS
from flcav.pipeline.results.training import Validated
from flcav.statistics.streams import derive_seed

CHECKPOINT, ROUND = "checkpoint.pt", LAST
VALIDATIONS, APART = 10, 5  # during pretraining; at least so many steps apart


def pretrain(
    learning: Learning, samples: Sequence[Any], validation: Sequence[Frames], folder: Path, report: Report
) -> tuple[Validated, ...]:
    """Pretrain with the task's schedule of the learning rate; return the validations on the way.

    Writes the weights of the last step. An interrupted training resumes after its last validation.
    """
    task, steps = learning.task, learning.training.steps
    every = max(steps // VALIDATIONS, min(APART, steps))
    network = learning.build_network()
    history = train(
        task,
        network,
        samples,
        steps=steps,
        batch=learning.batch,
        seed=derive_seed(learning.seed, PRETRAIN),
        checkpointing=Checkpointing(folder / CHECKPOINT, every),
        validation=Validation(lambda now: mean_score(task, now, validation), every),
        progress=report,
    )
    save_network(task, network, folder / WEIGHTS)
    (folder / CHECKPOINT).unlink()
    means = history.losses[: every * len(history.scores)].reshape(-1, every).mean(axis=1)
    return tuple(
        Validated(every * number, float(loss), float(score))
        for number, (loss, score) in enumerate(zip(means, history.scores, strict=True), start=1)
    )


def mean_score(task: Task, network: Any, splits: Sequence[Frames]) -> float:
    """Return the task's measure on the vehicles' frames, as the mean over `splits`."""
    return float(np.mean([score_network(task, network, split.data, split.vehicles) for split in splits]))


def train_centrally(
    learning: Learning, network: Any, samples: Sequence[Any], rounds: int, clients: int, name: str
) -> tuple[float, ...]:
    """Train centrally, in place, for as many steps as a federation of `clients` takes in `rounds`, at the same rates.

    Returns the mean loss of each round.
    """
    schedule = learning.schedule(rounds, learning.training.local_steps * clients, "more", name)
    losses = []
    for round_ in range(1, rounds + 1):
        work = schedule.work(round_)
        losses.append(
            train_steps(
                learning.task,
                network,
                samples,
                steps=work.steps,
                batch=learning.batch,
                learning_rate=work.learning_rate,
                seed=work.seed,
            )
        )
    return tuple(losses)
