"""Stragglers: vehicles of a region that take several times as long to train, drawn by the run's seed."""

from collections.abc import Sequence

from pydantic import Field

from flcav.config import Config
from flcav.statistics.streams import stream


class Stragglers(Config):
    """Share of each federating region's vehicles that train slower, and by what factor."""

    share: float = Field(gt=0, le=1)  # of the vehicles, rounded to whole ones
    slower: float = Field(gt=1, le=1000)  # times as long as a vehicle of speed 1


def draw_stragglers(how: Stragglers, vehicles: Sequence[str], seed: int, region: str) -> dict[str, float]:
    """Return the speed of each straggler among a region's vehicles; others have 1."""
    drawn: list[int] = stream(seed, "stragglers", region).permutation(len(vehicles)).tolist()
    return {vehicles[number]: 1 / how.slower for number in sorted(drawn[: round(how.share * len(vehicles))])}
