"""Errors of a detector by cell of a domain: average precision with intervals, misses, and the best pole.

A cell is a combination of buckets of a few attributes; every frame of a recording lies in one cell.
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
CERTAIN_RETURNS = 20  # least number of LiDAR returns of a missed object that counts as a failure
PATH_AHEAD_M = 40.0  # length of a vehicle's path
PATH_ASIDE_M = 2.0  # half its width


@dataclass(frozen=True)
class Coverer(Record):
    """The pole that covers the most errors of a cell."""

    town: str
    pole: int
    covered: int  # errors within its range and line of sight


@dataclass(frozen=True)
class Trial:
    """Results of a detector on the frames of a recording."""

    town: Town | None
    cells: Mapping[int, tuple[str, ...]]  # frame -> its cell
    found: Mapping[int, Sequence[PerceptionError]]  # frame -> errors, in the order of the outcomes
    failures: Mapping[int, bool]  # frame -> whether it has a failure


@dataclass(frozen=True)
class CellErrors(Record):
    """Performance of a detector in one cell."""

    cell: tuple[str, ...]  # bucket of each attribute
    frames: int
    scenes: int
    precision: Estimate | None  # mean AP with its interval over scenes; None without targets
    errors: int  # an object counts once per scene
    misses: int
    failures: int  # frames with a failure, see `locate_failure`
    pole: Coverer | None  # None if no pole covers an error


def cells_of(domain: Domain, measured: Measurements, by: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the cell of each frame by the attributes `by`, given as full or leaf names.

    Raises `InputError` for an attribute that the domain does not have, or that has no buckets.
    """
    items = {name: item_named(domain, name) for name in by}
    columns = {name: domain.bound.get(item.name.removeprefix("odd."), "") for name, item in items.items()}
    return [
        tuple(MISSING if (value := row.get(columns[name])) is None else item.bucket_of(value)
              for name, item in items.items())
        for row in measured.rows()
    ]  # fmt: skip


def full_name(domain: Domain, name: str) -> str:
    """Return the full name of an attribute by its full or leaf name; raises `InputError` where it has no buckets."""
    return item_named(domain, name).name.removeprefix("odd.")


def item_named(domain: Domain, name: str):
    """Return openodd-py's coverage item of an attribute; raises `InputError` where it has no buckets."""
    known = {item.name.removeprefix("odd."): item for item in domain.definition.cover_items()}
    full = [attribute for attribute in known if name in (attribute, attribute.rpartition(".")[2])]
    if not full:
        leaves = [attribute.rpartition(".")[2] for attribute in known]
        raise InputError(f"{domain.name}: no attribute '{name}' with buckets; those are {', '.join(leaves)}"
                         f"{suggest(name, leaves)}")  # fmt: skip
    return known[full[0]]


def measure_cell(measure: Measure, outcomes: Outcomes, inside: NDArray[np.bool_]) -> Estimate | None:
    """Return the measure on the frames of a cell (mask `inside`, (F,)), with its bootstrap interval over their scenes.

    None where the measure is not defined; an estimate of fewer than two scenes has no interval.
    """

    def of(times: Times) -> Values:
        counts = np.zeros((len(times), len(inside)), dtype=np.int64)
        counts[:, inside] = times
        return measure(outcomes, counts)

    scenes = outcomes.scene[inside]
    mean = float(of(np.ones((1, len(scenes)), dtype=np.int64))[0]) if len(scenes) else np.nan
    if np.isnan(mean):
        return None
    if len(np.unique(scenes)) < 2:
        return Estimate(mean, None, None)
    low, high = bootstrap_over_scenes(of, scenes, rng=stream(0, "bootstrap"))
    return Estimate(mean, None, None) if np.isnan(low) else Estimate(mean, low, high)


def find_failures(data: Dataset, found: Mapping[int, Sequence[PerceptionError]]) -> dict[int, bool]:
    """Return for each frame whether it has a failure (`locate_failure`)."""
    return {
        i: any(locate_failure(data.world_from_agent(i), error) is not None for error in errors)
        for i, errors in found.items()
    }


def locate_failure(world_from_agent: Array, error: PerceptionError) -> float | None:
    """Return the distance [m] ahead of a failure: a missed object with `CERTAIN_RETURNS` or more in the vehicle's path.

    None where the error is no failure. `world_from_agent` is the (4, 4) pose of the vehicle [m].
    """
    x, y = (inverse(world_from_agent) @ (error.x, error.y, error.z, 1.0)).tolist()[:2]
    certain = error.kind == MISS and error.returns >= CERTAIN_RETURNS
    return x if certain and 0 < x <= PATH_AHEAD_M and abs(y) <= PATH_ASIDE_M else None


def measure_cells(measure: Measure, outcomes: Outcomes, tested: Sequence[Trial], range_m: float) -> list[CellErrors]:
    """Return a detector's performance in each cell of several recordings, by falling number of errors per frame.

    The units of `outcomes` are the frames of `tested`, in the same order; `range_m` is that of a pole's sensor [m].
    """
    frames = [(trial, i) for trial in tested for i in trial.found]
    rows = []
    for cell in dict.fromkeys(trial.cells[i] for trial, i in frames):
        inside = np.array([trial.cells[i] == cell for trial, i in frames])
        by_town = [
            (trial.town, keep_first(e for i in trial.found if trial.cells[i] == cell for e in trial.found[i]))
            for trial in tested
        ]
        errors = [error for _, in_town in by_town for error in in_town]
        rows.append(
            CellErrors(
                cell,
                int(inside.sum()),
                len(np.unique(outcomes.scene[inside])),
                measure_cell(measure, outcomes, inside),
                len(errors),
                sum(error.kind == MISS for error in errors),
                sum(trial.failures[i] for trial, i in frames if trial.cells[i] == cell),
                _cover(by_town, range_m),
            )
        )
    return sorted(rows, key=lambda row: -row.errors / row.frames)


def _cover(errors: Sequence[tuple[Town | None, Sequence[PerceptionError]]], range_m: float) -> Coverer | None:
    """Return the pole that covers the most errors of its town, with occlusion by buildings; None if none covers any."""
    by_town: dict[str, tuple[Town, list[PerceptionError]]] = {}
    for town, in_recording in errors:
        if town is not None and in_recording and len(town.poles.id):
            by_town.setdefault(town.name, (town, []))[1].extend(in_recording)
    best = None
    for name, (town, in_town) in by_town.items():
        positions = [(error.x, error.y, error.z) for error in in_town]
        placed = place(positions, town.poles.position, range_m, 1, town=town)
        if placed.covered and (best is None or placed.covered > best.covered):
            best = Coverer(name, int(town.poles.id[placed.chosen[0]]), placed.covered)
    return best
