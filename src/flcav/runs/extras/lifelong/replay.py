"""Replay of the frames that vehicles remember of earlier conditions, in the rounds of a later one."""

from collections.abc import Mapping, Sequence
from typing import Any

from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.runs.engine import Work
from flcav.runs.extras.groups.members import Picked
from flcav.runs.frames import Joined
from flcav.runs.recipe import EDGE
from flcav.runs.stages.regions import label_samples
from flcav.runs.stages.settings import FederationSettings, RegionInputs, StepSettings

NO_LIMIT = LinkMegabytes(1e9, 1e9)  # budget for messages that were already counted in their condition [MB]


class Memory(StepSettings):
    """The replay memory of a region's vehicles: frames of earlier conditions, with the labels that they had then."""

    conditions: tuple[RegionInputs, ...]  # inputs of the labels, by earlier condition, the first one first
    frames: int  # per vehicle, of all conditions together

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return tuple(name for inputs in self.conditions for name in inputs.needs)


def remember(
    work: Work, settings: FederationSettings, memory: Memory, region: str, samples: Mapping[str, Sequence[Any]]
) -> dict[str, Sequence[Any]]:
    """Join the clients' `samples` in `region`, by "region/vehicle", with the memory of their vehicles."""
    parts = {name: [present] for name, present in samples.items()}
    shares = divide_memory(memory.frames, len(memory.conditions))
    for inputs, frames in zip(memory.conditions, shares, strict=True):
        known = label_samples(work, settings, inputs, Ledger(NO_LIMIT), EDGE).samples
        for name, sequences in parts.items():
            held = known.get(f"{inputs.region}/{name.removeprefix(f'{region}/')}", ())
            sequences.append(Picked(held, spread_evenly(len(held), frames)))
    return {name: Joined(sequences) for name, sequences in parts.items()}


def divide_memory(frames: int, conditions: int) -> list[int]:
    """Divide `frames` among conditions as equally as possible; later ones get the remainder."""
    return [frames * (number + 1) // conditions - frames * number // conditions for number in range(conditions)]


def spread_evenly(count: int, kept: int) -> list[int]:
    """Return the indices of `kept` of `count` samples, evenly spread; all indices if there are no more."""
    if kept >= count:
        return [*range(count)]
    return [int((number + 0.5) * count / kept) for number in range(kept)]
