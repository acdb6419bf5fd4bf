"""Recording of a drive for display: the actors around the ego vehicle and their perceived boxes, at 5 Hz."""

from dataclasses import dataclass

import numpy as np

from flcav.driving.driver import Decision, EgoMotion
from flcav.driving.measures import name_cause
from flcav.driving.scenarios import StagedScenario
from flcav.driving.seen import EGO, Seen, find_around
from flcav.geometry import Array
from flcav.storage.records import Record
from flcav.world.map.roads import read_net
from flcav.world.snapshot import Snapshot

EVERY = 2  # steps of 0.1 s between two instants
AROUND_M = 55.0  # radius around the ego vehicle
Box = tuple[float, float, float, float, float]  # x, y [m], yaw [rad], length, width [m]


@dataclass(frozen=True)
class Instant(Record):
    """One instant of a film, in the world frame."""

    time_s: float
    ego: Box
    speed: float  # [m/s]
    actors: tuple[Box, ...]  # true boxes within `AROUND_M`
    seen: tuple[Box, ...]  # perceived boxes within `AROUND_M`
    slows_for: str  # see `measures.name_cause`


@dataclass(frozen=True)
class Film(Record):
    """The film of one drive, and the lanes around it."""

    scenario: str
    seed: int
    lanes: tuple[tuple[tuple[float, float], ...], ...]  # centre lines, x, y [m]
    instants: tuple[Instant, ...]


class FilmCamera:
    """Recorder of a drive; `watch` is called at every step."""

    def __init__(self) -> None:
        """Begin with an empty film."""
        self._instants: list[Instant] = []
        self._steps = 0

    def watch(self, snapshot: Snapshot, seen: Seen, own: EgoMotion, decision: Decision) -> None:
        """Record every second step (`EVERY`)."""
        self._steps += 1
        if (self._steps - 1) % EVERY:
            return
        trace, row = snapshot.trace, snapshot.row(EGO)
        rows = find_around(snapshot, AROUND_M)
        whole = np.column_stack((trace.position[0, :, :2], trace.yaw[0], trace.size[:, :2]))
        near = np.hypot(*(seen.boxes.center[:, :2] - trace.position[0, row, :2]).T) <= AROUND_M
        perceived = np.column_stack((seen.boxes.center[:, :2], seen.boxes.yaw, seen.boxes.size[:, :2]))[near]
        speed = float(np.hypot(*trace.velocity[0, row, :2]))
        slows_for = name_cause(decision.cause, seen, snapshot)
        (ego,) = _boxes(whole[[row]])
        self._instants.append(
            Instant(round(snapshot.time_s, 1), ego, round(speed, 1), _boxes(whole[rows]), _boxes(perceived), slows_for)
        )

    def develop(self, staged: StagedScenario, seed: int) -> Film:
        """Return the film of the drive, with the lanes within `AROUND_M` of the driven path."""
        net = read_net(staged.town.net)
        shapes = [lane.shape for edge in net.edges.values() for lane in edge.lanes_of("driving")]
        path = np.array([instant.ego[:2] for instant in self._instants]).reshape(-1, 2)
        low, high = path.min(axis=0, initial=1e9) - AROUND_M, path.max(axis=0, initial=-1e9) + AROUND_M
        near = [shape for shape in shapes if (shape.max(axis=0) >= low).all() and (shape.min(axis=0) <= high).all()]
        lanes = tuple(tuple((round(x, 1), round(y, 1)) for x, y in shape.tolist()) for shape in near)
        return Film(staged.scenario.name, seed, lanes, tuple(self._instants))


def _boxes(rows: Array) -> tuple[Box, ...]:
    return tuple(
        (round(x, 2), round(y, 2), round(yaw, 3), round(length, 1), round(width, 1))
        for x, y, yaw, length, width in rows.tolist()
    )
