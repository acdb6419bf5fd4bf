"""The task that peers are compared on: pfl-research's benchmark of CIFAR's shape, on random pictures.

A network of 1,626,442 parameters; 1,000 users of 50 pictures, 50 of them in turn in each round, who take one pass in
batches of 10 by plain gradient descent at a rate of 0.1: 250 steps a round. Dropout is left out, so that every peer
ends with the same weights.
"""

import os
import sys

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

USERS, POINTS, COHORT, BATCH, RATE = 1000, 50, 50, 10, 0.1

Points = list[tuple[Tensor, Tensor]]  # batches of pictures (10, 3, 32, 32) and classes (10,)


def build() -> nn.Sequential:
    """Return the network with the weights that all peers begin with."""
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(3, 32, 3),
        nn.ReLU(),
        nn.Conv2d(32, 64, 3),
        nn.ReLU(),
        nn.MaxPool2d(2),
        nn.Flatten(),
        nn.Linear(12544, 128),
        nn.ReLU(),
        nn.Linear(128, 10),
    )


def draw_points(user: int) -> tuple[Tensor, Tensor]:
    """Return a user's pictures (50, 3, 32, 32) and their classes (50,)."""
    rng = np.random.default_rng(user)
    pictures = rng.standard_normal((POINTS, 3, 32, 32), dtype=np.float32)
    return torch.from_numpy(pictures), torch.from_numpy(rng.integers(0, 10, POINTS))


def choose_users(round_: int) -> list[int]:
    """Return the users of a round, counted from 1."""
    return [((round_ - 1) * COHORT + place) % USERS for place in range(COHORT)]


def train(network: nn.Module, user: int) -> None:
    """Take the user's local steps, in place."""
    optimizer = torch.optim.SGD(network.parameters(), RATE)
    for pictures, classes in zip(*(each.split(BATCH) for each in draw_points(user)), strict=True):
        optimizer.zero_grad()
        functional.cross_entropy(network(pictures), classes).backward()
        optimizer.step()


class Turns:
    """The peer's side of the comparison: before each round it waits for its turn, and tells a sum of its weights."""

    def __init__(self) -> None:
        """Keep standard output for the driver; whatever libraries print goes to standard error."""
        torch.set_num_threads(1)
        self._driver = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)

    def wait(self, weights: list[np.ndarray]) -> None:
        """Tell the driver that a round is over (or none has begun), with its weights, and wait."""
        total = sum(float(np.abs(array.astype(np.float64)).sum()) for array in weights)
        self._driver.write(f"{total!r}\n")
        self._driver.flush()
        sys.stdin.readline()
