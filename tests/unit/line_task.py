"""The task of fitting a line, for tests of training and of federations: one network of two weights."""

from typing import Any

import numpy as np
import torch
from pydantic.dataclasses import dataclass

from flcav.perception.task import Practice


@dataclass(frozen=True)
class Slope:
    bias: bool = True


class Line(torch.nn.Linear):
    """y = a x + b."""

    def __init__(self, config: Slope) -> None:
        super().__init__(1, 1)
        self.config = config


class LineTask:
    """Fits y = 2 x to samples x."""

    name, family, configurations, practice = "line", "line", {"tiny": Slope()}, Practice(2, learning_rate=0.1)
    build = Line

    def draw(self, samples: Any, index: Any, config: Any, rng: Any) -> Any:
        return samples[index]

    def loss(self, network: Any, samples: Any) -> Any:
        x = torch.tensor(np.array(samples))[:, None]
        return ((network(x) - 2 * x) ** 2).mean()
