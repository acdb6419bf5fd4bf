"""Curves of a training as TensorBoard event files."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from flcav.perception.training.loop import Watch


@contextlib.contextmanager
def event_files(folder: Path) -> Iterator[Watch]:
    """Yield a `Watch` that writes scalars below `folder`, which is made with the first one.

    A run that goes on from a checkpoint hides what an interrupted one wrote after it.
    """
    writer: Any = None

    def watch(step: int, values: Mapping[str, float]) -> None:
        nonlocal writer
        if writer is None:
            from torch.utils.tensorboard import SummaryWriter

            writer = SummaryWriter(folder, purge_step=step)
        for name, value in values.items():
            writer.add_scalar(name, value, step)

    try:
        yield watch
    finally:
        if writer is not None:
            writer.close()
