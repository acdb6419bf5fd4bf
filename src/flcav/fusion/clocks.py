"""Offsets of vehicles' clocks, from moving objects that road sensors see, too.

A vehicle whose clock is fast tells of a moving object where it was a little earlier than the time that it states. Road
sensors, whose clocks are exact, see many of the same objects and the vehicle itself; the offset is the one at which
both agree, by the likelihood over a grid of offsets with a share of outliers. Only what moves tells it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flcav.arrays import Array
from flcav.fusion.average import average_boxes, variance_of
from flcav.fusion.sightings import Sighting, tell

CLOCK_S = 0.3  # standard deviation of an offset, before anything is seen
OFFSETS_S: Array = np.linspace(-0.9, 0.9, 91)  # within three of these
LEAST_SPEED_MPS = 2.0  # slower objects say little about clocks
TRACE_M = 0.2  # standard deviation of a trace, and of a vehicle's origin from the middle of its body
BEYOND_S = 0.6  # farthest a trace is continued before its first and after its last instant
OUTLIERS = 0.05  # share of places that belong to no trace
LEAST_EVIDENCE = 2.0  # log-likelihood that an offset has above none: two standard deviations


@dataclass(frozen=True)
class ObjectPath:
    """The path of an object by road sensors alone."""

    times_s: Array  # (T,) increasing, two or more
    places: Array  # (T, 2) x, y, world frame [m]

    def place_at(self, times_s: Array) -> Array:
        """Return places (..., 2) at times (...): on straight lines between instants; infinite beyond `BEYOND_S`."""
        known, at = self.times_s, np.asarray(times_s)
        before = np.clip(np.searchsorted(known, at) - 1, 0, len(known) - 2)
        share = (at - known[before]) / (known[before + 1] - known[before])
        found = self.places[before] + (self.places[before + 1] - self.places[before]) * share[..., None]
        found[(at < known[0] - BEYOND_S) | (at > known[-1] + BEYOND_S)] = np.inf
        return found


def set_clocks(sightings: Sequence[Sighting], at_s: float) -> list[Sighting]:
    """Return the sightings with the times of vehicles set to the clock of the road sensors, where these see them move.

    at_s: time at which objects of different spins are associated [s]. Offsets that explain no more than none, by
    `LEAST_EVIDENCE`, are left.
    """
    traces = trace_objects([each for each in sightings if each.navigation is None], at_s)
    offset = {
        agent: estimate_offset([each for each in sightings if each.agent == agent], traces)
        for agent in {each.agent for each in sightings if each.navigation is not None}
    }
    return [replace(each, time_s=each.time_s - offset.get(each.agent, 0.0)) for each in sightings]


def trace_objects(surveyed: Sequence[Sighting], at_s: float) -> list[ObjectPath]:
    """Return the paths of moving objects that road sensors tell of at two instants or more."""
    found: dict[int, dict[float, list[tuple[Array, float]]]] = {}
    told = [tell(each) for each in surveyed]
    for each, member in zip(told, average_boxes(told, at_s).member, strict=True):
        certain = 1 / variance_of(each.boxes)[:, :2].mean(axis=1)
        for number, place, weight in zip(member.tolist(), each.boxes.center[:, :2], certain.tolist(), strict=True):
            found.setdefault(number, {}).setdefault(round(each.time_s, 3), []).append((place, weight))
    traces = []
    for seen in found.values():
        times = np.array(sorted(seen))
        places = np.array([_average(seen[time]) for time in times.tolist()])
        if len(times) > 1 and np.linalg.norm(places[-1] - places[0]) >= LEAST_SPEED_MPS * (times[-1] - times[0]):
            traces.append(ObjectPath(times, places))
    return traces


def _average(seen: Sequence[tuple[Array, float]]) -> Array:
    """Return the mean (2,) of places by their weights."""
    places, weights = (np.array(column) for column in zip(*seen, strict=True))
    return weights @ places / weights.sum()


def estimate_offset(own: Sequence[Sighting], traces: Sequence[ObjectPath]) -> float:
    """Return by how much a vehicle's clock is fast [s]; 0 where `traces` do not tell.

    own: what the vehicle tells of, and where it was itself.
    """
    if not traces:
        return 0.0
    evidence = -0.5 * (OFFSETS_S / CLOCK_S) ** 2
    for each in own:
        assert each.navigation is not None
        boxes = tell(each).boxes
        places = np.vstack((boxes.center[:, :2], each.world_from_agent[:2, 3]))
        variance = np.append(variance_of(boxes)[:, :2].mean(axis=1), each.navigation.position_m**2) + TRACE_M**2
        weight = np.append(np.ones(len(boxes)) if boxes.score is None else boxes.score, 1.0)
        expected = np.stack([trace.place_at(each.time_s - OFFSETS_S) for trace in traces])
        apart = np.linalg.norm(places[:, None, None] - expected[None], axis=3).min(axis=1)  # (places, offsets)
        evidence += weight @ np.log(OUTLIERS + np.exp(-0.5 * apart**2 / variance[:, None]))
    best = int(evidence.argmax())
    return float(OFFSETS_S[best]) if evidence[best] - evidence[len(OFFSETS_S) // 2] > LEAST_EVIDENCE else 0.0
