"""Groups of edge FL on request: requests, selection of members, and early stopping (Wang et al., IEEE Network, 2023).

A vehicle checks the deployed network against its labels (from tracks, the map or the road's boxes) on frames that it
holds back from training. Where the network errs, it sends a request. Vehicles in range of it offer their data: counts
of labels and a sketch of the gradient, by which the lead estimates how much the data add.
"""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flcav.federation.links.link import Ask
from flcav.federation.trainable import Trainable, Weights
from flcav.geometry.arrays import Array
from flcav.network.ledger import Ledger, send_message
from flcav.optimization.quality import data_quality, gradient_novelty, label_distribution_distance, visible_objects
from flcav.runs.extras.groups.members import MESSAGE, SCORE, GroupMember, Offer, Unreadable, read_loss
from flcav.runs.extras.groups.settings import Requests
from flcav.runs.recipe import EDGE

SERVER_RANGE = "out of V2X range of whoever asked"
ABSENT = "not in the town"
NO_LINK = "no link to spare"
NOT_NEEDED = "its data add less"
FULL = "the group is full"


@dataclass(frozen=True)
class Chosen:
    """The members of a group in a region, by name, and the reasons why others did not join."""

    members: tuple[str, ...]  # those that sent requests first
    quality: Mapping[str, float]  # of the offered data in (0, 1], by client
    stayed: Mapping[str, str]  # reason for not joining, by client


def weigh_offers(offers: Mapping[str, Offer]) -> dict[str, float]:
    """Return the quality of offered data in (0, 1], by client: from labels, visible objects and novelty of gradients.

    For a task without classes it depends on gradients alone.
    """
    classes = sorted({label for offer in offers.values() for label in offer.labels})
    counts = np.array([[offer.labels.get(label, 0) for label in classes] for offer in offers.values()])
    distance = label_distribution_distance(counts) if classes else np.zeros(len(offers))
    novelty = gradient_novelty([offer.sketch for offer in offers.values()])
    seen = visible_objects(counts.sum(axis=1), [offer.samples for offer in offers.values()]) if classes else None
    return dict(zip(offers, data_quality(distance, seen, novelty).tolist(), strict=True))


def find_in_range(positions: Mapping[str, Array], of: Sequence[str], range_m: float) -> list[str]:
    """Return the clients within `range_m` [m] of any client in `of`, including these.

    `positions`: (3,) by client, world frame [m].
    """
    centres = [positions[name] for name in of if name in positions]
    near = lambda position: any(np.linalg.norm(position - centre) <= range_m for centre in centres)  # noqa: E731
    return [name for name, position in positions.items() if name in of or near(position)]


def find_lead(
    positions: Mapping[str, Array], asked: Sequence[str], servers: Mapping[str, Array], range_m: float
) -> str:
    """Return the lead: the nearest edge server in range of a vehicle that `asked`, or else the lowest name in range.

    `positions`: (3,) of the vehicles present, by client, world frame [m]. `servers`: (3,) of the edge servers, by name,
    world frame [m]. `range_m`: range of V2X radio [m].
    """
    distances = {
        server: min(
            (float(np.linalg.norm(positions[name] - at)) for name in asked if name in positions), default=np.inf
        )
        for server, at in servers.items()
    }
    nearest = min(distances, key=lambda server: distances[server], default=None)
    if nearest is not None and distances[nearest] <= range_m:
        return nearest
    return min(find_in_range(positions, asked, range_m) or asked)


def choose_members(
    how: Requests,
    asked: Sequence[str],
    quality: Mapping[str, float],
    stayed: Mapping[str, str],
    most: int | None = None,
) -> Chosen:
    """Choose the members of a group: vehicles that `asked`, then those with good enough data, the best first.

    `asked`: vehicles with requests and offers, the largest error first. `quality`: of all offers, by client. `stayed`:
    reason for not making an offer, by client. `most`: number of members by the plan; None: that of `how`.
    """
    others = sorted((name for name in quality if name not in asked), key=lambda name: (-quality[name], name))
    good = [name for name in others if quality[name] >= how.least_quality * max(quality.values())]
    came = (*asked, *good)[: most or how.most]
    left = {name: NOT_NEEDED for name in others if name not in good} | dict.fromkeys((*asked, *good)[len(came) :], FULL)
    return Chosen(came, quality, {**stayed, **left})


def has_levelled(losses: Sequence[float], how: Requests) -> bool:
    """Return whether the loss has levelled off: the last `patience` rounds lowered its minimum by too small a share.

    `losses`: before the first round, and after every round.
    """
    if len(losses) <= how.patience:
        return False
    best = min(losses[: -how.patience])
    return min(losses[-how.patience :]) > best - how.least_gain * abs(best)


@dataclass
class GroupWatch:
    """Early stopping of a group by the loss on its members' held-out frames, round by round."""

    how: Requests
    members: Mapping[str, GroupMember]  # that hold samples back, by client
    losses: list[float] = field(default_factory=list)  # before the first round, and after every round

    def enlist(self, clients: Mapping[str, Trainable]) -> dict[str, Trainable]:
        """Return the clients of a group's rounds; members among them also answer questions."""
        members = {name: replace(member, client=clients[name]) for name, member in self.members.items()}
        return {name: members.get(name, client) for name, client in clients.items()}

    def hear(self, ask: Ask, weights: Weights, *, counted: bool = True) -> dict[str, bytes]:
        """Ask the members for a network's loss on their held-back samples; return their messages, by client."""
        replies = ask(SCORE, [*self.members], weights, counted=counted)
        return {name: answer[MESSAGE].tobytes() for name, answer in replies.answers.items() if MESSAGE in answer}

    def note(self, messages: Mapping[str, bytes]) -> None:
        """Record the mean of the reported losses; if none is reported, that of the previous round."""
        losses = [*read_losses(messages).values()]
        self.losses.append(float(np.mean(losses)) if losses else self.losses[-1])

    def follow(self, book: Ledger, number: int, weights: Weights, ask: Ask) -> None:
        """Record the loss after a round; the members' messages enter `book`. Raises `BudgetExceeded`."""
        messages = self.hear(ask, weights)
        self.note(messages)
        for name, message in messages.items():
            about: Any = {"stage": EDGE, "task": self.members[name].task.name, "link": "wireless", "direction": "up"}
            send_message(book, message, client=name, round_=number, **about)

    @property
    def over(self) -> bool:
        """Whether the loss has levelled off; it never does without members that hold samples back."""
        return bool(self.members) and has_levelled(self.losses, self.how)


def read_losses(messages: Mapping[str, bytes]) -> dict[str, float]:
    """Decode the losses in messages, by client; unreadable messages are left out."""
    found: dict[str, float] = {}
    for name, message in messages.items():
        with contextlib.suppress(Unreadable):
            found[name] = read_loss(message)
    return found
