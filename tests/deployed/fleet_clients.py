"""Clients that the processes of a fleet's vehicles import: quick, deterministic, with gradients, and counted."""

import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flcav.federation.trainable import LocalUpdate


@dataclass(frozen=True)
class Walker:
    """A client whose gradients are drawn by its seed; each training leaves a line in `log`, where there is one."""

    samples: int
    log: Path | None = None
    lasts_s: float = 0.0

    def train(self, weights, *, steps, learning_rate, seed, proximal=0.0, shift=None, centre=None, layers=()):
        if self.log is not None:
            with self.log.open("a") as file:
                file.write(f"{self.samples} {os.getpid()}\n")
        time.sleep(self.lasts_s)
        rng = np.random.default_rng(seed)
        learned = {name: array for name, array in weights.items() if np.issubdtype(array.dtype, np.floating)}
        gradient = {name: rng.normal(size=array.shape).astype(array.dtype) for name, array in learned.items()}
        moved = {}
        for name, array in weights.items():
            whole = gradient.get(name, np.zeros_like(array)) + (shift or {}).get(name, 0)
            moved[name] = (array - learning_rate * steps * whole).astype(array.dtype)
        return LocalUpdate(moved, self.samples, float(rng.random()), gradient)

    def count_samples(self, steps):
        return self.samples
