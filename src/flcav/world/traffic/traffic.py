"""Traffic simulation of a town by SUMO: the smoothed motion of all actors and the parked vehicles, as a `Trace`.

SUMO moves actors in plan. On a relief, heights, pitch, roll and vertical velocities follow from the ground; horizontal
velocities are unchanged.
"""

import contextlib
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from flcav.arrays import Array, Ints, Mask
from flcav.config import InputError
from flcav.geometry import heading_vectors, wrap_angle
from flcav.statistics.streams import derive_seed, stream
from flcav.world.map.relief import find_tilts
from flcav.world.map.roads import read_net
from flcav.world.map.surfaces import make_footprint
from flcav.world.map.town import KERB_M, Town
from flcav.world.scenarios.manoeuvres import shape_of
from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.stage import STEP_S
from flcav.world.shapes import SHAPES
from flcav.world.trace import Event, Trace
from flcav.world.traffic.bridges import find_footing
from flcav.world.traffic.client import Sumo, write_job
from flcav.world.traffic.demand import Demand, Parked, list_vehicle_types, park, write_demand
from flcav.world.traffic.process import RecordedTraffic

FILL_S = 30.0  # time by which all actors have departed
SMOOTHING_STEPS = 4  # half width of the moving average of poses, since SUMO turns and changes lanes abruptly
REACH_S = (SMOOTHING_STEPS + 1) * STEP_S  # look-ahead: a trace's state depends on SUMO's states up to so much later


def simulate(town: Town, *, seed: int, cavs: int, times_s: NDArray, scenarios: Sequence[Scenario] = ()) -> Trace:
    """Simulate the traffic of `town`; return it at `times_s` (T,), ascending multiples of 0.1 s.

    At time 0 the town is empty, and it fills until `FILL_S`. Actors are "cav<i>" (sedans, travelling from the start),
    "veh<i>", "ped<i>", "parked<i>", and "scripted<i>" for those created for a scenario; actors absent at all of
    `times_s` are left out. A scenario waits from its `at_s` on until the traffic allows it; `events` of the trace are
    those that have happened. The same arguments give the same trace. Raises `InputError` for other times, for a
    negative `cavs`, where not all CAVs are on the road at all times, and for a red-light scenario in a town without
    traffic lights; `RuntimeError` where SUMO fails.
    """
    return simulate_drives(town, seed=seed, cavs=cavs, times_s=times_s, lead_s=0.0, scenarios=scenarios)[0]


def simulate_drives(
    town: Town, *, seed: int, cavs: int, times_s: NDArray, lead_s: float, scenarios: Sequence[Scenario] = ()
) -> tuple[Trace, Trace]:
    """Return the traffic as `simulate` does, and the motion of only the CAVs at every step.

    The latter is from `lead_s` [s] before the first of `times_s` to the last; a CAV that has not departed yet is
    absent. Raises `InputError` and `RuntimeError` as `simulate` does.
    """
    times_s = np.asarray(times_s, dtype=np.float64)
    steps = np.rint(times_s / STEP_S).astype(np.int64)
    if not len(steps) or not np.allclose(steps * STEP_S, times_s, atol=1e-6) or (np.diff(steps, prepend=0) <= 0).any():
        raise InputError(f"times_s = {times_s}: must be ascending multiples of {STEP_S} s above 0")
    if cavs < 0:
        raise InputError(f"cavs = {cavs}: must be 0 or more")
    if any(scenario.kind == "red_light_runner" for scenario in scenarios) and not town.signals.link:
        raise InputError(f"scenario 'red_light_runner': {town.name} has no traffic lights")
    net = read_net(town.net)
    span = {"from_s": float(times_s[0]), "until_s": float(times_s[-1])}
    try:
        demand = write_demand(net, town.parameters, seed=seed, cavs=cavs, fill_s=FILL_S, **span)
    except InputError as error:
        raise InputError(f"{town.name}: {error}") from None
    driven = np.arange(max(steps[0] - round(lead_s / STEP_S), 1), steps[-1] + 1) if lead_s else steps[:1]
    windows, drive_windows = ([_windows(at + offset) for offset in (-1, 0, 1)] for at in (steps, driven))
    read = np.unique(np.concatenate((*windows, *drive_windows)))
    raw = _run(town.net, demand, derive_seed(seed, "sumo"), read, scenarios)
    parked = _drop_obstructing(raw, park(net, town.parameters, stream(seed, "parked")))
    rows, drive_rows = (tuple(np.searchsorted(read, window) for window in spans) for spans in (windows, drive_windows))
    trace = _build_trace(town, np.asarray(times_s.round(1)), raw, rows, parked)
    under_way = trace.present[:, np.char.startswith(trace.actor, "cav")]
    if under_way.sum() < cavs * len(times_s):
        missing = "the CAV is not" if cavs == 1 else f"not all of {cavs} CAVs are"
        fewer = ", or take fewer" if cavs > 1 else ""
        raise InputError(f"{missing} under way at {times_s[0]} s: begin later{fewer}")
    return trace, _build_trace(town, (driven * np.float64(STEP_S)).round(1), _of_cavs(raw), drive_rows, [])


