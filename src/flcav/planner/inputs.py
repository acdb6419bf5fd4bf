"""Inputs of a placement: tables of errors, poles and sensors, and their town with its traffic."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.sparse import csr_array

from flcav.config import InputError, shorten
from flcav.dataset.store import Dataset
from flcav.interface.wording import plural
from flcav.optimization.placement.instance import find_covered
from flcav.optimization.placement.place import check_inside
from flcav.optimization.placement.solve import Candidates, Placement, find_candidates
from flcav.optimization.verification.record import exact
from flcav.perception.errors import CLASS, FALSE_POSITIVE, FINAL_ERROR, MISS
from flcav.storage.tables import numbers, read_input_table
from flcav.world.map.town import Town, load_town
from flcav.world.places import AXES, NAMES, read_places
from flcav.world.sites import MOUNT_M, draw_sites, measure_streets
from flcav.world.trace import Trace

Array = NDArray[np.float64]

FACTORS = ("weight", "severity", "exposure")  # columns of errors whose product is an error's weight
ERRORS = (*AXES, *FACTORS, CLASS, "kind", "returns", "occlusion", "scene", "track", "distance_m")
POLES = ("id", *AXES, "cost", "yaw_deg", "kind", "height_m")
SENSORS = ("name", "range_m", "cost")
REGISTERED = {MISS, FALSE_POSITIVE, FINAL_ERROR}  # kinds of errors; other rows are user-defined points
EVERY_M = 50.0  # default distance between sites along streets without poles
NEAREST_M, FARTHEST_M = 5.0, 1000.0  # limits of that distance


@dataclass(frozen=True)
class Given:
    """The E errors, P poles and S sensors that a user has given."""

    errors: Array  # (E, 3) world [m]
    weight: Array  # (E,)
    kind: NDArray[np.str_]  # (E,) "point" where the user's table has none
    ids: tuple[int | str, ...]  # (P,) of the poles
    poles: Array  # (P, 3) world [m]
    pole_cost: Array  # (P,)
    names: tuple[str | None, ...]  # (S,) of the sensors; None with --range
    ranges_m: Array  # (S,)
    sensor_cost: Array  # (S,)
    priced: bool  # whether anything has a cost
    notes: tuple[str, ...] = ()  # sentences on assumptions and unused columns
    table: pa.Table | None = None  # of the errors, as it was read

    def count(self, covered: int | None = None) -> str:
        """Return the number of errors in words: "11 errors", "8 of 11 errors", or "your 300 points" for points."""
        total = f"{'your ' if self.noun == 'point' else ''}{plural(len(self.errors), self.noun)}"
        return total if covered is None else f"{covered} of {total}"

    @property
    def noun(self) -> str:
        """Return the noun for a row of the table of errors."""
        return "error" if {*self.kind.tolist()} <= REGISTERED else "point"

    def column(self, name: str) -> list[str | float | None]:
        """Return the values (E,) in a column of the table of errors; empty where it has none of that name."""
        return [] if self.table is None or name not in self.table.column_names else self.table[name].to_pylist()

    def cost_of(self, placed: Placement) -> float | None:
        """Return the cost of a placement; None where nothing has a cost."""
        if not self.priced:
            return None
        pairs = zip(placed.chosen, placed.sensors, strict=True)
        return float(sum(self.costs[pair] for pair in pairs))

    @property
    def costs(self) -> NDArray[np.object_]:
        """Return the costs (P, S) of each sensor on each pole, as `Fraction`s of the decimals that were given."""
        # Exact sums: a plan that costs exactly its budget must not exceed it by a rounding error.
        of_pole, of_sensor = (
            np.array([*map(exact, costs.tolist())], dtype=object) for costs in (self.pole_cost, self.sensor_cost)
        )
        return of_pole[:, None] + of_sensor

    def covered_by(self, placed: Placement, visible: csr_array | None) -> NDArray[np.bool_]:
        """Return a mask (E,) of the covered errors: within a sensor's range, and `visible` (P, E) from its pole."""
        covered = np.zeros(len(self.errors), np.bool_)
        for pole, sensor in zip(placed.chosen, placed.sensors, strict=True):
            near = find_covered(self.errors, self.poles[[pole]], self.ranges_m[[sensor]])
            seen = near if visible is None else near.multiply(visible[[pole]])
            covered |= seen.toarray()[0] > 0
        return covered


@dataclass(frozen=True)
class Sites:
    """Candidate sites of sensors."""

    ids: tuple[int | str, ...]  # (P,)
    xyz: Array  # (P, 3) world [m]
    cost: Array | None  # (P,)
    note: str  # a sentence on their origin
    degrees: Array | None = None  # (P, 2) latitude and longitude, if the user's table has them


