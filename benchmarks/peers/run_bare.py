"""A bare loop: the users of a round train one after another, and their weights are averaged.

In several processes each has an equal part of the users, and tells the sum of their weights.
"""

import multiprocessing
import sys
from multiprocessing.connection import Connection

import torch
from torch import Tensor
from work import COHORT, Turns, build, choose_users, train

Weights = dict[str, Tensor]


class Loop:
    """The users at some places of a round, trained with one network."""

    def __init__(self, first: int, step: int) -> None:
        torch.set_num_threads(1)
        self._network, self._places = build(), slice(first, None, step)

    def add_up(self, round_: int, weights: Weights) -> Weights:
        """Return the sum of the users' weights after training from `weights`."""
        total = {name: torch.zeros_like(tensor) for name, tensor in weights.items()}
        for user in choose_users(round_)[self._places]:
            self._network.load_state_dict(weights)
            train(self._network, user)
            for name, tensor in self._network.state_dict().items():
                total[name] += tensor
        return total


def serve(pipe: Connection, first: int, step: int) -> None:
    """Do the rounds that are asked for, with weights as NumPy arrays, until None is."""
    loop = Loop(first, step)
    while (asked := pipe.recv()) is not None:
        round_, weights = asked
        total = loop.add_up(round_, {name: torch.from_numpy(array) for name, array in weights.items()})
        pipe.send({name: tensor.numpy() for name, tensor in total.items()})


def main(rounds: int, processes: int) -> None:
    turns, own, context = Turns(), Loop(0, processes), multiprocessing.get_context("spawn")
    others = []
    for first in range(1, processes):
        here, there = context.Pipe()
        context.Process(target=serve, args=(there, first, processes), daemon=True).start()
        others.append(here)
    weights = {name: tensor.clone() for name, tensor in build().state_dict().items()}
    turns.wait([tensor.numpy() for tensor in weights.values()])
    for round_ in range(1, rounds + 1):
        for other in others:
            other.send((round_, {name: tensor.numpy() for name, tensor in weights.items()}))
        total = own.add_up(round_, weights)
        for other in others:
            for name, array in other.recv().items():
                total[name] += torch.from_numpy(array)
        weights = {name: tensor / COHORT for name, tensor in total.items()}
        turns.wait([tensor.numpy() for tensor in weights.values()])
    for other in others:
        other.send(None)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