def _of_cavs(raw: RecordedTraffic) -> RecordedTraffic:
    """Select the states of CAVs."""
    is_cav = np.char.startswith(raw.id, "cav")
    return raw._replace(id=raw.id[is_cav], type=raw.type[is_cav], state=raw.state[:, is_cav])


def _windows(steps: Ints) -> Ints:
    """Return the steps (T, W) over which the states at `steps` (T,) are averaged; at least 1."""
    return np.maximum(steps[:, None] + np.arange(-SMOOTHING_STEPS, SMOOTHING_STEPS + 1), 1)


def _run(net: Path, demand: Demand, seed: int, steps: Ints, scenarios: Sequence[Scenario]) -> RecordedTraffic:
    """Run SUMO without controlled vehicles; return its states at these steps. Raises `RuntimeError` where it fails."""
    with tempfile.TemporaryDirectory(prefix="flcav_traffic_") as name:
        job = write_job(Path(name), net, demand, seed)._replace(
            scenarios=[scenario.model_dump() for scenario in scenarios]
        )
        with contextlib.closing(Sumo(job, f"SUMO failed on {net}")) as sumo:
            sumo.record(steps.tolist(), out := Path(name) / "out.npz")
        with np.load(out) as arrays:
            return RecordedTraffic(**arrays)


def _build_trace(
    town: Town, time_s: Array, raw: RecordedTraffic, windows: tuple[Ints, ...], parked: list[Parked]
) -> Trace:
    """Build a trace from SUMO's states, averaged over `windows` (rows of the steps before, at and after the times)."""
    before, now, after = windows
    earlier, state, later = (_smooth(raw, window) for window in (before, now, after))
    rates = _rates(earlier, state, later)
    seen = np.flatnonzero(~np.isnan(state[..., 0]).all(axis=0))
    order = np.array(sorted(seen, key=lambda i: number_of(str(raw.id[i]))), dtype=np.int64)
    known = {name: (category, shape) for name, category, shape in list_vehicle_types()}
    kinds = [known[str(raw.type[i])] for i in order] + [(car.category, car.shape) for car in parked]
    size = np.array([SHAPES[category][shape][1:] for category, shape in kinds], dtype=np.float64).reshape(-1, 3)
    half_length = size[: len(order), 0] / 2  # from an actor's front, SUMO's reference point, to its centre
    walk = _walk(*(_centre(step[:, order], half_length) for step in (earlier, state, later)))
    still = np.array([(car.x, car.y, car.yaw, 0.0) for car in parked], dtype=np.float64).reshape(-1, 4)
    state = np.concatenate((state[:, order], np.broadcast_to(still, (len(time_s), *still.shape))), axis=1)
    rates = np.concatenate((rates[:, order], np.zeros((len(time_s), *still.shape))), axis=1)

    x, y, yaw, speed = np.moveaxis(state, 2, 0)
    forward = np.zeros((*yaw.shape, 3))
    forward[..., :2] = heading_vectors(yaw)
    pedestrian = np.array([category == "pedestrian" for category, _ in kinds], dtype=bool)
    velocity, acceleration = speed[..., None] * forward, rates[..., :3]
    walking = np.flatnonzero(pedestrian)  # SUMO moves people aside without turning them
    velocity[:, walking], acceleration[:, walking] = (motion[:, walking] for motion in walk)
    z = np.where(np.isnan(x), np.nan, KERB_M * (shapely.contains_xy(_pavement(town), x, y) & pedestrian))
    centre = _centre(state, np.append(half_length, np.zeros(len(still))))
    tilt = None
    if town.relief is not None:
        heights = find_footing(town.relief, town.net, centre, yaw)
        ground = stand_on_relief(heights, centre, yaw, velocity, acceleration, size, pedestrian)
        z, tilt, velocity, acceleration = z + ground.height, ground.tilt, ground.velocity, ground.acceleration
    lights = [(light, len(letters)) for light, letters in zip(raw.light, raw.light_state[0])]
    letters = [list("".join(row)) for row in raw.light_state[now[:, SMOOTHING_STEPS]]]
    return Trace(
        town=town.name,
        time_s=time_s,
        actor=np.array([*(str(raw.id[i]) for i in order), *(f"parked{i}" for i in range(len(parked)))], dtype=np.str_),
        category=np.array([category for category, _ in kinds], dtype=np.str_),
        shape=np.array([shape for _, shape in kinds], dtype=np.int64),
        size=size,
        present=~np.isnan(yaw),
        position=np.concatenate((centre, z[..., None]), axis=2),
        yaw=yaw,
        velocity=velocity,
        acceleration=acceleration,
        yaw_rate=rates[..., 3],
        light=np.array([f"{light}:{i}" for light, links in lights for i in range(links)], dtype=np.str_),
        light_state=np.array(letters, dtype="<U1").reshape(len(time_s), -1),
        events=tuple(Event(row["kind"], row["begins_s"], tuple(row["actors"])) for row in json.loads(str(raw.events))),
        tilt=tilt,
    )


