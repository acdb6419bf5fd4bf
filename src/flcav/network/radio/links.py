"""Radio links of the connected vehicles of a trace to roadside units, instant by instant; wireline links to the cloud.

The direct path between a vehicle and a unit is free, blocked by vehicles, or blocked by buildings. TR 37.885 draws the
state of urban links along a street at random by distance; here it is determined by ray casting: buildings are the
town's meshes, and vehicles are boxes as in the report.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.arrays import Array, Ints, Mask
from flcav.config import Config, InputError
from flcav.geometry import Boxes, segments_meet_boxes
from flcav.network.radio import budget as laws
from flcav.network.radio.budget import PathState, Radio, lone_rate_bps, received_dbm
from flcav.statistics.streams import stream
from flcav.world.map.town import Town
from flcav.world.rays.embree import Assembly, Solid, check_embree
from flcav.world.static import build_buildings_mesh
from flcav.world.trace import Trace


@dataclass(frozen=True)
class RadioLinks:
    """Links of V vehicles to U roadside units at T instants of a trace; a state holds until the next instant."""

    radio: Radio  # settings
    time_s: Array  # (T,) ascending, the trace's clock
    vehicle: tuple[str, ...]  # (V,) track ids
    unit: tuple[str, ...]  # (U,) e.g. "pole3"
    distance_m: Array  # (T, V, U) between the antennas; NaN where the vehicle is absent
    state: NDArray[np.int8]  # (T, V, U) `PathState`; -1 where the vehicle is absent
    loss_db: Array  # (T, V, U) path loss, blockage and shadowing; infinite where the vehicle is absent
    measured_bps: Array | None = None  # (T, V) measured rates, in place of those of the radio; None: there are none
    period_s: float | None = None  # after which measured rates repeat

    @property
    def present(self) -> Mask:
        """Return a mask (T, V) of the vehicles in the town."""
        return self.state[:, :, 0] >= 0

    @property
    def received_dbm(self) -> Array:
        """Return the received power (T, V, U) [dBm]."""
        return received_dbm(self.loss_db, self.radio)

    @property
    def rate_bps(self) -> Array:
        """Return the rates (T, V, U) [bit/s] of vehicles with a unit's whole band and without interference.

        Measured rates, if any, are returned unchanged.
        """
        if self.measured_bps is not None:
            return self.measured_bps[:, :, None]
        return lone_rate_bps(self.received_dbm, self.radio)


def unit_positions(town: Town, poles: Sequence[int]) -> dict[str, Array]:
    """Return the positions (3,) [m, world] of a town's poles by the name of their agent; raises `InputError`."""
    known = town.poles.id.tolist()
    if odd := [pole for pole in poles if pole not in known]:
        raise InputError(f"{town.name}: has no pole {odd[0]}; its poles are {', '.join(map(str, known))}")
    return {f"pole{pole}": town.poles.position[known.index(pole)] for pole in poles}


def check_units(town: Town, units: Mapping[str, Array], radio: Radio) -> None:
    """Raise `InputError` where there is no unit, one stands outside the town, or an urban one has no buildings."""
    if not units:
        raise InputError(f"{town.name}: no roadside unit is given")
    x_low, y_low, x_high, y_high = town.bounds
    for name, (x, y, z) in units.items():
        if not (x_low <= x <= x_high and y_low <= y <= y_high and 0 < z <= 1000):
            raise InputError(f"{name}: {x:g}, {y:g}, {z:g} lies outside {town.name}")
    if radio.environment == "urban" and not len(town.buildings):
        raise InputError(f"{town.name}: has no buildings, which the urban model needs; the highway's does without")


def walls_of(town: Town, radio: Radio) -> Assembly | None:
    """Return the buildings that block links in the radio's environment; None on a highway, where there are none."""
    return raise_walls(town) if radio.environment == "urban" else None


