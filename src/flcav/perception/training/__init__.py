"""Training of any task's networks: mini-batches, learning-rate schedules, checkpoints, early stopping."""

from flcav.perception.training.loop import (
    SCHEDULES,
    Checkpointing,
    TrainingHistory,
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
    "TrainingHistory",
    "Validation",
    "adamw",
    "batches",
    "step",
    "train",
    "train_steps",
]
