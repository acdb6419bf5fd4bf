"""Training, the same for every task: batches, learning rates, checkpoints, early stopping."""

from flcav.perception.training.loop import (
    SCHEDULES,
    Checkpointing,
    History,
    Validation,
    adamw,
    batches,
    step,
    train,
    train_steps,
)

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
