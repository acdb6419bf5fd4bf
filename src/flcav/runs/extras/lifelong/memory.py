"""Frames that vehicles remember of earlier conditions, and replay as they learn a new one.

Experience replay with a small memory: Chaudhry et al., "On Tiny Episodic Memories in Continual Learning", 2019. Here
the memory is each vehicle's own and never leaves it.
"""

from collections.abc import Sequence
from typing import Any


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
