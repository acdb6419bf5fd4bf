"""Records of groups: requests and their reasons, members, costs, and vehicles mended."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from flcav.interface.wording import plural
from flcav.storage.records import LEFT_OUT, Record


@dataclass(frozen=True)
class CheckedNetwork(Record):
    """A vehicle's check of the network that drives, on labelled frames that it holds back."""

    held_back: int  # frames
    before: float  # loss of the network that drives
    after: float | None = None  # of the group's network; None: it is in no group
    asks: bool = False  # whether `before` is above the limit, so that it sends a request, or it had asked its fleet
    told: Annotated[float | None, LEFT_OUT] = None  # loss in the FL request by which it had asked its fleet

    @property
    def error(self) -> float:
        """Return the loss that is compared with the limit."""
        return self.before if self.told is None else max(self.before, self.told)


@dataclass(frozen=True)
class LeadTerm(Record):
    """The term of a lead."""

    lead: str  # client
    first: int  # round, from 1
    left: int | None = None  # round in which it is gone; None: it leads to the end
    received: int | None = None  # updates that it had received in that round; None: it was gone before it began


@dataclass(frozen=True)
class Group(Record):
    """The group of a region: its request, its members, and how it dissolved."""

    limit: float  # of the loss, above which a vehicle asks
    vehicles: Mapping[str, CheckedNetwork]  # by client
    lead: str  # edge server, e.g. "pole3", or the vehicle that leads ad hoc; "" without a request
    members: tuple[str, ...] = ()  # clients, those that asked first
    quality: Mapping[str, float] = field(default_factory=dict)  # of the data of those who made an offer
    stayed: Mapping[str, str] = field(default_factory=dict)  # by client why it is no member
    request_bytes: int = 0  # of requests and offers
    most_rounds: int = 0  # of the plan
    losses: tuple[float, ...] = ()  # on the members' held-back frames, mean: before the first round, and after each
    dissolved: str = ""  # why
    roadside: tuple[str, ...] = ()  # units that joined, as clients
    scores: tuple[float, ...] = ()  # the task's measure on the region's validation frames before the rounds and after
    terms: tuple[LeadTerm, ...] = ()  # of the leads of an ad hoc group; none: an edge server led

    @property
    def asked(self) -> tuple[str, ...]:
        """Return the clients that sent a request."""
        return tuple(name for name, each in self.vehicles.items() if each.asks)

    @property
    def mended(self) -> tuple[str, ...]:
        """Return the clients that asked and would not ask again: the group's network is below the limit."""
        return tuple(
            name for name in self.asked if (own := self.vehicles[name].after) is not None and own <= self.limit
        )

    def describe(self) -> str:
        """Return the group in words."""
        if not self.asked:
            worst = max((each.before for each in self.vehicles.values()), default=0.0)
            return f"nobody asked: the largest loss on held-back frames is {worst:.3f}, and {self.limit:.3f} the limit"
        own = [name for name in self.asked if self.vehicles[name].told is None]
        told = [f"{', '.join(own)} asked, with a loss above {self.limit:.3f} on frames held back"] if own else []
        for name, each in self.vehicles.items():
            told += [] if each.told is None else [f"{name} had asked its fleet, with a loss of {each.told:.3f}"]
        told += [
            f"{self.lead} led {plural(len(self.members), 'vehicle')}{self._describe_units()} for "
            f"{max(len(self.losses) - 1, 0)} of {plural(self.most_rounds, 'round')}",
            f"{self.request_bytes} bytes of requests and offers",
        ]
        told += [_describe_end(term) for term in self.terms[:-1]]
        told.append(f"mended: {len(self.mended)} of {len(self.asked)}")
        for name in self.asked:
            own = self.vehicles[name]
            told.append(f"{name} {own.before:.3f} to {own.after:.3f}" if own.after is not None else name)
        if self.scores:
            before, after = self.scores
            told.append(f"on validation frames {before:.3f} to {after:.3f}, which nobody acts on")
        told += [f"{name} stayed ({why})" for name, why in self.stayed.items()]
        return "; ".join([*told, *([self.dissolved] if self.dissolved else [])])

    def _describe_units(self) -> str:
        names = [name.rpartition("/")[2] for name in self.roadside]
        return f" and {plural(len(names), 'roadside unit')} ({', '.join(names)})" if names else ""


def _describe_end(term: LeadTerm) -> str:
    """Return in words how the term of a lead ended."""
    if term.received is None:
        return f"{term.lead} was gone before round {term.left}"
    return f"{term.lead} left in round {term.left} with {plural(term.received, 'update')}, and the round began again"


@dataclass(frozen=True)
class GroupRow:
    """What groups add to the result of a stage."""

    group: Annotated[Group | None, LEFT_OUT] = None  # of stage II on request; None: all vehicles federate
