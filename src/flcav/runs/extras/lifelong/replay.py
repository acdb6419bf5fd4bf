"""Replay of the frames that vehicles remember of earlier conditions, in the rounds of a later one."""

from collections.abc import Mapping, Sequence
from typing import Any

from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.runs.engine import Work
from flcav.runs.extras.groups.members import Picked
from flcav.runs.recipe import EDGE
from flcav.runs.stages.regions import label_samples
from flcav.runs.stages.settings import FederationSettings, RegionInputs, StepSettings

NO_LIMIT = LinkMegabytes(1e9, 1e9)  # of messages that were sent, and counted, when their condition was there


class Memory(StepSettings):
    """What each vehicle of a region remembers: frames of earlier conditions, with the labels that they had then."""

    conditions: tuple[RegionInputs, ...]  # that its labels came from, the first condition first
    frames: int  # of all of them together, of each vehicle

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return tuple(name for inputs in self.conditions for name in inputs.needs)


def remember(
    work: Work, settings: FederationSettings, memory: Memory, region: str, samples: Mapping[str, Sequence[Any]]
) -> dict[str, Sequence[Any]]:
    """Return each client's samples in `region`, joined by what its vehicle remembers; `samples` by "region/vehicle"."""
    parts = {name: [own] for name, own in samples.items()}
    shares = divide_memory(memory.frames, len(memory.conditions))
    for inputs, frames in zip(memory.conditions, shares, strict=True):
        known = label_samples(work, settings, inputs, Ledger(NO_LIMIT), EDGE).samples
        for name, own in parts.items():
            held = known.get(f"{inputs.region}/{name.removeprefix(f'{region}/')}", ())
            own.append(Picked(held, spread_evenly(len(held), frames)))
    return {name: Joined(own) for name, own in parts.items()}


def divide_memory(frames: int, conditions: int) -> list[int]:
    """Return how many of `frames` are of each condition: as equal as they go, the latest have more."""
    return [frames * (number + 1) // conditions - frames * number // conditions for number in range(conditions)]


def spread_evenly(count: int, kept: int) -> list[int]:
    """Return the places of `kept` of `count` samples, evenly spread; all places where there are no more."""
    if kept >= count:
        return [*range(count)]
    return [int((number + 0.5) * count / kept) for number in range(kept)]


class Joined(Sequence[Any]):
    """The samples of several sequences, one after another, each read when it is asked for."""

    def __init__(self, parts: Sequence[Sequence[Any]]) -> None:
        self._places = [(part, place) for part in parts for place in range(len(part))]

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [part[place] for part, place in self._places[index]]
        part, place = self._places[index]
        return part[place]
