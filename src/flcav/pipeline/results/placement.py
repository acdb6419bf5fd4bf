"""Records of registered errors and of the placement of roadside sensors."""

from collections.abc import Mapping
from dataclasses import dataclass

from flcav.config import InputError
from flcav.pipeline.results.saved import Saved


@dataclass(frozen=True)
class ErrorRegistry(Saved):
    """Number of registered errors of a pretrained network in a region; their table is in the same folder."""

    region: str
    task: str
    counts: Mapping[str, int]  # by kind
    dropped: int  # false positives without a place in the town


@dataclass(frozen=True)
class Pole:
    """A candidate site of a roadside sensor."""

    pole: int
    covered: int  # errors within range
    actors: float  # road users within range on average


@dataclass(frozen=True)
class Placed(Saved):
    """Placement of a region's roadside sensors."""

    region: str
    rule: str
    chosen: tuple[int, ...]  # poles
    errors: int  # registered
    covered: int  # errors within range of a chosen pole
    range_m: float
    poles: tuple[Pole, ...]  # all candidates

    @property
    def first(self) -> int:
        """Return the pole that was chosen first; raises `InputError` where no sensor was placed."""
        if not self.chosen:
            found = f"candidate poles: {len(self.poles)}, errors to cover: {self.errors}"
            raise InputError(f"region {self.region!r}: no sensor was placed ({found})")
        return self.chosen[0]

    @property
    def densest(self) -> int:
        """Return the pole with the most road users within range on average."""
        return max(self.poles, key=lambda site: site.actors).pole
