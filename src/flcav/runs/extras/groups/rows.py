"""Records of groups: requests and their reasons, members, costs, and vehicles whose errors were mended."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from flcav.interface.wording import plural
from flcav.storage.records import LEFT_OUT, Record


@dataclass(frozen=True)
class CheckedNetwork(Record):
    """A vehicle's check of the deployed network, on labelled frames that it holds back."""

    held_back: int  # frames
    before: float  # loss of the deployed network
    after: float | None = None  # loss of the group's network; None: the vehicle is in no group
    asks: bool = False  # whether `before` is above the limit, so that it sends a request, or it had asked its fleet
    told: Annotated[float | None, LEFT_OUT] = None  # loss in the FL request by which it had asked its fleet

    @property
    def error(self) -> float:
        """The loss that is compared with the limit."""
        return self.before if self.told is None else max(self.before, self.told)


@dataclass(frozen=True)
class LeadTerm(Record):
    """The term of a lead."""

    lead: str  # client
    first: int  # round, from 1
    left: int | None = None  # round in which it leaves; None: it leads to the end
    received: int | None = None  # updates that it had received in that round; None: it left before the round began


@dataclass(frozen=True)
class Group(Record):
    """The group of a region: its request, its members, and how it dissolved."""

    limit: float  # of the loss, above which a vehicle sends a request
    vehicles: Mapping[str, CheckedNetwork]  # by client
    lead: str  # edge server, e.g. "pole3", or the vehicle that leads ad hoc; "" without a request
    members: tuple[str, ...] = ()  # clients, those that sent requests first
    quality: Mapping[str, float] = field(default_factory=dict)  # of offered data, in (0, 1], by client
    stayed: Mapping[str, str] = field(default_factory=dict)  # reason for not being a member, by client
    request_bytes: int = 0  # size of requests and offers [bytes]
    most_rounds: int = 0  # rounds of the plan
    losses: tuple[float, ...] = ()  # mean on the members' held-back frames: before the first round, and after every one
    dissolved: str = ""  # reason
    roadside: tuple[str, ...] = ()  # units that joined, as clients
    scores: tuple[float, ...] = ()  # the task's measure on the region's validation frames before the rounds and after
    terms: tuple[LeadTerm, ...] = ()  # of the leads of an ad hoc group; none: an edge server led

    @property
    def asked(self) -> tuple[str, ...]:
        """The clients that sent a request."""
        return tuple(name for name, check in self.vehicles.items() if check.asks)

    @property
    def mended(self) -> tuple[str, ...]:
        """The clients that sent a request and would not do so again: the group's network is below the limit."""
        return tuple(
            name for name in self.asked if (after := self.vehicles[name].after) is not None and after <= self.limit
        )

    def describe(self) -> str:
        """Describe the group in words."""
        if not self.asked:
            worst = max((check.before for check in self.vehicles.values()), default=0.0)
            return f"nobody asked: the largest loss on held-back frames is {worst:.3f}, and {self.limit:.3f} the limit"
        now = [name for name in self.asked if self.vehicles[name].told is None]
        parts = [f"{', '.join(now)} asked, with a loss above {self.limit:.3f} on frames held back"] if now else []
        for name, check in self.vehicles.items():
            parts += [] if check.told is None else [f"{name} had asked its fleet, with a loss of {check.told:.3f}"]
        parts += [
            f"{self.lead} led {plural(len(self.members), 'vehicle')}{self._describe_units()} for "
            f"{max(len(self.losses) - 1, 0)} of {plural(self.most_rounds, 'round')}",
            f"{self.request_bytes} bytes of requests and offers",
        ]
        parts += [_describe_end(term) for term in self.terms[:-1]]
        parts.append(f"mended: {len(self.mended)} of {len(self.asked)}")
        for name in self.asked:
            check = self.vehicles[name]
            parts.append(f"{name} {check.before:.3f} to {check.after:.3f}" if check.after is not None else name)
        if self.scores:
            before, after = self.scores
            parts.append(f"on validation frames {before:.3f} to {after:.3f}, which nobody acts on")
        parts += [f"{name} stayed ({why})" for name, why in self.stayed.items()]
        return "; ".join([*parts, *([self.dissolved] if self.dissolved else [])])

    def _describe_units(self) -> str:
        names = [name.rpartition("/")[2] for name in self.roadside]
        return f" and {plural(len(names), 'roadside unit')} ({', '.join(names)})" if names else ""


def _describe_end(term: LeadTerm) -> str:
    """Describe the end of a lead's term in words."""
    if term.received is None:
        return f"{term.lead} was gone before round {term.left}"
    return f"{term.lead} left in round {term.left} with {plural(term.received, 'update')}, and the round began again"


@dataclass(frozen=True)
class GroupRow:
    """The field that groups add to the result of a stage."""

    group: Annotated[Group | None, LEFT_OUT] = None  # of stage II on request; None: all vehicles federate
