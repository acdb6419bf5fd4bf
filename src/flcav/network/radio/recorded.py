"""Radio links of a recorded scene: its connected vehicles, its town, and roadside units on the town's poles."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import RadioLinks, link_vehicles, unit_positions
from flcav.network.radio.propagation import PathState
from flcav.world.map.town import Town

POLE = re.compile(r"pole([0-9]{1,9})")  # what agents on poles are called


@dataclass(frozen=True)
class RecordedScene:
    """The links of the connected vehicles of a scene, with what they were made of."""

    scene: str
    town: Town
    units: dict[str, NDArray[np.float64]]  # name -> mount (3,) [m, world]
    paths: NDArray[np.float64]  # (T, V, 2) ground positions of the vehicles [m, world]; NaN where one is absent
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
    trace, town = data.trace(name), data.town()
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
    """The link of a vehicle to a unit while it is in the town; rates are those of `RadioLinks.rate_bps`."""

    vehicle: str
    unit: str
    mean_mbps: float
    least_mbps: float
    most_mbps: float
    nearest_m: float
    farthest_m: float
    los: float  # fraction of the instants
    nlosv: float
    nlos: float


def summarise_links(links: RadioLinks) -> tuple[LinkSummary, ...]:
    """Return a summary of every link whose vehicle is in the town at some instant, vehicle by vehicle."""
    rates = links.rate_bps / 1e6
    found = []
    for v, vehicle in enumerate(links.vehicle):
        here = links.present[:, v]
        if not here.any():
            continue
        for u, unit in enumerate(links.unit):
            rate, distance, state = rates[here, v, u], links.distance_m[here, v, u], links.state[here, v, u]
            numbers = (rate.mean(), rate.min(), rate.max(), distance.min(), distance.max())
            shares = ((state == each).mean() for each in (PathState.LOS, PathState.NLOSV, PathState.NLOS))
            found.append(LinkSummary(vehicle, unit, *map(float, (*numbers, *shares))))
    return tuple(found)
