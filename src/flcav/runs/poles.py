"""Placement of roadside sensors: by VRCSP, by traffic density, at random, or on given poles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.optimization.placement.place import place
from flcav.optimization.placement.solve import coverage
from flcav.perception.errors import PerceptionError
from flcav.runs.frames import Frames
from flcav.runs.recipe import PlacementSettings
from flcav.runs.results.plans import Placed, Pole
from flcav.statistics.streams import stream
from flcav.world.map.census import measure_traffic_density
from flcav.world.trace import Trace


@dataclass(frozen=True)
class Sites:
    """The candidate sites of a region's roadside sensors: its poles."""

    number: NDArray[np.int64]  # (P,) numbers of the poles
    position: NDArray[np.float64]  # (P, 3) positions of the sensors' mounts, world frame [m]


def find_sites(drive: Frames, edge: Frames | None) -> Sites:
    """Return the candidate sites: the town's poles or, for recorded data (`edge`), the poles with recorded sweeps."""
    town = drive.data.town()
    if edge is None:
        return (
            Sites(town.poles.id, town.poles.position)
            if town is not None
            else Sites(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
        )
    known = sorted(edge.poles)
    mounts = [edge.data.frame(edge.poles[pole][0]).world_from_agent[:3, 3] for pole in known]
    return Sites(np.array(known, dtype=np.int64), np.array(mounts, dtype=np.float64).reshape(-1, 3))


def place_sensors(
    region: str,
    how: PlacementSettings,
    sites: Sites,
    errors: Mapping[str, Sequence[PerceptionError]],
    weights: Mapping[str, float],
    traces: Sequence[Trace],
    seed: int = 0,
    passed: NDArray[np.bool_] | None = None,
) -> Placed:
    """Place a region's sensors by the rule in `how`: VRCSP over errors, densest traffic, at random, or on given poles.

    `errors` and `weights` are by task: the weight of an error is multiplied by that of its task. `traces` give the
    traffic. Random poles are drawn from a stream of `seed` and the region: a smaller draw is a prefix of a larger one.
    Except by the rule "fixed", only poles that vehicles have `passed` (P,) are chosen, if there are any (None: all).
    Raises `InputError` for a given pole that the region does not have.
    """
    every = [replace(error, weight=error.weight * weights[task]) for task in how.tasks for error in errors[task]]
    xyz = np.array([(error.x, error.y, error.z) for error in every]).reshape(-1, 3)
    weight = np.array([error.weight for error in every])
    if not len(sites.number):
        return Placed(region, "none", (), len(xyz), 0, how.range_m, ())
    actors = measure_traffic_density(sites.position, traces, how.range_m)
    within = coverage(xyz, sites.position, how.range_m)
    usable = np.ones(len(sites.number), bool) if passed is None or not passed.any() else passed
    count = min(how.count, int(usable.sum()))
    chosen: list[int] = []
    if how.rule == "vrcsp" and len(xyz):  # without errors there is nothing to cover
        # Over all poles first, and over the passed ones alone only if the optimum includes a pole that nobody passes.
        for rows in (np.arange(len(usable)), np.flatnonzero(usable)):
            chosen = rows[list(place(xyz, sites.position[rows], how.range_m, count, weight=weight).chosen)].tolist()
            if usable[chosen].all():
                break
    elif how.rule == "densest":
        ranked = np.argsort(-actors, kind="stable")
        chosen = ranked[usable[ranked]][:count].tolist()
    elif how.rule == "random":
        drawn = stream(seed, "placement", region).permutation(len(sites.number))
        chosen = drawn[usable[drawn]][:count].tolist()
    elif how.rule == "fixed":
        chosen = [_find_row(region, sites, pole) for pole in how.poles]
    return Placed(
        region=region,
        rule=how.rule,
        chosen=tuple(int(sites.number[i]) for i in chosen),
        errors=len(xyz),
        covered=int(within[chosen].any(axis=0).sum()) if chosen else 0,
        range_m=how.range_m,
        poles=tuple(
            Pole(int(number), int(row.sum()), round(float(mean), 2))
            for number, row, mean in zip(sites.number, within, actors, strict=True)
        ),
    )


def find_passed(sites: Sites, drive: Frames, range_m: float) -> NDArray[np.bool_]:
    """Return whether a vehicle comes within `range_m` [m] of a site in any frame of a drive (P,), in the x-y plane."""
    places = np.array([drive.data.world_from_agent(i)[:2, 3] for i in drive.vehicles]).reshape(-1, 2)
    apart = np.linalg.norm(sites.position[:, None, :2] - places, axis=2)
    return (apart <= range_m).any(axis=1)


def read_traces(data: Dataset, frames: Sequence[int]) -> list[Trace]:
    """Read the recorded traffic of the frames' scenes; scenes without a trace are left out."""
    scenes = sorted({data.keys[i].scene for i in frames})
    return [trace for scene in scenes if (trace := data.trace(scene)) is not None]


def _find_row(region: str, sites: Sites, pole: int) -> int:
    known = sites.number.tolist()
    if pole not in known:
        listed = ", ".join(map(str, known))
        raise InputError(f"placement.poles: {pole} is none of the candidate poles of region '{region}': {listed}")
    return known.index(pole)
