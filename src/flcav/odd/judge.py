"""Verdicts of a domain on frames, and the parts of a domain that towns and recordings realise.

A verdict is three-valued: inside, outside, or unknown where it depends on missing values. OpenODD 1.0 counts the latter
as inside.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from flcav.config import Json
from flcav.dataset.store import Dataset
from flcav.interface.wording import plural
from flcav.odd.domain import Domain, Value
from flcav.odd.measure import Measurements, reach_of
from flcav.odd.scenery import ScenarioPlace, Scenery
from flcav.sensors.rig import RIGS
from flcav.statistics.estimates import Estimate, score_interval
from flcav.storage.records import Record, write_any_table

INSIDE, OUTSIDE, UNKNOWN = "inside", "outside", "unknown"


@dataclass(frozen=True)
class Verdicts:
    """Verdicts of a domain on F frames."""

    frames: tuple[int, ...]
    verdict: NDArray[np.str_]  # (F,) inside, outside or unknown
    failed: Mapping[str, int]  # number of frames outside by module, without modules that only combine others

    def count(self, verdict: str) -> int:
        """Return the number of frames with a verdict."""
        return int((self.verdict == verdict).sum())

    @property
    def sentence(self) -> str:
        """Return the counts in words."""
        counts = ", ".join(f"{self.count(word)} {word}" for word in (INSIDE, OUTSIDE, UNKNOWN))
        return f"{plural(len(self.frames), 'frame')}: {counts}"

    def as_json(self) -> dict[str, Json]:
        """Return the counts as a JSON object."""
        counts = {word: self.count(word) for word in (INSIDE, OUTSIDE, UNKNOWN)}
        return {"frames": len(self.frames), **counts, "modules": dict(self.failed)}


@dataclass(frozen=True)
class Rates(Record):
    """Precision and recall of a verdict, with Wilson's intervals; None where it was never given, or never true."""

    precision: Estimate | None
    recall: Estimate | None


@dataclass(frozen=True)
class PerceptionAgreement(Record):
    """Agreement of perceived verdicts with the truth, on the frames with a true verdict of inside or outside.

    The intervals take frames as independent, which those of a scene are not.
    """

    frames: int
    inside: Rates
    outside: Rates
    undecided: int  # frames that perception leaves unknown


def describe_agreement(agreement: PerceptionAgreement) -> list[str]:
    """Return the agreement in words."""
    rows = []
    for name, rates in ((INSIDE, agreement.inside), (OUTSIDE, agreement.outside)):
        words = ["-" if rate is None else rate.describe() for rate in (rates.precision, rates.recall)]
        rows.append(f"{name}: precision {words[0]}, recall {words[1]}")
    return [*rows, f"{plural(agreement.undecided, 'frame')} left unknown of {agreement.frames} that truth decides"]


def write_verdicts(data: Dataset, truth: Verdicts, seen: Verdicts | None, path: Path) -> None:
    """Write the verdicts by frame, and the perceived ones if any, as a CSV or Parquet table."""
    columns = {"frame": [data.name(i) for i in truth.frames], "verdict": truth.verdict.tolist()}
    write_any_table(pa.table(columns if seen is None else columns | {"perceived": seen.verdict.tolist()}), path)


def judge_values(domain: Domain, measured: Mapping[str, Value]) -> str:
    """Return the verdict on one row of measured columns; absent columns are missing values."""
    verdict = domain.definition.evaluate(domain.definition.complete(domain.values(measured)))
    return OUTSIDE if not verdict.inside else UNKNOWN if verdict.assumed else INSIDE


def judge_frames(domain: Domain, measured: Measurements) -> Verdicts:
    """Return the verdicts on frames, with the counts of the modules that put them outside.

    Raises `InputError` where the domain tests an attribute that nothing measures.
    """
    domain.require_bound()
    odd = domain.definition
    leaves = {module.name for module in odd.modules
              if any(condition.attributes() for condition in module.conditions())}  # fmt: skip
    verdicts = []
    failed = Counter[str]()
    for row in measured.rows():
        result = odd.evaluate(odd.complete(domain.values(row)))
        verdicts.append(OUTSIDE if not result.inside else UNKNOWN if result.assumed else INSIDE)
        failed.update(name for name, holds in result.modules.items() if holds is False and name in leaves)
    return Verdicts(measured.frames, np.array(verdicts, dtype=np.str_), dict(failed.most_common()))


def compare_verdicts(truth: Sequence[str], perceived: Sequence[str]) -> PerceptionAgreement:
    """Return the agreement of perceived verdicts with the true ones, on the frames whose true verdict is known."""
    wanted, given = np.asarray(truth), np.asarray(perceived)
    decided = wanted != UNKNOWN
    wanted, given = wanted[decided], given[decided]

    def rate(verdict: str) -> Rates:
        positive, true = given == verdict, wanted == verdict
        shares = (
            score_interval(float((positive & true).sum() / base.sum()), int(base.sum())) if base.any() else None
            for base in (positive, true)
        )
        return Rates(*shares)

    return PerceptionAgreement(int(decided.sum()), rate(INSIDE), rate(OUTSIDE), int((given == UNKNOWN).sum()))


