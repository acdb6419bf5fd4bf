"""Coverage by number of sensors: the share of a detector's errors that the best placement of each number covers.

Simple scenarios take few sensors, complex ones many (Wang et al., IEEE Network 37(3), 2023).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.optimization.placement.cheapest import cover_share
from flcav.optimization.placement.instance import TIE
from flcav.optimization.placement.solve import find_candidates, place_count
from flcav.world.map.town import Town

ASKED = (0.25, 0.5, 0.75)  # shares of the errors to cover
REACHED = (0.5, 0.75, 0.9)  # shares of the errors in reach of any pole


@dataclass(frozen=True)
class TownCover:
    """Errors of a town, and what sensors cover of them."""

    town: str
    errors: int
    poles: int  # candidates
    shares: tuple[float, ...]  # of the errors, covered at best by 1, 2, ... sensors on as many poles
    wanted: tuple[int | None, ...]  # fewest sensors for each of `ASKED`; None where all poles cover less
    kinds: Mapping[str, float]  # by kind of scenario, mean number of errors within range of a candidate pole of it

    def count_for_reached(self, share: float) -> int:
        """Return the fewest sensors for a share of the errors that sensors on all poles together cover."""
        return 1 + next(n for n, own in enumerate(self.shares) if own >= share * self.shares[-1] * (1 - TIE))


def cover_town(town: Town, errors: NDArray[np.float64], range_m: float) -> TownCover:
    """Return what sensors of a range cover of the errors (E, 3), world [m], on the town's candidate poles."""
    candidates = find_candidates(errors, town.poles.position, [range_m]).at_unit_cost()
    poles = len(town.poles.id)
    shares = tuple(place_count(candidates, count).covered / len(errors) for count in range(1, poles + 1))
    within = candidates.covers.sum(axis=1)
    kinds = sorted(set(town.poles.kind))
    return TownCover(
        town=town.name,
        errors=len(errors),
        poles=poles,
        shares=shares,
        wanted=tuple(len(cover_share(candidates, share)[0].chosen) if share <= shares[-1] else None for share in ASKED),
        kinds={kind: float(np.mean(within[np.asarray(town.poles.kind) == kind])) for kind in kinds},
    )


def list_kinds(towns: Sequence[TownCover]) -> list[str]:
    """Return the kinds of scenarios of all towns, those of fewest errors around a pole first."""
    kinds = {kind for town in towns for kind in town.kinds}
    return sorted(kinds, key=lambda kind: float(np.mean([town.kinds[kind] for town in towns if kind in town.kinds])))
