"""Radio links of a recorded scene to roadside units on its town's poles, and the coverage of a town by units."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes
from flcav.network.radio.budget import PathState, Radio, lone_rate_bps, path_loss_db, received_dbm
from flcav.network.radio.links import RadioLinks, check_units, find_sight, link_vehicles, unit_positions, walls_of
from flcav.world.map.town import Town

POLE = re.compile(r"pole([0-9]{1,9})")  # names of agents on poles


@dataclass(frozen=True)
class RecordedScene:
    """The links of the connected vehicles of a scene, with the town, units and paths that determine them."""

    scene: str
    town: Town
    units: dict[str, Array]  # name -> mount (3,) [m, world]
    paths: Array  # (T, V, 2) ground positions of the vehicles [m, world]; NaN where one is absent
    links: RadioLinks


def link_scene(
    data: Dataset, radio: Radio, poles: Sequence[int] = (), scene: str | None = None, seed: int = 0
) -> RecordedScene:
    """Return the radio links of a recorded scene's vehicles to roadside units on poles.

    Raises `InputError` where the dataset has no such scene, no traffic, town, connected vehicles or poles, and as
    `links.link_vehicles`.

    Args:
        data: the dataset.
        radio: settings of the links.
        poles: numbers of the town's poles; empty: those recorded from.
        scene: name of the scene; None: the first.
        seed: seed of shadowing and losses.
    """
    scenes = list(dict.fromkeys(key.scene for key in data.keys))
    name = scenes[0] if scene is None else scene
    if name not in scenes:
        raise InputError(f"{data.folder}: no scene '{name}'; the first is '{scenes[0]}'")
    trace = data.trace(name)
    town = data.town()
    if trace is None or town is None:
        raise InputError(f"{data.folder}: has no {'traffic' if trace is None else 'town'}, which radio links need")
    agents = list(dict.fromkeys(key.agent for key in data.keys if key.scene == name))
    vehicles = [agent for agent in agents if agent in trace.actor]
    if not vehicles:
        raise InputError(f"{data.folder}: no connected vehicle in scene '{name}'")
    recorded = [int(number[1]) for agent in agents if (number := POLE.fullmatch(agent))]
    if not (poles or recorded):
        raise InputError(f"{data.folder}: recorded from no pole; say on which the units are, --pole N")
    units = unit_positions(town, tuple(dict.fromkeys(poles or sorted(recorded))))
    links = link_vehicles(town, trace, vehicles, units, radio, seed)
    rows = [trace.actor.tolist().index(vehicle) for vehicle in vehicles]
    return RecordedScene(name, town, units, trace.position[:, rows, :2], links)


@dataclass(frozen=True)
class LinkSummary:
    """The link of a vehicle to a unit while the vehicle is in the town; rates are those of `RadioLinks.rate_bps`."""

    vehicle: str
    unit: str
    mean_mbps: float  # [Mbit/s]
    least_mbps: float
    most_mbps: float
    nearest_m: float
    farthest_m: float
    los: float  # fraction of the instants in line of sight
    nlosv: float  # blocked by vehicles
    nlos: float  # blocked by buildings


def summarise_links(links: RadioLinks) -> tuple[LinkSummary, ...]:
    """Return a summary of every link of the vehicles that are in the town at some instant."""
    rates = links.rate_bps / 1e6
    summaries = []
    for v, vehicle in enumerate(links.vehicle):
        here = links.present[:, v]
        if not here.any():
            continue
        for u, unit in enumerate(links.unit):
            rate = rates[here, v, u]
            distance = links.distance_m[here, v, u]
            state = links.state[here, v, u]
            numbers = (rate.mean(), rate.min(), rate.max(), distance.min(), distance.max())
            shares = ((state == path_state).mean() for path_state in (PathState.LOS, PathState.NLOSV, PathState.NLOS))
            summaries.append(LinkSummary(vehicle, unit, *map(float, (*numbers, *shares))))
    return tuple(summaries)


ANTENNA_M = 1.6  # height of a vehicle's antenna: TR 37.885, clause 6.1.2, type 2
FINEST_M = 0.5  # least step of the grid


@dataclass(frozen=True)
class Coverage:
    """Median rates on a grid of X times Y cells in a town, served by the unit of least path loss."""

    unit: tuple[str, ...]  # (U,)
    site: Array  # (U, 3) [m, world]
    x: Array  # (X,) centres of the cells [m, world]
    y: Array  # (Y,) [m, world]
    rate_bps: Array  # (Y, X) [bit/s]
    state: NDArray[np.int8]  # (Y, X) `PathState` LOS or NLOS, to the serving unit


def cover_town(town: Town, units: Mapping[str, Array], radio: Radio, step_m: float = 2.0) -> Coverage:
    """Return the radio coverage of a town by roadside units, on a grid.

    Rates are those of a vehicle alone in the band, without shadowing: the median over shadowing. Raises `InputError` as
    `links.check_units`, and for a step below `FINEST_M`.

    Args:
        town: the town.
        units: name -> (3,) position of the unit's antenna [m, world].
        radio: settings of the links.
        step_m: distance between the grid's points [m].
    """
    check_units(town, units, radio)
    if not step_m >= FINEST_M:
        raise InputError(f"a grid of {step_m:g} m: at least {FINEST_M:g} m are wanted")
    sites = np.array(list(units.values()), dtype=np.float64)
    walls = walls_of(town, radio)
    no_vehicles = Boxes.empty()
    x_low, y_low, x_high, y_high = town.bounds
    x = np.arange(x_low + step_m / 2, x_high, step_m)
    y = np.arange(y_low + step_m / 2, y_high, step_m)
    rate = np.empty((len(y), len(x)))
    state = np.empty((len(y), len(x)), np.int8)
    for row, north in enumerate(y):
        places = np.stack((x, np.full(len(x), north), np.full(len(x), ANTENNA_M)), axis=1)
        seen = find_sight(places, sites, walls, no_vehicles).state  # (X, U)
        distance = np.linalg.norm(places[:, None] - sites, axis=-1)
        loss = path_loss_db(distance, seen, radio.frequency_ghz, radio.environment)
        best = loss.argmin(axis=1)[:, None]
        rate[row] = lone_rate_bps(received_dbm(np.take_along_axis(loss, best, 1)[:, 0], radio), radio)
        state[row] = np.take_along_axis(seen, best, 1)[:, 0]
    return Coverage(tuple(units), sites, x, y, rate, state)
