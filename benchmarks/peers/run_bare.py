"""A bare loop: the users of a round train one after another, and their weights are averaged."""

import sys

import torch
from work import COHORT, Turns, build, choose_users, train


def main(rounds: int) -> None:
    turns, network = Turns(), build()
    weights = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    turns.wait([tensor.numpy() for tensor in weights.values()])
    for round_ in range(1, rounds + 1):
        total = {name: torch.zeros_like(tensor) for name, tensor in weights.items()}
        for user in choose_users(round_):
            network.load_state_dict(weights)
            train(network, user)
            for name, tensor in network.state_dict().items():
                total[name] += tensor
        weights = {name: tensor / COHORT for name, tensor in total.items()}
        turns.wait([tensor.numpy() for tensor in weights.values()])


if __name__ == "__main__":
    main(int(sys.argv[1]))