def link_vehicles(
    town: Town, trace: Trace, vehicles: Sequence[str], units: Mapping[str, Array], radio: Radio, seed: int = 0
) -> RadioLinks:
    """Return the radio links of vehicles to roadside units.

    A vehicle's antenna is in the middle of its roof. Random streams are named by seed, vehicle, unit and blocking
    vehicle, so that a link does not depend on other units; on a link a blocking vehicle has the same draw at all
    instants. Raises `InputError` for an unknown vehicle, and as `check_units`.

    Args:
        town: the town, whose buildings block links.
        trace: its traffic.
        vehicles: track ids of the trace.
        units: name -> (3,) position of the unit's antenna [m, world].
        radio: settings of the links.
        seed: seed of shadowing and of losses by blocking vehicles.
    """
    check_units(town, units, radio)
    actors = trace.actor.tolist()
    if odd := [name for name in vehicles if name not in actors]:
        raise InputError(f"the trace has no vehicle '{odd[0]}'")
    carriers = np.array([actors.index(name) for name in vehicles], dtype=np.int64)
    sites = np.array(list(units.values()), dtype=np.float64)
    walls = walls_of(town, radio)
    shape = (len(trace.time_s), len(carriers), len(sites))
    distance = np.full(shape, np.nan)
    state = np.full(shape, -1, np.int8)
    blocker = np.full(shape, -1, np.int64)  # (T, V, U) actors
    antenna = trace.position[:, carriers] + trace.size[carriers] * (0.0, 0.0, 1.0)  # (T, V, 3)
    for n in range(shape[0]):
        here = np.flatnonzero(trace.present[n, carriers])
        boxes, actor = vehicle_boxes(trace, n)
        row = np.full(len(trace.actor), -1, np.int64)
        row[actor] = np.arange(len(actor))
        sight = find_sight(antenna[n, here], sites, walls, boxes, row[carriers[here]])
        distance[n, here] = np.linalg.norm(antenna[n, here, None] - sites, axis=-1)
        state[n, here] = sight.state
        blocker[n, here] = np.where(sight.blocker >= 0, np.append(actor, -1)[sight.blocker], -1)
    passing = _Paths(distance, state, antenna, sites, blocker)
    loss = np.where(state >= 0, _losses(passing, trace, tuple(vehicles), tuple(units), radio, seed), np.inf)
    return RadioLinks(radio, trace.time_s, tuple(vehicles), tuple(units), distance, state, loss)


class _Paths(NamedTuple):
    """Geometry of the direct paths; `distance_m` and `state` as in `RadioLinks`."""

    distance_m: Array  # (T, V, U) [m]
    state: NDArray[np.int8]  # (T, V, U)
    antenna: Array  # (T, V, 3) of the vehicles [m, world]
    site: Array  # (U, 3) of the units [m, world]
    blocker: Ints  # (T, V, U) the actor that blocks the path; -1 for none


def _losses(
    paths: _Paths, trace: Trace, vehicles: Sequence[str], units: Sequence[str], radio: Radio, seed: int
) -> Array:
    """Return the losses (T, V, U) [dB] of the paths; undefined where a vehicle is absent."""
    state = np.maximum(paths.state, 0)
    distance = np.nan_to_num(paths.distance_m, nan=1.0)
    # Standard normal draws.
    shadow = np.zeros(distance.shape)
    blockage = np.zeros(distance.shape)
    if radio.shadowing:
        for (v, vehicle), (u, unit) in product(enumerate(vehicles), enumerate(units)):
            shadow[:, v, u] = stream(seed, "shadowing", vehicle, unit).standard_normal(len(shadow))
            for actor in sorted({*paths.blocker[:, v, u].tolist()} - {-1}):
                draws = stream(seed, "blockage", vehicle, unit, str(trace.actor[actor]))
                blockage[paths.blocker[:, v, u] == actor, v, u] = draws.standard_normal()
    antenna_m = paths.antenna[:, :, None, 2]
    unit_m = paths.site[:, 2]
    tops = trace.position[..., 2] + trace.size[:, 2]  # (T, A) [m]
    top_m = np.take_along_axis(tops, paths.blocker.reshape(len(tops), -1) % tops.shape[1], axis=1)
    blocked = laws.blockage_db(
        distance, np.minimum(antenna_m, unit_m), np.maximum(antenna_m, unit_m), top_m.reshape(distance.shape), blockage
    )
    moved = np.linalg.norm(np.diff(paths.antenna, axis=0, prepend=np.nan), axis=-1)
    moved = np.nan_to_num(moved, nan=np.inf)[:, :, None]  # the process starts anew after an absence
    correlation = laws.correlation_distance_m(state, radio.environment)
    shadowing = laws.shadowing_sigma_db(state, radio.environment) * laws.correlate_along_path(
        moved, correlation, shadow
    )
    path_loss = laws.path_loss_db(distance, state, radio.frequency_ghz, radio.environment)
    return path_loss + np.where(paths.state == PathState.NLOSV, blocked, 0.0) + shadowing


