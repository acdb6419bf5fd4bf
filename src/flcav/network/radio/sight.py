"""State of the direct paths between vehicles and roadside units: free, blocked by vehicles, blocked by buildings.

TR 37.885 draws the state of urban links along a street by distance; here it follows from the town and its traffic,
whose buildings are its meshes, and whose vehicles are boxes as in the report.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes, segments_meet_boxes
from flcav.network.radio.propagation import PathState
from flcav.world.map.town import Town
from flcav.world.rays.embree import Assembly, Embree
from flcav.world.static import build_buildings_mesh
from flcav.world.trace import Trace

Array = NDArray[np.float64]

BLOCKING = ("car", "van", "truck", "bus")  # the vehicle types of TR 37.885, clause 6.1.2


@dataclass(frozen=True)
class Sight:
    """States of the direct paths from N antennas to U sites."""

    state: NDArray[np.int8]  # (N, U) a State
    blocker: NDArray[np.int64]  # (N, U) row of the tallest vehicle in the path; -1 where none is


def raise_walls(town: Town) -> Assembly:
    """Return the buildings of a town for ray casting, world frame; raises `OSError` where the engine is missing."""
    mesh, engine = build_buildings_mesh(town), Embree()
    walls = engine.assembly([engine.solid(mesh.vertices, mesh.faces)])
    walls.place(0, np.eye(4))
    walls.commit()
    return walls


def vehicle_boxes(trace: Trace, instant: int) -> tuple[Boxes, NDArray[np.int64]]:
    """Return the vehicles that can block a path at an instant of a trace, world frame, and their actors (B,)."""
    actor = np.flatnonzero(trace.present[instant] & np.isin(trace.category, BLOCKING))
    tilt = None if trace.tilt is None else trace.tilt[instant, actor]
    center = trace.box_centres(instant)[actor]
    label = trace.category[actor]
    return Boxes(center, trace.size[actor], trace.yaw[instant, actor], label, tilt=tilt), actor


def find_sight(
    antennas: Array, sites: Array, walls: Assembly | None, vehicles: Boxes, carrier: NDArray[np.int64] | None = None
) -> Sight:
    """Return the states of the paths from antennas (N, 3) to sites (U, 3) [m], all in the frame of the boxes.

    `walls` are the buildings, None where there are none.
    `carrier` (N,) is the row in `vehicles` of the vehicle that carries each antenna, -1 for none: it does not block.
    """
    starts = np.repeat(antennas, len(sites), axis=0)
    ends = np.tile(sites, (len(antennas), 1))
    walled = np.zeros(len(starts), np.bool_) if walls is None else _occlude(walls, starts, ends)
    crossed = segments_meet_boxes(starts, ends, vehicles)
    if carrier is not None:
        carried = np.repeat(carrier, len(sites))
        rows = np.flatnonzero(carried >= 0)
        crossed[rows, carried[rows]] = False
    tops = np.where(crossed, vehicles.corners()[..., 2].max(axis=1), -np.inf)
    hidden = crossed.any(axis=1)
    blocker = np.where(hidden, tops.argmax(axis=1) if len(vehicles) else 0, -1)
    state = np.where(walled, PathState.NLOS, np.where(hidden, PathState.NLOSV, PathState.LOS)).astype(np.int8)
    shape = (len(antennas), len(sites))
    return Sight(state.reshape(shape), blocker.reshape(shape))


def _occlude(walls: Assembly, starts: Array, ends: Array) -> NDArray[np.bool_]:
    """Return (S,) whether a wall is between starts and ends (S, 3) [m]."""
    length = np.linalg.norm(ends - starts, axis=1)
    directions = (ends - starts) / np.maximum(length, 1e-9)[:, None]
    return walls.find_occluded(*(each.astype(np.float32) for each in (starts, directions, length)))
