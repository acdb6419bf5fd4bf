"""Training of any task's networks: mini-batches, learning-rate schedules, checkpoints, early stopping."""

from flcav.perception.training.checkpoint import AdamW
from flcav.perception.training.loop import (
    SCHEDULES,
    Checkpointing,
    TrainingHistory,
    Validation,
    batches,
    step,
    train,
    train_steps,
)

__all__ = [
    "SCHEDULES",
    "AdamW",
    "Checkpointing",
    "TrainingHistory",
    "Validation",
    "batches",
    "step",
    "train",
    "train_steps",
]
