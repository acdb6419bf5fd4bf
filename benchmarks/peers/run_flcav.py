"""flcav: clients of the in-process federation, in one process or in several."""

import contextlib
import sys
from collections.abc import Iterator, Mapping
from functools import lru_cache

import torch
from torch import nn
from work import COHORT, POINTS, RATE, USERS, Turns, build, train

from flcav.federation.links.metered import Account
from flcav.federation.links.processes import ClientProcesses
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.network.ledger import Ledger, LinkMegabytes


@lru_cache
def network() -> nn.Module:
    """Return the network of this process."""
    return build()


class User:
    """A user as a client."""

    def __init__(self, number: int) -> None:
        self.number = number

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        """Return the weights after a pass over the user's pictures."""
        network().load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
        train(network(), self.number)
        after = {name: tensor.numpy().copy() for name, tensor in network().state_dict().items()}
        return LocalUpdate(after, POINTS, 0.0)


class Users(Mapping[str, Trainable]):
    """All users, made when they are asked for."""

    def __getitem__(self, name: str) -> Trainable:
        return User(int(name))

    def __iter__(self) -> Iterator[str]:
        return map(str, range(USERS))

    def __len__(self) -> int:
        return USERS


def main(rounds: int, processes: int) -> None:
    turns, users = Turns(), Users()
    weights = {name: tensor.numpy() for name, tensor in build().state_dict().items()}
    turns.wait([*weights.values()])
    with ClientProcesses(users, processes) if processes > 1 else contextlib.nullcontext() as runtime:
        federate(
            users,
            weights,
            Schedule(rounds, 5, RATE, RATE, 0),
            Account(Ledger(LinkMegabytes(1e6, 1e6)), "edge", "peers", "wireless"),
            rules=Rules(selection=Selection(rule="round-robin", clients=COHORT)),
            on_round=lambda round_, after, loss: turns.wait([*after.values()]),
            runtime=runtime,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
