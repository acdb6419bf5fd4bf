"""Clients that the processes of a fleet's vehicles import: quick, deterministic, with gradients, and counted."""

import os
import time
from dataclasses import dataclass, field
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


@dataclass(frozen=True)
class Liar(Walker):
    """A client whose vehicle lies about its answer, in the process that it answers one message in."""

    lie: str = ""

    def train(self, weights, *, steps, learning_rate, seed, proximal=0.0, shift=None, centre=None, layers=()):
        from flcav.federation import wire
        from flcav.federation.links import vehicle_app
        from flcav.federation.wire import LOST_BY_NETWORK

        if self.lie == "raises":
            raise OSError("no power")
        answer, size = wire.reply, vehicle_app.wire_bytes
        if self.lie == "large":
            junk = {"junk": np.zeros(250_000)}
            wire.reply = lambda message, update, extra: answer(message, update, junk)
        vehicle_app.wire_bytes = lambda content: 0 if self.lie == "large" else size(content) + 2**63
        if self.lie == "lost by the network":
            vehicle_app.OVER_BUDGET = LOST_BY_NETWORK
        return super().train(weights, steps=steps, learning_rate=learning_rate, seed=seed)


@dataclass(frozen=True)
class SentOutput(LocalUpdate):
    """Outputs that are sent, and a network that is kept."""

    own: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Imitator:
    """A client that sends outputs of a network of its own, which learns from the mean; and a server with one."""

    rate: float = 0.5

    def outputs(self, weights):
        return {"outputs": weights["w"] * 2}

    def imitate(self, weights, outputs, *, steps, learning_rate, seed):
        return {"w": weights["w"] + self.rate * (outputs["outputs"] - weights["w"])}

    def train(self, weights, *, steps, learning_rate, seed, own=None, imitation_steps=1):
        start = own or {"w": np.zeros_like(weights["outputs"])}
        network = {"w": self.imitate(start, weights, steps=0, learning_rate=0, seed=0)["w"] + self.rate}
        return SentOutput(self.outputs(network), 3, self.rate, own=network)