def read_given(
    errors: Path,
    poles: Path | None,
    sensors: Path | None,
    range_m: float | None,
    class_weights: Sequence[str],
    *,
    town: Town | None = None,
    every_m: float | None = None,
) -> Given:
    """Read the tables of errors, poles and sensors; without `poles`, candidate sites are those of `find_sites`.

    Without `sensors`, there is one kind of range `range_m` [m]. Raises `InputError` for wrong files, columns, numbers,
    places, ids and factors.
    """
    placed = read_places(errors, "point", ERRORS, town)
    mistakes = placed.table
    sites = read_sites(poles, town, every_m)
    notes = [placed.note, sites.note]
    if town is not None:
        check_inside(town, placed.xyz, sites.xyz, (errors, poles or "poles"), (placed.degrees, sites.degrees))
        x_low, y_low, x_high, y_high = town.bounds
        out = ((placed.xyz[:, :2] < (x_low, y_low)) | (placed.xyz[:, :2] > (x_high, y_high))).any(axis=1)
        notes.append(f"{errors}: {out.sum()} of {len(placed.xyz)} lie outside {town.name}" if out.any() else "")
    names, ranges, sensor_cost = (None,), np.array([range_m], np.float64), np.zeros(1)
    if sensors is not None:
        names, ranges, sensor_cost = read_kinds(sensors)
    kind = mistakes["kind"].to_pylist() if "kind" in mistakes.column_names else ["point"] * mistakes.num_rows
    return Given(
        errors=placed.xyz,
        weight=_weigh(mistakes, errors, class_weights),
        kind=np.array(kind, dtype=np.str_),
        ids=sites.ids,
        poles=sites.xyz,
        pole_cost=np.zeros(len(sites.ids)) if sites.cost is None else sites.cost,
        names=names,
        ranges_m=ranges,
        sensor_cost=sensor_cost,
        priced=sensors is not None or sites.cost is not None,
        notes=tuple(note for note in notes if note),
        table=mistakes,
    )


def read_kinds(sensors: Path) -> tuple[tuple[str, ...], Array, Array]:
    """Return the names, ranges (S,) [m] and costs (S,) in a table of sensors; raises `InputError` for other tables."""
    kinds = _read(sensors, SENSORS, SENSORS)
    names = tuple(map(str, _identify(kinds["name"].to_pylist(), sensors, "sensors", "name")))
    return names, numbers(kinds, ("range_m",), sensors)[:, 0], _costs(kinds, sensors)


def read_sites(poles: Path | None, town: Town | None, every_m: float | None = None) -> Sites:
    """Return the candidate sites in a table, or without one those of `find_sites`."""
    return find_sites(town, every_m) if poles is None else _read_sites(poles, town)


def find_sites(town: Town | None, every_m: float | None = None) -> Sites:
    """Return candidate sites of a town every `every_m` [m] along its streets.

    Without `every_m`, they are its poles and, numbered after these, sites every `EVERY_M` along streets without poles.
    Raises `InputError` without a town, for a distance outside `NEAREST_M` to `FARTHEST_M`, and where there is no site.
    """
    if town is None:
        raise InputError("--poles: give a table of candidate sites, or --town, whose poles and streets have some")
    if every_m is not None and not NEAREST_M <= every_m <= FARTHEST_M:
        raise InputError(f"--every {every_m:g}: must be from {NEAREST_M:g} to {FARTHEST_M:g} m")
    spacing = every_m or EVERY_M
    known = town.poles.id.tolist()
    drawn = draw_sites(town, spacing, bare=every_m is None and bool(known))
    sites = f"{plural(len(drawn), 'site')} every {spacing:g} m along"
    if every_m is None and known:
        note = f"candidates: the {plural(len(known), 'pole')} of {town.name}"
        if len(drawn):
            bare_km = measure_streets(town, bare=True) / 1000
            note += f", and {sites} {bare_km:.1f} km of its streets that have none"
        ids = (*known, *range(max(known) + 1, max(known) + 1 + len(drawn)))
        return Sites(ids, np.concatenate((town.poles.position, drawn)), None, note)
    if not len(drawn):
        raise InputError(f"--town {town.name}: has no street with room for sites every {spacing:g} m; give --poles")
    note = f"candidates: {sites} the streets of {town.name}"
    note += "" if every_m is not None else ", which has no poles of its own"
    return Sites(tuple(range(1, len(drawn) + 1)), drawn, None, note)


