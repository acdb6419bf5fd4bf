"""Training, the same for every task: batches, learning rates, checkpoints, early stopping."""

from flcav.perception.training.loop import Checkpointing, History, Validation, adamw, batches, step, train, train_steps
from flcav.perception.training.schedules import SCHEDULES

__all__ = [
    "SCHEDULES",
    "Checkpointing",
    "History",
    "Validation",
    "adamw",
    "batches",
    "step",
    "train",
    "train_steps",
]
