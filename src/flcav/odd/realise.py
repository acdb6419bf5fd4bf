"""Feasibility of a domain by attribute: whether a town or a recording has values inside it, or unknown ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flcav.odd.domain import Domain, Value
from flcav.odd.measure import Measurements, reach_of
from flcav.odd.scenery import Place, Scenery
from flcav.sensors.rig import RIGS
from flcav.storage.records import Record

SET, FOUND, RIG, TRAFFIC, UNMEASURED = "set", "found", "rig", "traffic", "unmeasured"
OF_RIG = ("field_of_view", "sensing_range")
OF_TRAFFIC = ("agents", "pedestrians", "ego_speed")
VEHICLE_RIGS = ("car", "kitti", "lidar32", "car_surround", "kitti_lidar")  # the first that a domain allows is taken
GROUND = {"surface_type": "asphalt"}  # of every town


@dataclass(frozen=True)
class Part(Record):
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


def check_towns(domain: Domain, sceneries: Sequence[Scenery]) -> tuple[Part, ...]:
    """Return the parts of a domain that recipes for these towns realise, at all their places."""
    rows: list[dict[str, Value]] = []
    for scenery in sceneries:
        rows += [{**row, **GROUND} for _, row in _describe_places(scenery)]
    return tuple(_check_part(domain, name, rows) for name in domain.tested)


def check_frames(domain: Domain, measured: Measurements) -> tuple[Part, ...]:
    """Return the parts of a domain that the frames of a recording realise."""
    rows = measured.rows()
    return tuple(
        _count(domain, name, FOUND, "frames", [row.get(domain.bound[name]) for row in rows])
        if name in domain.bound
        else Part(name, UNMEASURED, "", 0, 0, len(rows))
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


def find_places(domain: Domain, sceneries: Sequence[Scenery]) -> tuple[tuple[Place, dict[str, Value]], ...]:
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


def _describe_places(scenery: Scenery) -> list[tuple[Place, dict[str, Value]]]:
    places = scenery.places()
    if not places:
        return []
    return list(
        zip(places, Measurements(tuple(range(len(places))), scenery.measure_places(places)).rows(), strict=True)
    )


def _check_part(domain: Domain, name: str, rows: list[dict[str, Value]]) -> Part:
    column = domain.bound.get(name)
    knobs = domain.knobs()
    if column is None:
        return Part(name, UNMEASURED, "", 0, 0, 1)
    if name in knobs and column != "junction":
        low, high = knobs[name].reach or (-np.inf, np.inf)
        allowed = [value for value in domain.allowed(name) if isinstance(value, float | int) and low <= value <= high]
        return Part(name, SET, knobs[name].key, int(bool(allowed)), int(not allowed), 0)
    if column in ("light", "surface_condition"):
        field = "weather.sun_elevation_deg" if column == "light" else "weather.wetness"
        return Part(name, SET, field, 1, 0, 0)
    if column in OF_RIG:
        fits = any(_can(domain, name, reach_of(RIGS[rig])[column]) for rig in VEHICLE_RIGS)
        return Part(name, RIG, "vehicle_rig", int(fits), int(not fits), 0)
    if column in OF_TRAFFIC:
        return Part(name, TRAFFIC, column, 0, 0, 0)
    return _count(domain, name, FOUND, "places", [row.get(column) for row in rows])


def _count(domain: Domain, name: str, how: str, by: str, values: Sequence[Value]) -> Part:
    known = [value for value in values if value is not None]
    inside = sum(_can(domain, name, value) for value in known)
    return Part(name, how, by, inside, len(known) - inside, len(values) - len(known))


def _can(domain: Domain, name: str, value: Value) -> bool:
    """Return whether the domain can hold with this value of an attribute; a missing one cannot."""
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return False
    return domain.can_hold({name: value})