def _read_sites(path: Path, town: Town | None) -> Sites:
    places = read_places(path, "pole", (*POLES, "name"), town, MOUNT_M)
    table = places.table
    column = next((name for name in NAMES if name in table.column_names), None)
    if column is None and not places.note:
        raise InputError(f"{path}: column 'id' is missing; found {', '.join(table.column_names)}")
    numbered = tuple(range(1, table.num_rows + 1))
    ids = numbered if column is None else _identify(table[column].to_pylist(), path, "poles", column)
    cost = _costs(table, path) if "cost" in table.column_names else None
    return Sites(ids, places.xyz, cost, places.note, places.degrees)


def read_world(data: Path | None, town: str | None) -> tuple[Town | None, list[Trace]]:
    """Return the named town, or else the dataset's, and the traffic of the dataset's scenes.

    Raises `InputError` where the dataset was recorded in another town than the named one.
    """
    if data is None:
        return (None if town is None else load_town(town)), []
    dataset = Dataset.open(data)
    scenes = sorted({key.scene for key in dataset.keys})
    traces = [trace for scene in scenes if (trace := dataset.trace(scene)) is not None]
    recorded = dataset.town()
    if town is None:
        return recorded, traces
    here = load_town(town)
    if recorded is not None and recorded.name != here.name:
        raise InputError(f"--town {town}: the traffic of {data} is that of {recorded.name}")
    return here, traces


def build_candidates(given: Given, visible: csr_array | None) -> Candidates:
    """Return the candidates, every sensor on every pole; they cover only errors that are `visible` (P, E)."""
    return find_candidates(
        given.errors,
        given.poles,
        given.ranges_m,
        weight=given.weight,
        pole_cost=given.pole_cost,
        sensor_cost=given.sensor_cost,
        visible=visible,
    )


def _read(path: Path, needed: Sequence[str], known: Sequence[str]) -> pa.Table:
    table = read_input_table(path, needed, NAMES)
    if unknown := [name for name in table.column_names if name not in known]:
        raise InputError(f"{path}: unknown column '{unknown[0]}'; known are {', '.join(known)}")
    return table


def _identify(names: Sequence[object], path: Path, what: str, column: str) -> tuple[int | str, ...]:
    """Return the names of rows; raises `InputError` for one that is missing, neither text nor number, or repeated."""
    first: dict[int | str, int] = {}
    for row, name in enumerate(names):
        if name is None or name == "" or name != name:  # NaN differs from itself
            raise InputError(f"{path}: row {row + 1} has no {column}")
        if isinstance(name, bool) or not isinstance(name, int | str):
            raise InputError(f"{path}: row {row + 1}: {column} = {shorten(name)} is neither text nor a whole number")
        if name in first:
            raise InputError(f"{path}: rows {first[name] + 1} and {row + 1} are two {what} of the {column} {name!r}")
        first[name] = row
    return tuple(first)


def _costs(table: pa.Table, path: Path) -> Array:
    return numbers(table, ("cost",), path)[:, 0] if "cost" in table.column_names else np.zeros(table.num_rows)


def _weigh(mistakes: pa.Table, path: Path, class_weights: Sequence[str]) -> Array:
    """Return the weights (E,) of errors: the product of their `FACTORS` and the factor of their class."""
    given = [name for name in FACTORS if name in mistakes.column_names]
    factor = numbers(mistakes, given, path)
    if len(below := np.argwhere(factor < 0)):
        row, column = below[0]
        raise InputError(f"{path}: row {row + 1}: {given[column]} = {factor[row, column]:g} is below 0")
    weight = np.array([float(prod(map(exact, row))) for row in factor.tolist()])
    factors = _parse_factors(class_weights)
    if not factors:
        return weight
    if CLASS not in mistakes.column_names:
        raise InputError(f"--class-weight: {path} has no column '{CLASS}'")
    labels = [str(label) for label in mistakes[CLASS].to_pylist()]
    if unknown := [name for name in factors if name not in labels]:
        raise InputError(f"--class-weight: no error in {path} is of the class {unknown[0]!r}")
    of_class = [factors.get(label, 1.0) for label in labels]
    return np.array([float(exact(one) * exact(other)) for one, other in zip(weight.tolist(), of_class, strict=True)])


def _parse_factors(class_weights: Sequence[str]) -> Mapping[str, float]:
    factors: dict[str, float] = {}
    for text in class_weights:
        name, sign, number = text.rpartition("=")
        try:
            factor = float(number) if sign and name else np.nan
        except ValueError:
            factor = np.nan
        if not (0 <= factor < np.inf) or name in factors:
            raise InputError(f"--class-weight {text}: write CLASS=FACTOR, a number from 0 on, and each class once")
        factors[name] = factor
    return factors