def _smooth(raw: RecordedTraffic, windows: Ints) -> Array:
    """Return front x, y [m], yaw [rad], speed [m/s] (T, A, 4), averaged over windows (T, W).

    NaN if absent in the middle.
    """
    rows = np.unique(windows)
    dense, windows = _dense(raw, rows), np.searchsorted(rows, windows)
    total, count = np.zeros((len(windows), *dense.shape[1:])), np.zeros((len(windows), dense.shape[1], 1))
    for column, opposite in zip(
        windows.T, windows.T[::-1]
    ):  # symmetric pairs, so that the mean of an actor that has just appeared is not shifted
        there = ~np.isnan(dense[column, :, :1] + dense[opposite, :, :1])
        total += np.where(there, dense[column], 0.0)
        count += there
    absent = np.isnan(dense[windows[:, windows.shape[1] // 2], :, :1])
    out = np.where(absent, np.nan, total / np.maximum(count, 1))
    out[..., 2] = wrap_angle(out[..., 2])
    return out


def _dense(raw: RecordedTraffic, rows: Ints) -> Array:
    """Return front x, y [m], unwrapped yaw [rad], speed [m/s] (R, A, 4) at `rows` (R,); NaN where absent."""
    out = raw.state[rows]
    yaw = np.pi / 2 - np.radians(out[..., 2])
    out[..., 2] = np.where(np.isnan(yaw), np.nan, np.unwrap(np.nan_to_num(yaw), axis=0))
    return out


def _rates(before: Array, now: Array, after: Array) -> Array:
    """Return acceleration [m/s^2] and yaw rate [rad/s] (T, A, 4) by central differences of states one step apart.

    Differences are one-sided where an actor is absent before or after; NaN where it is absent now.
    """

    def motion(state: Array) -> Array:
        _, _, yaw, speed = np.moveaxis(state, 2, 0)
        return np.concatenate((speed[..., None] * heading_vectors(yaw), np.stack((0 * speed, yaw), axis=2)), axis=2)

    changes = np.stack((motion(now) - motion(before), motion(after) - motion(now)))
    changes[..., 3] = wrap_angle(changes[..., 3])
    known = ~np.isnan(changes)
    mean = np.where(known, changes, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(np.isnan(now), np.nan, mean / STEP_S)


def _centre(state: Array, half_length: Array) -> Array:
    """Return the centres (T, A, 2) [m] of actors with the states (T, A, 4): front x, y [m], yaw [rad], speed [m/s]."""
    return state[..., :2] - half_length[:, None] * heading_vectors(state[..., 2])


def _walk(before: Array, now: Array, after: Array) -> tuple[Array, Array]:
    """Return velocity [m/s] and acceleration [m/s^2] (T, A, 3) by central differences of positions (T, A, 2) [m].

    Positions are those a step before, now and a step after. Where an actor is absent before or after, the velocity is
    one-sided and the acceleration 0; NaN where it is absent now.
    """
    steps = np.stack((now - before, after - now)) / STEP_S
    known = ~np.isnan(steps)
    velocity = np.where(known, steps, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    acceleration = np.where(known.all(axis=0), steps[1] - steps[0], 0.0) / STEP_S
    absent = np.isnan(now[..., :1])
    level = np.zeros_like(absent, dtype=np.float64)
    motions = (np.where(absent, np.nan, np.concatenate((flat, level), axis=2)) for flat in (velocity, acceleration))
    return next(motions), next(motions)


def _drop_obstructing(raw: RecordedTraffic, parked: list[Parked]) -> list[Parked]:
    """Return the parked vehicles that do not overlap the paths of actors created for scenarios."""
    scripted = np.flatnonzero(np.char.startswith(raw.id, "scripted"))
    ways = []
    for actor in scripted:
        at = raw.state[~np.isnan(raw.state[:, actor, 0]), actor]
        length, width = shape_of(str(raw.type[actor]))[1:3]
        yaw = np.pi / 2 - np.radians(at[:, 2])
        middle = at[:, :2] - length / 2 * heading_vectors(yaw)
        ways += [make_footprint(x, y, turn, length, width).buffer(0.3) for (x, y), turn in zip(middle, yaw)]
    taken = shapely.union_all(ways)
    room = [(car, SHAPES[car.category][car.shape]) for car in parked]
    return [
        car
        for car, size in room
        if not make_footprint(car.x, car.y, car.yaw, size.length, size.width).intersects(taken)
    ]


def _pavement(town: Town) -> BaseGeometry:
    """Return the union of the sidewalks, prepared for queries."""
    pavement = shapely.union_all([Polygon(outline) for outline in town.sidewalks])
    shapely.prepare(pavement)
    return pavement


def number_of(name: str) -> tuple[str, int]:
    """Return the sort key of a name by kind and number: "veh2" before "veh10"."""
    kind = name.rstrip("0123456789")
    return kind, int(name[len(kind) :])


DIFFERENCE_S = 0.3  # step of the central differences along an actor's path, longer than crossing a triangle's edge


class OnRelief(NamedTuple):
    """The motion of A actors on a relief at T instants, world frame; NaN where absent."""

    height: Array  # (T, A) height of the ground under the actors [m]
    tilt: Array  # (T, A, 2) pitch and roll [rad]
    velocity: Array  # (T, A, 3) [m/s]
    acceleration: Array  # (T, A, 3) [m/s^2]


def stand_on_relief(
    heights: Callable[[Array, Array], Array],
    centre: Array,
    yaw: Array,
    velocity: Array,
    acceleration: Array,
    size: Array,
    upright: Mask,
) -> OnRelief:
    """Return the motion of actors on a relief, given their motion in plan, world frame.

    `heights` gives the heights [m] of the surfaces that the actors are on, at x, y (T, A) [m]. `centre` is (T, A, 2)
    [m], `yaw` (T, A) [rad], `velocity` (T, A, 3) [m/s], `acceleration` (T, A, 3) [m/s^2], `size` (A, 3) [m]. Actors
    that are `upright` (A,) do not tilt.
    """

    def height_at(time_s: float) -> Array:
        moved = centre + time_s * velocity[..., :2] + time_s**2 / 2 * acceleration[..., :2]
        x, y = moved[..., 0], moved[..., 1]
        return np.where(upright, heights(x, y), find_tilts(heights, x, y, yaw, size)[0])

    _, pitch, roll = find_tilts(heights, centre[..., 0], centre[..., 1], yaw, size)
    tilt = np.where(upright[:, None], 0.0, np.stack((pitch, roll), axis=2))
    tilt[np.isnan(yaw)] = np.nan
    before, now, after = (height_at(time_s) for time_s in (-DIFFERENCE_S, 0.0, DIFFERENCE_S))
    climb = (after - before) / (2 * DIFFERENCE_S)
    change = (after - 2 * now + before) / DIFFERENCE_S**2
    return OnRelief(
        now,
        tilt,
        np.concatenate((velocity[..., :2], climb[..., None]), axis=2),
        np.concatenate((acceleration[..., :2], change[..., None]), axis=2),
    )
