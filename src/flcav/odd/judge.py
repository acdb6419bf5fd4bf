"""Judgement of frames by a domain, and how far towns and recordings realise it, attribute by attribute.

A judgement is three-valued: inside, outside, or unknown where it rests on missing values. OpenODD 1.0 counts what rests
on missing values as inside; here it never is.
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
    """The verdict of a domain on each of F frames."""

    frames: tuple[int, ...]
    verdict: NDArray[np.str_]  # (F,) inside, outside or unknown
    failed: Mapping[str, int]  # module -> frames that it puts outside; those that only join others are left out

    def count(self, verdict: str) -> int:
        """Return how many frames have that verdict."""
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
    """Precision and recall of one verdict, with Wilson's intervals; None if it was never given, or never true."""

    precision: Estimate | None
    recall: Estimate | None


@dataclass(frozen=True)
class PerceptionAgreement(Record):
    """How often perceived verdicts are right, on the frames that truth decides, dependent as those of a scene are."""

    frames: int
    inside: Rates
    outside: Rates
    undecided: int  # frames that perception leaves unknown


def describe_agreement(agreement: PerceptionAgreement) -> list[str]:
    """Return the agreement in words."""
    rows = []
    for name, rates in ((INSIDE, agreement.inside), (OUTSIDE, agreement.outside)):
        words = ["-" if each is None else each.describe() for each in (rates.precision, rates.recall)]
        rows.append(f"{name}: precision {words[0]}, recall {words[1]}")
    return [*rows, f"{plural(agreement.undecided, 'frame')} left unknown of {agreement.frames} that truth decides"]


def write_verdicts(data: Dataset, truth: Verdicts, seen: Verdicts | None, path: Path) -> None:
    """Write a table, CSV or Parquet: frame, verdict, and the perceived verdict where there is one."""
    columns = {"frame": [data.name(i) for i in truth.frames], "verdict": truth.verdict.tolist()}
    write_any_table(pa.table(columns if seen is None else columns | {"perceived": seen.verdict.tolist()}), path)


def judge_values(domain: Domain, measured: Mapping[str, Value]) -> str:
    """Return the verdict on one row of measured columns; a column that is not there is missing."""
    verdict = domain.definition.evaluate(domain.definition.complete(domain.values(measured)))
    return OUTSIDE if not verdict.inside else UNKNOWN if verdict.assumed else INSIDE


def judge_frames(domain: Domain, measured: Measurements) -> Verdicts:
    """Return the verdict on each frame, and which modules put frames outside.

    Raises `InputError` where the domain tests an attribute that nothing measures.
    """
    domain.require_bound()
    odd = domain.definition
    leaves = {module.name for module in odd.modules
              if any(each.attributes() for each in module.conditions())}  # fmt: skip
    verdicts, failed = [], Counter[str]()
    for row in measured.rows():
        found = odd.evaluate(odd.complete(domain.values(row)))
        verdicts.append(OUTSIDE if not found.inside else UNKNOWN if found.assumed else INSIDE)
        failed.update(name for name, holds in found.modules.items() if holds is False and name in leaves)
    return Verdicts(measured.frames, np.array(verdicts, dtype=np.str_), dict(failed.most_common()))


def compare_verdicts(truth: Sequence[str], perceived: Sequence[str]) -> PerceptionAgreement:
    """Return how well perceived verdicts match those of truth, on the frames that truth decides."""
    wanted, found = np.asarray(truth), np.asarray(perceived)
    decided = wanted != UNKNOWN
    wanted, found = wanted[decided], found[decided]

    def rate(of: str) -> Rates:
        said, is_so = found == of, wanted == of
        shares = (
            score_interval(float((said & is_so).sum() / every.sum()), int(every.sum())) if every.any() else None
            for every in (said, is_so)
        )
        return Rates(*shares)

    return PerceptionAgreement(int(decided.sum()), rate(INSIDE), rate(OUTSIDE), int((found == UNKNOWN).sum()))


SET, FOUND, RIG, TRAFFIC, UNMEASURED = "set", "found", "rig", "traffic", "unmeasured"
OF_RIG = ("field_of_view", "sensing_range")
OF_TRAFFIC = ("agents", "pedestrians", "ego_speed")
VEHICLE_RIGS = ("car", "kitti", "lidar32", "car_surround", "kitti_lidar")  # the first that a domain allows is taken
GROUND = {"surface_type": "asphalt"}  # of every town


@dataclass(frozen=True)
class DomainPart(Record):
    """How far one attribute of a domain is realised."""

    attribute: str
    how: str  # set in recipes | found at places | by the rig | by traffic | unmeasured
    by: str  # field of a recipe, or what measures it
    inside: int  # places or frames at which it is inside, or 1 where a recipe can set it so
    outside: int
    unknown: int  # those whose value is missing

    @property
    def realised(self) -> bool | None:
        """Return whether a value inside is realised; None where it is not known."""
        return True if self.inside else None if self.unknown else False

    @property
    def sentence(self) -> str:
        """Return the state in words."""
        if self.how == UNMEASURED:
            return "unknown: nothing in the binding measures it"
        if self.how == TRAFFIC and not self.inside + self.outside + self.unknown:
            return "by traffic: recordings measure it, recipes do not set it"
        if self.how in (SET, RIG):
            return f"{'can be inside' if self.inside else 'is never inside'}: recipes set it by {self.by}"
        of = self.inside + self.outside + self.unknown
        missing = f", unknown at {self.unknown}" if self.unknown else ""
        return f"inside at {self.inside} of {of}{missing}"


def check_towns(domain: Domain, sceneries: Sequence[Scenery]) -> tuple[DomainPart, ...]:
    """Return the parts of a domain that recipes for these towns realise, at all their places."""
    rows: list[dict[str, Value]] = []
    for scenery in sceneries:
        rows += [{**row, **GROUND} for _, row in _describe_places(scenery)]
    return tuple(_check_part(domain, name, rows) for name in domain.tested)


def check_frames(domain: Domain, measured: Measurements) -> tuple[DomainPart, ...]:
    """Return the parts of a domain that the frames of a recording realise."""
    rows = measured.rows()
    return tuple(
        _count_part(domain, name, FOUND, "frames", [row.get(domain.bound[name]) for row in rows])
        if name in domain.bound
        else DomainPart(name, UNMEASURED, "", 0, 0, len(rows))
        for name in domain.tested
    )


def choose_rig(domain: Domain) -> str | None:
    """Return the first of `VEHICLE_RIGS` whose field of view and range the domain allows; None where none is."""
    for name in VEHICLE_RIGS:
        reach = reach_of(RIGS[name])
        tested = [each for each in domain.tested if domain.bound.get(each) in OF_RIG]
        if all(_can(domain, each, reach[domain.bound[each]]) for each in tested):
            return name
    return None


def find_inside_places(
    domain: Domain, sceneries: Sequence[Scenery]
) -> tuple[tuple[ScenarioPlace, dict[str, Value]], ...]:
    """Return the places of towns that can be inside a domain, with the scenery of each; the rest is left open.

    A place whose scenery is missing an attribute that the domain tests is none: it is not inside by silence.
    """
    inside = []
    for scenery in sceneries:
        for place, row in _describe_places(scenery):
            own = {**row, **GROUND}
            known = {name: own[domain.bound[name]] for name in domain.tested if domain.bound.get(name) in own}
            if None not in known.values() and domain.can_hold(known):
                inside.append((place, own))
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
    """Return whether the domain can hold with this value of an attribute; a missing one cannot."""
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return False
    return domain.can_hold({name: value})
