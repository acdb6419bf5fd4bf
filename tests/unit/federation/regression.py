"""A task small enough to check a federation by hand: least squares by gradient steps."""

from dataclasses import dataclass

import numpy as np

from flcav.federation.trainable import LocalUpdate, Weights
from flcav.network.ledger import Ledger, LinkMegabytes


@dataclass
class Regression:
    inputs: np.ndarray
    targets: np.ndarray
    fail: bool = False

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        if self.fail:
            raise RuntimeError("no power")
        rng = np.random.default_rng(seed)
        w = weights["w"].astype(np.float64)
        losses = []
        for _ in range(steps):
            i = rng.integers(len(self.inputs))
            residual = float(self.inputs[i] @ w - self.targets[i])
            losses.append(residual**2)
            w = w - learning_rate * 2 * residual * self.inputs[i]
        count = weights["count"] + np.int64(steps)
        return LocalUpdate({"w": w.astype(np.float32), "count": count}, len(self.inputs), float(np.mean(losses)))

    def count_samples(self, steps: int) -> int:
        return len(self.inputs)


START = {"w": np.zeros(3, dtype=np.float32), "count": np.array(0, dtype=np.int64)}
TRUTH = np.array([1.0, -2.0, 0.5])


def vehicles(region: str, number: int) -> dict[str, Regression]:
    rng = np.random.default_rng(number)
    out = {}
    for i in range(number):
        inputs = rng.normal(size=(4 + i, 3))
        out[f"{region}/cav{i}"] = Regression(inputs, inputs @ TRUTH)
    return out


def ledger(wireless_mb: float = 1.0, wireline_mb: float = 1.0) -> Ledger:
    return Ledger(LinkMegabytes(wireless_mb, wireline_mb))
