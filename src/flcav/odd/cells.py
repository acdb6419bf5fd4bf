"""Errors of a detector by cell of a domain: average precision with intervals, misses, and the pole that covers most.

A cell is a bucket of each of a few attributes; the frames of a recording are in one each.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import Array, inverse
from flcav.interface.wording import suggest
from flcav.odd.domain import Domain
from flcav.odd.measure import Measurements
from flcav.optimization.placement.place import place
from flcav.perception.errors import MISS, PerceptionError, keep_first
from flcav.perception.outcomes import Measure, Outcomes, Times, Values
from flcav.statistics.bootstrap import bootstrap_over_scenes
from flcav.statistics.estimates import Estimate
from flcav.statistics.streams import stream
from flcav.storage.records import Record
from flcav.world.map.town import Town

MISSING = "<missing>"
CERTAIN_RETURNS = 20  # LiDAR returns from which a missed object is a failure
PATH_AHEAD_M, PATH_ASIDE_M = 40.0, 2.0  # the path of a vehicle: so far ahead, and so far to either side


@dataclass(frozen=True)
class Coverer(Record):
    """The pole that covers most errors of a cell."""

    town: str
    pole: int
    covered: int  # errors within its range and its sight


@dataclass(frozen=True)
class Trial:
    """A recording whose frames a detector was tested on."""

    town: Town | None
    cells: Mapping[int, tuple[str, ...]]  # frame -> its cell
    found: Mapping[int, Sequence[PerceptionError]]  # frame -> errors, in the order of the outcomes
    failures: Mapping[int, bool]  # frame -> whether it has a failure


@dataclass(frozen=True)
class CellErrors(Record):
    """What a detector does in one cell."""

    cell: tuple[str, ...]  # bucket of each attribute
    frames: int
    scenes: int
    precision: Estimate | None  # mean AP with its interval over scenes; None: nothing is to be found
    errors: int  # each once per scene
    misses: int
    failures: int  # frames with a missed object of `CERTAIN_RETURNS` in the path
    pole: Coverer | None  # None: no errors, no poles, or none sees one


def cells_of(domain: Domain, measured: Measurements, by: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the cell of each frame by the attributes `by`, full or leaf names.

    Raises `InputError` for an attribute that the domain does not have, or that has no buckets.
    """
    items = {name: item_named(domain, name) for name in by}
    columns = {name: domain.bound.get(found.name.removeprefix("odd."), "") for name, found in items.items()}
    return [
        tuple(MISSING if (value := row.get(columns[name])) is None else item.bucket_of(value)
              for name, item in items.items())
        for row in measured.rows()
    ]  # fmt: skip


def full_name(domain: Domain, name: str) -> str:
    """Return the full name of an attribute with buckets, given it or its leaf; raises `InputError` for another."""
    return item_named(domain, name).name.removeprefix("odd.")


def item_named(domain: Domain, name: str):
    """Return the library's buckets of an attribute; raises `InputError` where it has none."""
    known = {item.name.removeprefix("odd."): item for item in domain.definition.cover_items()}
    full = [each for each in known if name in (each, each.rpartition(".")[2])]
    if not full:
        leaves = [each.rpartition(".")[2] for each in known]
        raise InputError(f"{domain.name}: no attribute '{name}' with buckets; those are {', '.join(leaves)}"
                         f"{suggest(name, leaves)}")  # fmt: skip
    return known[full[0]]


def measure_cell(measure: Measure, outcomes: Outcomes, inside: NDArray[np.bool_]) -> Estimate | None:
    """Return the measure on the frames (F,) `inside` a cell, with its interval over the scenes there.

    None where it is not defined; no interval of fewer than two scenes.
    """

    def of(times: Times) -> Values:
        every = np.zeros((len(times), len(inside)), dtype=np.int64)
        every[:, inside] = times
        return measure(outcomes, every)

    scenes = outcomes.scene[inside]
    mean = float(of(np.ones((1, len(scenes)), dtype=np.int64))[0]) if len(scenes) else np.nan
    if np.isnan(mean):
        return None
    if len(np.unique(scenes)) < 2:
        return Estimate(mean, None, None)
    low, high = bootstrap_over_scenes(of, scenes, rng=stream(0, "bootstrap"))
    return Estimate(mean, None, None) if np.isnan(low) else Estimate(mean, low, high)


def find_failures(data: Dataset, found: Mapping[int, Sequence[PerceptionError]]) -> dict[int, bool]:
    """Return whether each frame has a failure, see `locate_failure`."""
    return {
        i: any(locate_failure(data.world_from_agent(i), error) is not None for error in errors)
        for i, errors in found.items()
    }


def locate_failure(world_from_agent: Array, error: PerceptionError) -> float | None:
    """Return how far ahead [m] a failure is: a missed object of `CERTAIN_RETURNS` or more in the vehicle's path.

    None where the error is no failure. `world_from_agent` is the (4, 4) pose of the vehicle.
    """
    x, y = (inverse(world_from_agent) @ (error.x, error.y, error.z, 1.0)).tolist()[:2]
    certain = error.kind == MISS and error.returns >= CERTAIN_RETURNS
    return x if certain and 0 < x <= PATH_AHEAD_M and abs(y) <= PATH_ASIDE_M else None


def measure_cells(measure: Measure, outcomes: Outcomes, tested: Sequence[Trial], range_m: float) -> list[CellErrors]:
    """Return a detector's measures in each cell of several recordings, the one with most errors per frame first.

    The units of `outcomes` are the frames of `tested`, in their order. range_m: of a pole's sensor.
    """
    frames = [(each, i) for each in tested for i in each.found]
    rows = []
    for cell in dict.fromkeys(each.cells[i] for each, i in frames):
        inside = np.array([each.cells[i] == cell for each, i in frames])
        errors = [
            (each.town, keep_first(e for i in each.found if each.cells[i] == cell for e in each.found[i]))
            for each in tested
        ]
        every = [error for _, own_errors in errors for error in own_errors]
        rows.append(
            CellErrors(
                cell,
                int(inside.sum()),
                len(np.unique(outcomes.scene[inside])),
                measure_cell(measure, outcomes, inside),
                len(every),
                sum(error.kind == MISS for error in every),
                sum(each.failures[i] for each, i in frames if each.cells[i] == cell),
                _cover(errors, range_m),
            )
        )
    return sorted(rows, key=lambda row: -row.errors / row.frames)


def _cover(errors: Sequence[tuple[Town | None, Sequence[PerceptionError]]], range_m: float) -> Coverer | None:
    """Return the pole that covers most of the errors in its town, past the town's buildings; None where none does."""
    by_town: dict[str, tuple[Town, list[PerceptionError]]] = {}
    for town, own in errors:
        if town is not None and own and len(town.poles.id):
            by_town.setdefault(town.name, (town, []))[1].extend(own)
    best = None
    for name, (town, own) in by_town.items():
        placed = place([(each.x, each.y, each.z) for each in own], town.poles.position, range_m, 1, town=town)
        if placed.covered and (best is None or placed.covered > best.covered):
            best = Coverer(name, int(town.poles.id[placed.chosen[0]]), placed.covered)
    return best
