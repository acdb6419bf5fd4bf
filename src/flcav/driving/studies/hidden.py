"""Occlusion of road users from a vehicle, from poles, and from both: the argument for road sensors.

The article argues for them with what a vehicle cannot see (Wang et al., IEEE Network 37(3), 2023). Counted are cars and
vans in the field of the vehicle's detector, and hidden is who no ray reaches: `visibility.share_seen`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.driving.visibility import EYE_M, FIELD_M, share_seen
from flcav.geometry import Boxes, rotate
from flcav.perception.objects.truth import CARS
from flcav.statistics.estimates import Estimate, score_interval
from flcav.storage.records import Record
from flcav.world.line_of_sight import look_at_instants
from flcav.world.map.town import Town
from flcav.world.scene import Scene
from flcav.world.trace import Trace

Array = NDArray[np.float64]

INSTANTS = 40


@dataclass(frozen=True)
class Hidden(Record):
    """Shares of the cars around vehicles that are hidden, with Wilson's interval; 0 cars give no shares."""

    cars: int
    vehicle: Estimate | None  # from the vehicle
    poles: Estimate | None  # from every pole, or out of its range
    both: Estimate | None

    def lines(self) -> list[str]:
        """Return the shares in words."""
        if self.vehicle is None or self.poles is None or self.both is None:
            return ["nobody drives near the vehicles"]
        return [
            f"of {self.cars} cars around vehicles hidden from the vehicle {self.vehicle.describe()}, "
            f"from every pole {self.poles.describe()}, from both {self.both.describe()}"
        ]


def find_hidden(scene: Scene, own: int, sites: Sequence[Array], range_m: float) -> tuple[Boxes, NDArray[np.bool_]]:
    """Return the cars in the field of the vehicle in row `own`, and (N, 2) whether hidden from it, from every site."""
    trace, i = scene.trace, scene.index
    rows = np.flatnonzero(trace.present[i] & np.isin(trace.category, CARS))
    rows = rows[rows != own]
    at, yaw = trace.position[i, own], float(trace.yaw[i, own])
    x, y = rotate(trace.position[i, rows, 0] - at[0], trace.position[i, rows, 1] - at[1], -yaw)
    rows = rows[(x > 0) & (x < FIELD_M[0]) & (np.abs(y) < FIELD_M[1])]
    size = trace.size[rows]
    boxes = Boxes(trace.position[i, rows] + size * (0.0, 0.0, 0.5), size, trace.yaw[i, rows], np.full(len(rows), "Car"))
    hidden = np.ones((len(rows), 2), np.bool_)
    hidden[:, 0] = share_seen(scene, at + np.array((0.0, 0.0, EYE_M)), boxes, own) == 0
    for site in sites:
        near = np.linalg.norm(boxes.center - site, axis=1) <= range_m
        hidden[near, 1] &= share_seen(scene, site, boxes[near]) == 0
    return boxes, hidden


def summarise_hidden(flags: Sequence[NDArray[np.bool_]]) -> Hidden:
    """Return the shares of the flags (N, 2) of all instants."""
    joined = np.concatenate([np.zeros((0, 2), np.bool_), *flags])
    n = len(joined)
    if not n:
        return Hidden(0, None, None, None)
    vehicle, poles, both = joined[:, 0].mean(), joined[:, 1].mean(), joined.all(axis=1).mean()
    return Hidden(n, *(score_interval(float(share), n) for share in (vehicle, poles, both)))


def count_hidden(town: Town, traces: Sequence[Trace], sites: Array, ranges_m: Sequence[float]) -> Hidden:
    """Return the road users hidden from connected vehicles ("cav0", ...) in recorded traffic, and from sites (P, 3).

    Looked at are about `INSTANTS` instants. Without connected vehicles every car that drives is one.
    """
    flags = []
    for scene in look_at_instants(town, traces, INSTANTS):
        trace, i = scene.trace, scene.index
        names = np.char.startswith(trace.actor, "cav") & trace.present[i]
        if not names.any():
            driving = np.linalg.norm(trace.velocity[i, :, :2], axis=1) > 1.0
            names = trace.present[i] & np.isin(trace.category, CARS) & driving
        for own in np.flatnonzero(names).tolist():
            flags.append(_hidden_of(scene, own, sites, ranges_m))
    return summarise_hidden(flags)


def _hidden_of(scene: Scene, own: int, sites: Array, ranges_m: Sequence[float]) -> NDArray[np.bool_]:
    """Return the flags of the cars around one vehicle, of sites that have a range each."""
    _, hidden = find_hidden(scene, own, [], 0.0)
    for site, range_m in zip(sites, ranges_m, strict=True):
        hidden[:, 1] &= find_hidden(scene, own, [site], range_m)[1][:, 1]
    return hidden