SET, FOUND, RIG, TRAFFIC, UNMEASURED = "set", "found", "rig", "traffic", "unmeasured"
OF_RIG = ("field_of_view", "sensing_range")
OF_TRAFFIC = ("agents", "pedestrians", "ego_speed")
VEHICLE_RIGS = ("car", "kitti", "lidar32", "car_surround", "kitti_lidar")  # in the order of choice
GROUND = {"surface_type": "asphalt"}  # of every town


@dataclass(frozen=True)
class DomainPart(Record):
    """Realisation of one attribute of a domain in towns or recordings."""

    attribute: str
    how: str  # set in recipes | found at places | by the rig | by traffic | unmeasured
    by: str  # field of a recipe, or what measures it
    inside: int  # number of places or frames inside, or 1 where a recipe can set a value inside
    outside: int
    unknown: int  # number of places or frames without a value

    @property
    def realised(self) -> bool | None:
        """Return whether a value inside the domain is realised; None where unknown."""
        return True if self.inside else None if self.unknown else False

    @property
    def sentence(self) -> str:
        """Return the realisation in words."""
        if self.how == UNMEASURED:
            return "unknown: nothing in the binding measures it"
        if self.how == TRAFFIC and not self.inside + self.outside + self.unknown:
            return "by traffic: recordings measure it, recipes do not set it"
        if self.how in (SET, RIG):
            return f"{'can be inside' if self.inside else 'is never inside'}: recipes set it by {self.by}"
        total = self.inside + self.outside + self.unknown
        missing = f", unknown at {self.unknown}" if self.unknown else ""
        return f"inside at {self.inside} of {total}{missing}"


def check_towns(domain: Domain, sceneries: Sequence[Scenery]) -> tuple[DomainPart, ...]:
    """Return how recipes for these towns realise each tested attribute of a domain, over all their places."""
    rows: list[dict[str, Value]] = []
    for scenery in sceneries:
        rows += [{**row, **GROUND} for _, row in _describe_places(scenery)]
    return tuple(_check_part(domain, name, rows) for name in domain.tested)


def check_frames(domain: Domain, measured: Measurements) -> tuple[DomainPart, ...]:
    """Return how the frames of a recording realise each tested attribute of a domain."""
    rows = measured.rows()
    return tuple(
        _count_part(domain, name, FOUND, "frames", [row.get(domain.bound[name]) for row in rows])
        if name in domain.bound
        else DomainPart(name, UNMEASURED, "", 0, 0, len(rows))
        for name in domain.tested
    )


def choose_rig(domain: Domain) -> str | None:
    """Return the first of `VEHICLE_RIGS` whose field of view and range are inside the domain; None without one."""
    for name in VEHICLE_RIGS:
        reach = reach_of(RIGS[name])
        tested = [attribute for attribute in domain.tested if domain.bound.get(attribute) in OF_RIG]
        if all(_can(domain, attribute, reach[domain.bound[attribute]]) for attribute in tested):
            return name
    return None


def find_inside_places(
    domain: Domain, sceneries: Sequence[Scenery]
) -> tuple[tuple[ScenarioPlace, dict[str, Value]], ...]:
    """Return the places of towns whose scenery is inside a domain, with that scenery; other attributes are open.

    A place with a missing value of a tested attribute is left out.
    """
    inside = []
    for scenery in sceneries:
        for place, row in _describe_places(scenery):
            columns = {**row, **GROUND}
            known = {name: columns[domain.bound[name]] for name in domain.tested if domain.bound.get(name) in columns}
            if None not in known.values() and domain.can_hold(known):
                inside.append((place, columns))
    return tuple(inside)


def _describe_places(scenery: Scenery) -> list[tuple[ScenarioPlace, dict[str, Value]]]:
    places = scenery.places()
    if not places:
        return []
    return list(
        zip(places, Measurements(tuple(range(len(places))), scenery.measure_places(places)).rows(), strict=True)
    )


def _check_part(domain: Domain, name: str, rows: list[dict[str, Value]]) -> DomainPart:
    column = domain.bound.get(name)
    knobs = domain.knobs()
    if column is None:
        return DomainPart(name, UNMEASURED, "", 0, 0, 1)
    if name in knobs and column != "junction":
        low, high = knobs[name].reach or (-np.inf, np.inf)
        allowed = [value for value in domain.allowed(name) if isinstance(value, float | int) and low <= value <= high]
        return DomainPart(name, SET, knobs[name].key, int(bool(allowed)), int(not allowed), 0)
    if column in ("light", "surface_condition"):
        field = "weather.sun_elevation_deg" if column == "light" else "weather.wetness"
        return DomainPart(name, SET, field, 1, 0, 0)
    if column in OF_RIG:
        fits = any(_can(domain, name, reach_of(RIGS[rig])[column]) for rig in VEHICLE_RIGS)
        return DomainPart(name, RIG, "vehicle_rig", int(fits), int(not fits), 0)
    if column in OF_TRAFFIC:
        return DomainPart(name, TRAFFIC, column, 0, 0, 0)
    return _count_part(domain, name, FOUND, "places", [row.get(column) for row in rows])


def _count_part(domain: Domain, name: str, how: str, by: str, values: Sequence[Value]) -> DomainPart:
    known = [value for value in values if value is not None]
    inside = sum(_can(domain, name, value) for value in known)
    return DomainPart(name, how, by, inside, len(known) - inside, len(values) - len(known))


def _can(domain: Domain, name: str, value: Value) -> bool:
    """Return whether a value of an attribute can be inside the domain; a missing value cannot."""
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return False
    return domain.can_hold({name: value})
