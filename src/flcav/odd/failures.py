"""Failures of a detector in sampled scenarios, each in a cell of a grid that is fixed before any search.

A failure is a missed object of many LiDAR returns in the vehicle's path (`cells.locate_failure`). Two are distinct
where they are in different cells: by place, class, weather, road users around, distance and occlusion. What is tested
are frames of the recording that a sample's recipe describes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flcav.odd.cells import PATH_AHEAD_M, PATH_ASIDE_M, locate_failure
from flcav.odd.measure import AROUND_M, PARKED
from flcav.odd.sampling import Sample
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.task import find_errors
from flcav.perception.objects.truth import DETECTION_CLASS
from flcav.sources.embedded import EmbeddedSource
from flcav.storage.records import Record
from flcav.world.trace import Trace
from flcav.world.weather import Weather

SCORE = 0.3  # from which a detection counts
APART_M = 5.0  # between two tested frames of one vehicle
GRID: Mapping[str, tuple[float, ...]] = {  # edges between the buckets of numbers
    "rainfall": (0.3, 5.0),  # [mm/h]
    "visibility": (400.0, 3000.0),  # [m]
    "agents": (5.0, 15.0, 30.0),  # that are not parked, within `AROUND_M`
    "distance": (10.0, 20.0, 30.0),  # ahead [m]
    "occlusion": (1 / 3, 2 / 3),
}
CLASSES = tuple(dict.fromkeys(DETECTION_CLASS.values()))
NOBODY = ""  # class of a candidate without anybody in the path

Cell = tuple[str, ...]  # kind of place, class, and the bucket of each number of `GRID`


@dataclass(frozen=True)
class Candidate:
    """A candidate frame of the search: a vehicle at a spin, and the road users in its path."""

    spin: int
    vehicle: int  # number of "cav0", ...
    x: float  # of the vehicle [m]
    y: float
    cell: Cell  # without occlusion, of the nearest in the path; its class is `NOBODY` where there is none
    away_m: float  # from the place of the sample
    plays: bool  # whether the corner case plays


@dataclass(frozen=True)
class Failure(Record):
    """One failure: a missed object in the path of a vehicle."""

    frame: str  # key in the recording of the recipe
    cell: Cell
    distance_m: float
    returns: int


@dataclass(frozen=True)
class TriedFrame(Record):
    """A tested frame: the cell of its candidate, and its failures."""

    cell: Cell
    failures: tuple[Failure, ...]


def bucket(name: str, value: float) -> str:
    """Return the bucket of a number of `GRID`."""
    return f"{name} {int(np.digitize(value, GRID[name]))}"


def weather_buckets(weather: Weather) -> tuple[str, str]:
    """Return the buckets of rain and of sight."""
    return bucket("rainfall", weather.rain_mm_h), bucket("visibility", weather.visibility_m)


def list_candidates(sample: Sample, trace: Trace, cavs: int, plays_s: float = 12.0) -> list[Candidate]:
    """Return the frames of connected vehicles in the traffic of a sample's recipe.

    A corner case plays for `plays_s` from its beginning.
    """
    names = trace.actor.tolist()
    rows = [names.index(f"cav{number}") for number in range(cavs)]
    labels = np.array([DETECTION_CLASS.get(str(each), NOBODY) for each in trace.category])
    driving = ~np.char.startswith(trace.actor, PARKED)
    begins_s = trace.events[0].begins_s if trace.events else np.inf
    found = []
    for spin, time_s in enumerate(trace.time_s.tolist()):
        at = np.where(trace.present[spin, :, None], trace.position[spin, :, :2], np.inf)
        for vehicle, row in enumerate(rows):
            own, yaw = at[row], float(trace.yaw[spin, row])
            gap = np.where(np.isfinite(at), at - own, 1e6)
            ahead = gap @ (np.cos(yaw), np.sin(yaw))
            aside = gap @ (-np.sin(yaw), np.cos(yaw))
            path = (ahead > 0) & (ahead <= PATH_AHEAD_M) & (np.abs(aside) <= PATH_ASIDE_M) & (labels != NOBODY)
            path[row] = False
            nearest = int(np.argmin(np.where(path, ahead, np.inf)))
            count = int((driving & (np.hypot(*gap.T) <= AROUND_M)).sum()) - 1
            cell = (
                sample.place.kind,
                str(labels[nearest]) if path.any() else NOBODY,
                *weather_buckets(sample.weather),
                bucket("agents", count),
                bucket("distance", float(ahead[nearest]) if path.any() else np.inf),
            )
            away = float(np.hypot(own[0] - sample.place.x, own[1] - sample.place.y))
            plays = begins_s <= time_s <= begins_s + plays_s
            found.append(Candidate(spin, vehicle, float(own[0]), float(own[1]), cell, away, plays))
    return found


def take_apart(ranked: Sequence[Candidate], count: int) -> list[Candidate]:
    """Return the first `count` candidates, without those within `APART_M` of an earlier one of the same vehicle."""
    taken: list[Candidate] = []
    for each in ranked:
        if all(
            other.vehicle != each.vehicle or np.hypot(other.x - each.x, other.y - each.y) >= APART_M for other in taken
        ):
            taken.append(each)
        if len(taken) == count:
            break
    return taken


def try_frames(
    sample: Sample, source: EmbeddedSource, trace: Trace, chosen: Sequence[Candidate], network: Second
) -> list[TriedFrame]:
    """Return the failures of a detector in chosen frames of a sample's recording, whose traffic is `trace`."""
    scene, tested = source.scenes()[0], []
    for each in chosen:
        number = each.spin * len(source.agents) + each.vehicle
        frame = next(source.replay(scene, trace, range(number, number + 1)))
        found = detect_in(network, [frame], score_threshold=SCORE)
        marks = frame.annotations
        away = np.linalg.norm(marks.boxes.center[:, :2] - frame.world_from_agent[:2, 3], axis=1)
        agents = int((~np.char.startswith(marks.track, PARKED) & (away <= AROUND_M)).sum())
        failures = []
        for error in next(find_errors([frame], found, network.config, SCORE)):
            ahead = locate_failure(frame.world_from_agent, error)
            if ahead is None:
                continue
            numbers = {"agents": float(agents), "distance": ahead, "occlusion": error.occlusion}
            buckets = (bucket(name, value) for name, value in numbers.items())
            cell = (sample.place.kind, error.label, *weather_buckets(sample.weather), *buckets)
            failures.append(Failure(frame.key, cell, ahead, error.returns))
        tested.append(TriedFrame(each.cell, tuple(failures)))
    return tested