BLOCKING = ("car", "van", "truck", "bus")  # the vehicle types of TR 37.885, clause 6.1.2


@dataclass(frozen=True)
class PathStates:
    """States of the direct paths from N antennas to U sites."""

    state: NDArray[np.int8]  # (N, U) `PathState`
    blocker: Ints  # (N, U) row of the highest vehicle in the path; -1 where there is none


def raise_walls(town: Town) -> Assembly:
    """Return the buildings of a town for ray casting, world frame; raises `OSError` where the engine is missing."""
    check_embree()
    mesh = build_buildings_mesh(town)
    walls = Assembly([Solid(mesh.vertices, mesh.faces)])
    walls.place(0, np.eye(4))
    walls.commit()
    return walls


def vehicle_boxes(trace: Trace, instant: int) -> tuple[Boxes, Ints]:
    """Return the vehicles that can block a path at an instant of a trace, world frame, and their actors (B,)."""
    actor = np.flatnonzero(trace.present[instant] & np.isin(trace.category, BLOCKING))
    tilt = None if trace.tilt is None else trace.tilt[instant, actor]
    center = trace.box_centres(instant)[actor]
    label = trace.category[actor]
    return Boxes(center, trace.size[actor], trace.yaw[instant, actor], label, tilt=tilt), actor


def find_sight(
    antennas: Array, sites: Array, walls: Assembly | None, vehicles: Boxes, carrier: Ints | None = None
) -> PathStates:
    """Return the states of the paths from antennas (N, 3) to sites (U, 3) [m], all in the frame of the boxes.

    `walls` are the buildings, None where there are none. `carrier` (N,) is the row in `vehicles` of the vehicle that
    carries each antenna and does not block its paths; -1 for none.
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
    return PathStates(state.reshape(shape), blocker.reshape(shape))


def _occlude(walls: Assembly, starts: Array, ends: Array) -> Mask:
    """Return a mask (S,) of the segments from `starts` to `ends` (S, 3) [m] that intersect a wall."""
    length = np.linalg.norm(ends - starts, axis=1)
    directions = (ends - starts) / np.maximum(length, 1e-9)[:, None]
    return walls.find_occluded(*(array.astype(np.float32) for array in (starts, directions, length)))


class Wireline(Config):
    """A dedicated wireline link between an edge server and the cloud, the same in both directions."""

    rate_mbps: float = Field(default=1000.0, gt=0)
    latency_s: float = Field(default=0.01, ge=0, le=3600)

    def seconds(self, count: int) -> float:
        """Return the transmission time [s] of a message of `count` bytes; raises `InputError` for a negative count.

        >>> Wireline(rate_mbps=100, latency_s=0.02).seconds(1_000_000)
        0.1
        """
        if count < 0:
            raise InputError(f"a message of {count} bytes: at least 0 are wanted")
        return self.latency_s + 8 * count / (self.rate_mbps * 1e6)
